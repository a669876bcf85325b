// The slider along the path: the eye takes the camera's place, its picture stands beside.

const find = id => document.getElementById(id);

export class TimeLine {
  constructor(eye, changed) {
    Object.assign(this, { eye, changed, rows: new Float32Array(0), scene: null, beside: false, number: -1, shown: "", newest: true });
    find("pose").addEventListener("input", () => this.go(Number(find("pose").value)));
    find("beside").addEventListener("click", () => this.besides(!this.beside));
  }

  get count() { return this.rows.length / 8; }

  setPath(rows, scene) {
    Object.assign(this, { rows, scene });
    find("time").hidden = !this.count || !scene.camera;
    find("pose").max = String(Math.max(0, this.count - 1));
    if (this.newest) find("pose").value = find("pose").max;
    if (this.number < 0 && !scene.live) this.newest = false;
    if (this.number < 0 && !scene.live && scene.pictures.length) find("pose").value = String(scene.pictures[scene.pictures.length >> 1]);
    this.words();
  }

  // A live dive: the newest picture, and its pose if that is looked at.
  setScene(scene) {
    this.scene = scene;
    if (scene.live && this.beside && this.newest && this.count) this.go(this.count - 1);
  }

  // The camera at the slider's pose; the newest is as new as the picture. Null where there is none.
  get camera() {
    const { scene, rows } = this, number = Number(find("pose").value);
    if (!scene?.camera || this.newest || number >= this.count) return scene?.camera ?? null;
    const row = [...rows.subarray(8 * number, 8 * number + 8)];
    return { ...scene.camera, place: row.slice(0, 3), wxyz: row.slice(3, 7) };
  }

  go(number) {
    const { scene, eye } = this;
    this.number = number;
    this.newest = scene.live && number === this.count - 1;
    find("pose").value = String(number);
    const { place, wxyz } = this.camera;
    eye.take(place, wxyz, scene.camera, scene.map ? 0.5 * scene.map.half[0] : 1);
    this.words();
    this.picture();
    this.changed();
  }

  // The eye is moved by hand: it is no camera's any more.
  leave() { this.number = -1; }

  besides(on) {
    this.beside = on;
    find("beside").setAttribute("aria-pressed", String(on));
    find("seen").hidden = !on;
    if (on) this.go(Number(find("pose").value));
    this.changed();
  }

  words() {
    const number = Number(find("pose").value);
    find("where").textContent = `pose ${number + 1} of ${this.count}${this.newest ? ", now" : ""}`;
  }

  // The picture of that pose, else the nearest one that is kept.
  picture() {
    if (!this.beside) return;
    const { scene, number } = this;
    let [address, words] = ["", "No picture of this dive is kept."];
    if (scene.live) {
      [address, words] = [scene.camera.picture ? `/picture/newest?${scene.camera.number}` : "", this.newest ? "now" : "now; the map beside is seen from an earlier pose"];
    } else if (scene.pictures.length) {
      const nearest = scene.pictures.reduce((best, i) => Math.abs(i - number) < Math.abs(best - number) ? i : best);
      [address, words] = [`/picture/${nearest}`, nearest === number ? `pose ${number + 1}` : `of pose ${nearest + 1}: the nearest picture that is kept`];
    }
    find("caption").textContent = words;
    if (address === this.shown) return;
    this.shown = address;
    find("picture").hidden = !address;
    if (address) find("picture").src = address;
  }
}

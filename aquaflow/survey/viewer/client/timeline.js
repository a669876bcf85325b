// The slider along the path: the eye takes the camera's place, its picture stands beside.

import { ROW } from "./marks.js";

const SECONDS = 8, DEPTH = 9, HEADING = 10, PICTURE = 11, TAKEN = 12; // of a row, see aquaflow/survey/viewer/moments.py
const SAME_S = 0.005; // a picture that is so close to a pose is its own
const find = id => document.getElementById(id);
const two = number => String(Math.floor(number)).padStart(2, "0");

// Minutes and seconds since the first pose, with hours where there are any.
export function clock(seconds) {
  const [h, m, s] = [seconds / 3600, seconds / 60 % 60, seconds % 60];
  return h >= 1 ? `${Math.floor(h)}:${two(m)}:${two(s)}` : `${Math.floor(m)}:${two(s)}`;
}

export class TimeLine {
  constructor(eye, changed) {
    Object.assign(this, { eye, changed, rows: new Float32Array(0), scene: null, beside: false, number: -1, shown: null, newest: true });
    find("pose").addEventListener("input", () => this.go(Number(find("pose").value)));
    find("beside").addEventListener("click", () => this.besides(!this.beside));
  }

  get count() { return this.rows.length / ROW; }

  setPath(rows, scene) {
    const first = this.number < 0 && !this.count;
    Object.assign(this, { rows, scene });
    find("time").hidden = !this.count || !scene.camera;
    find("pose").max = String(Math.max(0, this.count - 1));
    if (first && !scene.live) {
      this.newest = false;
      find("pose").value = String(this.count >> 1);
    }
    if (this.newest) find("pose").value = find("pose").max;
    this.words();
  }

  // The dive that a pose is of, where the path has several: its name, first pose, begin and lens.
  part(number) { return this.scene?.path.parts.findLast(each => each.first <= number) ?? null; }

  // Number of the last pose of the same dive.
  last(number) { return (this.scene.path.parts.find(each => each.first > number)?.first ?? this.count) - 1; }

  // A live dive: the newest picture, and its pose if that is looked at.
  setScene(scene) {
    this.scene = scene;
    if (scene.live && this.beside && this.newest && this.count) this.go(this.count - 1);
  }

  // The camera at the slider's pose; the newest is as new as the picture. Null where there is none.
  get camera() {
    const { scene, rows } = this, number = Number(find("pose").value);
    if (!scene?.camera || this.newest || number >= this.count) return scene?.camera ?? null;
    const row = [...rows.subarray(ROW * number, ROW * number + 7)];
    return { ...scene.camera, ...this.part(number), place: row.slice(0, 3), wxyz: row.slice(3, 7) };
  }

  go(number) {
    const { scene, eye } = this;
    this.number = number;
    this.newest = scene.live && number === this.count - 1;
    find("pose").value = String(number);
    const camera = this.camera;
    eye.take(camera.place, camera.wxyz, camera, scene.map ? 0.5 * scene.map.half[0] : 1);
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

  began(number) { return (this.part(number) ?? this.scene).began; }

  // What is known of a moment: UTC where the dive knows it, else the time since the first pose.
  moment(number, seconds) {
    const began = this.began(number);
    if (!Number.isFinite(seconds)) return `pose ${number + 1} of ${this.count}`;
    if (began) return `${new Date(Date.parse(began) + 1000 * seconds).toISOString().slice(11, 19)} UTC`;
    return clock(seconds);
  }

  words() {
    const number = Math.min(Number(find("pose").value), this.count - 1);
    if (number < 0) return;
    const at = k => this.rows[ROW * number + k], parts = [this.moment(number, at(SECONDS))];
    if (!this.began(number) && Number.isFinite(at(SECONDS))) parts[0] += ` of ${clock(this.rows[ROW * this.last(number) + SECONDS])}`;
    if (this.newest) parts[0] += ", now";
    if (this.part(number)) parts.unshift(this.part(number).name);
    if (Number.isFinite(at(DEPTH))) parts.push(`${at(DEPTH).toFixed(1)} m deep`);
    if (Number.isFinite(at(HEADING))) parts.push(this.heading(Math.round(at(HEADING)) % 360));
    find("where").textContent = parts.join(" \u00b7 ");
  }

  // Of a compass, or of what x points to where no compass was heard.
  heading(degrees) {
    const { north } = this.scene;
    return north.endsWith("north") ? `heading ${degrees}\u00b0` : north ? `${degrees}\u00b0 from the ${north}` : `turned ${degrees}\u00b0`;
  }

  // The picture of that pose, else the nearest one that is kept.
  picture() {
    if (!this.beside) return;
    const { scene, number, rows } = this, at = k => rows[ROW * number + k];
    let [address, words] = ["", "No picture of this dive is kept."];
    if (this.newest) {
      [address, words] = [scene.camera.picture ? `/picture/newest?${scene.camera.number}` : "", "now"];
    } else if (Number.isFinite(at(PICTURE))) {
      const apart = at(TAKEN) - at(SECONDS), taken = this.moment(number, at(TAKEN));
      [address, words] = [`/picture/${at(PICTURE)}`, Math.abs(apart) < SAME_S ? taken : `of ${taken}: ${Math.abs(apart).toFixed(1)} s ${apart < 0 ? "before" : "after"} this pose`];
    }
    find("caption").textContent = words;
    if (address === this.shown) return;
    this.shown = address;
    find("picture").hidden = !address;
    if (address) find("picture").src = address;
  }
}

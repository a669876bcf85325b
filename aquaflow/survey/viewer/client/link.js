// The address of what is looked at: the eye's place, or the pose of the path, and how it is shown.

const WAIT_MS = 300; // after a movement: browsers allow no address for every picture
const SHOWN = { water: "0", colours: "picture", all: "" }; // controls that a link has, where they are not so
const find = id => document.getElementById(id);
const state = control => control.type === "checkbox" ? control.checked ? "1" : "" : control.value;
const numbers = text => (text ?? "").split(",").map(Number);
const isPlace = place => place.length === 3 && place.every(Number.isFinite);

export class Link {
  constructor(eye, line, looks) {
    Object.assign(this, { eye, line, looks, due: 0 });
    addEventListener("hashchange", () => this.follow());
  }

  get words() {
    const { eye, line } = this, said = new URLSearchParams();
    const place = at => at.map(v => Number(v.toFixed(4))).join();
    if (line.number >= 0) said.set("pose", String(line.number));
    else {
      said.set("at", place(eye.place));
      said.set("to", place(eye.target));
    }
    for (const [id, usual] of Object.entries(SHOWN)) if (state(find(id)) !== usual) said.set(id, state(find(id)));
    if (this.looks.cropWords) said.set("crop", this.looks.cropWords);
    return said.toString().replaceAll("%2C", ",");
  }

  // Puts the view into the address, without a step of the browser's history.
  tell() {
    clearTimeout(this.due);
    this.due = setTimeout(() => history.replaceState(null, "", `#${this.words}`), WAIT_MS);
  }

  // Shows what such words say, also where the address says the same but the eye was moved since.
  go(words) {
    history.replaceState(null, "", `#${words}`);
    this.follow();
  }

  // Shows what the address says; false where it says no view.
  follow() {
    clearTimeout(this.due); // what is looked at until now is no longer asked for
    const said = new URLSearchParams(location.hash.slice(1)), { eye, line } = this;
    const [at, to, pose] = [numbers(said.get("at")), numbers(said.get("to")), Number(said.get("pose") ?? NaN)];
    if (Number.isInteger(pose) && pose >= 0 && pose < line.count) {
      line.newest = false;
      find("pose").value = String(pose);
      line.go(pose);
    } else if (isPlace(at) && isPlace(to)) {
      line.leave();
      eye.look(at, to);
    } else return false;
    this.looks.cropWords = said.get("crop") ?? "";
    for (const [id, usual] of Object.entries(SHOWN)) {
      const control = find(id), before = control.value, wanted = said.get(id) ?? usual;
      if (control.type === "checkbox") control.checked = Boolean(wanted);
      else control.value = wanted;
      if (!control.value) control.value = before; // a colouring that this map has not
      control.dispatchEvent(new Event(control.type === "range" ? "input" : "change"));
    }
    return true;
  }
}

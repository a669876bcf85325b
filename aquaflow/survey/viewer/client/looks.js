// How the map is coloured and what of it is shown: water, its range, colourings, distance, divider.

const MOST_WATER = 3; // times the range from which most of the map was seen
const OPEN = [[-Infinity, -Infinity, -Infinity], [Infinity, Infinity, Infinity]]; // the box that keeps all
const FAR = 1e30; // of an open side, for what draws
const find = id => document.getElementById(id);
export const rounded = (value, unit) => `${Number(value.toPrecision(2))} ${unit}`;

// RGBA of the 256 values of a palette.
export function colours({ stops, words }) {
  const rows = new Uint8Array(1024);
  for (let i = 0; i < 256; i++) {
    const at = words.length ? Math.min(i, stops.length - 1) : i / 255 * (stops.length - 1);
    const k = Math.min(Math.floor(at), stops.length - 2 < 0 ? 0 : stops.length - 2), share = at - k;
    const next = stops[Math.min(k + 1, stops.length - 1)];
    for (let c = 0; c < 3; c++) rows[4 * i + c] = Math.round(stops[k][c] + share * (next[c] - stops[k][c]));
    rows[4 * i + 3] = 255;
  }
  return rows;
}

export class Looks {
  constructor(changed) {
    Object.assign(this, { changed, about: null, unit: "", drawing: null, offered: "", box: OPEN, cropped: () => {} });
    find("wipe").addEventListener("change", () => this.wipe());
    for (const id of ["water", "through", "within"]) find(id).addEventListener("input", () => this.apply());
    for (const id of ["colours", "all"]) find(id).addEventListener("change", () => this.apply());
  }

  get wiping() { return find("wipe").checked; }

  // What of the map is shown, for who points at it.
  get shown() { return { all: find("all").checked, box: this.box }; }

  // Keeps what lies in a box: its lowest and highest coordinates; all without one.
  crop(box) {
    this.box = box ?? OPEN;
    this.cropped();
    this.apply();
  }

  // The box as words of an address, an open side as none; empty where all is kept.
  get cropWords() {
    const sides = this.box.flat();
    return sides.some(Number.isFinite) ? sides.map(v => Number.isFinite(v) ? Number(v.toFixed(4)) : "").join() : "";
  }

  set cropWords(words) {
    const sides = words.split(","), box = OPEN.map((open, k) => open.map((v, axis) => Number(sides[3 * k + axis] || v)));
    this.crop(sides.length === 6 && !box.flat().some(Number.isNaN) ? box : null);
  }

  begin(drawing, placeDivider) { Object.assign(this, { drawing, placeDivider }); }

  wipe() {
    for (const id of ["divider", "sides"]) find(id).hidden = !this.wiping;
    find("water").disabled = this.wiping;
    this.drawing.look.wipe = null;
    if (this.wiping) {
      find("colours").value = "picture";
      this.placeDivider();
    }
    this.apply();
  }

  // The choices that this map has.
  offer(about, unit, metres) {
    Object.assign(this, { about, unit, metres });
    find("water-part").hidden = !about.water;
    find("floaters").hidden = !about.floaters;
    find("floaters").lastElementChild.textContent = about.floaters === 1 ? "one that floats is hidden" : `${about.floaters} that float are hidden`;
    find("within-part").hidden = !("range" in about.palettes);
    const names = about.levels.filter(name => name in about.palettes), offered = names.join();
    if (offered !== this.offered) {
      this.offered = offered;
      const chosen = find("colours").value;
      const options = [["picture", "as a picture"], ...names.map(name => [name, about.palettes[name].label])];
      find("colours").replaceChildren(...options.map(([value, text]) => new Option(text, value)));
      if (options.some(([value]) => value === chosen)) find("colours").value = chosen;
    }
    this.apply();
  }

  apply() {
    const { about, unit, drawing } = this, look = drawing.look, name = find("colours").value;
    look.all = find("all").checked;
    find("crop").firstElementChild.textContent = this.cropWords ? "Crop: on" : "Crop";
    [look.low, look.high] = this.box.map(corner => corner.map(v => Math.max(-FAR, Math.min(FAR, v))));
    look.water = Number(find("water").value) / 100;
    find("water-value").textContent = `${find("water").value} %`;
    if (about.water) {
      look.through = MOST_WATER * about.water.range * (Number(find("through").value) / 100) ** 1.58; // half way: that range
      find("through-value").textContent = rounded(this.metres * look.through, unit);
    }
    look.level = name === "picture" ? -1 : about.levels.indexOf(name);
    if (look.level >= 0 && this.wiping) { find("wipe").checked = false; return this.wipe(); }
    if (look.level >= 0) drawing.colours(colours(about.palettes[name]));
    this.legend(about.palettes[name]);
    const range = about.palettes.range, within = Number(find("within").value);
    look.rangeLevel = range && within < 255 ? about.levels.indexOf("range") : -1;
    look.within = within;
    if (range) find("within-value").textContent = within < 255 ? rounded(range.largest * within / 255, unit) : "any distance";
    this.changed();
  }

  legend(palette) {
    const parts = !palette ? [] : palette.words.length
      ? palette.words.map((word, i) => [palette.stops[i], word])
      : palette.stops.map((stop, i, all) => [stop, rounded(palette.largest * i / (all.length - 1), palette.unit)]);
    find("legend").replaceChildren(...parts.map(([stop, word]) => {
      const row = document.createElement("li"), patch = document.createElement("i");
      patch.style.background = `rgb(${stop.join()})`;
      row.append(patch, word);
      return row;
    }));
  }
}

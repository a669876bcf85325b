// The sides of the box that is kept of the map: two sliders for each axis of the world.

import { rounded } from "./looks.js";

const STEPS = 200; // of a slider; at its end the box is open
const REACH = 1.25; // of a slider, of the box that holds nearly all of the map

export class Crop {
  // `up` is one of the world's axes or its opposite, so that sides are level or upright.
  constructor(place, looks, { up, unit, metres }) {
    Object.assign(this, { place, looks, unit, metres });
    const vertical = up.findIndex(v => v !== 0), others = [0, 1, 2].filter(axis => axis !== vertical);
    const axes = [[vertical, Math.sign(up[vertical]), "Height"], ...others.map(axis => [axis, 1, "xyz"[axis]])];
    this.sides = axes.flatMap(([axis, sign, name]) => [["from", -1], ["to", 1]].map(([word, end]) => this.side(axis, sign, `${name} ${word}`, end)));
    const all = document.createElement("button");
    all.textContent = "Keep all";
    all.addEventListener("click", () => looks.crop(null));
    place.replaceChildren(...this.sides.map(side => side.label), all);
    looks.cropped = () => this.show();
    this.show();
  }

  // `end`: -1 for the least value along `sign` times the axis, 1 for the largest.
  side(axis, sign, name, end) {
    const label = document.createElement("label"), value = document.createElement("output"), input = document.createElement("input");
    Object.assign(input, { type: "range", min: "0", max: String(STEPS) });
    input.dataset.side = name;
    label.append(`${name} `, value, input);
    const side = { axis, sign, end, label, value, input };
    input.addEventListener("input", () => this.move(side));
    return side;
  }

  // [low or high of the looks' box, what a slider's middle is, half of its way]
  of({ axis, sign, end }) {
    const { middle, half } = this.looks.about;
    return [sign * end < 0 ? 0 : 1, middle[axis], REACH * half[axis] * sign];
  }

  move(side) {
    const [which, middle, half] = this.of(side), box = this.looks.box.map(corner => [...corner]), at = Number(side.input.value);
    const open = at === (side.end < 0 ? 0 : STEPS);
    box[which][side.axis] = open ? (which ? Infinity : -Infinity) : middle + half * (2 * at / STEPS - 1);
    this.looks.crop(box);
  }

  show() {
    for (const side of this.sides) {
      const [which, middle, half] = this.of(side), bound = this.looks.box[which][side.axis], open = !Number.isFinite(bound);
      const at = open ? (side.end < 0 ? 0 : STEPS) : Math.round(STEPS / 2 * (1 + (bound - middle) / half));
      if (document.activeElement !== side.input || open) side.input.value = String(at);
      side.value.textContent = open ? "open" : rounded(this.metres * side.sign * bound, this.unit);
    }
  }
}

// Draws the map: by WebGPU where the browser gives a device, else by WebGL 2. What a device cannot
// draw in time is left out, the least first.

import { WebGl } from "./webgl.js";

const MOVING_MS = 60, STILL_MS = 2500; // of one picture, while the eye moves and when it rests
const FEWEST = 12000; // that are drawn on however slow a device
const FIRST = 4000; // that are drawn before it is known how slow the device is: a second on a busy processor
const SHARPEST = 1.5; // device pixels for each of CSS: more cost a tablet its smoothness
const DARK = [0.067, 0.094, 0.114];
const NONE = [0, 0, 0], ONE = [1, 1, 1];
const CLEAR = {
  beta: NONE, B_inf: NONE, b: NONE, B_res: NONE, d: NONE, lamp: [0, 0, 1], gain: ONE, white: ONE, compression: 0, shown_compression: 0,
};

// Null where the browser has no WebGPU: then its part of the page is not asked for.
const onGpu = async canvas => navigator.gpu ? (await import("./webgpu.js")).WebGpu.on(canvas) : null;

export class Drawing {
  // `drawn(drawing)` is called after each picture.
  constructor(canvas, drawn) {
    Object.assign(this, { canvas, drawn, about: null, next: null, count: 0, detail: 0, began: null, moving: false });
    this.look = { water: 0, through: 1, wipe: null, level: -1, rangeLevel: -1, within: 255, all: false, low: [-1e30, -1e30, -1e30], high: [1e30, 1e30, 1e30] };
    this.cost_us = 5; // of a Gaussian; measured from the first picture on
  }

  static async on(canvas, drawn) {
    const drawing = new Drawing(canvas, drawn);
    const webgpu = await onGpu(canvas).catch(error => console.warn(error));
    drawing.renderer = webgpu ?? new WebGl(drawing);
    webgpu?.device.lost.then(({ message }) => { console.warn(message); drawing.replaceDevice(); })
      .catch(({ message }) => drawing.canvas.replaceWith(message));
    return drawing;
  }

  // WebGL goes on where WebGPU lost its device, on a new canvas: one has one kind of context for ever.
  replaceDevice() {
    const canvas = this.canvas.cloneNode();
    this.canvas.replaceWith(canvas);
    Object.assign(this, { canvas, began: null, wanted: true });
    this.renderer = new WebGl(this);
    for (const map of new Set([this.shown, this.next].filter(Boolean))) {
      const { parts, count } = map.room;
      map.room = this.renderer.room(count);
      for (const part of parts.values()) this.renderer.put(map.room, ...part);
    }
    if (this.shown) this.renderer.show(this.shown.room);
    if (this.palette) this.renderer.colours(this.palette);
  }

  // Room for a map and its tiles, which is shown from its first chunk on if none is there, else when it is whole.
  begin(about) {
    if (this.next && this.next !== this.shown) this.renderer.free(this.next.room);
    this.next = { about, room: this.renderer.room(Math.max(about.count, about.tiles?.budget ?? 0)), count: 0 };
    if (!this.about) this.swap();
  }

  put(part, first, end) {
    const into = this.next;
    this.renderer.put(into.room, part, first, end);
    into.count = end;
    if (into.about === this.about) this.count = end;
    else if (end === into.about.count) this.swap();
    this.wanted = true;
  }

  // Puts others in place of those from `first` on.
  replace(part, first) {
    this.renderer.put(this.shown.room, part, first, first + part.places.length / 3);
    this.wanted = true;
  }

  swap() {
    if (this.shown) this.renderer.free(this.shown.room);
    this.shown = this.next;
    this.renderer.show(this.shown.room);
    Object.assign(this, { about: this.shown.about, count: this.shown.count, detail: 0, wanted: true });
  }

  // One colour for each of the 256 values of a level.
  colours(rows) {
    this.palette = rows;
    this.renderer.colours(rows);
  }

  // How many are drawn now: as many as the device draws in time; what that is, the first chunk tells.
  get limit() {
    if (this.shownAt === undefined) return Math.min(this.count, this.first + FIRST);
    return Math.min(Math.max(this.count, this.detail), this.inTime(this.moving ? MOVING_MS : STILL_MS));
  }

  // How many could be drawn while the eye rests.
  get most() { return this.inTime(STILL_MS); }

  inTime(ms) { return Math.max(FEWEST, Math.round(ms * 1000 / this.cost_us / (this.look.wipe === null ? 1 : 2))); }

  // The first ones are those that float, which are hidden until they are asked for.
  get first() { return this.look.all ? 0 : this.about.floaters; }

  // Whether what is on the screen is the last word.
  get still() { return !this.wanted && !this.late && this.began === null && !this.renderer.sorting; }

  get nearest() { return 0.005 * Math.max(...this.about.half); }

  // Called once for each picture of the screen.
  turn(eye) {
    if (!this.about || !this.count || this.began !== null && !this.finished()) return;
    if (!this.wanted) {
      if (this.late) this.paint(); // from where the order was asked for: another one would be late again
      return;
    }
    this.wanted = false;
    this.eye = { place: [...eye.place], axes: eye.axes.map(axis => [...axis]) };
    this.optics = eye.optics(this.canvas.clientWidth, this.canvas.clientHeight);
    this.renderer.sort?.(this);
    this.paint();
  }

  paint() {
    const painted = this.renderer.paint(this.view());
    if (!painted) return;
    Object.assign(this, { painted, began: performance.now(), late: false });
    this.drawn(this);
  }

  // There is another order: it is for the next picture, or for this one once that is on the screen.
  ordered() {
    if (this.began === null) this.paint();
    else this.late = true;
  }

  // All that a picture depends on, in the canvas' pixels.
  view() {
    const ratio = Math.min(devicePixelRatio, SHARPEST), { canvas, about, look, eye } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map(v => Math.max(1, Math.round(v * ratio)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const [fx, fy, cx, cy] = ["fx", "fy", "cx", "cy"].map(name => this.optics[name] * ratio);
    const B = about.water?.B_inf, at = Math.round(look.wipe * width);
    const side = (left, right, water) => ({
      left, width: right - left, water,
      background: DARK.map((v, k) => B && look.level < 0 ? v + water * (B[k] - v) : v),
    });
    const sides = look.wipe === null ? [side(0, width, B ? look.water : 0)] : [side(0, at, 1), side(at, width, 0)];
    const { nearest, limit, first } = this, water = about.water ?? CLEAR;
    return { about, look, eye, width, height, fx, fy, cx, cy, sides, water, nearest, first, count: limit, grown: this.grown() };
  }

  // While some are missing, those that are there grow by part of what these would cover.
  grown() {
    const { ends, covered, count } = this.about, limit = Math.min(this.limit, count);
    const k = ends.findIndex(end => end >= limit), before = k > 0 ? ends[k - 1] : 0;
    const [low, high] = [k > 0 ? covered[k - 1] : 0, covered[k]];
    const share = low + (high - low) * (limit - before) / Math.max(1, ends[k] - before);
    return Math.min(2.5, Math.max(share, 1e-3) ** -0.5);
  }

  // Whether the last picture is on the screen; learns what a Gaussian costs.
  finished() {
    if (this.renderer.busy) return false;
    const cost = 1000 * (performance.now() - this.began) / Math.max(this.painted, FIRST) / (this.look.wipe === null ? 1 : 2);
    this.began = null;
    this.cost_us += (this.shownAt === undefined ? 1 : 0.5) * (cost - this.cost_us);
    if (this.shownAt === undefined) {
      this.shownAt = performance.now();
      this.wanted = true;
    }
    return true;
  }
}

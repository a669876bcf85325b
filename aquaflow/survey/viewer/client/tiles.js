// The detail of a large map where the eye is (aquaflow/survey/viewer/map_tiles.py): parts of tiles come when they
// make a difference on the screen, and go when others do. The base's Gaussians in a tile that is there are hidden.

import { add, dot } from "./camera.js";
import { asked, unpacked, WORDS } from "./load.js";

const ROW = 1024; // Gaussians of a row of the texture: a part takes whole rows, wherever some are free
const FINE_PX = 1.5; // between neighbours on the screen, from which on finer ones are wanted
const LOOK_MS = 200; // between two choices
const ASIDE = 1.2; // half pictures beside the middle up to which a tile counts as seen
const rowsOf = part => Math.ceil(part.count / ROW);

function joined(Kind, parts) {
  const all = new Kind(parts.reduce((sum, part) => sum + part.length, 0));
  parts.reduce((first, part) => { all.set(part, first); return first + part.length; }, 0);
  return all;
}

// A copy whose scales are larger by `steps` of their bytes.
function larger({ words, places }, steps) {
  const copy = { words: words.slice(), places };
  const more = (word, shift) => Math.min(255, (word >>> shift & 255) + steps);
  for (let w = 0; w < copy.words.length; w += WORDS) {
    const [one, two] = [copy.words[w + 1], copy.words[w + 2]];
    copy.words[w + 1] = more(one, 16) << 16 | more(one, 24) << 24;
    copy.words[w + 2] = two & ~0xff | more(two, 0);
  }
  return copy;
}

export class Tiles {
  // `base`: the chunks as they came.
  constructor(drawing, about, base) {
    Object.assign(this, { drawing, about, due: 0, coming: false, covered: "", hiding: new Set(), wanted: [] });
    this.words = joined(Uint32Array, base.map(part => part.words));
    this.places = joined(Float32Array, base.map(part => part.places));
    this.list = about.tiles.list.map((tile, number) => {
      const size = tile.high.map((high, k) => high - tile.low[k]), [, one, two] = [...size].sort((a, b) => a - b);
      const made = { ...tile, number, area: Math.max(one * two, 1e-12), radius: Math.hypot(...size) / 2, inBase: 0, placed: 0 };
      made.centre = tile.low.map((low, k) => low + size[k] / 2);
      made.parts = tile.ends.map((end, k) => ({ tile: made, number: k, count: end - (tile.ends[k - 1] ?? 0), rows: null }));
      return made;
    });
    // A slow device draws a part of the base alone, and tiles in place of the rest.
    const all = Math.floor(about.count / ROW), first = Math.max(1, Math.min(all, Math.floor(drawing.most / 2 / ROW)));
    this.first = first;
    this.free = Array.from({ length: Math.floor(about.tiles.budget / ROW) - first }, (_, k) => first + k);
    this.owners = this.findOwners();
    this.owners.slice(0, ROW * first).forEach(tile => { if (tile) tile.inBase++; });
  }

  // The tile that each Gaussian of the base lies in.
  findOwners() {
    const { list, places, about } = this, owners = new Array(about.count), slack = 1e-3;
    const bounds = Float64Array.from(list.flatMap(({ low, high }) => [...low.map(v => v - slack), ...high.map(v => v + slack)]));
    for (let i = 0; i < about.count; i++) {
      const x = places[3 * i], y = places[3 * i + 1], z = places[3 * i + 2];
      for (let k = 0, b = 0; k < list.length; k++, b += 6) {
        if (x < bounds[b] || x > bounds[b + 3] || y < bounds[b + 1] || y > bounds[b + 4] || z < bounds[b + 2] || z > bounds[b + 5]) continue;
        owners[i] = list[k];
        break;
      }
    }
    return owners;
  }

  // How many parts are drawn.
  get shown() { return this.list.reduce((sum, tile) => sum + tile.placed, 0); }

  // Called once for each picture of the screen.
  look(eye) {
    const now = performance.now(), { drawing } = this;
    if (drawing.about !== this.about || drawing.shownAt === undefined) return;
    this.cover();
    if (now < this.due || drawing.moving) return;
    this.due = now + LOOK_MS;
    this.wanted = this.choose(eye);
    const next = this.wanted.find(part => !part.rows);
    if (next?.words) this.place(next);
    else if (next && !this.coming) this.get(next);
  }

  // The parts that are wanted from there, the most urgent first, as many as there is room and time for.
  choose(eye) {
    const { drawing, about, first } = this, { clientWidth, clientHeight } = drawing.canvas;
    const optics = eye.optics(clientWidth, clientHeight), found = [];
    for (const tile of this.list) {
      if (!this.sees(tile, eye, optics, clientWidth, clientHeight)) continue;
      const away = Math.hypot(...eye.place.map((v, k) => Math.max(tile.low[k] - v, v - tile.high[k], 0)));
      const apart = count => optics.fx * Math.sqrt(tile.area / Math.max(count, 1)) / Math.max(away, drawing.nearest);
      tile.parts.forEach((part, k) => {
        const px = apart(k ? tile.ends[k - 1] : tile.inBase);
        if (px > FINE_PX) found.push({ part, px });
      });
    }
    this.last = Math.floor(Math.min(about.tiles.budget, drawing.most) / ROW);
    let room = this.last - first;
    const wanted = found.sort((a, b) => b.px - a.px).map(({ part }) => part);
    const end = wanted.findIndex(part => (room -= rowsOf(part)) < 0);
    return end < 0 ? wanted : wanted.slice(0, end);
  }

  sees({ centre, radius }, eye, { fx, fy }, width, height) {
    const [x, y, z] = eye.axes.map(axis => dot(axis, add(centre, eye.place, -1))), far = Math.max(z + radius, 0);
    return z > -radius && Math.abs(x) - radius < ASIDE * far * width / (2 * fx) && Math.abs(y) - radius < ASIDE * far * height / (2 * fy);
  }

  async get(part) {
    this.coming = true;
    try {
      const { tile, number, count } = part;
      const answer = await asked(`/tile/${this.about.version}/${tile.number}/${number}`);
      const code = { ...this.about, middle: tile.middle, half: tile.half };
      Object.assign(part, unpacked(await answer.arrayBuffer(), count, code));
      if (this.drawing.about === this.about) this.place(part);
    } catch (error) {
      console.warn(error.message);
      this.due = performance.now() + 10 * LOOK_MS;
    } finally { this.coming = false; }
  }

  // Draws a part from now on, in place of parts that nobody wants any more.
  place(part) {
    const spare = this.list.flatMap(tile => tile.parts).filter(other => other.rows && !this.wanted.includes(other));
    const lacks = () => (this.free[rowsOf(part) - 1] ?? Infinity) >= this.last; // what lies behind is not drawn in time
    while (lacks() && spare.length) this.drop(spare.pop());
    if (lacks()) return;
    part.rows = this.free.splice(0, rowsOf(part));
    part.tile.placed++;
    for (const each of part.tile.parts) if (each.rows) this.put(each);
    this.settle();
  }

  drop(part) {
    const { rows, tile } = part;
    this.free = [...this.free, ...rows].sort((a, b) => a - b);
    Object.assign(part, { rows: null, words: null, places: null });
    tile.placed--;
    for (const row of rows) this.putBase(row);
    for (const each of tile.parts) if (each.rows) this.put(each);
    this.settle();
  }

  // What the base has in a row that no part takes, without what lies in tiles that are there.
  putBase(row) {
    const words = new Uint32Array(WORDS * ROW), places = new Float32Array(3 * ROW).fill(NaN);
    words.set(this.words.subarray(WORDS * ROW * row, WORDS * ROW * (row + 1)));
    places.set(this.places.subarray(3 * ROW * row, 3 * ROW * (row + 1)));
    for (let i = 0; i < ROW; i++) {
      if (!this.hiding.has(this.owners[ROW * row + i])) continue;
      words[WORDS * i + 2] &= ~0xff00; // opacity
      places.fill(NaN, 3 * i, 3 * i + 3);
    }
    this.drawing.replace({ words, places }, ROW * row);
  }

  // Puts a part into its rows: larger while the finer ones of its tile are missing.
  put(part) {
    const { tile, rows } = part, [low, high] = this.about.log_scales;
    const alone = part.number === 0 && tile.placed < tile.parts.length;
    const drawn = alone ? larger(part, Math.round(255 * Math.log(tile.grown) / (high - low))) : part;
    rows.forEach((row, k) => {
      const words = new Uint32Array(WORDS * ROW), places = new Float32Array(3 * ROW).fill(NaN);
      words.set(drawn.words.subarray(WORDS * ROW * k, WORDS * ROW * (k + 1)));
      places.set(drawn.places.subarray(3 * ROW * k, 3 * ROW * (k + 1)));
      this.drawing.replace({ words, places }, ROW * row);
    });
  }

  // Draws as many rows as are taken.
  settle() {
    const { taken } = this;
    this.drawing.detail = taken.length ? ROW * (Math.max(...taken) + 1) : 0;
  }

  // Hides the base where tiles are there; nowhere while the eye moves too fast for all of these to be drawn.
  cover() {
    const { drawing } = this, there = drawing.limit < drawing.detail ? [] : this.list.filter(tile => tile.placed);
    const said = there.map(tile => tile.number).join();
    if (said === this.covered) return;
    Object.assign(this, { covered: said, hiding: new Set(there) });
    const taken = new Set(this.taken);
    for (let row = 0; ROW * row < this.about.count; row++) if (!taken.has(row)) this.putBase(row);
  }

  // The rows of all parts.
  get taken() { return this.list.flatMap(tile => tile.parts.flatMap(part => part.rows ?? [])); }
}

// What lies over the map: path, camera, measured points and notes, on a canvas of its own.

import { add, axesOf } from "./camera.js";

export const ROW = 13; // numbers of a pose: place, rotation, quality, and five of its moment
const LONGEST = 2000; // poses of the path that are drawn
const COVERED = 0.15, CELL = 16; // share that the path may cover of the cells it crosses, px
const NOTE = "#7fd4ff", MARK = "#ffb454", CAMERA = "#eb7828";
const PATH = ["#8a3ba8", "#2f9fc0", "#f4e04a"]; // pose hardly known, known, well known

export class Marks {
  constructor(canvas) {
    Object.assign(this, { canvas, path: [], camera: null, points: [], closed: false, box: null, notes: [], picked: null, size: 1 });
  }

  // Rows of `ROW` numbers; no line is drawn from one of the `parts` to the next.
  setPath(rows, parts) {
    const count = rows.length / ROW, step = Math.max(1, Math.ceil(count / LONGEST));
    this.path = [];
    for (let i = 0; i < count; i += step) {
      const part = parts.filter(each => each.first <= i).length;
      this.path.push({ place: [...rows.subarray(ROW * i, ROW * i + 3)], quality: rows[ROW * i + 7], part });
    }
  }

  // Middle and half of a cube about the path, with room at its ends.
  get extent() {
    const ends = [0, 1, 2].map(k => [Math.min, Math.max].map(end => end(...this.path.map(pose => pose.place[k]))));
    if (!this.path.length) return { middle: [0, 0, 0], half: [1, 1, 1] };
    const half = 0.7 * Math.max(...ends.map(([low, high]) => high - low)) || 1;
    return { middle: ends.map(([low, high]) => (low + high) / 2), half: [half, half, half] };
  }

  draw(eye) {
    const { canvas } = this, ratio = devicePixelRatio;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
    }
    const pen = this.pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const optics = eye.optics(width, height);
    this.at = point => eye.project(point, optics);
    this.nearest = 0.01 * this.size;
    if (!eye.lens) this.drawPath();
    if (this.camera && !eye.lens) this.drawCamera();
    if (eye.lens) this.frame(eye.lens, optics);
    if (this.box) this.drawBox(this.box);
    this.drawPoints();
    this.notes.forEach(note => this.pin(note));
  }

  // The part of the picture that the camera saw.
  frame({ width, height, cx, cy, fx }, optics) {
    const scale = optics.fx / fx;
    this.pen.strokeStyle = "#ffffff80";
    this.pen.lineWidth = 1;
    this.pen.strokeRect(optics.cx - cx * scale, optics.cy - cy * scale, width * scale, height * scale);
  }

  line(a, b, colour, width = 2) { this.stroke(this.at(a), this.at(b), colour, width); }

  stroke(p, q, colour, width) {
    if (p[2] < this.nearest || q[2] < this.nearest) return;
    this.pen.strokeStyle = colour;
    this.pen.lineWidth = width;
    this.pen.beginPath();
    this.pen.moveTo(p[0], p[1]);
    this.pen.lineTo(q[0], q[1]);
    this.pen.stroke();
  }

  // Thinner where lines lie close together: the map is to be seen between them.
  drawPath() {
    const { path } = this, at = path.map(pose => this.at(pose.place)), cells = new Set();
    const lines = [...path.keys()].filter(i => i && path[i].part === path[i - 1].part && at[i][2] >= this.nearest);
    let length = 0;
    for (const i of lines) {
      length += Math.min(CELL, Math.hypot(at[i][0] - at[i - 1][0], at[i][1] - at[i - 1][1]));
      cells.add(Math.floor(at[i][0] / CELL) + 1e6 * Math.floor(at[i][1] / CELL));
    }
    const width = Math.min(2, COVERED * CELL ** 2 * cells.size / length);
    for (const i of lines) this.stroke(at[i - 1], at[i], PATH[Math.max(0, Math.min(2, Math.floor(3 * path[i].quality)))], width);
  }

  drawCamera() {
    const { place, wxyz, width, height, fx, fy, cx, cy } = this.camera, axes = axesOf(wxyz);
    const depth = 0.08 * this.size;
    const corners = [[0, 0], [width, 0], [width, height], [0, height]].map(([u, v]) =>
      [(u - cx) / fx, (v - cy) / fy, 1].reduce((sum, value, k) => add(sum, axes[k], value * depth), place));
    corners.forEach((corner, k) => {
      this.line(place, corner, CAMERA);
      this.line(corner, corners[(k + 1) % 4], CAMERA);
    });
  }

  // Edges between the corners of a box that differ in one axis.
  drawBox(box) {
    const corner = k => [0, 1, 2].map(axis => box[k >> axis & 1][axis]);
    for (let k = 0; k < 8; k++) [1, 2, 4].forEach(bit => k & bit || this.line(corner(k), corner(k | bit), "#ffffff60", 1));
  }

  drawPoints() {
    const places = this.points.map(point => point.place);
    for (let i = 1; i < places.length; i++) this.line(places[i - 1], places[i], MARK, 3);
    if (this.closed && places.length > 2) this.line(places.at(-1), places[0], MARK, 3);
    places.forEach((place, i) => this.disc(place, MARK, String(i + 1)));
  }

  disc(place, colour, text) {
    const [x, y, z] = this.at(place), pen = this.pen;
    if (z < this.nearest) return;
    pen.fillStyle = colour;
    pen.strokeStyle = "#11181d";
    pen.lineWidth = 2;
    pen.beginPath();
    pen.arc(x, y, 7, 0, 7);
    pen.fill();
    pen.stroke();
    this.words(text, x + 10, y - 8, colour);
  }

  pin(note) {
    if (note.shape === "Point") return this.disc(note.places[0], NOTE, note.text);
    note.places.forEach((place, i) => i && this.line(note.places[i - 1], place, NOTE, 2));
    if (note.shape === "Polygon") this.line(note.places.at(-1), note.places[0], NOTE, 2);
    this.disc(note.places[0], NOTE, note.text);
  }

  words(text, x, y, colour) {
    const pen = this.pen, short = text.length > 40 ? `${text.slice(0, 39)}\u2026` : text;
    pen.font = "13px system-ui, sans-serif";
    pen.lineWidth = 4;
    pen.strokeStyle = "#11181dcc";
    pen.strokeText(short, x, y);
    pen.fillStyle = colour;
    pen.fillText(short, x, y);
  }
}

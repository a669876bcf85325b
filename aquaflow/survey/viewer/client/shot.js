// The picture as it is on the screen, as a file: with its marks, a scale bar and an arrow to the north.

import { dot } from "./camera.js";

const INK = "#ffffff", BACK = "#000000b0";
const MARGIN = 16, TALL = 34, ARROW = 34; // CSS pixels
const BAR = 0.25; // of the picture's width at most
const SIDEWAYS = 0.05; // share of north that lies across the eye's direction, at least

// The largest of 1, 2 and 5 times a power of ten up to `length`.
export function rounded(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return Math.max(...[1, 2, 5].map(k => k * power).filter(each => each <= length * 1.001));
}

// A canvas with the picture. `range`: of what lies in its middle, from the eye, where that is known.
export function picture(drawing, marks, eye, scene, range) {
  drawing.paint(); // what WebGL drew is there until this task ends
  marks.draw(eye);
  const map = drawing.canvas, made = document.createElement("canvas"), pen = made.getContext("2d");
  const { clientWidth: width, clientHeight: height } = map;
  Object.assign(made, { width: map.width, height: map.height });
  pen.drawImage(map, 0, 0);
  pen.drawImage(marks.canvas, 0, 0, map.width, map.height);
  pen.scale(map.width / width, map.height / height);
  Object.assign(pen, { font: "13px system-ui, sans-serif", lineWidth: 2, strokeStyle: INK });
  if (range) scaleBar(pen, eye.optics(width, height).fx / range, width, height, scene);
  if (scene.up[2] === -1 && scene.north) northArrow(pen, eye, width, scene.north);
  return made;
}

// `focal`: CSS pixels that a unit of the map takes in the middle of the picture.
function scaleBar(pen, focal, width, height, { unit, metres }) {
  const length = rounded(BAR * width * metres / focal), long = length * focal / metres;
  const text = `${length} ${unit}, in the middle`, [left, top] = [MARGIN, height - MARGIN - TALL];
  pen.fillStyle = BACK;
  pen.fillRect(left, top, Math.max(long, pen.measureText(text).width) + 20, TALL);
  pen.fillStyle = INK;
  pen.fillText(text, left + 10, top + 14);
  pen.beginPath();
  for (const [x, y] of [[0, -5], [0, 0], [long, 0], [long, -5]]) pen.lineTo(left + 10 + x, top + TALL - 6 + y);
  pen.stroke();
}

// None where the eye looks along north.
function northArrow(pen, eye, width, north) {
  const [x, y] = [dot(eye.axes[0], [1, 0, 0]), dot(eye.axes[1], [1, 0, 0])], across = Math.hypot(x, y);
  if (across < SIDEWAYS) return;
  const text = { "true north": "N", "magnetic north": "magnetic N" }[north] ?? north, wide = Math.max(2 * ARROW, pen.measureText(text).width + 20);
  const [left, top, high] = [width - MARGIN - wide, MARGIN, 2 * ARROW + 16];
  pen.fillStyle = BACK;
  pen.fillRect(left, top, wide, high);
  pen.fillStyle = INK;
  pen.textAlign = "center";
  pen.fillText(text, left + wide / 2, top + high - 8);
  pen.translate(left + wide / 2, top + ARROW);
  pen.rotate(Math.atan2(x, -y));
  pen.beginPath();
  for (const [right, down] of [[0, -0.8], [0.35, 0.7], [0, 0.45], [-0.35, 0.7]]) pen.lineTo(right * ARROW, down * ARROW);
  pen.fill();
}

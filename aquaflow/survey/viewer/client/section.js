// A cross-section on a sheet of its own: the Gaussians of a slice square on, with axes, to be saved.

import { rounded } from "./shot.js";

const LEFT = 64, RIGHT = 16, TOP = 40, BOTTOM = 44; // CSS pixels beside the drawing
const WIDEST = 1100, TALLEST = 0.62; // CSS pixels, and share of the window's height
const TICKS = 6; // along the line, about
const FLATTEST = 0.15; // height of the drawing over its length, at least
const SIGMAS = 1.5; // of a Gaussian that are drawn
const PAPER = "#ffffff", INK = "#11181d", GRID = "#d5dde2";

const made = (kind, properties) => Object.assign(document.createElement(kind), properties);

// `name`: of the file that is saved.
export function showSection(section, name) {
  const dialog = made("dialog", { id: "section" }), canvas = made("canvas"), bar = made("p");
  const save = made("button", { textContent: "Save picture" }), close = made("button", { textContent: "Close" });
  bar.append(save, close);
  dialog.append(canvas, bar);
  document.body.append(dialog);
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => dialog.remove());
  save.addEventListener("click", () => made("a", { href: canvas.toDataURL("image/png"), download: `${name}_section.png` }).click());
  draw(canvas, section);
  dialog.showModal();
}

function draw(canvas, section) {
  const { length } = section, ratio = devicePixelRatio, tall = Math.max(section.high - section.low, FLATTEST * length);
  const middle = (section.high + section.low) / 2, [low, high] = [middle - tall / 2, middle + tall / 2];
  const room = [Math.min(WIDEST, innerWidth - 56) - LEFT - RIGHT, TALLEST * innerHeight - TOP - BOTTOM];
  const scale = Math.min(room[0] / length, room[1] / tall); // the same both ways
  const [wide, high_px] = [length * scale, tall * scale], [width, height] = [Math.max(wide, room[0]) + LEFT + RIGHT, high_px + TOP + BOTTOM];
  Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  Object.assign(canvas.style, { width: `${width}px`, height: `${height}px` });
  const pen = canvas.getContext("2d"), x = v => LEFT + scale * v, y = v => TOP + scale * (high - v);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.fillStyle = PAPER;
  pen.fillRect(0, 0, width, height);
  pen.font = "13px system-ui, sans-serif";
  axes(pen, { ...section, low, high }, { x, y, wide, high_px, step: rounded(Math.max(length / TICKS, 60 / scale)) });
  pen.save();
  pen.beginPath();
  pen.rect(LEFT, TOP, wide, high_px);
  pen.clip();
  section.along.forEach((along, i) => ellipse(pen, x(along), y(section.height[i]), scale, section, i));
  pen.restore();
}

function axes(pen, { length, low, high, thickness, unit, upright }, { x, y, wide, high_px, step }) {
  const text = value => String(Number(value.toPrecision(6))), bottom = TOP + high_px;
  Object.assign(pen, { fillStyle: INK, strokeStyle: GRID, lineWidth: 1, textAlign: "center" });
  const line = (...at) => { pen.beginPath(); pen.moveTo(at[0], at[1]); pen.lineTo(at[2], at[3]); pen.stroke(); };
  for (let k = 0; k * step <= length; k++) {
    line(x(k * step), TOP, x(k * step), bottom);
    pen.fillText(text(k * step), x(k * step), bottom + 16);
  }
  pen.textAlign = "right";
  for (let k = Math.ceil(low / step); k * step <= high; k++) {
    line(LEFT, y(k * step), LEFT + wide, y(k * step));
    pen.fillText(text(k * step), LEFT - 6, y(k * step) + 4);
  }
  pen.strokeStyle = INK;
  pen.strokeRect(LEFT, TOP, wide, high_px);
  pen.textAlign = "left";
  pen.fillText(`${upright ? "height" : "towards the eye"}, ${unit}; slice ${text(thickness)} ${unit} thick`, 8, 22);
  pen.fillText(`along the line, ${unit}`, LEFT, bottom + 36);
}

// The ellipse of a Gaussian in the plane of the slice, as wide as half a pixel at least.
function ellipse(pen, x, y, scale, { xx, xy, yy, alpha, rgb }, i) {
  const mean = (xx[i] + yy[i]) / 2, apart = Math.hypot((xx[i] - yy[i]) / 2, xy[i]);
  const radius = variance => Math.max(0.5, SIGMAS * scale * Math.sqrt(Math.max(0, variance)));
  pen.globalAlpha = alpha[i];
  pen.fillStyle = `rgb(${rgb[i].join()})`;
  pen.beginPath();
  pen.ellipse(x, y, radius(mean + apart), radius(mean - apart), -Math.atan2(xy[i], (xx[i] - yy[i]) / 2) / 2, 0, 7);
  pen.fill();
}

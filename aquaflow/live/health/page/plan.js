// The path seen from above, drawn in pixels of its frame: what was seen, grid, path, next line,
// start, vehicle, scale bar.

const SVG = "http://www.w3.org/2000/svg";
const MARGIN_PX = 30, BAR_PX = 16; // the scale bar's own, below the path
const SMALLEST = 0.5; // units across the view: a path of a few millimetres is no path yet
const GRID_PX = 40; // at least, between two lines
const VEHICLE_PX = [[15, 0], [-9, 8], [-5, 0], [-9, -8]]; // seen from above, ahead is +x

function element(name, attributes, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

// The smallest of 1, 2, 5, 10, ... that is at least `length`.
export function roundStep(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return [1, 2, 5, 10].map(factor => factor * power).find(step => step >= length * 0.999);
}

// From units of the map to pixels, the same for both axes; y grows downwards on the screen.
function fitted(points, width, height) {
  const xs = points.map(point => point[0]), ys = points.map(point => point[1]);
  const middle = values => (Math.min(...values) + Math.max(...values)) / 2;
  const span = values => Math.max(Math.max(...values) - Math.min(...values), SMALLEST);
  const scale = Math.min((width - 2 * MARGIN_PX) / span(xs), (height - 2 * MARGIN_PX - BAR_PX) / span(ys));
  const [x0, y0] = [middle(xs), middle(ys)];
  const [px, py] = [width / 2, (height - BAR_PX) / 2];
  const place = ([x, y]) => [px + (x - x0) * scale, py - (y - y0) * scale];
  return { scale, place, left: x0 - px / scale, low: y0 - (height - py) / scale };
}

function grid(view, step, width, height) {
  const lines = [];
  for (let x = Math.ceil(view.left / step) * step; ; x += step) {
    const px = view.place([x, 0])[0];
    if (px > width) break;
    lines.push(element("line", { class: "grid", x1: px, x2: px, y1: 0, y2: height }));
  }
  for (let y = Math.ceil(view.low / step) * step; ; y += step) {
    const py = view.place([0, y])[1];
    if (py < 0) break;
    lines.push(element("line", { class: "grid", x1: 0, x2: width, y1: py, y2: py }));
  }
  return lines;
}

function vehicle(at, ahead) {
  if (ahead === null) return element("circle", { class: "vehicle", cx: at[0], cy: at[1], r: 7 });
  const [c, s] = [ahead[0], -ahead[1]];
  const corners = VEHICLE_PX.map(([x, y]) => `${at[0] + c * x - s * y},${at[1] + s * x + c * y}`);
  return element("polygon", { class: "vehicle", points: corners.join(" ") });
}

function scaleBar(step, unit, scale, height) {
  const [x, y, end] = [12, height - 12, 12 + step * scale];
  const text = `${Number(step.toPrecision(3))} ${unit}`;
  return [
    element("path", { class: "bar", d: `M${x} ${y - 5}V${y}H${end}V${y - 5}` }),
    element("text", { x: x + 5, y: y - 7 }, text),
  ];
}

// The cells as one picture; `to_page` is from its pixels to units of the map.
function cells(number, coverage, view, version) {
  const [[a, c, e], [b, d, f]] = coverage.to_page, k = view.scale, [x, y] = view.place([0, 0]);
  const matrix = [k * a, -k * b, k * c, -k * d, x + k * e, y - k * f];
  const [width, height] = coverage.size;
  return element("image", {
    class: "cells", width, height, href: `coverage/${number}.png?frame=${version}`,
    preserveAspectRatio: "none", transform: `matrix(${matrix.join(" ")})`,
  });
}

// Corners of the cells' picture, in units of the map.
function corners({ to_page: [[a, c, e], [b, d, f]], size: [width, height] }) {
  return [[0, 0], [width, 0], [0, height], [width, height]].map(([u, v]) => [a * u + c * v + e, b * u + d * v + f]);
}

function nextLine([start, end]) {
  const [x, y] = start;
  return [
    element("line", { class: "next", x1: x, y1: y, x2: end[0], y2: end[1] }),
    element("circle", { class: "next-start", cx: x, cy: y, r: 4.5 }),
  ];
}

// Draws `plan` (an entry of sub_maps in /path.json) and `now`, if it is of that sub-map; `version`
// changes when what was seen may have.
export function drawPlan(frame, plan, now, version) {
  const [width, height] = [frame.clientWidth, frame.clientHeight];
  if (!width || !plan.points.length) return;
  const coverage = plan.coverage, next = coverage?.next_line?.places ?? [];
  const around = [...(now ? [now.at] : []), ...(coverage ? corners(coverage) : []), ...next];
  const view = fitted([...plan.points, ...around], width, height);
  const step = roundStep(GRID_PX / view.scale);
  const path = plan.points.map(view.place);
  const drawn = element("svg", {
    viewBox: `0 0 ${width} ${height}`, role: "img",
    "aria-label": `Path of ${plan.points.length} points; up is ${plan.up}`,
  });
  if (coverage) drawn.append(cells(plan.number, coverage, view, version));
  drawn.append(
    ...grid(view, step, width, height),
    element("polyline", { class: "path", points: path.join(" ") }),
    ...(next.length ? nextLine(next.map(view.place)) : []),
    element("circle", { class: "start", cx: path[0][0], cy: path[0][1], r: 4.5 }),
    ...scaleBar(step, plan.unit, view.scale, height),
  );
  if (now) drawn.append(vehicle(view.place(now.at), now.ahead));
  frame.replaceChildren(drawn);
}

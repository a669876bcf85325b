// The page: asks for the dive, shows it, and joins the parts.

import { add, cross, Eye } from "./camera.js";
import { Drawing } from "./draw.js";
import { hands } from "./hands.js";
import { Link } from "./link.js";
import { asked, chunk, loadMap, tell } from "./load.js";
import { Looks } from "./looks.js";
import { Marks } from "./marks.js";
import { Tiles } from "./tiles.js";
import { TimeLine } from "./timeline.js";
import { ToolBox } from "./tools.js";
import { divider } from "./wipe.js";

const ASK_MS = 500; // between two questions for what is new in a live dive
const find = id => document.getElementById(id);
const say = text => { find("said").textContent = text; };

let scene = null, drawing = null, detail = null, looking = false, steered = false, pathShown = -1, loading = false, wrong = "";

const changed = () => {
  if (drawing) drawing.wanted = true;
  else over();
  if (looking) link.tell();
};
// In ms since the address was opened: the script runs, a first chunk is there, a first picture is on
// the screen, the whole map is drawn. And what a Gaussian costs, and whether nothing is left to draw.
const times = window.aquaflowTimes = { script: performance.now(), get first() { return drawing?.shownAt; }, get cost_us() { return drawing?.cost_us; }, get still() { return drawing?.still; }, get tiles() { return detail?.shown; } };
const over = () => {
  marks.camera = line.camera;
  marks.draw(eye);
};
const drawn = () => {
  marks.box = looks.cropWords && looks.box.map((corner, k) => corner.map((v, axis) => {
    const { middle, half } = drawing.about, end = half[axis] * (k ? 1.25 : -1.25);
    return Number.isFinite(v) ? v : middle[axis] + end;
  }));
  over();
  times.whole = drawing.count === scene.map.count ? times.whole ?? performance.now() : undefined;
};
const eye = new Eye([0, -1, 0]), marks = new Marks(find("marks"));
const looks = new Looks(changed), tools = new ToolBox(marks, looks, changed);
const line = new TimeLine(eye, changed);
const link = new Link(eye, line, looks);
window.aquaflowEye = eye; // for who looks at the page from outside, as its tests do

hands(find("marks"), eye, {
  changed: () => { if (drawing) drawing.moving = true; steered = true; line.leave(); changed(); },
  rested: () => { if (drawing) drawing.moving = false; changed(); },
  pointed: (x, y) => {
    const optics = eye.optics(marks.canvas.clientWidth, marks.canvas.clientHeight);
    tools.point({ origin: eye.place, direction: eye.ray(x, y, optics), pixel_rad: 1 / optics.fx });
  },
});
new ResizeObserver(changed).observe(find("view"));

// Behind the path and above it, with the map before the eye, or without one the path.
function home() {
  const { middle, half } = scene.map ?? marks.extent, size = half[0], path = marks.path;
  const mean = path.reduce((sum, pose) => add(sum, pose.place, 1 / path.length), [0, 0, 0]);
  const back = !path.length ? eye.up : scene.map ? add(mean, middle, -1) : cross([1, 0, 0], eye.up);
  const length = Math.hypot(...back) || 1;
  const place = add(add(middle, back, 1.8 * size / length), eye.up, 0.7 * size);
  line.leave();
  eye.look(place, [...middle]);
  changed();
}
find("home").addEventListener("click", home);

// How far away what lies in the middle is, or what the eye turns about where nothing lies there.
async function rangeAhead() {
  const { fx } = eye.optics(marks.canvas.clientWidth, marks.canvas.clientHeight);
  try {
    return (await tell("pick", { origin: eye.place, direction: eye.ahead, pixel_rad: 1 / fx, ...looks.shown })).range;
  } catch { return eye.distance; }
}

find("crop").addEventListener("toggle", async () => {
  const { Crop } = await import("./crop.js"); // comes when it is wanted
  new Crop(find("crop").lastElementChild, looks, scene);
}, { once: true });

find("views").addEventListener("toggle", async () => {
  const { showViews } = await import("./views.js");
  const [place, said] = find("views").querySelectorAll("div, p");
  showViews(place, link, text => { said.textContent = text; });
}, { once: true });

find("shot").addEventListener("click", async () => {
  const { picture } = await import("./shot.js"); // comes when it is wanted
  const made = picture(drawing, marks, eye, scene, await rangeAhead()), save = document.createElement("a");
  Object.assign(save, { href: made.toDataURL("image/png"), download: `${scene.title.replaceAll(/[^\w.-]+/g, "_")}.png` });
  save.click();
});

find("fold").addEventListener("click", () => {
  const open = find("panel").toggleAttribute("data-folded");
  find("fold").setAttribute("aria-expanded", String(!open));
});

// One map after the other: the next one is asked for when this one is whole.
async function showMap(about, coming) {
  const base = []; // of a map with tiles, which hide parts of it
  loading = true;
  try {
    drawing.begin(about);
    marks.size = about.half[0];
    await loadMap(about, coming, (part, first, end) => {
      times.data ??= performance.now();
      if (about.tiles) base.push({ words: part.words, places: part.places.slice() });
      drawing.put(part, first, end);
    });
    detail = about.tiles ? new Tiles(drawing, about, base) : null;
  } finally { loading = false; }
}

async function showPath(path) {
  if (path.number === pathShown) return;
  pathShown = path.number;
  const rows = new Float32Array(await (await asked(`/path/${path.number}`)).arrayBuffer());
  marks.setPath(rows, path.parts);
  line.setPath(rows, scene);
}

async function update() {
  const said = await (await asked("/scene.json")).json();
  if (scene?.live && !said.live) { // the finished dive has other axes and more tools
    history.replaceState(null, "", location.pathname);
    location.reload();
    return;
  }
  scene = said;
  find("health").replaceChildren(...scene.health.split("\n\n").map(text => {
    const part = document.createElement("p");
    part.textContent = text;
    return part;
  }));
  document.title = scene.title;
  eye.up = scene.up;
  const due = scene.map && !loading && drawing?.about?.version !== scene.map.version;
  const coming = due && chunk(scene.map, 0); // on its way while all else is made ready
  await showPath(scene.path);
  line.setScene(scene);
  if (!scene.map) {
    say("There is no map so far.");
    marks.size = marks.extent.half[0];
    if (steered || line.beside) over();
    else home();
    return;
  }
  if (!drawing) await begin();
  looks.offer(scene.map, scene.unit, scene.metres);
  if (!looking) {
    if (!link.follow() && !steered) home();
    looking = true;
  }
  const done = due && showMap(scene.map, coming).catch(error => say(error.message));
  if (!scene.live) await done;
  say("");
}

async function begin() {
  drawing = await Drawing.on(find("map"), drawn);
  looks.begin(drawing, divider(find("divider"), find("view"), share => { drawing.look.wipe = looks.wiping ? share : null; changed(); }));
  tools.offer(scene.can);
  for (const id of ["look", "tools"]) find(id).hidden = false;
  find("views").hidden = !scene.can.includes("view");
  const turn = () => { drawing.turn(eye); detail?.look(eye); requestAnimationFrame(turn); };
  requestAnimationFrame(turn);
}

async function run() {
  for (;;) {
    try {
      await update();
      if (wrong) { wrong = ""; say(""); }
    } catch (error) {
      wrong = error.message;
      say(`The viewer does not answer: ${wrong}`);
    }
    if (scene && !scene.live && !wrong) return;
    await new Promise(later => setTimeout(later, ASK_MS));
  }
}
run();

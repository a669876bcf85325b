// Measuring, notes, the scale bar and level: points on the map, which the server finds and measures.

import { tell } from "./load.js";

const HINTS = {
  distance: "Point at both ends; more points make a line.",
  area: "Point at three or more corners, in their order.",
  profile: "Point at both ends of the profile.",
  note: "Point at where the note belongs.",
  scale: "Point at both ends of a known length.",
  level: "Point at three or more places of something level, far apart.",
};
const MOST = { profile: 2, note: 1, scale: 2 };
const LEAST = { distance: 2, area: 3, profile: 2 };
const THICK = 0.05; // of a cross-section at first, of its length
const find = id => document.getElementById(id);
const number = id => Number(find(id).value.replace(",", "."));

export class ToolBox {
  constructor(marks, looks, changed) {
    Object.assign(this, { marks, looks, changed, tool: null, points: [], quantities: {}, turn: 0, can: [] });
    for (const button of document.querySelectorAll("[data-tool]")) {
      button.addEventListener("click", () => this.choose(this.tool === button.dataset.tool ? null : button.dataset.tool));
    }
    find("again").addEventListener("click", () => this.choose(this.tool));
    for (const [form, work] of [["note", "keepNote"], ["scale", "setScale"], ["level", "setLevel"], ["section", "section"]]) {
      find(`${form}-form`).addEventListener("submit", event => { event.preventDefault(); this.guarded(() => this[work]()); });
    }
  }

  offer(can) {
    this.can = can;
    for (const name of ["note", "scale", "level"]) document.querySelector(`[data-tool=${name}]`).hidden = !can.includes(name);
    if (can.includes("note")) this.guarded(() => this.showNotes());
  }

  choose(tool) {
    this.tool = tool;
    this.turn++;
    this.points = [];
    this.quantities = {};
    for (const button of document.querySelectorAll("[data-tool]")) button.setAttribute("aria-pressed", String(button.dataset.tool === tool));
    find("hint").textContent = HINTS[tool] || "";
    this.result("");
    for (const id of ["note-form", "scale-form", "level-form", "section-form", "again"]) find(id).hidden = true;
    this.marks.canvas.classList.toggle("pointing", tool !== null);
    this.show();
  }

  show() {
    find("tools").dataset.points = String(this.points.length);
    Object.assign(this.marks, { points: this.points, closed: this.tool === "area" });
    this.changed();
  }

  result(text, chart = false) {
    find("result").textContent = text;
    find("chart").toggleAttribute("hidden", !chart); // an SVG has no property of that name
    if (text) (chart ? find("chart") : find("result")).scrollIntoView({ block: "nearest" });
  }

  // What fails costs this request; a later click begins another.
  async guarded(work) {
    const turn = this.turn;
    try { await work(); } catch (error) { if (turn === this.turn) this.result(error.message); }
  }

  point(ray) {
    if (this.tool) this.guarded(() => this.add(ray));
  }

  async add(ray) {
    const turn = this.turn, tool = this.tool;
    const found = await tell("pick", { ...ray, ...this.looks.shown });
    if (turn !== this.turn) return;
    if (this.points.length >= (MOST[tool] ?? Infinity)) this.points = [];
    this.points.push({ ...found, ray });
    find("again").hidden = false;
    this.result("");
    this.show();
    find("section-form").hidden = true;
    find("note-form").hidden = !(tool === "note" && this.can.includes("note"));
    find("scale-form").hidden = !(tool === "scale" && this.points.length === 2);
    find("level-form").hidden = !(tool === "level" && this.points.length >= 3);
    if (tool === "note") find("note-text").focus();
    if (this.points.length >= (LEAST[tool] ?? Infinity)) await this.measure(turn);
  }

  // What the server says of the points.
  ask(what, more) {
    const points = this.points.map(({ place, sigma, range, ray }) => ({ place, sigma, range, ...ray }));
    return tell("measure", { what, points, ...this.looks.shown, ...more });
  }

  async measure(turn) {
    const { points } = this, count = points.length;
    const said = await this.ask(this.tool);
    const { drawChart } = said.profile ? await import("./chart.js") : {}; // comes when it is wanted
    if (turn !== this.turn || this.points !== points || points.length !== count) return;
    this.quantities = said.quantities;
    find("note-form").hidden = !this.can.includes("note");
    drawChart?.(find("chart"), said.profile);
    this.result(said.words, Boolean(said.profile));
    find("section-form").hidden = !said.profile;
    if (said.profile) {
      find("section-unit").textContent = said.profile.unit;
      find("thickness").value = Number((THICK * said.profile.along.at(-1)).toPrecision(1));
    }
  }

  async section() {
    const [said, { showSection }] = await Promise.all([this.ask("section", { thickness: number("thickness") }), import("./section.js")]);
    showSection(said, document.title.replaceAll(/[^\w.-]+/g, "_"));
  }

  async keepNote() {
    const shape = { note: "Point", area: "Polygon" }[this.tool] ?? "LineString";
    await tell("notes/add", { text: find("note-text").value, shape, places: this.points.map(point => point.place), measured: this.quantities });
    find("note-text").value = "";
    this.choose(this.tool);
    await this.showNotes();
  }

  async setScale() {
    const said = await tell("scale", { places: this.points.map(point => point.place), length_m: number("length"), sigma_m: number("sigma") });
    this.result(said.words);
    find("scale-form").hidden = true;
    if (said.rescaled) setTimeout(() => location.reload(), 2500);
  }

  async setLevel() {
    const said = await tell("level", { places: this.points.map(point => point.place) });
    this.result(said.words);
    find("level-form").hidden = true;
    setTimeout(() => location.reload(), 2500);
  }

  async showNotes() {
    const { notes } = await tell("notes/list", {});
    this.marks.notes = notes;
    find("notes").replaceChildren(...notes.map(note => {
      const row = document.createElement("li"), text = document.createElement("span"), remove = document.createElement("button");
      text.textContent = note.text || "(no text)";
      remove.textContent = "Remove";
      remove.addEventListener("click", () => this.guarded(async () => { await tell("notes/remove", { key: note.key }); await this.showNotes(); }));
      row.append(text, remove);
      return row;
    }));
    this.changed();
  }
}

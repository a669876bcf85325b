// Draws the map by WebGL 2. What a device cannot draw in time is left out, the least first.

import { FRAGMENT, VERTEX } from "./shaders.js";
import { WORDS } from "./load.js";

const WIDTH = 1024; // Gaussians in a row of the texture
const MOVING_MS = 60, STILL_MS = 2500; // of one picture, while the eye moves and when it rests
const FEWEST = 12000; // that are drawn on however slow a device
const SHARPEST = 1.5; // device pixels for each of CSS: more cost a tablet its smoothness
const DARK = [0.067, 0.094, 0.114];

function built(gl, kind, text) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, text);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
  return shader;
}

export class Drawing {
  constructor(canvas, drawn) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser has no WebGL 2: use a newer one, or switch its graphics on.");
    Object.assign(this, { canvas, gl, drawn, about: null, next: null, count: 0, order: null, sorting: false, moving: false });
    this.look = { water: 0, through: 1, wipe: null, level: -1, rangeLevel: -1, within: 255 };
    this.cost_us = 5; // of a Gaussian; measured from the first picture on
    canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); this.about = null; });
    canvas.addEventListener("webglcontextrestored", () => location.reload());
    this.program = gl.createProgram();
    gl.attachShader(this.program, built(gl, gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(this.program, built(gl, gl.FRAGMENT_SHADER, FRAGMENT));
    gl.bindAttribLocation(this.program, 0, "corner");
    gl.bindAttribLocation(this.program, 1, "index");
    gl.linkProgram(this.program);
    gl.useProgram(this.program);
    this.at = name => gl.getUniformLocation(this.program, name);
    this.corners = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    this.indices = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(1, 1);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.palettes = this.texture(gl.TEXTURE1);
  }

  texture(unit) {
    const gl = this.gl, made = gl.createTexture();
    gl.activeTexture(unit);
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const [name, value] of [["MIN_FILTER", "NEAREST"], ["MAG_FILTER", "NEAREST"], ["WRAP_S", "CLAMP_TO_EDGE"], ["WRAP_T", "CLAMP_TO_EDGE"]]) {
      gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], gl[value]);
    }
    return made;
  }

  // Room for a map, which is shown from its first chunk on if none is there, else when it is whole.
  begin(about) {
    const gl = this.gl, rows = Math.max(1, Math.ceil(about.count / WIDTH));
    if (this.next) { gl.deleteTexture(this.next.data); this.next.worker.terminate(); }
    const data = this.texture(gl.TEXTURE0);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, 2 * WIDTH, rows);
    const worker = new Worker("/client/sort.js");
    worker.postMessage({ begin: about.count });
    worker.onmessage = ({ data: said }) => this.take(said);
    this.next = { about, data, worker, count: 0 };
    if (!this.about) this.swap();
  }

  put({ words, places }, first, end) {
    const gl = this.gl, into = this.next, rows = Math.ceil((end - first) / WIDTH);
    const padded = new Uint32Array(WORDS * WIDTH * rows);
    padded.set(words);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, into.data);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, first / WIDTH, 2 * WIDTH, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, padded);
    into.worker.postMessage({ places, first }, [places.buffer]);
    into.count = end;
    if (into.about === this.about) this.count = end;
    else if (end === into.about.count) this.swap();
    this.wanted = true;
  }

  swap() {
    if (this.shown) { this.gl.deleteTexture(this.shown.data); this.shown.worker.terminate(); }
    this.shown = this.next;
    this.about = this.shown.about;
    Object.assign(this, { count: this.shown.count, order: null, sorting: false, wanted: true });
  }

  // One colour for each of the 256 values of a level.
  colours(rows) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.palettes);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, rows);
  }

  // How many are drawn now: as many as the device draws in time; what that is, the first chunk tells.
  get limit() {
    if (this.shownAt === undefined) return Math.min(this.count, this.about.ends[0]);
    const most = (this.moving ? MOVING_MS : STILL_MS) * 1000 / this.cost_us / (this.look.wipe === null ? 1 : 2);
    return Math.min(this.count, Math.max(FEWEST, Math.round(most)));
  }

  // Called once for each picture of the screen.
  turn(eye) {
    if (!this.about || !this.count || this.fence && !this.finished()) return;
    if (!this.wanted) return;
    this.wanted = false;
    this.eye = { place: [...eye.place], axes: eye.axes.map(axis => [...axis]) };
    this.optics = eye.optics(this.canvas.clientWidth, this.canvas.clientHeight);
    if (!this.sorting) {
      this.sorting = true;
      const nearest = this.nearest, count = this.limit;
      this.shown.worker.postMessage({ place: eye.place, ahead: eye.axes[2], nearest, count, map: this.about.version });
    } else this.wanted = true;
    if (this.order) this.paint();
  }

  get nearest() { return 0.005 * Math.max(...this.about.half); }

  take({ order, map }) {
    if (!this.about || map !== this.about.version) return;
    this.sorting = false;
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.order = order.length;
    if (!this.fence) this.paint();
    else this.late = true;
  }

  paint() {
    const gl = this.gl, ratio = Math.min(devicePixelRatio, SHARPEST), { about, look } = this;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map(v => Math.max(1, Math.round(v * ratio)));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    gl.viewport(0, 0, width, height);
    const { fx, fy, cx, cy } = this.optics, water = about.water;
    const three = (name, value) => gl.uniform3fv(this.at(name), value);
    gl.uniformMatrix3fv(this.at("axes"), false, this.eye.axes.flat());
    three("place", this.eye.place);
    gl.uniform2f(this.at("focal"), fx * ratio, fy * ratio);
    gl.uniform2f(this.at("centre"), cx * ratio, cy * ratio);
    gl.uniform2f(this.at("size"), width, height);
    three("middle", about.middle);
    three("extent", about.half);
    gl.uniform2fv(this.at("logScales"), about.log_scales);
    gl.uniform1f(this.at("brightest"), about.brightest);
    gl.uniform1f(this.at("grown"), this.grown());
    gl.uniform1f(this.at("nearest"), this.nearest);
    for (const name of ["beta", "b", "d"]) three(name, water ? water[name] : [0, 0, 0]);
    three("Binf", water ? water.B_inf : [0, 0, 0]);
    three("Bres", water ? water.B_res : [0, 0, 0]);
    three("lamp", water ? water.lamp : [0, 0, 1]);
    for (const name of ["gain", "white"]) three(name, water ? water[name] : [1, 1, 1]);
    gl.uniform1f(this.at("compression"), water ? water.compression : 0);
    gl.uniform1f(this.at("shownCompression"), water ? water.shown_compression : 0);
    gl.uniform1f(this.at("through"), look.through);
    gl.uniform1i(this.at("level"), look.level);
    gl.uniform1i(this.at("rangeLevel"), look.rangeLevel);
    gl.uniform1f(this.at("within"), look.within);
    gl.uniform1i(this.at("data"), 0);
    gl.uniform1i(this.at("palette"), 1);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.shown.data);
    if (look.wipe === null) this.side(0, width, height, water ? look.water : 0);
    else {
      const at = Math.round(look.wipe * width);
      this.side(0, at, height, 1);
      this.side(at, width - at, height, 0);
    }
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    Object.assign(this, { began: performance.now(), late: false });
    this.drawn(this);
  }

  // The part of the picture from `left` on.
  side(left, width, height, water) {
    const gl = this.gl, B = this.about.water?.B_inf;
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, 0, width, height);
    const ground = DARK.map((v, k) => B && this.look.level < 0 ? v + water * (B[k] - v) : v);
    gl.clearColor(...ground, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniform1f(this.at("water"), water);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.order);
  }

  // While some are missing, those that are there grow by part of what these would cover.
  grown() {
    const { ends, covered } = this.about, limit = this.limit;
    const k = ends.findIndex(end => end >= limit), before = k > 0 ? ends[k - 1] : 0;
    const [low, high] = [k > 0 ? covered[k - 1] : 0, covered[k]];
    const share = low + (high - low) * (limit - before) / Math.max(1, ends[k] - before);
    return Math.min(2.5, Math.max(share, 1e-3) ** -0.5);
  }

  // Whether the last picture is on the screen; learns what a Gaussian costs.
  finished() {
    const gl = this.gl, state = gl.clientWaitSync(this.fence, 0, 0);
    if (state === gl.TIMEOUT_EXPIRED) return false;
    gl.deleteSync(this.fence);
    this.fence = null;
    const cost = 1000 * (performance.now() - this.began) / Math.max(this.order, FEWEST) / (this.look.wipe === null ? 1 : 2);
    this.cost_us += (this.shownAt === undefined ? 1 : 0.5) * (cost - this.cost_us);
    if (this.shownAt === undefined) {
      this.shownAt = performance.now();
      this.wanted = true;
    }
    if (this.late) this.wanted = true;
    return true;
  }
}

// Draws by WebGL 2: a quad for each Gaussian, in the order that a worker finds for the eye.

import { FRAGMENT, VERTEX } from "./shaders.js";
import { WORDS } from "./load.js";

const WIDTH = 1024; // Gaussians in a row of the texture

function built(gl, kind, text) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, text);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
  return shader;
}

export class WebGl {
  constructor(drawing) {
    const { canvas } = drawing;
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser has no WebGL 2: use a newer one, or switch its graphics on.");
    Object.assign(this, { drawing, gl, order: null, sorting: false });
    canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); drawing.about = null; });
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

  // A place for `count` Gaussians, and the worker that sorts them.
  room(count) {
    const gl = this.gl, data = this.texture(gl.TEXTURE0), worker = new Worker("/client/sort.js");
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, 2 * WIDTH, Math.max(1, Math.ceil(count / WIDTH)));
    worker.postMessage({ begin: count });
    const room = { data, worker };
    worker.onmessage = ({ data: order }) => { if (room === this.shown) this.take(order); };
    return room;
  }

  put(room, { words, places }, first, end) {
    const gl = this.gl, rows = Math.ceil((end - first) / WIDTH);
    const padded = new Uint32Array(WORDS * WIDTH * rows);
    padded.set(words);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, room.data);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, first / WIDTH, 2 * WIDTH, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, padded);
    room.worker.postMessage({ places, first }, [places.buffer]);
  }

  show(room) { Object.assign(this, { shown: room, order: null, sorting: false }); }

  free(room) {
    this.gl.deleteTexture(room.data);
    room.worker.terminate();
  }

  colours(rows) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.palettes);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, rows);
  }

  // Asks for the order from where the eye is; while one is under way, again at the next turn.
  sort(drawing) {
    if (this.sorting) { drawing.wanted = true; return; }
    this.sorting = true;
    const { nearest, first, limit, eye } = drawing;
    this.shown.worker.postMessage({ place: eye.place, ahead: eye.axes[2], nearest, first, count: limit });
  }

  take(order) {
    this.sorting = false;
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.order = order.length;
    if (this.drawing.about) this.drawing.ordered();
  }

  // How many it draws; null while there is no order yet.
  paint({ about, look, eye, width, height, fx, fy, cx, cy, sides, water, nearest, grown }) {
    if (this.order === null) return null;
    const gl = this.gl;
    gl.viewport(0, 0, width, height);
    const three = (name, value) => gl.uniform3fv(this.at(name), value);
    gl.uniformMatrix3fv(this.at("axes"), false, eye.axes.flat());
    three("place", eye.place);
    gl.uniform2f(this.at("focal"), fx, fy);
    gl.uniform2f(this.at("centre"), cx, cy);
    gl.uniform2f(this.at("size"), width, height);
    three("low", look.low);
    three("high", look.high);
    gl.uniform2fv(this.at("logScales"), about.log_scales);
    gl.uniform1f(this.at("brightest"), about.brightest);
    gl.uniform1f(this.at("grown"), grown);
    gl.uniform1f(this.at("nearest"), nearest);
    for (const name of ["beta", "b", "d", "gain", "white", "lamp"]) three(name, water[name]);
    three("Binf", water.B_inf);
    three("Bres", water.B_res);
    gl.uniform1f(this.at("compression"), water.compression);
    gl.uniform1f(this.at("shownCompression"), water.shown_compression);
    gl.uniform1f(this.at("through"), look.through);
    gl.uniform1i(this.at("level"), look.level);
    gl.uniform1i(this.at("rangeLevel"), look.rangeLevel);
    gl.uniform1f(this.at("within"), look.within);
    gl.uniform1i(this.at("data"), 0);
    gl.uniform1i(this.at("palette"), 1);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.shown.data);
    gl.enable(gl.SCISSOR_TEST);
    for (const side of sides) {
      gl.scissor(side.left, 0, side.width, height);
      gl.clearColor(...side.background, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      gl.uniform1f(this.at("water"), side.water);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.order);
    }
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    return this.order;
  }

  get busy() {
    const gl = this.gl;
    if (this.fence && gl.clientWaitSync(this.fence, 0, 0) === gl.TIMEOUT_EXPIRED) return true;
    gl.deleteSync(this.fence);
    this.fence = null;
    return false;
  }
}

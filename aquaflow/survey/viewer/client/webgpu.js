// Draws by WebGPU: ellipses and their order by the kernels that maps are optimised with
// (aquaflow/render/wgsl), then a quad for each Gaussian, the farthest first. Nothing waits for an order.

import { asked, WORDS } from "./load.js";

const KERNELS = { splats: ["unpack"], project: ["project"], sort: ["count", "move_keys"], sum: ["sum"] }; // by file
const LIMITS = ["maxBufferSize", "maxStorageBufferBindingSize"]; // asked in full: a map's size follows from them
const ROW = 16; // numbers of a Gaussian, and of its ellipse
const THREADS = 256, SORTED = 2048; // Gaussians, and keys of the sort, that a workgroup takes
const DIGIT_BITS = 4, DIGITS = 16, PASSES = 8; // of the sort: depths are positive floats of 31 bits
const SLOT = 256; // bytes from one uniform to the next in a buffer, as WebGPU has it
const MARGIN = 1.3; // half fields of view beyond which ellipses do not grow; 1 + TANGENT_MARGIN of limits.py

export class WebGpu {
  // Null where the browser has no WebGPU, no adapter for it, or one that is a program: WebGL is faster then.
  static async on(canvas) {
    const adapter = await navigator.gpu?.requestAdapter({ powerPreference: "high-performance" });
    if (!adapter || (adapter.info?.isFallbackAdapter ?? adapter.isFallbackAdapter)) return null;
    const requiredLimits = Object.fromEntries(LIMITS.map(name => [name, adapter.limits[name]]));
    const [device, ...texts] = await Promise.all([adapter.requestDevice({ requiredLimits }),
      ...Object.keys(KERNELS).map(async file => (await asked(`/client/${file}.wgsl`)).text())]);
    const modules = texts.map(code => device.createShaderModule({ code })), made = {};
    const format = navigator.gpu.getPreferredCanvasFormat();
    const over = { srcFactor: "one", dstFactor: "one-minus-src-alpha" };
    const rendering = (entryPoint, blend) => device.createRenderPipelineAsync({
      layout: "auto", vertex: { module: modules[0], entryPoint }, primitive: { topology: "triangle-strip" },
      fragment: { module: modules[0], entryPoint: `${entryPoint}_colour`, targets: [{ format, blend }] },
    }).then(pipeline => { made[entryPoint] = pipeline; });
    await Promise.all([rendering("background"), rendering("ellipse", { color: over, alpha: over }),
      ...Object.values(KERNELS).flatMap((names, k) => names.map(async entryPoint => {
        made[entryPoint] = await device.createComputePipelineAsync({ layout: "auto", compute: { module: modules[k], entryPoint } });
      }))]);
    return new WebGpu(canvas, device, made, format);
  }

  constructor(canvas, device, pipelines, format) {
    Object.assign(this, { device, pipelines, context: canvas.getContext("webgpu"), busy: false });
    this.context.configure({ device, format, alphaMode: "opaque" });
    // Whatever it refuses, WebGL may do: the map is too large for it, or the driver is at fault.
    device.addEventListener("uncapturederror", ({ error }) => { console.warn(error.message); device.destroy(); });
    this.palette = this.buffer(256);
    this.camera = this.buffer(28, true);
    this.sides = this.buffer(2 * SLOT / 4, true);
    this.passes = this.buffer((PASSES + 1) * SLOT / 4, true);
    this.total = this.buffer(1);
    this.unread = this.buffer(1);
  }

  buffer(numbers, uniform = false) {
    const use = GPUBufferUsage;
    return this.device.createBuffer({ size: 4 * Math.max(4, numbers), usage: (uniform ? use.UNIFORM : use.STORAGE) | use.COPY_DST });
  }

  // A place for `count` Gaussians; `parts`, by their first, are what another device would need to draw them.
  room(count) { return { count, words: this.buffer(WORDS * count), parts: new Map() }; }

  put(room, part, first, end) {
    this.device.queue.writeBuffer(room.words, 4 * WORDS * first, part.words);
    room.parts.set(first, [part, first, end]);
  }

  free(room) {
    for (const buffer of [room.words, ...room.buffers ?? []]) buffer.destroy();
  }

  colours(rows) { this.device.queue.writeBuffer(this.palette, 0, rows); }

  // Buffers for what follows from the Gaussians, and the kernels on them, in their order.
  show(room) {
    const { count, words } = room, of = (times, each = count) => this.buffer(times * each);
    const gaussians = of(ROW), splats = of(ROW), hits = of(1), radius = of(1), tiles = of(1, 1);
    const keys = [of(1), of(1)], order = [of(1), of(1)], counts = of(DIGITS, Math.ceil(count / SORTED));
    room.buffers = [gaussians, splats, hits, radius, tiles, ...keys, ...order, counts];
    this.device.queue.writeBuffer(tiles, 0, new Uint32Array([1]));
    const { camera, palette, total, unread } = this, side = k => this.slot(this.sides, k), pass = k => this.slot(this.passes, k);
    const projecting = k => [["unpack", THREADS, side(k), words, palette, gaussians],
      ["project", THREADS, camera, gaussians, tiles, splats, keys[0], hits, radius]];
    const sorting = Array.from({ length: PASSES }, (_, k) => {
      const from = k % 2, to = 1 - from;
      return [["count", SORTED, pass(k), total, keys[from], null, counts],
        ["sum", 0, pass(PASSES), counts, unread],
        ["move_keys", SORTED, pass(k), total, keys[from], order[from], counts, keys[to], order[to]]];
    }).flat();
    this.steps = [[...projecting(0), ...sorting], projecting(1)].map(steps => steps.map(([name, each, ...bound]) => ({ name, each, bindings: this.bindGroup(name, bound) })));
    this.drawings = [0, 1].map(k => ({
      background: this.bindGroup("background", [side(k)]),
      ellipse: this.bindGroup("ellipse", [null, null, null, null, camera, splats, order[0], radius]),
    }));
  }

  slot(buffer, number) { return { buffer, offset: number * SLOT, size: SLOT }; }

  bindGroup(name, buffers) {
    const entries = buffers.map((each, binding) => each && { binding, resource: each instanceof GPUBuffer ? { buffer: each } : each });
    return this.device.createBindGroup({ layout: this.pipelines[name].getBindGroupLayout(0), entries: entries.filter(Boolean) });
  }

  // How many it draws.
  paint(view) {
    const { device } = this, { count, sides, width, height } = view, encoder = device.createCommandEncoder();
    this.writeUniforms(view);
    const picture = this.context.getCurrentTexture().createView();
    sides.forEach((side, k) => {
      const compute = encoder.beginComputePass();
      for (const { name, each, bindings } of this.steps[k]) {
        compute.setPipeline(this.pipelines[name]);
        compute.setBindGroup(0, bindings);
        compute.dispatchWorkgroups(each ? Math.ceil(count / each) : 1);
      }
      compute.end();
      const pass = encoder.beginRenderPass({ colorAttachments: [{ view: picture, loadOp: k ? "load" : "clear", storeOp: "store" }] });
      pass.setScissorRect(side.left, 0, side.width, height);
      for (const [name, instances] of [["background", 1], ["ellipse", count]]) {
        pass.setPipeline(this.pipelines[name]);
        pass.setBindGroup(0, this.drawings[k][name]);
        pass.draw(4, instances);
      }
      pass.end();
    });
    device.queue.submit([encoder.finish()]);
    this.busy = true;
    device.queue.onSubmittedWorkDone().then(() => { this.busy = false; });
    return count;
  }

  // The eye, the look of each side, and how many are sorted.
  writeUniforms({ about, look, eye, width, height, fx, fy, cx, cy, sides, water, nearest, first, count, grown }) {
    const { queue } = this.device, blocks = Math.ceil(count / SORTED);
    const camera = new Float32Array(28), limit = [width, height].map((size, k) => MARGIN * size / (2 * [fx, fy][k]));
    camera.set([...eye.axes.flatMap(axis => [...axis, 0]), fx, fy, cx, cy, -limit[0], limit[0], -limit[1], limit[1]]);
    new Uint32Array(camera.buffer).set([width, height, 1, 1, count], 20); // one tile: nobody asks which ones are hit
    queue.writeBuffer(this.camera, 0, camera);
    sides.forEach((side, k) => queue.writeBuffer(this.sides, SLOT * k, new Float32Array([
      ...eye.place, nearest, ...about.log_scales, side.water, look.through, about.brightest, grown, look.level, look.rangeLevel,
      ...water.beta, water.compression, ...water.B_inf, water.shown_compression, ...water.b, look.within, ...water.B_res, count,
      ...water.d, first, ...water.gain, 0, ...water.white, 0, ...water.lamp, 0, ...look.low, 0, ...look.high, 0, ...side.background, 1])));
    queue.writeBuffer(this.total, 0, new Uint32Array([count]));
    const passes = new Uint32Array((PASSES + 1) * SLOT / 4);
    for (let k = 0; k < PASSES; k++) passes.set([DIGIT_BITS * k, blocks, k === 0], k * SLOT / 4);
    passes[PASSES * SLOT / 4] = DIGITS * blocks;
    queue.writeBuffer(this.passes, 0, passes);
  }
}

// Gradient of blend.wgsl. A workgroup walks the list of its tile as drawing did, a thread for each
// pixel; what lies behind a Gaussian is the pixel's total minus the prefix, so no transmittance is
// recovered by division and every threshold decides exactly as it did in drawing.
//
// Sums over pixels: CHUNK Gaussians at a time, every pixel writes its weight and its gradient of the
// exponent into shared memory; then each thread sums the moments of one Gaussian over SHARE pixels, and
// few threads sum what these have found. Each hit has a place of its own for its sums, which
// project_backward.wgsl adds up: no float atomics, and the same sums in every run.

@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var<storage, read> ranges: array<u32>;
@group(0) @binding(2) var<storage, read> sorted: array<u32>;
@group(0) @binding(3) var<storage, read> owners: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<vec4f>;
@group(0) @binding(5) var<storage, read> behind_all: array<f32>;  // [H, W] dL/d(all that is drawn)
@group(0) @binding(6) var<storage, read> incoming: array<vec4f>;  // [H, W] dL/dcolour
@group(0) @binding(7) var<storage, read_write> moments: array<f32>;  // [hits, MOMENTS]

const PIXELS: u32 = TILE_PX * TILE_PX;
const SHARE: u32 = CHUNK;             // pixels of a thread that sums
const PARTS: u32 = PIXELS / SHARE;    // threads that sum for one Gaussian

var<workgroup> ellipse: array<vec4f, CHUNK>;
var<workgroup> tail: array<vec2f, CHUNK>;
var<workgroup> colour: array<vec4f, CHUNK>;
var<workgroup> hit: array<u32, CHUNK>;
var<workgroup> numbers: array<f32, MOMENTS * PIXELS>;
var<workgroup> open: atomic<u32>;
var<workgroup> any_open: u32;

@compute @workgroup_size(TILE_PX, TILE_PX)
fn blend_backward(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_index) thread: u32,
                  @builtin(global_invocation_id) pixel: vec3u) {
  let at = vec2f(pixel.xy);
  let corner = vec2f(tile.xy * TILE_PX);
  let inside = all(pixel.xy < camera.size.xy);
  let p = pixel.y * camera.size.x + pixel.x;
  let index = tile.y * camera.size.z + tile.x;
  let end = ranges[index + 1];
  var T = 0.0;
  var behind = 0.0;
  var g_colour = vec4f(0);
  if (inside) { T = 1.0; behind = behind_all[p]; g_colour = incoming[p]; }

  // The pixels whose sums this thread takes, the same for every Gaussian.
  let mine = thread / PARTS;           // of the chunk's Gaussians
  let share = (thread % PARTS) * SHARE;

  for (var first = ranges[index]; first < end; first += CHUNK) {
    let count = min(CHUNK, end - first);
    if (thread == 0) { atomicStore(&open, 0u); }
    workgroupBarrier();
    if (T > MIN_TRANSMITTANCE) { atomicOr(&open, 1u); }
    if (thread < count) {
      let h = sorted[first + thread];
      let s = VECTORS * owners[h];
      hit[thread] = h;
      ellipse[thread] = splats[s];
      tail[thread] = splats[s + 1].xy;
      colour[thread] = splats[s + 2];
    }
    workgroupBarrier();
    if (thread == 0) { any_open = atomicLoad(&open); }
    if (workgroupUniformLoad(&any_open) == 0) { break; }

    for (var k = 0u; k < count; k++) {
      let s0 = ellipse[k]; let s1 = tail[k];
      let d = at - s0.xy;
      let exponent = (s0.z * d.x + s0.w * d.y) * d.x + s1.x * d.y * d.y + s1.y;
      var w = 0.0;
      var g = 0.0;
      if (exponent > LOG2_MIN_ALPHA && T > MIN_TRANSMITTANCE) {
        let raw = exp2(exponent);
        let alpha = min(MAX_ALPHA, raw);
        w = alpha * T;
        T -= w;
        let own = w * dot(g_colour, colour[k]);
        behind -= own;
        if (raw < MAX_ALPHA) { g = own - behind * (alpha / (1 - alpha)); }  // clamped: no gradient
      }
      numbers[k * PIXELS + thread] = w;
      numbers[(CHUNK + k) * PIXELS + thread] = g;
    }
    workgroupBarrier();

    var first_order = vec3f(0);   // sums of g (1, dx, dy)
    var second_order = vec3f(0);  // of g (dx^2, dx dy, dy^2)
    var by_colour = vec4f(0);
    if (mine < count) {
      let centre = ellipse[mine].xy - corner;
      for (var q = share; q < share + SHARE; q++) {
        let w = numbers[mine * PIXELS + q]; let g = numbers[(CHUNK + mine) * PIXELS + q];
        let d = vec2f(f32(q % TILE_PX), f32(q / TILE_PX)) - centre;
        first_order += g * vec3f(1, d);
        second_order += g * vec3f(d.x * d.x, d.x * d.y, d.y * d.y);
        if (w > 0) {  // so it is on the picture
          let y = tile.y * TILE_PX + q / TILE_PX;
          by_colour += w * incoming[y * camera.size.x + tile.x * TILE_PX + q % TILE_PX];
        }
      }
    }
    workgroupBarrier();
    for (var i = 0u; i < 3; i++) {
      numbers[i * PIXELS + thread] = first_order[i];
      numbers[(3 + i) * PIXELS + thread] = second_order[i];
    }
    for (var i = 0u; i < 4; i++) { numbers[(6 + i) * PIXELS + thread] = by_colour[i]; }
    workgroupBarrier();
    if (thread < MOMENTS * count) {
      let m = thread % MOMENTS; let k = thread / MOMENTS;
      var total = 0.0;
      for (var j = 0u; j < PARTS; j++) { total += numbers[m * PIXELS + k * PARTS + j]; }
      moments[MOMENTS * hit[k] + m] = total;
    }
    workgroupBarrier();
  }
}

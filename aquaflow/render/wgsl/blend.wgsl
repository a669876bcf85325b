// Drawing: a workgroup blends the Gaussians of its tile from near to far, a thread for each pixel.

@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var<storage, read> ranges: array<u32>;
@group(0) @binding(2) var<storage, read> sorted: array<u32>;  // hits, by tile and from near to far
@group(0) @binding(3) var<storage, read> owners: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> colours: array<vec4f>;  // [H, W] premultiplied
@group(0) @binding(6) var<storage, read_write> rest: array<f32>;  // [H, W] transmittance

const BATCH: u32 = TILE_PX * TILE_PX;

var<workgroup> ellipse: array<vec4f, BATCH>;
var<workgroup> tail: array<vec2f, BATCH>;
var<workgroup> colour: array<vec4f, BATCH>;
var<workgroup> open: atomic<u32>;
var<workgroup> any_open: u32;

@compute @workgroup_size(TILE_PX, TILE_PX)
fn blend(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_index) thread: u32,
         @builtin(global_invocation_id) pixel: vec3u) {
  let at = vec2f(pixel.xy);
  let inside = all(pixel.xy < camera.size.xy);
  let index = tile.y * camera.size.z + tile.x;
  let end = ranges[index + 1];
  var T = select(0.0, 1.0, inside);  // off the picture: saturated from the start
  var sum = vec4f(0);
  for (var first = ranges[index]; first < end; first += BATCH) {
    if (thread == 0) { atomicStore(&open, 0u); }
    workgroupBarrier();
    if (T > MIN_TRANSMITTANCE) { atomicOr(&open, 1u); }
    workgroupBarrier();
    if (thread == 0) { any_open = atomicLoad(&open); }
    if (workgroupUniformLoad(&any_open) == 0) { break; }
    if (first + thread < end) {
      let s = VECTORS * owners[sorted[first + thread]];
      ellipse[thread] = splats[s];
      tail[thread] = splats[s + 1].xy;
      colour[thread] = splats[s + 2];
    }
    workgroupBarrier();
    let count = min(BATCH, end - first);
    for (var k = 0u; k < count && T > MIN_TRANSMITTANCE; k++) {
      let s0 = ellipse[k]; let s1 = tail[k];
      let d = at - s0.xy;
      let exponent = (s0.z * d.x + s0.w * d.y) * d.x + s1.x * d.y * d.y + s1.y;
      if (exponent <= LOG2_MIN_ALPHA) { continue; }
      let w = min(MAX_ALPHA, exp2(exponent)) * T;
      sum += w * colour[k];
      T -= w;
    }
  }
  if (inside) {
    let p = pixel.y * camera.size.x + pixel.x;
    colours[p] = sum;
    rest[p] = T;
  }
}

// The loss of a view (paper, Eqs. 19 to 22) and its gradient: weighted L1 and SSIM under the mask, and
// the ranges of the prior. As in photometric.py: 11 x 11 Gaussian window, images padded with zeros.

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> image: array<vec4f>;
@group(0) @binding(2) var<storage, read> mask: array<f32>;
@group(0) @binding(3) var<storage, read> observed: array<u32>;
@group(0) @binding(4) var<storage, read> rest: array<f32>;
@group(0) @binding(5) var<storage, read_write> slopes: array<vec4f>;  // [3, H, W] dSSIM/d(mean, variance, covariance)
@group(0) @binding(6) var<storage, read_write> losses: array<vec4f>;  // [tiles] L1, 1 - SSIM, ranges; mean error
@group(0) @binding(7) var<storage, read_write> g_image: array<vec4f>;

const RADIUS: u32 = 5;
const WINDOW: u32 = 2 * RADIUS + 1;
const WIDE: u32 = TILE_PX + 2 * RADIUS;  // of a tile with what its window reaches

var<workgroup> near: array<f32, 3 * WIDE * WIDE>;  // x and y of a channel, or its three slopes
var<workgroup> blurred: array<vec4f, WIDE * TILE_PX>;  // along rows; then sums over the tile

fn tap(k: u32) -> f32 {
  let d = f32(k) - f32(RADIUS);
  return exp(-d * d / (2 * SSIM_SIGMA_PX * SSIM_SIGMA_PX)) / SSIM_TAPS;
}

fn inside(x: i32, y: i32) -> bool {
  return x >= 0 && y >= 0 && x < i32(step.size.x) && y < i32(step.size.y);
}

// M I and M target of a channel at a pixel; zero beyond the picture.
fn pair_at(x: i32, y: i32, channel: u32) -> vec2f {
  if (!inside(x, y)) { return vec2f(0); }
  let p = u32(y) * step.size.x + u32(x);
  if (mask[p] == 0) { return vec2f(0); }
  return vec2f(image[p][channel], colour_of(observed[OBSERVED * p])[channel]);
}

// x, y, x^2 + y^2 and x y; or the slopes.
fn near_at(k: u32, pairs: bool) -> vec4f {
  let found = vec3f(near[3 * k], near[3 * k + 1], near[3 * k + 2]);
  return select(vec4f(found, 0), vec4f(found.xy, dot(found.xy, found.xy), found.x * found.y), pairs);
}

// Sums of ``near`` over windows along rows, for all rows that the tile needs.
fn blur_rows(thread: u32, pairs: bool) {
  for (var k = thread; k < WIDE * TILE_PX; k += TILE_PX * TILE_PX) {
    let first = k / TILE_PX * WIDE + k % TILE_PX;
    var sum = vec4f(0);
    for (var j = 0u; j < WINDOW; j++) { sum += tap(j) * near_at(first + j, pairs); }
    blurred[k] = sum;
  }
}

fn blur_column(at: vec2u) -> vec4f {
  var sum = vec4f(0);
  for (var j = 0u; j < WINDOW; j++) { sum += tap(j) * blurred[(at.y + j) * TILE_PX + at.x]; }
  return sum;
}

@compute @workgroup_size(TILE_PX, TILE_PX)
fn compare(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_id) at: vec3u,
           @builtin(local_invocation_index) thread: u32, @builtin(global_invocation_id) pixel: vec3u) {
  let corner = vec2i(tile.xy * TILE_PX) - i32(RADIUS);
  let on_picture = all(pixel.xy < step.size.xy);
  let p = min(pixel.y, step.size.y - 1) * step.size.x + min(pixel.x, step.size.x - 1);
  var found = vec4f(0);
  for (var channel = 0u; channel < 3; channel++) {
    workgroupBarrier();
    for (var k = thread; k < WIDE * WIDE; k += TILE_PX * TILE_PX) {
      let pair = pair_at(corner.x + i32(k % WIDE), corner.y + i32(k / WIDE), channel);
      near[3 * k] = pair.x;
      near[3 * k + 1] = pair.y;
    }
    workgroupBarrier();
    blur_rows(thread, true);
    workgroupBarrier();
    if (!on_picture) { continue; }
    let s = blur_column(at.xy);
    let a1 = 2 * s.x * s.y + SSIM_C1; let a2 = 2 * (s.w - s.x * s.y) + SSIM_C2;
    let means = s.x * s.x + s.y * s.y;
    let b1 = means + SSIM_C1; let b2 = s.z - means + SSIM_C2;
    let inverse = 1 / (b1 * b2);
    let ssim = a1 * a2 * inverse;
    let by_var = -ssim * b1 * inverse;
    let by_cov = 2 * a1 * inverse;
    let by_mean = 2 * (s.y * a2 - s.x * ssim * b2) * inverse - 2 * s.x * by_var - s.y * by_cov;
    slopes[channel * step.size.x * step.size.y + p] = vec4f(by_mean, by_var, by_cov, 0);
    let pair = pair_at(i32(pixel.x), i32(pixel.y), channel);
    found.x += mask[p] * abs(pair.x - pair.y);
    found.y += 1 - ssim;
    if (shows_scene(observed[OBSERVED * p])) {
      found.w += abs(image[p][channel] - colour_of(observed[OBSERVED * p])[channel]);
    }
  }
  if (on_picture) { found.z = abs(range_error(p).x) * range_error(p).y; }
  workgroupBarrier();
  blurred[thread] = found;
  for (var half = TILE_PX * TILE_PX / 2; half > 0; half /= 2) {
    workgroupBarrier();
    if (thread < half) { blurred[thread] += blurred[thread + half]; }
  }
  if (thread == 0) {
    let room = min(vec2u(TILE_PX), step.size.xy - tile.xy * TILE_PX);
    losses[tile.y * step.size.z + tile.x] = vec4f(blurred[0].xyz, blurred[0].w / f32(3 * room.x * room.y));
  }
}

// How far 1 / z is from what the prior expects, its weight, and d(1 / z)/dz.
fn range_error(p: u32) -> vec3f {
  if (step.flags.y == 0) { return vec3f(0); }
  let expected = bitcast<f32>(observed[OBSERVED * p + 1]) * step.centre.w;
  let trust = mask[p] * bitcast<f32>(observed[OBSERVED * p + 2]);
  if (expected <= 0 || 1 - rest[p] <= SOLID) { return vec3f(0); }
  let z = image[p].w;
  let inverse = 1 / max(z, MIN_RANGE);
  return vec3f(inverse - expected, trust, select(0.0, -inverse * inverse, z >= MIN_RANGE));
}

@compute @workgroup_size(TILE_PX, TILE_PX)
fn differentiate(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_id) at: vec3u,
                 @builtin(local_invocation_index) thread: u32, @builtin(global_invocation_id) pixel: vec3u) {
  let corner = vec2i(tile.xy * TILE_PX) - i32(RADIUS);
  let on_picture = all(pixel.xy < step.size.xy);
  let p = min(pixel.y, step.size.y - 1) * step.size.x + min(pixel.x, step.size.x - 1);
  let pixels = step.size.x * step.size.y;
  let share = 1 / f32(3 * pixels);
  var g = vec4f(0);
  for (var channel = 0u; channel < 3; channel++) {
    workgroupBarrier();
    for (var k = thread; k < WIDE * WIDE; k += TILE_PX * TILE_PX) {
      let x = corner.x + i32(k % WIDE); let y = corner.y + i32(k / WIDE);
      var slope = vec4f(0);
      if (inside(x, y)) { slope = slopes[channel * pixels + u32(y) * step.size.x + u32(x)]; }
      near[3 * k] = slope.x;
      near[3 * k + 1] = slope.y;
      near[3 * k + 2] = slope.z;
    }
    workgroupBarrier();
    blur_rows(thread, false);
    workgroupBarrier();
    if (!on_picture || mask[p] == 0) { continue; }
    let s = blur_column(at.xy);
    let pair = pair_at(i32(pixel.x), i32(pixel.y), channel);
    let by_ssim = s.x + 2 * pair.x * s.y + pair.y * s.z;
    g[channel] = share * ((1 - step.weights.x) * mask[p] * sign(pair.x - pair.y) - step.weights.x * by_ssim);
  }
  if (!on_picture) { return; }
  let error = range_error(p);
  g.w = step.weights.y / f32(pixels) * error.y * sign(error.x) * error.z;
  g_image[p] = g;
}

// What the kernels of an optimiser's step share: the view, its picture, and the weights of the loss.

struct Step {
  size: vec4u,     // width and height, pixels; columns of tiles; Gaussians
  flags: vec4u,    // whether common frames' outliers are masked; ranges are known; there is water; spare
  weights: vec4f,  // of SSIM, of ranges, of volumes; residual from which a pixel is an outlier
  centre: vec4f,   // of the camera, world; then 1 / scale of the view's ranges
  water: array<vec4f, 5>,  // RGB of beta, B_inf, b, B_res, d
}

// A pixel of the picture: its colours in 8 bits and whether it shows the scene; 1 / range and how far
// that is believed. Three numbers of 32 bits.
const OBSERVED: u32 = 3;

fn colour_of(packed: u32) -> vec3f { return unpack4x8unorm(packed).rgb; }
fn shows_scene(packed: u32) -> bool { return (packed >> 24) != 0; }

// K_rad: less weight towards the corners.
fn radial(x: u32, y: u32, size: vec2u) -> f32 {
  let at = 2 * vec2f(f32(x), f32(y)) / max(vec2f(size - 1), vec2f(1)) - 1;
  return exp(-dot(at, at) / (2 * RADIAL_VARIANCE));
}

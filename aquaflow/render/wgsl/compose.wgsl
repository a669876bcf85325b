// The picture through the water (paper, Eqs. 12 and 15), and its gradient:
//
//   I = s (J exp(-beta z) + u (a (B_inf (1 - exp(-b z)) + B_res exp(-d z)) + (1 - a) B_inf))
//
// as in water.py; s holds the camera's shading and the light over the picture.

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> colours: array<vec4f>;  // [H, W] premultiplied, and range
@group(0) @binding(2) var<storage, read> rest: array<f32>;
@group(0) @binding(3) var<storage, read> gains: array<vec4f>;  // [H, W] s in RGB, and u
@group(0) @binding(4) var<storage, read> observed: array<u32>;
@group(0) @binding(5) var<storage, read> drawn_tiles: array<u32>;
@group(0) @binding(6) var<storage, read_write> image: array<vec4f>;  // [H, W] I and z
@group(0) @binding(7) var<storage, read_write> mask: array<f32>;  // [H, W] M, and K_rad where it is one

fn exp_depth(rate: vec3f, z: f32) -> vec3f {
  return exp(-clamp(rate * z, vec3f(0), vec3f(MAX_OPTICAL_DEPTH)));
}

@compute @workgroup_size(TILE_PX, TILE_PX)
fn compose(@builtin(workgroup_id) tile: vec3u, @builtin(global_invocation_id) pixel: vec3u) {
  if (any(pixel.xy >= step.size.xy)) { return; }
  let p = pixel.y * step.size.x + pixel.x;
  let drawn = colours[p];
  let a = 1 - rest[p];
  let z = drawn.w / max(a, MIN_SOLID);
  let gain = gains[p];
  var light = drawn.rgb;
  if (step.flags.z != 0) {
    let veil = step.water[1].rgb * (1 - a * exp_depth(step.water[2].rgb, z))
      + a * step.water[3].rgb * exp_depth(step.water[4].rgb, z);
    light = drawn.rgb * exp_depth(step.water[0].rgb, z) + gain.w * veil;
  }
  let shown = gain.rgb * light;
  image[p] = vec4f(shown, z);
  let packed = observed[OBSERVED * p];
  let K = radial(pixel.x, pixel.y, step.size.xy);
  var counts = shows_scene(packed) && drawn_tiles[tile.y * step.size.z + tile.x] != 0;
  if (step.flags.x != 0) {
    let residual = abs(shown - colour_of(packed));
    let worst = max(residual.r, max(residual.g, residual.b));
    counts = counts && is_finite(worst) && K * worst <= step.weights.w;
  }
  mask[p] = select(0.0, K, counts);
}

// Gradient of compose.wgsl: that of the drawing, and of the water's parameters in a sum for each tile.

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> colours: array<vec4f>;
@group(0) @binding(2) var<storage, read> rest: array<f32>;
@group(0) @binding(3) var<storage, read> gains: array<vec4f>;
@group(0) @binding(4) var<storage, read> g_image: array<vec4f>;  // [H, W] dL/dI and dL/dz
@group(0) @binding(5) var<storage, read_write> incoming: array<vec4f>;  // [H, W] dL/d(colours)
@group(0) @binding(6) var<storage, read_write> behind: array<f32>;  // [H, W] dL/d(all that was drawn)
@group(0) @binding(7) var<storage, read_write> waters: array<vec4f>;  // [tiles, 5]

fn sum_over_tile(tile: u32, row: u32, thread: u32, own: vec3f) {
  let total = add_up(thread, vec4f(own, 0));
  if (thread == 0) { waters[5 * tile + row] = total; }
}

@compute @workgroup_size(TILE_PX, TILE_PX)
fn compose_backward(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_index) thread: u32,
                    @builtin(global_invocation_id) pixel: vec3u) {
  var by_beta = vec3f(0); var by_inf = vec3f(0); var by_b = vec3f(0); var by_res = vec3f(0);
  var by_d = vec3f(0);
  if (all(pixel.xy < step.size.xy)) {
    let p = pixel.y * step.size.x + pixel.x;
    let drawn = colours[p];
    let a = 1 - rest[p];
    let solid = max(a, MIN_SOLID);
    let z = drawn.w / solid;
    let gain = gains[p];
    let found = g_image[p];
    let g = gain.rgb * found.rgb;
    var g_J = g;
    var g_z = found.w;
    var g_a = 0.0;
    if (step.flags.z != 0) {
      let range = max(z, 0.0);
      let beta = step.water[0].rgb; let B_inf = step.water[1].rgb; let b = step.water[2].rgb;
      let B_res = step.water[3].rgb; let d = step.water[4].rgb;
      let deepest = vec3f(MAX_OPTICAL_DEPTH);
      let T = exp(-min(beta * range, deepest));
      let far = exp(-min(b * range, deepest));
      let near = exp(-min(d * range, deepest));
      let veil = gain.w * g;
      // By the optical depths; zero where these are clamped.
      let by_T = select(vec3f(0), -g * drawn.rgb * T, beta * range < deepest);
      let by_far = select(vec3f(0), veil * a * B_inf * far, b * range < deepest);
      let by_near = select(vec3f(0), -veil * a * B_res * near, d * range < deepest);
      g_J = g * T;
      g_a = dot(veil, B_res * near - B_inf * far);
      if (z > 0) { g_z += dot(beta, by_T) + dot(b, by_far) + dot(d, by_near); }
      by_beta = range * by_T;
      by_inf = veil * (1 - a * far);
      by_b = range * by_far;
      by_res = veil * a * near;
      by_d = range * by_near;
    }
    let by_range = g_z / solid;
    if (a > MIN_SOLID) { g_a -= by_range * z; }
    let all = vec4f(g_J, by_range);
    incoming[p] = all;
    behind[p] = dot(drawn, all) - rest[p] * g_a;
  }
  let index = tile.y * step.size.z + tile.x;
  sum_over_tile(index, 0, thread, by_beta);
  sum_over_tile(index, 1, thread, by_inf);
  sum_over_tile(index, 2, thread, by_b);
  sum_over_tile(index, 3, thread, by_res);
  sum_over_tile(index, 4, thread, by_d);
}

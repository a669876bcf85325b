// Projection of all Gaussians: a record of the ellipse, a key to sort by, the number of tiles hit, and
// the radius that the renderer reports.

@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var<storage, read> gaussians: array<vec4f>;
@group(0) @binding(2) var<storage, read> drawn_tiles: array<u32>;
@group(0) @binding(3) var<storage, read_write> splats: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> hits: array<u32>;
@group(0) @binding(6) var<storage, read_write> radius_px: array<f32>;

const LAST: u32 = 0x7fffffffu;  // sorts behind every depth

fn is_sound(mean: vec4f, quat: vec4f, scale: vec4f, colour: vec4f, sigma: f32) -> bool {
  let length = dot(quat, quat);
  return all_finite(mean) && all_finite(quat) && all_finite(scale) && all_finite(colour)
    && all(scale.xyz > vec3f(0)) && is_finite(length) && length > MIN_QUAT_NORM_SQ
    && is_finite(sigma) && sigma < MAX_SIGMA_PX;
}

@compute @workgroup_size(256)
fn project(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if (i >= camera.counts.x) { return; }
  keys[i] = LAST;
  hits[i] = 0;
  radius_px[i] = 0;
  let mean = gaussians[VECTORS * i]; let quat = gaussians[VECTORS * i + 1];
  let scale = gaussians[VECTORS * i + 2]; let colour = gaussians[VECTORS * i + 3];
  let opacity = mean.w;
  let f = footprint(camera, mean.xyz, quat, scale.xyz);
  let normal = cross(f.m0, f.m1);
  let xx = dot(f.m0, f.m0) + DILATION_PX2; let yy = dot(f.m1, f.m1) + DILATION_PX2;
  let xy = dot(f.m0, f.m1);
  // det(V') by Cauchy-Binet: no cancellation for needles, never below the dilation's square.
  let det = dot(normal, normal) + DILATION_PX2 * (xx + yy - DILATION_PX2);
  let half_gap = 0.5 * (xx - yy);
  let sigma = sqrt(0.5 * (xx + yy) + sqrt(half_gap * half_gap + xy * xy));
  let in_front = f.t.z > NEAR_PLANE_M && opacity > MIN_ALPHA;
  if (!in_front || !is_sound(mean, quat, scale, colour, sigma)) { return; }
  let centre = vec2f(f.t.x * f.j00, f.t.y * f.j11) + camera.lens.zw;
  let log2_opacity = log2(opacity);
  let reach = 2 * LN2 * max(log2_opacity - LOG2_MIN_ALPHA, 0.0);  // squared Mahalanobis distance
  let extent = sqrt(reach * vec2f(xx, yy));
  let size = vec2f(camera.size.xy);
  if (any(centre + extent <= vec2f(0)) || any(centre - extent >= size)) { return; }

  let a = yy / det; let b = -xy / det; let c = xx / det;
  let s0 = vec4f(centre - 0.5, -0.5 * LOG2E * a, -LOG2E * b);
  let s1 = vec4f(-0.5 * LOG2E * c, log2_opacity, extent);
  let slope = vec2f(-b / a, -b / c);
  let box = tile_box(s0.xy, extent, camera.size.zw);
  var touched = false;
  var count = 0u;
  for (var y = box.first.y; y <= box.last.y; y++) {
    for (var x = box.first.x; x <= box.last.x; x++) {
      if (drawn_tiles[y * camera.size.z + x] == 0) { continue; }
      touched = true;
      count += u32(reaches(vec2u(x, y), s0, s1, slope));
    }
  }
  if (!touched) { return; }
  splats[VECTORS * i] = s0;
  splats[VECTORS * i + 1] = s1;
  splats[VECTORS * i + 2] = colour;
  splats[VECTORS * i + 3] = vec4f(slope, a, b);
  keys[i] = bitcast<u32>(f.t.z);  // positive floats order like their bits
  hits[i] = count;
  radius_px[i] = RADIUS_SIGMAS * sigma;
}

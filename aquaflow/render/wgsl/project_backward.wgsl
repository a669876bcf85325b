// From the sums of a Gaussian's hits to the gradients of its numbers, and of the view matrix.

@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var<storage, read> gaussians: array<vec4f>;
@group(0) @binding(2) var<storage, read> splats: array<vec4f>;
@group(0) @binding(3) var<storage, read> hits: array<u32>;
@group(0) @binding(4) var<storage, read> starts: array<u32>;
@group(0) @binding(5) var<storage, read> moments: array<f32>;
@group(0) @binding(6) var<storage, read_write> gradients: array<vec4f>;  // [N, VECTORS]
@group(0) @binding(7) var<storage, read_write> view: array<vec4f>;  // [blocks, 3] rows of the view matrix

// q is of length one; the length of the quaternion has no effect. g: dL/dE, in rows.
fn quat_gradient(q: vec4f, inverse_norm: f32, g: mat3x3f) -> vec4f {
  let w = q.x; let x = q.y; let y = q.z; let z = q.w;
  let r0 = g[0]; let r1 = g[1]; let r2 = g[2];
  let found = 2 * vec4f(
    x * (r2.y - r1.z) + y * (r0.z - r2.x) + z * (r1.x - r0.y),
    -2 * x * (r1.y + r2.z) + y * (r0.y + r1.x) + z * (r0.z + r2.x) + w * (r2.y - r1.z),
    x * (r0.y + r1.x) - 2 * y * (r0.x + r2.z) + z * (r1.z + r2.y) + w * (r0.z - r2.x),
    x * (r0.z + r2.x) + y * (r1.z + r2.y) - 2 * z * (r0.x + r1.y) + w * (r1.x - r0.y));
  return inverse_norm * (found - dot(found, q) * q);
}

fn sum_over_block(block: u32, row: u32, thread: u32, own: vec4f) {
  let total = add_up(thread, own);
  if (thread == 0) { view[3 * block + row] = total; }
}

@compute @workgroup_size(256)
fn project_backward(@builtin(global_invocation_id) id: vec3u, @builtin(workgroup_id) group: vec3u,
                    @builtin(local_invocation_index) thread: u32) {
  let i = id.x;
  var row0 = vec4f(0); var row1 = vec4f(0); var row2 = vec4f(0);
  if (i < camera.counts.x) {
    var g_mean = vec4f(0); var g_quat = vec4f(0); var g_scale = vec3f(0); var g_colour = vec4f(0);
    if (hits[i] > 0) {
      var sum: array<f32, MOMENTS>;
      for (var h = starts[i]; h < starts[i] + hits[i]; h++) {
        for (var m = 0u; m < MOMENTS; m++) { sum[m] += moments[MOMENTS * h + m]; }
      }
      let mean = gaussians[VECTORS * i]; let scale = gaussians[VECTORS * i + 2].xyz;
      let f = footprint(camera, mean.xyz, gaussians[VECTORS * i + 1], scale);
      let s3 = splats[VECTORS * i + 3];
      let a = s3.z; let b = s3.w; let c = splats[VECTORS * i + 1].x * (-2 / LOG2E);
      let gu = a * sum[1] + b * sum[2]; let gv = b * sum[1] + c * sum[2];
      // V'^-1 is the conic Q, so dL/dV' = -Q (dL/dQ) Q; xy stands for both elements off the diagonal.
      let qa = -0.5 * sum[3]; let qb = -0.5 * sum[4]; let qc = -0.5 * sum[5];
      let p00 = a * qa + b * qb; let p01 = a * qb + b * qc;
      let p10 = b * qa + c * qb; let p11 = b * qb + c * qc;
      let gxx = -(p00 * a + p01 * b); let gyy = -(p10 * b + p11 * c);
      let gxy = -(p00 * b + p01 * c) - (p10 * a + p11 * b);
      let gm0 = 2 * gxx * f.m0 + gxy * f.m1; let gm1 = 2 * gyy * f.m1 + gxy * f.m0;
      g_scale = gm0 * f.jwe0 + gm1 * f.jwe1;
      let ge0 = gm0 * scale; let ge1 = gm1 * scale;  // dL/d(rows of J W E)
      let gE = mat3x3f(f.jw0.x * ge0 + f.jw1.x * ge1, f.jw0.y * ge0 + f.jw1.y * ge1,
                       f.jw0.z * ge0 + f.jw1.z * ge1);
      g_quat = quat_gradient(f.quat, f.inverse_norm, gE);
      let gw0 = f.E * ge0; let gw1 = f.E * ge1;  // dL/d(rows of J W)
      let r0 = camera.rows[0].xyz; let r1 = camera.rows[1].xyz; let r2 = camera.rows[2].xyz;
      let g00 = dot(gw0, r0); let g02 = dot(gw0, r2); let g11 = dot(gw1, r1); let g12 = dot(gw1, r2);
      let g_tan_x = select(0.0, -g02 * f.j00, f.free.x);
      let g_tan_y = select(0.0, -g12 * f.j11, f.free.y);
      let g_inverse_z = camera.lens.x * (g00 - g02 * f.tangent.x + gu * f.t.x)
        + camera.lens.y * (g11 - g12 * f.tangent.y + gv * f.t.y) + g_tan_x * f.t.x + g_tan_y * f.t.y;
      let gt = vec3f(gu * f.j00 + g_tan_x * f.inverse_z, gv * f.j11 + g_tan_y * f.inverse_z,
                     -g_inverse_z * f.inverse_z * f.inverse_z);  // dL/d(mean in the camera's axes)
      g_mean = vec4f(gt.x * r0 + gt.y * r1 + gt.z * r2, sum[0] / mean.w);
      g_colour = vec4f(sum[6], sum[7], sum[8], sum[9]);
      row0 = vec4f(gt.x * mean.xyz + f.j00 * gw0, gt.x);
      row1 = vec4f(gt.y * mean.xyz + f.j11 * gw1, gt.y);
      row2 = vec4f(gt.z * mean.xyz + f.j02 * gw0 + f.j12 * gw1, gt.z);
    }
    gradients[VECTORS * i] = g_mean;
    gradients[VECTORS * i + 1] = g_quat;
    gradients[VECTORS * i + 2] = vec4f(g_scale, 0);
    gradients[VECTORS * i + 3] = g_colour;
  }
  sum_over_block(group.x, 0, thread, row0);
  sum_over_block(group.x, 1, thread, row1);
  sum_over_block(group.x, 2, thread, row2);
}

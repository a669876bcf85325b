// From a Gaussian to its ellipse on the picture: what forward and backward share. Symbols as in EWA
// splatting (Zwicker et al. 2001): W rotation of the view, J Jacobian of the projection, V covariance,
// V' = J W V W^T J^T + dilation. V = (E S)(E S)^T with E from the quaternion.

struct Footprint {
  t: vec3f,  // mean in the camera's axes
  inverse_z: f32,
  quat: vec4f,  // wxyz of length one
  inverse_norm: f32,
  E: mat3x3f,  // in columns
  tangent: vec2f,  // x / z and y / z at which J is taken
  free: vec2<bool>,  // not clamped
  j00: f32, j02: f32, j11: f32, j12: f32,
  jw0: vec3f, jw1: vec3f,    // rows of J W
  jwe0: vec3f, jwe1: vec3f,  // rows of J W E
  m0: vec3f, m1: vec3f,      // rows of J W E S
}

fn rotation(q: vec4f) -> mat3x3f {
  let w = q.x; let x = q.y; let y = q.z; let z = q.w;
  return mat3x3f(
    1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
    2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
    2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y));
}

fn footprint(camera: Camera, mean: vec3f, quat: vec4f, scale: vec3f) -> Footprint {
  var f: Footprint;
  let r0 = camera.rows[0]; let r1 = camera.rows[1]; let r2 = camera.rows[2];
  f.t = vec3f(dot(r0.xyz, mean) + r0.w, dot(r1.xyz, mean) + r1.w, dot(r2.xyz, mean) + r2.w);
  f.inverse_z = 1.0 / max(f.t.z, NEAR_PLANE_M);
  f.inverse_norm = 1.0 / sqrt(dot(quat, quat));
  f.quat = f.inverse_norm * quat;
  f.E = rotation(f.quat);
  let tangent = f.t.xy * f.inverse_z;
  f.tangent = clamp(tangent, camera.tangents.xz, camera.tangents.yw);
  f.free = (tangent > camera.tangents.xz) & (tangent < camera.tangents.yw);
  f.j00 = camera.lens.x * f.inverse_z;
  f.j02 = -f.j00 * f.tangent.x;
  f.j11 = camera.lens.y * f.inverse_z;
  f.j12 = -f.j11 * f.tangent.y;
  f.jw0 = f.j00 * r0.xyz + f.j02 * r2.xyz;
  f.jw1 = f.j11 * r1.xyz + f.j12 * r2.xyz;
  f.jwe0 = f.jw0 * f.E;
  f.jwe1 = f.jw1 * f.E;
  f.m0 = f.jwe0 * scale;
  f.m1 = f.jwe1 * scale;
  return f;
}

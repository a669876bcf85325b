// From a Gaussian to its ellipse on the image: the part of the projection that forward and backward
// share. Symbols as in EWA splatting (Zwicker et al. 2001): W view rotation, J Jacobian of the
// projection, V covariance, V' = J W V W^T J^T + dilation. V = (E S)(E S)^T with E from the
// quaternion.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "constants.h"
#include "context.h"
#include "simd.h"

namespace aq {

struct Vec3 {
  float x, y, z;
};
struct Mat3 {
  Vec3 r0, r1, r2;  // rows
};
struct Quat {
  float w, x, y, z;
};

AQ_INLINE Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
AQ_INLINE Vec3 operator*(float s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
AQ_INLINE Vec3 operator*(Vec3 a, Vec3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
AQ_INLINE float dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
AQ_INLINE Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
AQ_INLINE Vec3 operator*(Vec3 row, const Mat3& m) {
  return row.x * m.r0 + row.y * m.r1 + row.z * m.r2;
}
AQ_INLINE Vec3 operator*(const Mat3& m, Vec3 a) {
  return {dot(m.r0, a), dot(m.r1, a), dot(m.r2, a)};
}

AQ_INLINE float clamp(float x, float low, float high) { return std::min(high, std::max(low, x)); }

AQ_INLINE Mat3 rotation(Quat q) {
  return {
      {1 - 2 * (q.y * q.y + q.z * q.z), 2 * (q.x * q.y - q.w * q.z), 2 * (q.x * q.z + q.w * q.y)},
      {2 * (q.x * q.y + q.w * q.z), 1 - 2 * (q.x * q.x + q.z * q.z), 2 * (q.y * q.z - q.w * q.x)},
      {2 * (q.x * q.z - q.w * q.y), 2 * (q.y * q.z + q.w * q.x), 1 - 2 * (q.x * q.x + q.y * q.y)}};
}

// log2 of a positive normal float, relative error 1e-7; a plain loop over it vectorises.
AQ_INLINE float log2_positive(float x) {
  union {
    float f;
    int32_t i;
  } bits{x};
  const int32_t exponent = (bits.i - 0x3f3504f3) >> 23;  // mantissa in [sqrt(1/2), sqrt(2))
  bits.i -= exponent * (1 << 23);
  const float s = (bits.f - 1.0f) / (bits.f + 1.0f), s2 = s * s;
  const float series = 1.0f + s2 * (1.0f / 3 + s2 * (1.0f / 5 + s2 * (1.0f / 7 + s2 * (1.0f / 9))));
  return (float)exponent + 2.0f * kLog2e * s * series;
}

struct Footprint {
  Vec3 t;  // mean in the camera frame, metres
  float inverse_z;
  Quat unit_quat;
  float quat_norm_sq, inverse_norm;
  Mat3 E;
  float tan_x, tan_y;   // clamped x / z, y / z at which J is taken
  bool free_x, free_y;  // not clamped
  float j00, j02, j11, j12;
  Vec3 jw0, jw1;    // rows of J W
  Vec3 jwe0, jwe1;  // rows of J W E
  Vec3 m0, m1;      // rows of J W E S
};

AQ_INLINE Footprint footprint(const Camera& cam, const Mat3& W, Vec3 mean, Quat q, Vec3 scale) {
  Footprint f;
  f.t = W * mean + Vec3{cam.d[0], cam.d[1], cam.d[2]};
  f.inverse_z = 1.0f / std::max(f.t.z, kNearPlane);
  f.quat_norm_sq = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z;
  f.inverse_norm = 1.0f / std::sqrt(f.quat_norm_sq);
  f.unit_quat = {q.w * f.inverse_norm, q.x * f.inverse_norm, q.y * f.inverse_norm,
                 q.z * f.inverse_norm};
  f.E = rotation(f.unit_quat);
  const float tan_x = f.t.x * f.inverse_z, tan_y = f.t.y * f.inverse_z;
  f.tan_x = clamp(tan_x, cam.tan_x_min, cam.tan_x_max);
  f.tan_y = clamp(tan_y, cam.tan_y_min, cam.tan_y_max);
  f.free_x = (tan_x > cam.tan_x_min) & (tan_x < cam.tan_x_max);
  f.free_y = (tan_y > cam.tan_y_min) & (tan_y < cam.tan_y_max);
  f.j00 = cam.fx * f.inverse_z;
  f.j02 = -f.j00 * f.tan_x;
  f.j11 = cam.fy * f.inverse_z;
  f.j12 = -f.j11 * f.tan_y;
  f.jw0 = f.j00 * W.r0 + f.j02 * W.r2;
  f.jw1 = f.j11 * W.r1 + f.j12 * W.r2;
  f.jwe0 = f.jw0 * f.E;
  f.jwe1 = f.jw1 * f.E;
  f.m0 = f.jwe0 * scale;
  f.m1 = f.jwe1 * scale;
  return f;
}

AQ_INLINE Mat3 view_rotation(const Camera& cam) {
  return {{cam.w[0][0], cam.w[0][1], cam.w[0][2]},
          {cam.w[1][0], cam.w[1][1], cam.w[1][2]},
          {cam.w[2][0], cam.w[2][1], cam.w[2][2]}};
}

}  // namespace aq

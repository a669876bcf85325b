// Projection of all Gaussians: one Splat, one depth and one radius each. Chunks of
// structure-of-arrays lanes, so that the compiler vectorises over Gaussians.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "constants.h"
#include "context.h"
#include "footprint.h"
#include "pool.h"
#include "simd.h"

namespace aq {

constexpr int kChunk = 64;

struct GaussianInputs {
  const float* means;      // [N, 3] metres, world
  const float* quats;      // [N, 4] wxyz, any length
  const float* scales;     // [N, 3] metres
  const float* opacities;  // [N]
  const float* colours;    // [N, channels]
};

struct ProjectedChunk {
  float u[kChunk], v[kChunk], a[kChunk], b[kChunk], c[kChunk], log2_opacity[kChunk];
  float extent_x[kChunk], extent_y[kChunk], depth[kChunk], radius[kChunk];
};

AQ_INLINE bool finite3(Vec3 a) {  // written so that NaN fails
  return (std::fabs(a.x) < HUGE_VALF) & (std::fabs(a.y) < HUGE_VALF) & (std::fabs(a.z) < HUGE_VALF);
}

// Culls (depth = -1) what is behind the near plane, degenerate, non-finite, fainter than kMinAlpha
// everywhere, or off the image.
AQ_INLINE void project_one(const Camera& cam, const Mat3& W, Vec3 mean, Quat quat, Vec3 scale,
                           float opacity, ProjectedChunk& out, int j) {
  const Footprint f = footprint(cam, W, mean, quat, scale);
  const Vec3 normal = cross(f.m0, f.m1);
  const float var0 = dot(f.m0, f.m0), var1 = dot(f.m1, f.m1), covariance = dot(f.m0, f.m1);
  // det(V') by Cauchy-Binet: no cancellation for needles, never below the dilation's square
  const float det = dot(normal, normal) + kDilationPx2 * (var0 + var1 + kDilationPx2);
  const float xx = var0 + kDilationPx2, yy = var1 + kDilationPx2, inverse_det = 1.0f / det;
  const float u = f.t.x * f.j00 + cam.cx, v = f.t.y * f.j11 + cam.cy;
  const float log2_opacity = log2_positive(opacity);
  const float reach = 2.0f * kLn2 * (log2_opacity - kLog2MinAlpha);  // squared Mahalanobis distance
  const float extent_x = std::sqrt(std::max(reach, 0.0f) * xx);
  const float extent_y = std::sqrt(std::max(reach, 0.0f) * yy);
  const float half_gap = 0.5f * (xx - yy);
  const float sigma =
      std::sqrt(0.5f * (xx + yy) + std::sqrt(half_gap * half_gap + covariance * covariance));
  const bool sound = finite3(mean) & finite3(scale) & (scale.x > 0) & (scale.y > 0) &
                     (scale.z > 0) & (f.quat_norm_sq > kMinQuatNormSq) &
                     (f.quat_norm_sq < HUGE_VALF) & (opacity < HUGE_VALF) & (sigma < kMaxSigmaPx);
  const bool seen = (f.t.z > kNearPlane) & (opacity > kMinAlpha) & (u + extent_x > 0) &
                    (u - extent_x < cam.width) & (v + extent_y > 0) & (v - extent_y < cam.height);
  const bool ok = sound & seen;
  out.u[j] = u - 0.5f;
  out.v[j] = v - 0.5f;
  out.a[j] = yy * inverse_det;
  out.b[j] = -covariance * inverse_det;
  out.c[j] = xx * inverse_det;
  out.log2_opacity[j] = log2_opacity;
  out.extent_x[j] = extent_x;
  out.extent_y[j] = extent_y;
  out.depth[j] = ok ? f.t.z : -1.0f;
  out.radius[j] = ok ? kRadiusSigmas * sigma : 0.0f;
}

AQ_INLINE Splat make_splat(const ProjectedChunk& p, int j, const float* colour, int channels) {
  Splat s;
  s.u = p.u[j];
  s.v = p.v[j];
  s.qa = -0.5f * kLog2e * p.a[j];
  s.qb = -kLog2e * p.b[j];
  s.qc = -0.5f * kLog2e * p.c[j];
  s.log2_opacity = p.log2_opacity[j];
  for (int k = 0; k < 4; k++) s.colour[k] = k < channels ? colour[k] : 0.0f;
  s.extent_x = p.extent_x[j];
  s.extent_y = p.extent_y[j];
  s.slope_x = -p.b[j] / p.a[j];
  s.slope_y = -p.b[j] / p.c[j];
  s.conic_a = p.a[j];
  s.conic_b = p.b[j];
  return s;
}

static void project_chunk(Context& ctx, const GaussianInputs& in, int begin, int size,
                          uint8_t* visible, float* radius_px) {
  ProjectedChunk p;
  const Camera cam = ctx.camera;
  const Mat3 W = view_rotation(cam);
  const float *means = in.means + 3 * (size_t)begin, *quats = in.quats + 4 * (size_t)begin;
  const float *scales = in.scales + 3 * (size_t)begin, *opacities = in.opacities + begin;
#pragma omp simd
  for (int j = 0; j < size; j++)
    project_one(cam, W, {means[3 * j], means[3 * j + 1], means[3 * j + 2]},
                {quats[4 * j], quats[4 * j + 1], quats[4 * j + 2], quats[4 * j + 3]},
                {scales[3 * j], scales[3 * j + 1], scales[3 * j + 2]}, opacities[j], p, j);
  int32_t seen[kChunk];
  for (int j = 0; j < size; j++) {
    const int i = begin + j;
    const float* colour = in.colours + (size_t)i * ctx.channels;
    bool finite = true;
    for (int k = 0; k < ctx.channels; k++) finite &= std::fabs(colour[k]) < HUGE_VALF;
    ctx.splats[i] = make_splat(p, j, colour, ctx.channels);
    seen[j] = (p.depth[j] > 0) & finite & ctx.active.touch(tile_box(ctx, ctx.splats[i]));
  }
  // a loop of its own has no branches to predict: under a mask they go either way
#pragma omp simd
  for (int j = 0; j < size; j++) {
    ctx.depth[begin + j] = seen[j] ? p.depth[j] : -1.0f;
    radius_px[begin + j] = seen[j] ? p.radius[j] : 0.0f;
    visible[begin + j] = (uint8_t)seen[j];
  }
}

static void project(Context& ctx, const GaussianInputs& in, uint8_t* visible, float* radius_px) {
  ctx.splats.resize(ctx.count);
  ctx.depth.resize(ctx.count);
  Pool::run(ctx.threads, [&](int part) {
    const int end = part_begin(ctx.count, kChunk, ctx.threads, part + 1);
    for (int i = part_begin(ctx.count, kChunk, ctx.threads, part); i < end; i += kChunk)
      project_chunk(ctx, in, i, std::min(kChunk, end - i), visible, radius_px);
  });
}

}  // namespace aq

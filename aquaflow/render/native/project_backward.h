// From gradients of the splats to gradients of the Gaussians and of the view matrix. In storage
// order, so that memory is read as a stream, and in chunks, so that the compiler vectorises over
// Gaussians.
#pragma once

#include <algorithm>
#include <cstddef>

#include "constants.h"
#include "context.h"
#include "footprint.h"
#include "moments.h"
#include "pool.h"
#include "project.h"
#include "simd.h"

namespace aq {

struct GaussianGradients {
  float *means, *quats, *scales, *opacities, *colours;
};

struct BackwardChunk {
  float moment[kMoments][kChunk];
  float a[kChunk], b[kChunk], c[kChunk];  // conic
  float mean[3][kChunk], scale[3][kChunk], quat[4][kChunk], opacity[kChunk];
};

constexpr int kViewElements = 12;

struct GradientChunk {
  float mean[3][kChunk], scale[3][kChunk], quat[4][kChunk];
  float view[kViewElements][kChunk];  // each Gaussian's part in dL/d(first three rows of viewmat)
};

AQ_INLINE void put(float (*to)[kChunk], int j, Vec3 a) {
  to[0][j] = a.x, to[1][j] = a.y, to[2][j] = a.z;
}

// dL/dV' from the moments: V'^-1 is the conic Q, so dL/dV' = -Q (dL/dQ) Q.
struct CovarianceGradient {
  float xx, xy, yy;  // xy: both off-diagonal elements together
};

AQ_INLINE CovarianceGradient covariance_gradient(float a, float b, float c, float gxx, float gxy,
                                                 float gyy) {
  const float qa = -0.5f * gxx, qb = -0.5f * gxy, qc = -0.5f * gyy;
  const float p00 = a * qa + b * qb, p01 = a * qb + b * qc;
  const float p10 = b * qa + c * qb, p11 = b * qb + c * qc;
  return {-(p00 * a + p01 * b), -(p00 * b + p01 * c) - (p10 * a + p11 * b), -(p10 * b + p11 * c)};
}

AQ_INLINE Quat quat_gradient(Quat q, float inverse_norm, const Mat3& g) {
  const float gw =
      2 * (q.x * (g.r2.y - g.r1.z) + q.y * (g.r0.z - g.r2.x) + q.z * (g.r1.x - g.r0.y));
  const float gx = 2 * (-2 * q.x * (g.r1.y + g.r2.z) + q.y * (g.r0.y + g.r1.x) +
                        q.z * (g.r0.z + g.r2.x) + q.w * (g.r2.y - g.r1.z));
  const float gy = 2 * (q.x * (g.r0.y + g.r1.x) - 2 * q.y * (g.r0.x + g.r2.z) +
                        q.z * (g.r1.z + g.r2.y) + q.w * (g.r0.z - g.r2.x));
  const float gz = 2 * (q.x * (g.r0.z + g.r2.x) + q.y * (g.r1.z + g.r2.y) -
                        2 * q.z * (g.r0.x + g.r1.y) + q.w * (g.r1.x - g.r0.y));
  const float along = gw * q.w + gx * q.x + gy * q.y + gz * q.z;  // the length has no effect
  return {(gw - along * q.w) * inverse_norm, (gx - along * q.x) * inverse_norm,
          (gy - along * q.y) * inverse_norm, (gz - along * q.z) * inverse_norm};
}

// A function of its own, so that its structs live in registers when the loop over j is vectorised.
AQ_INLINE void project_one_backward(const Camera& cam, const Mat3& W, const BackwardChunk& k, int j,
                                    GradientChunk& out) {
  const Vec3 mean{k.mean[0][j], k.mean[1][j], k.mean[2][j]};
  const Vec3 scale{k.scale[0][j], k.scale[1][j], k.scale[2][j]};
  const Footprint f =
      footprint(cam, W, mean, {k.quat[0][j], k.quat[1][j], k.quat[2][j], k.quat[3][j]}, scale);
  const float a = k.a[j], b = k.b[j], c = k.c[j];
  const float gu = a * k.moment[kGx][j] + b * k.moment[kGy][j];
  const float gv = b * k.moment[kGx][j] + c * k.moment[kGy][j];
  const CovarianceGradient g =
      covariance_gradient(a, b, c, k.moment[kGxx][j], k.moment[kGxy][j], k.moment[kGyy][j]);
  const Vec3 gm0 = 2 * g.xx * f.m0 + g.xy * f.m1, gm1 = 2 * g.yy * f.m1 + g.xy * f.m0;
  const Vec3 g_scale = gm0 * f.jwe0 + gm1 * f.jwe1;
  const Vec3 ge0 = gm0 * scale, ge1 = gm1 * scale;  // dL/d(rows of J W E)
  const Mat3 gE{f.jw0.x * ge0 + f.jw1.x * ge1, f.jw0.y * ge0 + f.jw1.y * ge1,
                f.jw0.z * ge0 + f.jw1.z * ge1};
  const Quat g_quat = quat_gradient(f.unit_quat, f.inverse_norm, gE);
  const Vec3 gw0 = f.E * ge0, gw1 = f.E * ge1;  // dL/d(rows of J W)
  const float g00 = dot(gw0, W.r0), g02 = dot(gw0, W.r2);
  const float g11 = dot(gw1, W.r1), g12 = dot(gw1, W.r2);
  const float g_tan_x = f.free_x ? -g02 * f.j00 : 0.0f, g_tan_y = f.free_y ? -g12 * f.j11 : 0.0f;
  const float g_inverse_z = cam.fx * (g00 - g02 * f.tan_x + gu * f.t.x) +
                            cam.fy * (g11 - g12 * f.tan_y + gv * f.t.y) + g_tan_x * f.t.x +
                            g_tan_y * f.t.y;
  const Vec3 gt{gu * f.j00 + g_tan_x * f.inverse_z, gv * f.j11 + g_tan_y * f.inverse_z,
                -g_inverse_z * f.inverse_z * f.inverse_z};  // dL/d(camera-frame mean)
  put(out.mean, j, gt * W);
  put(out.scale, j, g_scale);
  out.quat[0][j] = g_quat.w, out.quat[1][j] = g_quat.x;
  out.quat[2][j] = g_quat.y, out.quat[3][j] = g_quat.z;
  put(out.view, j, gt.x * mean + f.j00 * gw0);
  put(out.view + 4, j, gt.y * mean + f.j11 * gw1);
  put(out.view + 8, j, gt.z * mean + f.j02 * gw0 + f.j12 * gw1);
  out.view[3][j] = gt.x, out.view[7][j] = gt.y, out.view[11][j] = gt.z;
}

// Adds up the threads' sums. A culled Gaussian, whose records may hold anything, is replaced by a
// sound one with zero gradient.
static void load_chunk(const Context& ctx, const GaussianInputs& in, const float* gradient,
                       int begin, int size, BackwardChunk& k) {
  for (int j = 0; j < size; j++) {
    const size_t i = begin + j;
    const Splat& s = ctx.splats[i];
    const float* g = gradient + i * kGradientFloats;
    float sums[kGradientFloats];
    for (int q = 0; q < kGradientFloats; q++) sums[q] = g[q];
    for (int t = 1; t < ctx.threads; t++)
      for (int q = 0; q < kGradientFloats; q++)
        sums[q] += g[(size_t)t * ctx.count * kGradientFloats + q];
    const bool ok = ctx.depth[i] > 0;
    for (int q = 0; q < kMoments; q++) k.moment[q][j] = ok ? sums[moment_slot(q)] : 0.0f;
    k.a[j] = ok ? s.conic_a : 0.0f;
    k.b[j] = ok ? s.conic_b : 0.0f;
    k.c[j] = ok ? s.qc * (-2.0f / kLog2e) : 0.0f;
    for (int q = 0; q < 3; q++) k.mean[q][j] = ok ? in.means[3 * i + q] : 0.0f;
    for (int q = 0; q < 3; q++) k.scale[q][j] = ok ? in.scales[3 * i + q] : 0.0f;
    for (int q = 0; q < 4; q++) k.quat[q][j] = ok ? in.quats[4 * i + q] : q == 0 ? 1.0f : 0.0f;
    k.opacity[j] = ok ? in.opacities[i] : 1.0f;
  }
}

static void store_chunk(const BackwardChunk& k, const GradientChunk& g, int channels, int begin,
                        int size, const GaussianGradients& out) {
  for (int j = 0; j < size; j++) {
    const size_t i = begin + j;
    for (int q = 0; q < 3; q++) out.means[3 * i + q] = g.mean[q][j];
    for (int q = 0; q < 3; q++) out.scales[3 * i + q] = g.scale[q][j];
    for (int q = 0; q < 4; q++) out.quats[4 * i + q] = g.quat[q][j];
    out.opacities[i] = k.moment[kG][j] / k.opacity[j];
    for (int q = 0; q < channels; q++) out.colours[channels * i + q] = k.moment[kColour + q][j];
  }
}

static void add_view_gradient(const GradientChunk& g, int size, double* sums) {
  for (int q = 0; q < kViewElements; q++) {
    float total = 0;
#pragma omp simd reduction(+ : total)
    for (int j = 0; j < size; j++) total += g.view[q][j];
    sums[q] += total;
  }
}

static void clear_gradients(const Context& ctx, const GaussianGradients& out) {
  const size_t n = ctx.count;
  std::fill(out.means, out.means + 3 * n, 0.0f);
  std::fill(out.quats, out.quats + 4 * n, 0.0f);
  std::fill(out.scales, out.scales + 3 * n, 0.0f);
  std::fill(out.opacities, out.opacities + n, 0.0f);
  std::fill(out.colours, out.colours + ctx.channels * n, 0.0f);
}

// view_gradient: [4, 4], last row zero. Summed over chunks in double, in storage order.
static void project_backward(const Context& ctx, const GaussianInputs& in, const float* gradient,
                             const GaussianGradients& out, float* view_gradient) {
  double sums[kMaxThreads][kViewElements] = {};
  Pool::run(ctx.threads, [&](int part) {
    BackwardChunk chunk;
    GradientChunk gradients;
    const Camera cam = ctx.camera;
    const Mat3 W = view_rotation(cam);
    const int end = part_begin(ctx.count, kChunk, ctx.threads, part + 1);
    for (int i = part_begin(ctx.count, kChunk, ctx.threads, part); i < end; i += kChunk) {
      const int size = std::min(kChunk, end - i);
      load_chunk(ctx, in, gradient, i, size, chunk);
#pragma omp simd
      for (int j = 0; j < size; j++) project_one_backward(cam, W, chunk, j, gradients);
      store_chunk(chunk, gradients, ctx.channels, i, size, out);
      add_view_gradient(gradients, size, sums[part]);
    }
  });
  for (int q = 0; q < kViewElements; q++) {
    double total = 0;
    for (int part = 0; part < ctx.threads; part++) total += sums[part][q];
    view_gradient[q] = (float)total;
  }
  for (int q = kViewElements; q < 16; q++) view_gradient[q] = 0;
}

}  // namespace aq

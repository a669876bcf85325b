// From gradients of the splats to gradients of the Gaussians and of the view matrix. In storage order,
// so that memory is read as a stream, and in chunks, so that the compiler vectorises over Gaussians.
#pragma once

namespace aq {

struct GaussianGradients {
  float *means, *quats, *scales, *opacities, *colours;
};

// Sum over Gaussians: dL/dW and dL/dd.
struct ViewGradient {
  Vec3 w0, w1, w2, d;
};

struct BackwardChunk {
  float moment[kMoments][kChunk];
  float a[kChunk], b[kChunk], c[kChunk];
};

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
  const float gw = 2 * (q.x * (g.r2.y - g.r1.z) + q.y * (g.r0.z - g.r2.x) + q.z * (g.r1.x - g.r0.y));
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

struct OneGradient {
  Vec3 mean, scale, t, wx, wy;  // t: camera-frame mean; wx, wy: dL/d(rows of J W)
  Quat quat;
};

AQ_INLINE OneGradient project_one_backward(const Camera& cam, const Mat3& W, const Footprint& f,
                                           Vec3 scale, const BackwardChunk& k, int j) {
  OneGradient out;
  const float a = k.a[j], b = k.b[j], c = k.c[j];
  const float gu = a * k.moment[kGx][j] + b * k.moment[kGy][j];
  const float gv = b * k.moment[kGx][j] + c * k.moment[kGy][j];
  const CovarianceGradient g =
      covariance_gradient(a, b, c, k.moment[kGxx][j], k.moment[kGxy][j], k.moment[kGyy][j]);
  const Vec3 gm0 = 2 * g.xx * f.m0 + g.xy * f.m1, gm1 = 2 * g.yy * f.m1 + g.xy * f.m0;
  out.scale = gm0 * f.jwe0 + gm1 * f.jwe1;
  const Vec3 ge0 = gm0 * scale, ge1 = gm1 * scale;  // dL/d(rows of J W E)
  const Mat3 gE{f.jw0.x * ge0 + f.jw1.x * ge1, f.jw0.y * ge0 + f.jw1.y * ge1,
                f.jw0.z * ge0 + f.jw1.z * ge1};
  out.quat = quat_gradient(f.unit_quat, f.inverse_norm, gE);
  out.wx = f.E * ge0;
  out.wy = f.E * ge1;
  const float g00 = dot(out.wx, W.r0), g02 = dot(out.wx, W.r2);
  const float g11 = dot(out.wy, W.r1), g12 = dot(out.wy, W.r2);
  const float g_tan_x = f.free_x ? -g02 * f.j00 : 0.0f, g_tan_y = f.free_y ? -g12 * f.j11 : 0.0f;
  out.t.x = gu * f.j00 + g_tan_x * f.inverse_z;
  out.t.y = gv * f.j11 + g_tan_y * f.inverse_z;
  const float g_inverse_z = cam.fx * (g00 - g02 * f.tan_x + gu * f.t.x) +
                            cam.fy * (g11 - g12 * f.tan_y + gv * f.t.y) + g_tan_x * f.t.x +
                            g_tan_y * f.t.y;
  out.t.z = -g_inverse_z * f.inverse_z * f.inverse_z;
  out.mean = out.t * W;
  return out;
}

// Adds up the threads' sums and clears culled Gaussians, whose records may hold anything.
static void gather_moments(const Context& ctx, const float* gradient, int begin, int size,
                           BackwardChunk& k) {
  for (int j = 0; j < size; j++) {
    const Splat& s = ctx.splats[begin + j];
    const float* g = gradient + (size_t)(begin + j) * kGradientFloats;
    float sums[kGradientFloats];
    for (int q = 0; q < kGradientFloats; q++) sums[q] = g[q];
    for (int t = 1; t < ctx.threads; t++)
      for (int q = 0; q < kGradientFloats; q++)
        sums[q] += g[(size_t)t * ctx.count * kGradientFloats + q];
    const bool ok = ctx.depth[begin + j] > 0;
    for (int q = 0; q < kMoments; q++) k.moment[q][j] = ok ? sums[moment_slot(q)] : 0.0f;
    k.a[j] = ok ? s.conic_a : 0.0f;
    k.b[j] = ok ? s.conic_b : 0.0f;
    k.c[j] = ok ? s.qc * (-2.0f / kLog2e) : 0.0f;
  }
}

static ViewGradient project_chunk_backward(const Context& ctx, const GaussianInputs& in,
                                           const float* gradient, int begin, int size,
                                           const GaussianGradients& out) {
  BackwardChunk k;
  gather_moments(ctx, gradient, begin, size, k);
  const Camera cam = ctx.camera;
  const Mat3 W = view_rotation(cam);
  float x0 = 0, y0 = 0, z0 = 0, x1 = 0, y1 = 0, z1 = 0, x2 = 0, y2 = 0, z2 = 0, dx = 0, dy = 0, dz = 0;
  const float *means = in.means + 3 * (size_t)begin, *quats = in.quats + 4 * (size_t)begin;
  const float *scales = in.scales + 3 * (size_t)begin, *opacities = in.opacities + begin;
  const float* depth = ctx.depth.data() + begin;
  float *g_means = out.means + 3 * (size_t)begin, *g_quats = out.quats + 4 * (size_t)begin;
  float *g_scales = out.scales + 3 * (size_t)begin, *g_opacities = out.opacities + begin;
#pragma omp simd reduction(+ : x0, y0, z0, x1, y1, z1, x2, y2, z2, dx, dy, dz)
  for (int j = 0; j < size; j++) {
    const bool ok = depth[j] > 0;  // a culled Gaussian is replaced by a sound one with zero gradient
    const Vec3 mean{ok ? means[3 * j] : 0, ok ? means[3 * j + 1] : 0, ok ? means[3 * j + 2] : 0};
    const Vec3 scale{ok ? scales[3 * j] : 0, ok ? scales[3 * j + 1] : 0, ok ? scales[3 * j + 2] : 0};
    const Quat quat{ok ? quats[4 * j] : 1, ok ? quats[4 * j + 1] : 0, ok ? quats[4 * j + 2] : 0,
                    ok ? quats[4 * j + 3] : 0};
    const Footprint f = footprint(cam, W, mean, quat, scale);
    const OneGradient g = project_one_backward(cam, W, f, scale, k, j);
    g_opacities[j] = k.moment[kG][j] / (ok ? opacities[j] : 1.0f);
    g_means[3 * j] = g.mean.x;
    g_means[3 * j + 1] = g.mean.y;
    g_means[3 * j + 2] = g.mean.z;
    g_scales[3 * j] = g.scale.x;
    g_scales[3 * j + 1] = g.scale.y;
    g_scales[3 * j + 2] = g.scale.z;
    g_quats[4 * j] = g.quat.w;
    g_quats[4 * j + 1] = g.quat.x;
    g_quats[4 * j + 2] = g.quat.y;
    g_quats[4 * j + 3] = g.quat.z;
    const Vec3 w0 = g.t.x * mean + f.j00 * g.wx, w1 = g.t.y * mean + f.j11 * g.wy;
    const Vec3 w2 = g.t.z * mean + f.j02 * g.wx + f.j12 * g.wy;
    x0 += w0.x, y0 += w0.y, z0 += w0.z;
    x1 += w1.x, y1 += w1.y, z1 += w1.z;
    x2 += w2.x, y2 += w2.y, z2 += w2.z;
    dx += g.t.x, dy += g.t.y, dz += g.t.z;
  }
  for (int j = 0; j < size; j++)
    for (int q = 0; q < ctx.channels; q++)
      out.colours[(size_t)(begin + j) * ctx.channels + q] = k.moment[kColour + q][j];
  return {{x0, y0, z0}, {x1, y1, z1}, {x2, y2, z2}, {dx, dy, dz}};
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
  double sums[kMaxThreads][12] = {};
  Pool::run(ctx.threads, [&](int part) {
    const int end = part_begin(ctx.count, kChunk, ctx.threads, part + 1);
    for (int i = part_begin(ctx.count, kChunk, ctx.threads, part); i < end; i += kChunk) {
      const ViewGradient g =
          project_chunk_backward(ctx, in, gradient, i, std::min(kChunk, end - i), out);
      const float row_major[12] = {g.w0.x, g.w0.y, g.w0.z, g.d.x, g.w1.x, g.w1.y,
                                   g.w1.z, g.d.y,  g.w2.x, g.w2.y, g.w2.z, g.d.z};
      for (int q = 0; q < 12; q++) sums[part][q] += row_major[q];
    }
  });
  for (int q = 0; q < 12; q++) {
    double total = 0;
    for (int part = 0; part < ctx.threads; part++) total += sums[part][q];
    view_gradient[q] = (float)total;
  }
  for (int q = 12; q < 16; q++) view_gradient[q] = 0;
}

}  // namespace aq

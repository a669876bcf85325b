// The part of the neural Gaussians' decoder that knows the view (paper, Sec. 3.3.1), forward and
// backward:
//
//   o = [v, d],  h = relu(trunk + W gamma(o)),  r = tanh(heads h + bias) limits,  attributes =
//   initial + r
//
// Gaussians are taken in blocks, one lane each, so that every line of the arithmetic is a vector of
// them. The definition is Decoder.residuals and apply_residuals in
// aquaflow/mapping/neural/decoder.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "image_formation.h"
#include "pool.h"
#include "simd.h"

namespace aq {

constexpr int kMaxWidth = 64, kMaxCode = 36, kResiduals = 9, kBands = 4;
constexpr int kVecs = 2, kCrowd = kVecs * kLanes;  // Gaussians of a block
constexpr int kUnits = 4;  // hidden units whose sums are in registers at once
constexpr float kFurthest = 16.0f, kNearest = 1e-6f;  // of observation.py
constexpr float kPi = 3.14159265358979f;

typedef Vec Lanes[kVecs];  // one number of each Gaussian of a block

struct DecoderView {
  int count, width, code;  // Gaussians decoded, d, length of gamma(o): 36, or 27 without distance
  const int64_t *rows, *places;  // [count] Gaussian, and row of its trunk; each at most once
  const float* means;            // [N, 3]
  const float* centre;           // [3] of the camera
  const float* trunk;            // [P, d]
  const float* view;             // [d, code]
  const float *heads, *bias,
      *limits;         // [9, d / 2], [9], [9]: six of geometry on the first half of h
  const float* quats;  // [N, 4] initial
};

// What a block of Gaussians is decoded to, and all that its gradient needs.
struct DecodedBlock {
  alignas(64) float code[kMaxCode][kCrowd], hidden[kMaxWidth][kCrowd], residual[kResiduals][kCrowd];
  float sound[kCrowd];  // 1; 0 where the place is no number
  int size;
};

AQ_INLINE void load(const float* from, Lanes& to) { std::memcpy(&to, from, sizeof to); }
AQ_INLINE void store(const Lanes& from, float* to) { std::memcpy(to, &from, sizeof from); }

// sin and cos of pi x for |x| <= kFurthest, absolute error 2e-7: the period, then its half, folded
// away.
AQ_INLINE void sin_cos_pi(float x, float& sine, float& cosine) {
  const float half = 0.5f * x;
  float t = x - 2.0f * (float)(int)(half + (half < 0 ? -0.5f : 0.5f));
  const bool far = std::fabs(t) > 0.5f;
  t = far ? (t < 0 ? -1.0f : 1.0f) - t : t;
  const float y = kPi * t, y2 = y * y;
  float s = -2.5052108e-8f, c = 2.0876757e-9f;
  s = s * y2 + 2.7557319e-6f, c = c * y2 - 2.7557319e-7f;
  s = s * y2 - 1.9841270e-4f, c = c * y2 + 2.4801587e-5f;
  s = s * y2 + 8.3333333e-3f, c = c * y2 - 1.3888889e-3f;
  s = s * y2 - 1.6666667e-1f, c = c * y2 + 4.1666667e-2f;
  c = c * y2 - 0.5f;
  sine = y + y * y2 * s;
  cosine = (far ? -1.0f : 1.0f) * (1.0f + y2 * c);
}

// gamma(o): o, then sin and cos of 2^l pi o, octave by octave by the double angle.
static void encode(const DecoderView& in, int first, DecodedBlock& block) {
  const int inputs = in.code / (1 + 2 * kBands);
  alignas(64) float o[4][kCrowd], sine[4][kCrowd], cosine[4][kCrowd];
  for (int i = 0; i < kCrowd; i++) {
    const float* mean = in.means + 3 * in.rows[first + std::min(i, block.size - 1)];
    for (int c = 0; c < 3; c++) o[c][i] = mean[c] - in.centre[c];
  }
#pragma omp simd
  for (int i = 0; i < kCrowd; i++) {
    const float d = std::sqrt(o[0][i] * o[0][i] + o[1][i] * o[1][i] + o[2][i] * o[2][i]);
    const bool sound = d < 1e30f;  // NaN fails too
    const float inverse = sound ? 1.0f / std::max(d, kNearest) : 0.0f;
    for (int c = 0; c < 3; c++) o[c][i] = sound ? o[c][i] * inverse : 0.0f;
    o[3][i] = sound ? std::min(d, kFurthest) : 0.0f;
    block.sound[i] = sound ? 1.0f : 0.0f;
  }
  for (int c = 0; c < inputs; c++) {
    std::memcpy(block.code[c], o[c], sizeof o[c]);
#pragma omp simd
    for (int i = 0; i < kCrowd; i++) sin_cos_pi(o[c][i], sine[c][i], cosine[c][i]);
    for (int level = 0; level < kBands; level++) {
      float *s = block.code[inputs * (1 + 2 * level) + c],
            *k = block.code[inputs * (2 + 2 * level) + c];
#pragma omp simd
      for (int i = 0; i < kCrowd; i++) {
        s[i] = sine[c][i], k[i] = cosine[c][i];
        sine[c][i] = 2.0f * s[i] * k[i];
        cosine[c][i] = 1.0f - 2.0f * s[i] * s[i];
      }
    }
  }
}

// out[unit] = start[unit] + sum over e of weight[unit, e] x[e], for kUnits units.
AQ_INLINE void add_products(const float* weight, int stride, int inputs, const float (*x)[kCrowd],
                            Lanes (&sum)[kUnits]) {
  for (int e = 0; e < inputs; e++) {
    Lanes at;
    load(x[e], at);
#pragma GCC unroll 4
    for (int u = 0; u < kUnits; u++) {
      const float w = weight[u * stride + e];
#pragma GCC unroll 2
      for (int v = 0; v < kVecs; v++) sum[u][v] += splat(w) * at[v];
    }
  }
}

static void decode_block(const DecoderView& in, int first, DecodedBlock& block) {
  const int half = in.width / 2;
  block.size = std::min(kCrowd, in.count - first);
  encode(in, first, block);
  for (int i = 0; i < kCrowd; i++) {
    const float* own = in.trunk + in.width * in.places[first + std::min(i, block.size - 1)];
    for (int j = 0; j < in.width; j++) block.hidden[j][i] = own[j];
  }
  for (int j = 0; j < in.width; j += kUnits) {
    Lanes sum[kUnits];
    for (int u = 0; u < kUnits; u++) load(block.hidden[j + u], sum[u]);
    add_products(in.view + (size_t)j * in.code, in.code, in.code, block.code, sum);
    for (int u = 0; u < kUnits; u++) {
      for (int v = 0; v < kVecs; v++) sum[u][v] = max(sum[u][v], splat(0.0f));
      store(sum[u], block.hidden[j + u]);
    }
  }
  for (int r = 0; r < kResiduals; r++) {
    const float (*h)[kCrowd] = block.hidden + (r < 6 ? 0 : half);
    Lanes sum;
    for (int v = 0; v < kVecs; v++) sum[v] = splat(in.bias[r]);
    for (int j = 0; j < half; j++) {
      Lanes at;
      load(h[j], at);
      for (int v = 0; v < kVecs; v++) sum[v] += splat(in.heads[r * half + j]) * at[v];
    }
    store(sum, block.residual[r]);
#pragma omp simd
    for (int i = 0; i < kCrowd; i++) {  // tanh by exp(-2 |x|)
      const float x = block.residual[r][i], e = exp_negative(std::min(2.0f * std::fabs(x), 30.0f));
      const float t = (1.0f - e) / (1.0f + e);
      block.residual[r][i] = block.sound[i] * in.limits[r] * (x < 0 ? -t : t);
    }
  }
}

// q0 (1, u) / |(1, u)|, wxyz.
AQ_INLINE void turned(const float* q0, const float* u, float* q) {
  const float w = 1.0f / std::sqrt(1.0f + u[0] * u[0] + u[1] * u[1] + u[2] * u[2]);
  const float x = w * u[0], y = w * u[1], z = w * u[2];
  q[0] = q0[0] * w - q0[1] * x - q0[2] * y - q0[3] * z;
  q[1] = q0[0] * x + q0[1] * w + q0[2] * z - q0[3] * y;
  q[2] = q0[0] * y - q0[1] * z + q0[2] * w + q0[3] * x;
  q[3] = q0[0] * z + q0[1] * y - q0[2] * x + q0[3] * w;
}

// From the gradient of q: those of q0 (in place of g) and of u.
AQ_INLINE void turned_backward(const float* q0, const float* u, float* g, float* g_u) {
  const float norm = 1.0f / std::sqrt(1.0f + u[0] * u[0] + u[1] * u[1] + u[2] * u[2]);
  const float p[4] = {norm, norm * u[0], norm * u[1], norm * u[2]};
  const float g_p[4] = {q0[0] * g[0] + q0[1] * g[1] + q0[2] * g[2] + q0[3] * g[3],
                        -q0[1] * g[0] + q0[0] * g[1] + q0[3] * g[2] - q0[2] * g[3],
                        -q0[2] * g[0] - q0[3] * g[1] + q0[0] * g[2] + q0[1] * g[3],
                        -q0[3] * g[0] + q0[2] * g[1] - q0[1] * g[2] + q0[0] * g[3]};
  const float along = p[0] * g_p[0] + p[1] * g_p[1] + p[2] * g_p[2] + p[3] * g_p[3];
  for (int c = 0; c < 3; c++) g_u[c] = norm * (g_p[c + 1] - along * p[c + 1]);
  const float a = g[0], b = g[1], c = g[2], d = g[3];
  g[0] = a * p[0] + b * p[1] + c * p[2] + d * p[3];
  g[1] = -a * p[1] + b * p[0] - c * p[3] + d * p[2];
  g[2] = -a * p[2] + b * p[3] + c * p[0] - d * p[1];
  g[3] = -a * p[3] - b * p[2] + c * p[1] + d * p[0];
}

// quats [N, 4], log_scales [N, 3] and raw_colours [N, 3] come in as the initial ones.
inline void decode_view(const DecoderView& in, int threads, float* quats, float* log_scales,
                        float* raw_colours) {
  Pool::run(threads, [&](int part) {
    DecodedBlock block;
    const int last = part_begin(in.count, kCrowd, threads, part + 1);
    for (int first = part_begin(in.count, kCrowd, threads, part); first < last; first += kCrowd) {
      decode_block(in, first, block);
      for (int i = 0; i < block.size; i++) {
        const int64_t row = in.rows[first + i];
        const float u[3] = {block.residual[0][i], block.residual[1][i], block.residual[2][i]};
        turned(in.quats + 4 * row, u, quats + 4 * row);
        for (int c = 0; c < 3; c++) {
          log_scales[3 * row + c] += block.residual[3 + c][i];
          raw_colours[3 * row + c] += block.residual[6 + c][i];
        }
      }
    }
  });
}

}  // namespace aq

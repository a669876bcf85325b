// What is drawn of the Gaussians' raw parameters, and its gradient:
//
//   scale = exp(log_scale), opacity = 1 / (1 + exp(-logit)),
//   radiance = log(1 + exp(k raw)) / k, range = |mean - centre|
//
// with k = kSharpness. Numbers are taken in blocks of one array each, so that every line of the
// arithmetic is one vector.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "constants.h"
#include "exponential.h"
#include "pool.h"

namespace aq {

constexpr float kSharpness = 10.0f;     // of the softplus: the identity above about 0.3
constexpr float kMostExponent = 87.0f;  // exp(87) is near the largest float, exp(-87) the smallest
constexpr int kActivated = 64;          // numbers in a block

// exp(x), relative error 2e-7 within the limits above, which x is clamped to.
inline float exp_of(float x) {
  const float y = kLog2e * std::min(std::max(x, -kMostExponent), kMostExponent);
  return two_to(y, (int)(y + (y < 0.0f ? -0.5f : 0.5f)));
}

// log(1 + u) for 0 <= u <= 1, relative error 2e-7: the series of 2 atanh(u / (2 + u)).
inline float log_1_plus(float u) {
  const float s = u / (2.0f + u), q = s * s;
  float p = 1.0f / 13.0f;
  p = p * q + 1.0f / 11.0f;
  p = p * q + 1.0f / 9.0f;
  p = p * q + 1.0f / 7.0f;
  p = p * q + 1.0f / 5.0f;
  p = p * q + 1.0f / 3.0f;
  return 2.0f * s * (1.0f + p * q);
}

struct RawGaussians {
  const float *means, *log_scales, *opacity_logits, *raw_colours;  // [N, 3], [N, 3], [N], [N, 3]
  const float* centre;                                             // [3]
  int count;
};

// Calls work(first, n) for blocks of at most kActivated of ``count`` numbers.
template <class Work>
inline void in_blocks(size_t begin, size_t end, const Work& work) {
  for (size_t first = begin; first < end; first += kActivated)
    work(first, (int)std::min((size_t)kActivated, end - first));
}

// scales [N, 3], opacities [N], colours [N, 4]: radiance and range.
inline void activate(const RawGaussians& in, int threads, float* scales, float* opacities,
                     float* colours) {
  Pool::run(threads, [&](int part) {
    const size_t begin = part_begin(in.count, kActivated, threads, part);
    const size_t end = part_begin(in.count, kActivated, threads, part + 1);
    in_blocks(3 * begin, 3 * end, [&](size_t first, int n) {
#pragma omp simd
      for (int i = 0; i < n; i++) scales[first + i] = exp_of(in.log_scales[first + i]);
    });
    in_blocks(begin, end, [&](size_t first, int n) {
#pragma omp simd
      for (int i = 0; i < n; i++)
        opacities[first + i] = 1.0f / (1.0f + exp_of(-in.opacity_logits[first + i]));
    });
    in_blocks(begin, end, [&](size_t first, int n) {
      float J[3 * kActivated];
#pragma omp simd
      for (int i = 0; i < 3 * n; i++) {
        const float y = kSharpness * in.raw_colours[3 * first + i];
        J[i] = (std::max(y, 0.0f) + log_1_plus(exp_of(-std::fabs(y)))) / kSharpness;
      }
      for (int i = 0; i < n; i++) {
        const float* mean = in.means + 3 * (first + i);
        const float x = mean[0] - in.centre[0], y = mean[1] - in.centre[1],
                    z = mean[2] - in.centre[2];
        float* colour = colours + 4 * (first + i);
        for (int c = 0; c < 3; c++) colour[c] = J[3 * i + c];
        colour[3] = std::sqrt(x * x + y * y + z * z);
      }
    });
  });
}

struct ActivationGradients {
  const float *scales, *opacities, *colours;                 // come in: of what activate() gave
  float *means, *log_scales, *opacity_logits, *raw_colours;  // go out
};

// The centre is taken as fixed. ``scales`` and ``colours`` are activate()'s.
inline void activate_backward(const RawGaussians& in, int threads, const float* scales,
                              const float* colours, const ActivationGradients& g) {
  Pool::run(threads, [&](int part) {
    const size_t begin = part_begin(in.count, kActivated, threads, part);
    const size_t end = part_begin(in.count, kActivated, threads, part + 1);
    for (size_t i = 3 * begin; i < 3 * end; i++) g.log_scales[i] = g.scales[i] * scales[i];
    in_blocks(begin, end, [&](size_t first, int n) {
#pragma omp simd
      for (int i = 0; i < n; i++) {
        const size_t k = first + i;  // opacity (1 - opacity), without the cancellation near 1
        const float e = exp_of(-std::fabs(in.opacity_logits[k])), one_plus = 1.0f + e;
        g.opacity_logits[k] = g.opacities[k] * e / (one_plus * one_plus);
      }
    });
    in_blocks(begin, end, [&](size_t first, int n) {
      float slope[3 * kActivated];
#pragma omp simd
      for (int i = 0; i < 3 * n; i++)
        slope[i] = 1.0f / (1.0f + exp_of(-kSharpness * in.raw_colours[3 * first + i]));
      for (int i = 0; i < n; i++) {
        const size_t k = first + i;
        const float range = colours[4 * k + 3];
        const float by_range = range > 0.0f ? g.colours[4 * k + 3] / range : 0.0f;
        for (int c = 0; c < 3; c++) {
          g.raw_colours[3 * k + c] = g.colours[4 * k + c] * slope[3 * i + c];
          g.means[3 * k + c] = by_range * (in.means[3 * k + c] - in.centre[c]);
        }
      }
    });
  });
}

}  // namespace aq

// Underwater image formation (paper, Eq. 12 and 15) and its gradient:
//
//   I = s (J exp(-beta z) + u (a (B_inf (1 - exp(-b z)) + B_res exp(-d z)) + (1 - a) B_inf))
//
// per pixel and channel, with J premultiplied by alpha a, z = accumulated range / max(a,
// kMinSolid), u the gain of the backscatter at the pixel and s that of the camera. Pixels are taken
// in blocks and turned into planes, so that every line of the arithmetic is one vector.
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

#include "constants.h"
#include "exponential.h"
#include "pool.h"

namespace aq {

constexpr float kMaxOpticalDepth = 8.0f;  // exp(-8) is below a tenth of a grey level
constexpr float kMinSolid = 1e-3f;        // alpha below which nothing was drawn
constexpr int kWater = 15, kBlock = 64;

// Each [3] RGB, in this order.
enum WaterRow { kBeta, kBInf, kScatter, kBRes, kDecay };

// exp(-x) for 0 <= x <= kMaxOpticalDepth, relative error 2e-7.
inline float exp_negative(float x) {
  const float y = -kLog2e * x;
  return two_to(y, (int)(y - 0.5f));
}

struct WaterImages {
  const float* drawn;   // [P, 4] premultiplied radiance and accumulated range
  const float* alpha;   // [P]
  const float* water;   // [15]
  const float* uneven;  // [P] gain of the backscatter, or null for ones
  const float* gain;    // [P] of the camera, or null for ones
  int pixels;
};

struct WaterBlock {
  float J[3][kBlock], a[kBlock], z[kBlock], solid[kBlock], u[kBlock], s[kBlock];
  float T[3][kBlock], far[3][kBlock], near[3][kBlock];

  // Pixels [first, first + n).
  void load(const WaterImages& in, size_t first, int n) {
    const float *drawn = in.drawn + 4 * first, *alpha = in.alpha + first;
    for (int i = 0; i < n; i++) {
      for (int c = 0; c < 3; c++) J[c][i] = drawn[4 * i + c];
      a[i] = alpha[i];
      solid[i] = std::max(a[i], kMinSolid);
      z[i] = drawn[4 * i + 3] / solid[i];
      u[i] = in.uneven ? in.uneven[first + i] : 1.0f;
      s[i] = in.gain ? in.gain[first + i] : 1.0f;
    }
    for (int i = n; i < kBlock; i++)
      J[0][i] = J[1][i] = J[2][i] = a[i] = z[i] = 0.0f, solid[i] = u[i] = s[i] = 1.0f;
  }

  void attenuate(const float* water) {
    for (int c = 0; c < 3; c++) {
      const float beta = water[3 * kBeta + c], b = water[3 * kScatter + c],
                  d = water[3 * kDecay + c];
#pragma omp simd
      for (int i = 0; i < kBlock; i++) {
        const float range = std::max(z[i], 0.0f);
        T[c][i] = exp_negative(std::min(beta * range, kMaxOpticalDepth));
        far[c][i] = exp_negative(std::min(b * range, kMaxOpticalDepth));
        near[c][i] = exp_negative(std::min(d * range, kMaxOpticalDepth));
      }
    }
  }
};

inline void compose_water(const WaterImages& in, int threads, float* image, float* z) {
  Pool::run(threads, [&](int part) {
    WaterBlock block;
    const int last = part_begin(in.pixels, kBlock, threads, part + 1);
    for (int first = part_begin(in.pixels, kBlock, threads, part); first < last; first += kBlock) {
      const int n = std::min(kBlock, last - first);
      block.load(in, first, n);
      block.attenuate(in.water);
      for (int i = 0; i < n; i++) z[first + i] = block.z[i];
      for (int c = 0; c < 3; c++) {
        const float B_inf = in.water[3 * kBInf + c], B_res = in.water[3 * kBRes + c];
        float* out = image + 3 * (size_t)first + c;
        for (int i = 0; i < n; i++) {
          const float a = block.a[i];
          const float veil = B_inf * (1.0f - a * block.far[c][i]) + a * B_res * block.near[c][i];
          out[3 * i] = block.s[i] * (block.J[c][i] * block.T[c][i] + block.u[i] * veil);
        }
      }
    }
  });
}

// Gradients of one block; sums over its pixels go to g_water [15] in double.
inline void water_block_backward(const WaterBlock& block, const float* water,
                                 const float (*g)[kBlock], float (*g_J)[kBlock], float* g_a,
                                 float* g_z, double* g_water) {
  for (int c = 0; c < 3; c++) {
    const float beta = water[3 * kBeta + c], B_inf = water[3 * kBInf + c],
                b = water[3 * kScatter + c];
    const float B_res = water[3 * kBRes + c], d = water[3 * kDecay + c];
    float s_beta = 0, s_inf = 0, s_b = 0, s_res = 0, s_d = 0;
#pragma omp simd reduction(+ : s_beta, s_inf, s_b, s_res, s_d)
    for (int i = 0; i < kBlock; i++) {
      const float a = block.a[i], range = std::max(block.z[i], 0.0f), T = block.T[c][i];
      const float far = block.far[c][i], near = block.near[c][i];
      const float gi = block.s[i] * g[c][i], veil = block.u[i] * gi;
      // Derivatives with respect to the optical depths; zero where these are clamped.
      const float by_T = beta * range < kMaxOpticalDepth ? -gi * block.J[c][i] * T : 0.0f;
      const float by_far = b * range < kMaxOpticalDepth ? veil * a * B_inf * far : 0.0f;
      const float by_near = d * range < kMaxOpticalDepth ? -veil * a * B_res * near : 0.0f;
      g_J[c][i] = gi * T;
      g_a[i] += veil * (B_res * near - B_inf * far);
      g_z[i] += block.z[i] > 0.0f ? beta * by_T + b * by_far + d * by_near : 0.0f;
      s_beta += range * by_T, s_b += range * by_far, s_d += range * by_near;
      s_inf += veil * (1.0f - a * far), s_res += veil * a * near;
    }
    const float sums[] = {s_beta, s_inf, s_b, s_res, s_d};
    for (int row = 0; row < kWater / 3; row++) g_water[3 * row + c] += sums[row];
  }
}

// g_image [P, 3] and g_range [P] come in; g_drawn [P, 4], g_alpha [P] and g_water [15] go out.
inline void compose_water_backward(const WaterImages& in, int threads, const float* g_image,
                                   const float* g_range, float* g_drawn, float* g_alpha,
                                   float* g_water) {
  std::vector<double> sums((size_t)threads * kWater, 0.0);
  Pool::run(threads, [&](int part) {
    WaterBlock block;
    float g[3][kBlock], g_J[3][kBlock], g_a[kBlock], g_z[kBlock];
    const int last = part_begin(in.pixels, kBlock, threads, part + 1);
    for (int first = part_begin(in.pixels, kBlock, threads, part); first < last; first += kBlock) {
      const int n = std::min(kBlock, last - first);
      block.load(in, first, n);
      block.attenuate(in.water);
      for (int i = 0; i < kBlock; i++) {
        const size_t p = (size_t)first + i;
        for (int c = 0; c < 3; c++) g[c][i] = i < n ? g_image[3 * p + c] : 0.0f;
        g_a[i] = 0.0f, g_z[i] = i < n ? g_range[p] : 0.0f;
      }
      water_block_backward(block, in.water, g, g_J, g_a, g_z, sums.data() + (size_t)part * kWater);
      for (int i = 0; i < n; i++) {
        const size_t p = (size_t)first + i;
        const float by_range = g_z[i] / block.solid[i];
        for (int c = 0; c < 3; c++) g_drawn[4 * p + c] = g_J[c][i];
        g_drawn[4 * p + 3] = by_range;
        g_alpha[p] = g_a[i] - (block.a[i] > kMinSolid ? by_range * block.z[i] : 0.0f);
      }
    }
  });
  for (int row = 0; row < kWater; row++) {
    double total = 0;
    for (int part = 0; part < threads; part++) total += sums[(size_t)part * kWater + row];
    g_water[row] = (float)total;
  }
}

}  // namespace aq

// What the loss of a view has beside the pictures' likeness: pixels that are outliers, and the
// ranges of the prior.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "constants.h"
#include "pool.h"
#include "row_ring.h"

namespace aq {

constexpr float kSolidAlpha = 0.5f;  // above it the map's range means something
constexpr int kLossBlock = 4096;     // pixels that are summed at a time

// mask [P]: whether no channel's weighted residual exceeds ``tau``. rendered, target [P, 3].
inline void outlier_mask(const float* rendered, const float* target, const float* weight, float tau,
                         int pixels, int threads, uint8_t* mask) {
  Pool::run(threads, [&](int part) {
    const int last = part_begin(pixels, kLossBlock, threads, part + 1);
    for (int p = part_begin(pixels, kLossBlock, threads, part); p < last; p++) {
      bool within = true;  // not where a residual is no number
      for (int c = 0; c < kChannels; c++)
        within &= weight[p] * std::fabs(rendered[3 * p + c] - target[3 * p + c]) <= tau;
      mask[p] = within;
    }
  });
}

// All [P] but the last two.
struct RangeImages {
  const float *z, *alpha;      // of the map
  const float* inverse_range;  // of the prior, 0 where unknown
  const float* weight;
  float min_range;
  int pixels;
};

// Mean of weight |1 / z - inverse_range| where the prior knows and the map is solid; g_z [P] is its
// derivative. Blocks are summed in order: nothing depends on the number of threads.
inline float range_loss(const RangeImages& in, int threads, float* g_z) {
  const int blocks = (in.pixels + kLossBlock - 1) / kLossBlock;
  const float share = 1.0f / (float)in.pixels;
  std::vector<double> sums(blocks, 0.0);
  Pool::run(threads, [&](int part) {
    const int end = part_begin(blocks, 1, threads, part + 1);
    for (int block = part_begin(blocks, 1, threads, part); block < end; block++) {
      const int last = std::min(in.pixels, (block + 1) * kLossBlock);
      float total = 0;
#pragma omp simd reduction(+ : total)
      for (int p = block * kLossBlock; p < last; p++) {
        const bool known = in.inverse_range[p] > 0.0f && in.alpha[p] > kSolidAlpha;
        const float weight = known ? in.weight[p] : 0.0f;
        const float inverse = 1.0f / std::max(in.z[p], in.min_range);
        const float error = inverse - in.inverse_range[p];
        total += weight * std::fabs(error);
        const float slope = in.z[p] >= in.min_range ? -share * weight * inverse * inverse : 0.0f;
        g_z[p] = error > 0 ? slope : error < 0 ? -slope : 0.0f;
      }
      sums[block] = total;
    }
  });
  double loss = 0;
  for (double sum : sums) loss += sum;
  return (float)(loss / in.pixels);
}

}  // namespace aq

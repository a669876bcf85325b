// Gradient of decode_view.h. Blocks are decoded again: that is cheaper than to keep what was in
// them.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

#include "adam.h"
#include "decode_view.h"
#include "pool.h"
#include "simd.h"

namespace aq {

// Sums over Gaussians, lane by lane: of one thread, for the weights.
struct WeightSums {
  std::vector<float> lanes;
  explicit WeightSums(size_t weights) : lanes(weights * kLanes, 0.0f) {}

  void add(size_t weight, const Lanes& a, const Lanes& b) {
    Vec sum;
    float* at = lanes.data() + weight * kLanes;
    std::memcpy(&sum, at, sizeof sum);
    for (int v = 0; v < kVecs; v++) sum += a[v] * b[v];
    std::memcpy(at, &sum, sizeof sum);
  }

  double total(size_t weight) const {
    double sum = 0;
    for (int i = 0; i < kLanes; i++) sum += lanes[weight * kLanes + i];
    return sum;
  }
};

struct DecoderGradients {
  const float *log_scales, *raw_colours;  // [N, 3], also the gradients of the initial ones
  float* quats;                // [N, 4] comes in of the decoded ones, goes out of the initial
  float* trunk;                // [P, d]; places that were not decoded are left as they are
  float *view, *heads, *bias;  // [d, code], [9, d / 2], [9]
};

// Of the heads' outputs before tanh, [9] rows of the block; zero for padding.
static void residual_gradients(const DecoderView& in, int first, const DecodedBlock& block,
                               const DecoderGradients& out, float (*g)[kCrowd]) {
  for (int i = 0; i < kCrowd; i++) {
    if (i >= block.size) {
      for (int r = 0; r < kResiduals; r++) g[r][i] = 0.0f;
      continue;
    }
    const int64_t row = in.rows[first + i];
    const float u[3] = {block.residual[0][i], block.residual[1][i], block.residual[2][i]};
    float g_u[3];
    turned_backward(in.quats + 4 * row, u, out.quats + 4 * row, g_u);
    for (int c = 0; c < 3; c++) {
      g[c][i] = g_u[c];
      g[3 + c][i] = out.log_scales[3 * row + c];
      g[6 + c][i] = out.raw_colours[3 * row + c];
    }
  }
  for (int r = 0; r < kResiduals; r++) {
    const float limit = in.limits[r], inverse = 1.0f / limit;
#pragma omp simd
    for (int i = 0; i < kCrowd;
         i++) {  // what is not sound, or no number, must not reach the weights
      const float t = block.residual[r][i] * inverse, x = g[r][i] * limit * (1.0f - t * t);
      g[r][i] = block.sound[i] > 0.0f && std::fabs(x) < kLargestGradient ? x : 0.0f;
    }
  }
}

static void block_backward(const DecoderView& in, int first, const DecodedBlock& block,
                           const DecoderGradients& out, WeightSums& sums) {
  const int half = in.width / 2;
  const size_t heads_at = (size_t)in.width * in.code,
               bias_at = heads_at + (size_t)kResiduals * half;
  alignas(64) float g[kResiduals][kCrowd], g_hidden[kMaxWidth][kCrowd];
  residual_gradients(in, first, block, out, g);
  Lanes one;
  for (int v = 0; v < kVecs; v++) one[v] = splat(1.0f);
  for (int r = 0; r < kResiduals; r++) {
    Lanes g_r, h;
    load(g[r], g_r);
    sums.add(bias_at + r, g_r, one);
    for (int j = 0; j < half; j++) {
      load(block.hidden[j + (r < 6 ? 0 : half)], h);
      sums.add(heads_at + r * half + j, g_r, h);
    }
  }
  for (int j = 0; j < in.width; j++) {
    const bool geometry = j < half;
    Lanes sum, at;
    for (int v = 0; v < kVecs; v++) sum[v] = splat(0.0f);
    for (int r = geometry ? 0 : 6; r < (geometry ? 6 : kResiduals); r++) {
      load(g[r], at);
      for (int v = 0; v < kVecs; v++) sum[v] += splat(in.heads[r * half + j % half]) * at[v];
    }
    load(block.hidden[j], at);
    for (int v = 0; v < kVecs; v++) sum[v] = keep(greater(at[v], splat(0.0f)), sum[v]);
    store(sum, g_hidden[j]);
    for (int e = 0; e < in.code; e++) {
      load(block.code[e], at);
      sums.add((size_t)j * in.code + e, sum, at);
    }
  }
  for (int i = 0; i < block.size; i++) {
    float* own = out.trunk + in.width * in.places[first + i];
    for (int j = 0; j < in.width; j++) own[j] = g_hidden[j][i];
  }
}

inline void decode_view_backward(const DecoderView& in, int threads, const DecoderGradients& out) {
  const size_t view = (size_t)in.width * in.code, heads = (size_t)kResiduals * (in.width / 2);
  std::vector<WeightSums> sums(threads, WeightSums(view + heads + kResiduals));
  Pool::run(threads, [&](int part) {
    DecodedBlock block;
    const int last = part_begin(in.count, kCrowd, threads, part + 1);
    for (int first = part_begin(in.count, kCrowd, threads, part); first < last; first += kCrowd) {
      decode_block(in, first, block);
      block_backward(in, first, block, out, sums[part]);
    }
  });
  for (size_t weight = 0; weight < view + heads + kResiduals; weight++) {
    double total = 0;
    for (const WeightSums& part : sums) total += part.total(weight);
    float* at = weight < view           ? out.view + weight
                : weight < view + heads ? out.heads + (weight - view)
                                        : out.bias + (weight - view - heads);
    *at = (float)total;
  }
}

}  // namespace aq

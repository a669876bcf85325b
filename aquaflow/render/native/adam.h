// Adam over the rows (Gaussians) that were visible, each with its own step count, so that a
// Gaussian's first visible step is a proper first step.
//
// In chunks of rows: rows are judged one by one, then short rows (means, scales, ...) are stepped
// as one flat array, with each row's coefficients repeated over its elements. Without sums across
// rows: the result does not depend on the number of threads.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "pool.h"
#include "simd.h"

namespace aq {

// Layout shared with adam.py.
struct AdamGroup {
  float* param;           // [rows, dim]
  const float* gradient;  // [rows, dim]
  float* first_moment;    // [rows, dim]
  float* second_moment;   // [rows, dim]
  int32_t dim;
  float learning_rate;
};

// Its square is still finite; NaN fails the comparison too.
constexpr float kLargestGradient = 1e18f;
constexpr int kAdamRows = 16384;  // of a chunk: long runs of each array; its gradients stay cached
constexpr int kAdamBlock = 64;    // rows that are passed over together
constexpr int kAdamRun = 1024;    // rows stepped together if their counts are equal
constexpr int kAdamRowsPerThread = 4096;  // fewer are done before another thread is awake

struct AdamStep {
  int groups;
  const AdamGroup* group;
  int rows;
  const uint8_t* visible;  // [rows]
  int32_t* steps;          // [rows] visible steps so far
  double beta1, beta2;     // 1 - beta2 needs more digits than a float keeps
  float eps;
  const float* bias;  // [bias_rows, 2]: 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t) for t = 1, 2, ...
  int bias_rows;      // later steps use the last row, where both are 1
};

// Bias corrections of a chunk's rows; zero, which they never are, for a row that is not stepped.
struct ChunkBias {
  float first[kAdamRows], second[kAdamRows];
};

struct AdamCoefficients {
  float take1, take2, learning_rate, eps;
  AdamCoefficients(const AdamStep& s, const AdamGroup& g)
      : take1((float)(1 - s.beta1)), take2((float)(1 - s.beta2)), learning_rate(g.learning_rate),
        eps(s.eps) {}
};

// Always writes, if only what was there: processors are slow at masked stores.
AQ_INLINE void step_element(const AdamCoefficients& k, float bias1, float bias2, float gradient,
                            float& param, float& first_moment, float& second_moment) {
  const bool stepped = bias1 > 0;
  const float x = stepped ? gradient : 0.0f;  // what is not stepped may be NaN
  const float take1 = stepped ? k.take1 : 0.0f, take2 = stepped ? k.take2 : 0.0f;
  const float m = first_moment + take1 * (x - first_moment);
  const float v = second_moment + take2 * (x * x - second_moment);
  const float change = k.learning_rate * bias1 * m / (std::sqrt(v) * bias2 + k.eps);
  first_moment = m;
  second_moment = v;
  param -= stepped ? change : 0.0f;
}

// Calls visit(first row, rows) for runs of neighbouring blocks of [begin, begin + rows) that have a
// visible row each.
template <class Visit>
AQ_INLINE void each_visible_run(const AdamStep& s, int begin, int rows, const Visit& visit) {
  const int end = begin + rows;
  int first = begin;  // of the run that is being collected
  for (int row = begin; row < end; row += kAdamBlock) {
    const int size = std::min(kAdamBlock, end - row);
    const bool seen = std::memchr(s.visible + row, 1, size) != nullptr;
    const int last = seen ? row + size : row;
    if (last > first && (!seen || last == end || last - first == kAdamRun))
      visit(first, last - first), first = last;
    if (!seen) first = row + size;
  }
}

AQ_INLINE bool sound(const float* gradient, int count) {
  int broken = 0;
#pragma omp simd reduction(| : broken)
  for (int i = 0; i < count; i++) broken |= !(std::fabs(gradient[i]) < kLargestGradient);
  return !broken;
}

AQ_INLINE bool sound_row(const AdamStep& s, int row) {
  bool all = true;
  for (int g = 0; g < s.groups; g++)
    all &= sound(s.group[g].gradient + (size_t)row * s.group[g].dim, s.group[g].dim);
  return all;
}

// Whether the visible blocks of rows [begin, begin + rows) have sound gradients in all groups.
static bool sound_rows(const AdamStep& s, int begin, int rows) {
  bool all = true;
  for (int g = 0; g < s.groups; g++)
    each_visible_run(s, begin, rows, [&](int row, int size) {
      all &= sound(s.group[g].gradient + (size_t)row * s.group[g].dim, size * s.group[g].dim);
    });
  return all;
}

// Whether all rows are visible and have the same count of steps.
AQ_INLINE bool in_step(const uint8_t* visible, const int32_t* steps, int rows) {
  if (std::memchr(visible, 0, rows)) return false;
  const int32_t first = steps[0];
  int other = 0;
#pragma omp simd reduction(| : other)
  for (int j = 0; j < rows; j++) other |= steps[j] ^ first;
  return !other;
}

// Counts the steps of the rows and returns how many are visible but not sound.
static int start_rows(const AdamStep& s, int begin, int rows, bool all_sound, float* bias1,
                      float* bias2) {
  const uint8_t* visible = s.visible + begin;
  int32_t* steps = s.steps + begin;
  if (all_sound && in_step(visible, steps, rows)) {
    const int32_t count = steps[0];
    const float* at = s.bias + 2 * (size_t)std::min(count, s.bias_rows - 1);
    std::fill(bias1, bias1 + rows, at[0]);
    std::fill(bias2, bias2 + rows, at[1]);
    std::fill(steps, steps + rows, count + 1);
    return 0;
  }
  int skipped = 0;
  for (int j = 0; j < rows; j++) {
    const bool stepped = visible[j] & (all_sound || sound_row(s, begin + j));
    const float* at = s.bias + 2 * (size_t)std::min(steps[j], s.bias_rows - 1);
    bias1[j] = at[0] * stepped;
    bias2[j] = at[1] * stepped;
    steps[j] += stepped;
    skipped += visible[j] - stepped;
  }
  return skipped;
}

// Whether all rows are stepped, and at the same count.
AQ_INLINE bool uniform(const float* bias1, int rows) {
  const float first = bias1[0];
  int other = first == 0;
#pragma omp simd reduction(| : other)
  for (int j = 0; j < rows; j++) other |= bias1[j] != first;
  return !other;
}

// Each row's value once for each of its elements: the existing array, or `buffer`.
template <int Dim>
AQ_INLINE const float* repeated(const float* per_row, int rows, float* buffer) {
  if (Dim == 1) return per_row;
#pragma omp simd
  for (int j = 0; j < rows; j++) {
#pragma GCC unroll 4
    for (int d = 0; d < Dim; d++) buffer[Dim * j + d] = per_row[j];
  }
  return buffer;
}

// Rows of Dim elements, as one array.
template <int Dim>
static void step_short_rows(const AdamCoefficients& k, const AdamGroup& g, int begin, int rows,
                            const float* bias1, const float* bias2) {
  float buffer1[Dim * kAdamBlock], buffer2[Dim * kAdamBlock];
  const float* first = repeated<Dim>(bias1, rows, buffer1);
  const float* second = repeated<Dim>(bias2, rows, buffer2);
  const size_t at = (size_t)begin * Dim;
  float *param = g.param + at, *m = g.first_moment + at, *v = g.second_moment + at;
  const float* gradient = g.gradient + at;
#pragma omp simd
  for (int i = 0; i < Dim * rows; i++)
    step_element(k, first[i], second[i], gradient[i], param[i], m[i], v[i]);
}

static void step_long_rows(const AdamCoefficients& k, const AdamGroup& g, int begin, int rows,
                           const float* bias1, const float* bias2) {
  for (int j = 0; j < rows; j++) {
    if (bias1[j] == 0) continue;
    const size_t at = (size_t)(begin + j) * g.dim;
    float *param = g.param + at, *m = g.first_moment + at, *v = g.second_moment + at;
    const float* gradient = g.gradient + at;
#pragma omp simd
    for (int i = 0; i < g.dim; i++)
      step_element(k, bias1[j], bias2[j], gradient[i], param[i], m[i], v[i]);
  }
}

// Rows that all have the same bias, of any length, as one array.
static void step_uniform_rows(const AdamCoefficients& k, const AdamGroup& g, int begin, int rows,
                              float bias1, float bias2) {
  const size_t at = (size_t)begin * g.dim;
  float *param = g.param + at, *m = g.first_moment + at, *v = g.second_moment + at;
  const float* gradient = g.gradient + at;
#pragma omp simd
  for (int i = 0; i < g.dim * rows; i++)
    step_element(k, bias1, bias2, gradient[i], param[i], m[i], v[i]);
}

static void step_rows(const AdamCoefficients& k, const AdamGroup& g, int begin, int rows,
                      const float* bias1, const float* bias2) {
  switch (g.dim) {
    case 1: return step_short_rows<1>(k, g, begin, rows, bias1, bias2);
    case 2: return step_short_rows<2>(k, g, begin, rows, bias1, bias2);
    case 3: return step_short_rows<3>(k, g, begin, rows, bias1, bias2);
    case 4: return step_short_rows<4>(k, g, begin, rows, bias1, bias2);
    default: step_long_rows(k, g, begin, rows, bias1, bias2);
  }
}

static void step_run(const AdamStep& s, const AdamGroup& g, int begin, int rows, const float* bias1,
                     const float* bias2) {
  const AdamCoefficients k(s, g);
  if (uniform(bias1, rows)) return step_uniform_rows(k, g, begin, rows, bias1[0], bias2[0]);
  for (int row = 0; row < rows; row += kAdamBlock)
    step_rows(k, g, begin + row, std::min(kAdamBlock, rows - row), bias1 + row, bias2 + row);
}

static int step_chunk(const AdamStep& s, int begin, int rows) {
  ChunkBias bias;
  const bool all_sound = sound_rows(s, begin, rows);
  int skipped = 0;
  each_visible_run(s, begin, rows, [&](int row, int size) {
    const int at = row - begin;
    skipped += start_rows(s, row, size, all_sound, bias.first + at, bias.second + at);
  });
  for (int g = 0; g < s.groups; g++)
    each_visible_run(s, begin, rows, [&](int row, int size) {
      step_run(s, s.group[g], row, size, bias.first + row - begin, bias.second + row - begin);
    });
  return skipped;
}

static int adam_step(const AdamStep& s, int threads) {
  const int parts = std::min(threads, 1 + s.rows / kAdamRowsPerThread);
  int skipped[kMaxThreads] = {};
  Pool::run(parts, [&](int part) {
    const int end = part_begin(s.rows, kAdamBlock, parts, part + 1);
    for (int row = part_begin(s.rows, kAdamBlock, parts, part); row < end; row += kAdamRows)
      skipped[part] += step_chunk(s, row, std::min(kAdamRows, end - row));
  });
  int total = 0;
  for (int part = 0; part < parts; part++) total += skipped[part];
  return total;
}

}  // namespace aq

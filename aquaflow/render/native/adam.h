// Adam over the rows (Gaussians) that were visible, each with its own step count, so that a Gaussian's
// first visible step is a proper first step.
//
// Row-wise and without sums across rows: the result does not depend on the number of threads.
#pragma once

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

constexpr float kLargestGradient = 1e18f;  // its square is still finite; NaN fails the comparison too

struct AdamStep {
  int groups;
  const AdamGroup* group;
  int rows;
  const uint8_t* visible;  // [rows]
  int32_t* steps;          // [rows] visible steps so far
  double beta1, beta2;     // 1 - beta2 needs more digits than a float keeps
  float eps;
  const float* bias;       // [bias_rows, 2]: 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t) for t = 1, 2, ...
  int bias_rows;           // later steps use the last row, where both are 1
};

AQ_INLINE bool finite_row(const AdamStep& s, int row) {
  bool finite = true;
  for (int g = 0; g < s.groups; g++) {
    const float* gradient = s.group[g].gradient + (size_t)row * s.group[g].dim;
    for (int d = 0; d < s.group[g].dim; d++) finite &= std::fabs(gradient[d]) < kLargestGradient;
  }
  return finite;
}

AQ_INLINE void update_row(const AdamStep& s, const AdamGroup& g, int row, const float* bias) {
  const size_t at = (size_t)row * g.dim;
  const float keep1 = (float)s.beta1, take1 = (float)(1 - s.beta1);
  const float keep2 = (float)s.beta2, take2 = (float)(1 - s.beta2);
  const float step_size = g.learning_rate * bias[0];
  for (int d = 0; d < g.dim; d++) {
    const float x = g.gradient[at + d];
    const float m = keep1 * g.first_moment[at + d] + take1 * x;
    const float v = keep2 * g.second_moment[at + d] + take2 * x * x;
    g.first_moment[at + d] = m;
    g.second_moment[at + d] = v;
    g.param[at + d] -= step_size * m / (std::sqrt(v) * bias[1] + s.eps);
  }
}

static int adam_step(const AdamStep& s, int threads) {
  constexpr int kGrain = 256;
  int skipped[kMaxThreads] = {};
  Pool::run(threads, [&](int part) {
    const int end = part_begin(s.rows, kGrain, threads, part + 1);
    for (int row = part_begin(s.rows, kGrain, threads, part); row < end; row++) {
      if (!s.visible[row]) continue;
      if (!finite_row(s, row)) {
        skipped[part]++;
        continue;
      }
      const int step = s.steps[row]++;
      const float* bias = s.bias + 2 * (size_t)std::min(step, s.bias_rows - 1);
      for (int g = 0; g < s.groups; g++) update_row(s, s.group[g], row, bias);
    }
  });
  int total = 0;
  for (int part = 0; part < threads; part++) total += skipped[part];
  return total;
}

}  // namespace aq

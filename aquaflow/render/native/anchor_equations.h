// The normal equations of a joint adjustment, one anchor keyframe at a time. What each line does
// and why is in aquaflow/tracking/adjustment/equations.py (``equations_by_definition``), whose
// constants come in; the names are theirs.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace aq {

struct AnchorProblem {
  const double *R, *t;             // [V, 3, 3] and [V, 3] from the anchor to each view
  const double *rays, *rho;        // [P, 3] and [P]
  const double *at, *sigma;        // [V, P, 2] and [V]
  const uint8_t* used;             // [V, P]
  const double *known, *variance;  // [P]
  int32_t views, points;
  double min_z, huber, least_curvature;
};

// Over n = 7 (1 + V) unknowns: H [n, n], gradient [n], gain [P, n], offset [P], scores [P, n].
struct AnchorSums {
  double *H, *gradient, *gain, *offset, *scores;
};

constexpr int kSimilarity = 7;

// A point as a view sees it.
struct SeenPoint {
  double Y[3], inverse_z, error[2];
};

inline SeenPoint see_point(const AnchorProblem& in, int view, int point) {
  const double *R = in.R + 9 * view, *t = in.t + 3 * view, *ray = in.rays + 3 * point;
  const double* at = in.at + 2 * ((size_t)view * in.points + point);
  SeenPoint seen;
  for (int i = 0; i < 3; i++)
    seen.Y[i] =
        R[3 * i] * ray[0] + R[3 * i + 1] * ray[1] + R[3 * i + 2] * ray[2] + in.rho[point] * t[i];
  seen.inverse_z = 1.0 / std::max(seen.Y[2], in.min_z);
  for (int i = 0; i < 2; i++) seen.error[i] = seen.Y[i] * seen.inverse_z - at[i];
  return seen;
}

// Lengths [V, P] of the errors; 0 where a point is not seen.
inline void anchor_errors(const AnchorProblem& in, double* length) {
  for (int v = 0; v < in.views; v++) {
    for (int p = 0; p < in.points; p++) {
      const size_t match = (size_t)v * in.points + p;
      length[match] = 0.0;
      if (!in.used[match]) continue;
      const SeenPoint seen = see_point(in, v, p);
      length[match] = std::sqrt(seen.error[0] * seen.error[0] + seen.error[1] * seen.error[1]);
    }
  }
}

// Derivative of one coordinate by a step of a frame: ``J`` is that by the point Y in the frame,
// over the anchor's depth.
inline void by_similarity(const double* J, const double* Y, double rho, double* out) {
  for (int i = 0; i < 3; i++) out[i] = rho * J[i];
  out[3] = J[2] * Y[1] - J[1] * Y[2];
  out[4] = J[0] * Y[2] - J[2] * Y[0];
  out[5] = J[1] * Y[0] - J[0] * Y[1];
  out[6] = J[0] * Y[0] + J[1] * Y[1] + J[2] * Y[2];
}

inline void add_product(const double* left, const double* right, double weight, size_t n,
                        double* H) {
  for (int i = 0; i < kSimilarity; i++) {
    const double scaled = weight * left[i];
    for (int j = 0; j < kSimilarity; j++) H[i * n + j] += scaled * right[j];
  }
}

// What one match adds to its point's own sums and to H.
struct PointSums {
  double curvature, gradient;
  double *coupling, *score;  // [n]
};

inline void add_match(const AnchorProblem& in, int v, int p, size_t n, PointSums& sums, double* H) {
  const SeenPoint seen = see_point(in, v, p);
  const double iz = seen.inverse_z, sigma = in.sigma[v], rho = in.rho[p];
  const double *R = in.R + 9 * v, *t = in.t + 3 * v, *ray = in.rays + 3 * p, *e = seen.error;
  const double size = std::sqrt(e[0] * e[0] + e[1] * e[1]) / sigma;
  const double weight = std::min(in.huber / std::max(size, in.huber), 1.0) / (sigma * sigma);
  double* at_view = H + (1 + v) * kSimilarity * (n + 1);
  double* across = H + (1 + v) * kSimilarity * n;
  for (int row = 0; row < 2; row++) {
    double J[3] = {0.0, 0.0, -seen.Y[row] * iz * iz}, in_anchor[3];
    J[row] = iz;
    for (int i = 0; i < 3; i++) in_anchor[i] = J[0] * R[i] + J[1] * R[3 + i] + J[2] * R[6 + i];
    double by_view[kSimilarity], by_anchor[kSimilarity];
    by_similarity(J, seen.Y, rho, by_view);
    by_similarity(in_anchor, ray, rho, by_anchor);
    for (double& value : by_view) value = -value;
    const double by_rho = J[0] * t[0] + J[1] * t[1] + J[2] * t[2];
    const double pulled = weight * by_rho, left = weight * e[row];
    sums.curvature += pulled * by_rho;
    sums.gradient += pulled * e[row];
    double* coupling = sums.coupling + (1 + v) * kSimilarity;
    double* score = sums.score + (1 + v) * kSimilarity;
    for (int i = 0; i < kSimilarity; i++) {
      coupling[i] += pulled * by_view[i], sums.coupling[i] += pulled * by_anchor[i];
      score[i] += left * by_view[i], sums.score[i] += left * by_anchor[i];
    }
    add_product(by_anchor, by_anchor, weight, n, H);
    add_product(by_view, by_anchor, weight, n, across);
    add_product(by_view, by_view, weight, n, at_view);
  }
}

// Takes a point's depth out of H: its row of the coupling over the curvature, for the frames that
// see it.
inline void eliminate_depth(const std::vector<int>& frames, const double* coupling,
                            const double* gain, size_t n, double* H) {
  for (int a : frames) {
    for (int b : frames) {
      if (b > a) continue;  // the other half follows
      double* block = H + a * kSimilarity * n + b * kSimilarity;
      const double *left = coupling + a * kSimilarity, *right = gain + b * kSimilarity;
      for (int i = 0; i < kSimilarity; i++)
        for (int j = 0; j < kSimilarity; j++) block[i * n + j] -= left[i] * right[j];
    }
  }
}

inline void anchor_equations(const AnchorProblem& in, const AnchorSums& out) {
  const size_t n = kSimilarity * (1 + (size_t)in.views);
  std::fill_n(out.H, n * n, 0.0);
  std::fill_n(out.gradient, n, 0.0);
  std::fill_n(out.gain, n * in.points, 0.0);
  std::fill_n(out.scores, n * in.points, 0.0);
  std::vector<double> coupling(n);
  std::vector<int> frames;
  for (int p = 0; p < in.points; p++) {
    std::fill(coupling.begin(), coupling.end(), 0.0);
    frames.assign(1, 0);
    double *gain = out.gain + n * p, *score = out.scores + n * p;
    PointSums sums{0.0, 0.0, coupling.data(), score};
    for (int v = 0; v < in.views; v++) {
      if (!in.used[(size_t)v * in.points + p]) continue;
      add_match(in, v, p, n, sums, out.H);
      frames.push_back(1 + v);
    }
    const double precision = 1.0 / in.variance[p];
    const double curvature = sums.curvature + precision + in.least_curvature;
    out.offset[p] = (sums.gradient + precision * (in.rho[p] - in.known[p])) / curvature;
    for (int frame : frames) {
      for (int i = frame * kSimilarity; i < (frame + 1) * kSimilarity; i++) {
        gain[i] = coupling[i] / curvature;
        score[i] -= out.offset[p] * coupling[i];
        out.gradient[i] += score[i];
      }
    }
    eliminate_depth(frames, coupling.data(), gain, n, out.H);
  }
  for (size_t i = 0; i < n; i++)
    for (size_t j = 0; j < i; j++) out.H[j * n + i] = out.H[i * n + j];
}

}  // namespace aq

// Cost and normal equations of a pose by the pixel residual. What each line does and why is in
// aquaflow/tracking/pose/residuals.py (``pixel_rows``) and solver.py, whose constants come in; the
// names are theirs.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace aq {

struct PoseEquations {
  const double *X, *Y, *Z, *variance, *u, *v, *weights;  // [M] each
  const double* nearer;                                  // [M], or null
  int32_t count;
  double fx, fy, cx, cy, sigma_px;
  double R[9], t[3], scale;
  double nearest, huber, behind_residual, most_change, inlier;
};

// Left tangent [translation, rotation].
constexpr int kPose = 6;

struct PoseResult {
  double H[kPose * kPose], g[kPose], cost;
};

// Matches that are linearised before their products are summed: they stay in the first cache.
constexpr int kPoseBlock = 128;

struct PoseBlock {
  double residual[2 * kPoseBlock], J[kPose][2 * kPoseBlock];  // along, then across
};

// Rows of the matches from ``first`` on, without a branch, so that they become vectors.
inline void pose_rows(const PoseEquations in, int first, int count, PoseBlock& out) {
  const double (&R)[9] = in.R;
  const double tx = in.t[0], ty = in.t[1], tz = in.t[2], fx = in.fx, fy = in.fy;
  const double *X = in.X + first, *Y = in.Y + first, *Z = in.Z + first, *u = in.u + first,
               *v = in.v + first, *variances = in.variance + first;
  const double* nearer = in.nearer ? in.nearer + first : in.u;
  const bool around = in.nearer != nullptr;
  const double across_precision = 1.0 / in.sigma_px, noise = in.sigma_px * in.sigma_px;
#pragma omp simd
  for (int i = 0; i < count; i++) {
    const double variance = variances[i], z = Z[i];
    const double mx = in.scale * (R[0] * X[i] + R[1] * Y[i] + R[2] * z);
    const double my = in.scale * (R[3] * X[i] + R[4] * Y[i] + R[5] * z);
    const double mz = in.scale * (R[6] * X[i] + R[7] * Y[i] + R[8] * z);
    const double depth = mz + tz;
    const bool behind = depth < in.nearest;
    const double in_front = 1.0 / (behind ? 1.0 : depth);
    const double x0 = (mx + tx) * in_front, y0 = (my + ty) * in_front;
    const double error_u = fx * x0 + (in.cx - u[i]), error_v = fy * y0 + (in.cy - v[i]);
    // The epipolar direction.
    const double lever = in_front * z;
    const double du = fx * lever * (tx - x0 * tz), dv = fy * lever * (ty - y0 * tz);
    const double spread = std::sqrt(du * du + dv * dv);
    const bool still = spread < 1e-12;
    const double shorten = 1.0 / (still ? 1.0 : spread);
    const double along_u = still ? 1.0 : du * shorten, along_v = dv * shorten;
    const double along = along_u * error_u + along_v * error_v;
    const double precision = 1.0 / (noise + variance * spread * spread);
    const double along_precision = std::sqrt(precision);
    const double first_residual = along * along_precision;
    const double second_residual = (along_u * error_v - along_v * error_u) * across_precision;
    // Where the derivatives are taken.
    const double best = std::min(
        std::max(-z * variance * spread * along * precision, -in.most_change), in.most_change);
    const bool outlier =
        (std::fabs(first_residual) >= in.inlier) | (std::fabs(second_residual) >= in.inlier);
    const double change = around ? nearer[i] - 1.0 : (outlier ? 0.0 : best);
    const double closer = 1.0 / (1.0 + change);
    const double iz = 1.0 / std::max(mz * closer + tz, in.nearest);
    const double x = (mx * closer + tx) * iz, y = (my * closer + ty) * iz;
    const double gradient = behind ? 0.0 : 1.0;
    out.residual[i] = behind ? in.behind_residual : first_residual;
    out.residual[kPoseBlock + i] = behind ? in.behind_residual : second_residual;
    const double ps[2] = {fx * along_u * along_precision, -fx * along_v * across_precision};
    const double qs[2] = {fy * along_v * along_precision, fy * along_u * across_precision};
    for (int row = 0; row < 2; row++) {
      const double p = gradient * ps[row], q = gradient * qs[row], r = -(p * x + q * y);
      const int at = row * kPoseBlock + i;
      out.J[0][at] = p * iz, out.J[1][at] = q * iz, out.J[2][at] = r * iz;
      out.J[3][at] = y * r - q, out.J[4][at] = p - x * r, out.J[5][at] = x * q - y * p;
    }
  }
}

// Adds a block's matches, each weighted by Huber's weight and its own, to ``out``.
inline void add_pose_block(const PoseEquations& in, int first, int count, PoseBlock& block,
                           PoseResult& out) {
  const double huber = in.huber, *weights = in.weights + first;
  double cost = 0.0;
  for (int row = 0; row < 2; row++) {
    double* residual = block.residual + row * kPoseBlock;
#pragma omp simd reduction(+ : cost)
    for (int i = 0; i < count; i++) {
      const double size = std::fabs(residual[i]), near = std::min(size, huber);
      cost += (size - 0.5 * near) * near * weights[i];
      const double root = std::sqrt(huber / std::max(size, huber) * weights[i]);
      residual[i] *= root;
      for (int k = 0; k < kPose; k++) block.J[k][row * kPoseBlock + i] *= root;
    }
  }
  out.cost += cost;
  for (int j = 0; j < kPose; j++) {
    for (int row = 0; row < 2; row++) {
      const double *left = block.J[j] + row * kPoseBlock, *end = block.residual + row * kPoseBlock;
      double gradient = 0.0;
#pragma omp simd reduction(+ : gradient)
      for (int i = 0; i < count; i++) gradient += left[i] * end[i];
      out.g[j] += gradient;
      for (int k = j; k < kPose; k++) {
        const double* right = block.J[k] + row * kPoseBlock;
        double product = 0.0;
#pragma omp simd reduction(+ : product)
        for (int i = 0; i < count; i++) product += left[i] * right[i];
        out.H[kPose * j + k] += product;
      }
    }
  }
}

// What is left of every match at a pose, and what it pulls the pose by: weighted J' residual.
struct PoseLeft {
  double *residual, *pull;  // [2, M] and [6, M]
};

inline void leave_pose_block(const PoseEquations& in, int first, int count, const PoseBlock& block,
                             const PoseLeft& left) {
  const double huber = in.huber, *weights = in.weights + first;
  const double *along = block.residual, *across = block.residual + kPoseBlock;
  std::copy_n(along, count, left.residual + first);
  std::copy_n(across, count, left.residual + in.count + first);
  for (int k = 0; k < kPose; k++) {
    const double* J = block.J[k];
    double* pull = left.pull + (size_t)k * in.count + first;
#pragma omp simd
    for (int i = 0; i < count; i++) {
      const double a = along[i] * (huber / std::max(std::fabs(along[i]), huber));
      const double b = across[i] * (huber / std::max(std::fabs(across[i]), huber));
      pull[i] = (J[i] * a + J[kPoseBlock + i] * b) * weights[i];
    }
  }
}

// ``left`` may be null.
inline void pose_equations(const PoseEquations& in, PoseResult& out, const PoseLeft* left) {
  std::fill_n(out.H, kPose * kPose, 0.0);
  std::fill_n(out.g, kPose, 0.0);
  out.cost = 0.0;
  PoseBlock block;
  for (int first = 0; first < in.count; first += kPoseBlock) {
    const int count = std::min(kPoseBlock, in.count - first);
    pose_rows(in, first, count, block);
    if (left) leave_pose_block(in, first, count, block, *left);
    add_pose_block(in, first, count, block, out);
  }
  for (int j = 0; j < kPose; j++)
    for (int k = 0; k < j; k++) out.H[kPose * j + k] = out.H[kPose * k + j];
}

}  // namespace aq

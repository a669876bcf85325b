// Two-view depths of every matched pixel, fused into a keyframe's pointmap. What each line does and
// why is in aquaflow/geometry/triangulation.py and aquaflow/tracking/pose/depth_fusion.py, whose
// constants come in; the names are theirs.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace aq {

struct FuseDepths {
  const float* matches;     // [H, W, 2] px
  const uint8_t* valid;     // [H, W]
  const float* confidence;  // [H, W]
  double *rho, *variance;   // [H, W], come in and go out
  int32_t width, height;
  double fx_a, fy_a, cx_a, cy_a, fx_b, fy_b, cx_b, cy_b;
  double R[9], t[3];  // T_ba, t in units of a
  double sigma_px;
  double min_rho, max_rho, min_depth, max_reprojection_px, min_cross_sq, min_sine;
  double unknown_variance, least_confidence, measurement_floor, fused_floor, gate_sigmas,
      disagreement_inflation, forgetting_sigmas;
};

// One row; returns the number of its pixels that got a usable measurement. Without a branch, so
// that it becomes vectors.
inline int fuse_row(const FuseDepths& in, int y) {
  const size_t first = (size_t)y * in.width;
  const float* match = in.matches + 2 * first;
  const float* sure = in.confidence + first;
  const uint8_t* valid = in.valid + first;
  double *rho = in.rho + first, *variance = in.variance + first;
  const double *R = in.R, tx = in.t[0], ty = in.t[1], tz = in.t[2];
  // Centre of b in a.
  const double ox = -(R[0] * tx + R[3] * ty + R[6] * tz), oy = -(R[1] * tx + R[4] * ty + R[7] * tz),
               oz = -(R[2] * tx + R[5] * ty + R[8] * tz);
  const double ya = ((double)y + 0.5 - in.cy_a) / in.fy_a;
  const double most_off = in.max_reprojection_px * in.max_reprojection_px;
  const double gate = in.gate_sigmas * in.gate_sigmas;
  const double forgetting = in.forgetting_sigmas * in.forgetting_sigmas;
  int measured = 0;
#pragma omp simd reduction(+ : measured)
  for (int x = 0; x < in.width; x++) {
    const double old_rho = rho[x], old_variance = variance[x];
    const bool fresh =
        (old_variance >= in.unknown_variance) | (old_variance > forgetting * old_rho * old_rho);
    // Triangulation.
    const double xa = ((double)x + 0.5 - in.cx_a) / in.fx_a;
    const double xb = ((double)match[2 * x] - in.cx_b) / in.fx_b;
    const double yb = ((double)match[2 * x + 1] - in.cy_b) / in.fy_b;
    const double ax = R[0] * xa + R[1] * ya + R[2], ay = R[3] * xa + R[4] * ya + R[5],
                 az = R[6] * xa + R[7] * ya + R[8];
    const double cx = yb * az - ay, cy = ax - xb * az, cz = xb * ay - yb * ax;
    const double dx = yb * tz - ty, dy = tx - xb * tz, dz = xb * ty - yb * tx;
    const double cc = cx * cx + cy * cy + cz * cz, dd = dx * dx + dy * dy + dz * dz;
    const double solved = -(cx * dx + cy * dy + cz * dz) / std::max(dd, 1e-18);
    const double new_rho = std::min(std::max(solved, in.min_rho), in.max_rho);
    const double z = 1.0 / new_rho;
    const double expected_z =
        !fresh & (old_rho > in.min_rho) ? 1.0 / std::max(old_rho, in.min_rho) : z;
    const double ux = ya * oz - oy, uy = ox - xa * oz, uz = xa * oy - ya * ox;
    const double across = ux * ux + uy * uy + uz * uz;
    const double along = expected_z * (xa * xa + ya * ya + 1.0) - (xa * ox + ya * oy + oz);
    const double sine = std::sqrt(across / std::max(across + along * along, 1e-300));
    const double in_b = z * az + tz, inverse = 1.0 / std::max(in_b, in.min_depth);
    const double off_u = in.fx_b * ((z * ax + tx) * inverse - xb);
    const double off_v = in.fy_b * ((z * ay + ty) * inverse - yb);
    const bool good = (solved > in.min_rho) & (z > in.min_depth) & (in_b > in.min_depth) &
                      (off_u * off_u + off_v * off_v < most_off) & (sine > in.min_sine) &
                      (cc > in.min_cross_sq) & (valid[x] != 0);
    const double sigma = (in.sigma_px / in.fx_b) / (expected_z * std::max(sine, 1e-6));
    // Fusion.
    const double trust = std::max((double)sure[x], in.least_confidence);
    const double floor = in.measurement_floor * (fresh ? new_rho : old_rho);
    const double new_variance = std::max(sigma * sigma / trust, floor * floor);
    const double distance = new_rho - old_rho, both = new_variance + old_variance;
    const bool agrees = fresh | (distance * distance < gate * both);
    const double merged =
        fresh ? new_rho : (new_rho * old_variance + old_rho * new_variance) / both;
    const double fused = in.fused_floor * merged;
    const double merged_variance =
        std::max(fresh ? new_variance : new_variance * old_variance / both, fused * fused);
    // Nothing that is no number passes a comparison.
    const bool sound = good & (std::fabs(merged) <= 1.7e308) & (merged_variance <= 1.7e308);
    rho[x] = sound & agrees ? merged : old_rho;
    variance[x] = !sound ? old_variance
                         : (agrees ? merged_variance : old_variance * in.disagreement_inflation);
    measured += good ? 1 : 0;
  }
  return measured;
}

inline int fuse_depths(const FuseDepths& in) {
  int measured = 0;
  for (int y = 0; y < in.height; y++) measured += fuse_row(in, y);
  return measured;
}

}  // namespace aq

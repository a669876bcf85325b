// Two-view depths of every matched pixel, fused into a keyframe's pointmap. What each line does and
// why is in aquaflow/geometry/two_view.py and aquaflow/tracking/pose/depth_fusion.py, whose
// constants come in; the names are theirs. In single precision: its rounding, some 1e-4 of a depth
// where the parallax is least, is a hundredth of what no measurement is trusted beyond.
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

// What is the same for all pixels of a row.
struct FuseRow {
  FuseRow(const FuseDepths& in, int y) {
    const double *r = in.R, *t = in.t;
    const double ya = ((double)y + 0.5 - in.cy_a) / in.fy_a;
    // Direction of a pixel's ray in b: start + xa * step.
    for (int k = 0; k < 3; k++) {
      step[k] = (float)r[3 * k];
      start[k] = (float)(r[3 * k + 1] * ya + r[3 * k + 2]);
      centre[k] = -(float)(r[k] * t[0] + r[3 + k] * t[1] + r[6 + k] * t[2]);  // of b in a
      at[k] = (float)t[k];
    }
    row = (float)ya;
  }
  float step[3], start[3], centre[3], at[3], row;
};

constexpr int kFuseAtOnce = 128;  // pixels of a row, whose results wait in the first cache

// Up to kFuseAtOnce pixels from (x0, y) on; returns how many of them got a usable measurement.
// Without a branch, so that it becomes vectors: what is chosen between is computed first, and
// SSE4 and NEON have no vector that chooses between doubles by a comparison of floats.
inline int fuse_pixels(const FuseDepths& in, const FuseRow& row, int y, int x0, int count) {
  const size_t first = (size_t)y * in.width + x0;
  const float *match = in.matches + 2 * first, *sure = in.confidence + first;
  const uint8_t* valid = in.valid + first;
  double *rho = in.rho + first, *variance = in.variance + first;
  const float ya = row.row, tx = row.at[0], ty = row.at[1], tz = row.at[2];
  const float ox = row.centre[0], oy = row.centre[1], oz = row.centre[2];
  const float per_fx_a = (float)(1.0 / in.fx_a), cx_a = (float)in.cx_a;
  const float fx_b = (float)in.fx_b, fy_b = (float)in.fy_b;
  const float cx_b = (float)in.cx_b, cy_b = (float)in.cy_b;
  const float per_fx_b = 1.0f / fx_b, per_fy_b = 1.0f / fy_b;
  const float angle = (float)(in.sigma_px / in.fx_b);
  const float min_rho = (float)in.min_rho, max_rho = (float)in.max_rho;
  const float min_depth = (float)in.min_depth, min_cross_sq = (float)in.min_cross_sq;
  const float min_sine = (float)in.min_sine, unknown = (float)in.unknown_variance;
  const float least_sure = (float)in.least_confidence;
  const float measurement_floor = (float)in.measurement_floor;
  const float fused_floor = (float)in.fused_floor, inflation = (float)in.disagreement_inflation;
  const float most_off = (float)(in.max_reprojection_px * in.max_reprojection_px);
  const float gate = (float)(in.gate_sigmas * in.gate_sigmas);
  const float forgetting = (float)(in.forgetting_sigmas * in.forgetting_sigmas);
  const float largest = 3e38f;
  float changed_rho[kFuseAtOnce], changed_variance[kFuseAtOnce];
  int32_t use_rho[kFuseAtOnce], use_variance[kFuseAtOnce];
  int measured = 0;
#pragma omp simd reduction(+ : measured)
  for (int x = 0; x < count; x++) {
    const float old_rho = (float)rho[x], old_variance = (float)variance[x];
    const bool fresh = (old_variance >= unknown) | (old_variance > forgetting * old_rho * old_rho);
    // Triangulation.
    const float xa = ((float)(x0 + x) + 0.5f - cx_a) * per_fx_a;
    const float xb = (match[2 * x] - cx_b) * per_fx_b, yb = (match[2 * x + 1] - cy_b) * per_fy_b;
    const float ax = row.step[0] * xa + row.start[0], ay = row.step[1] * xa + row.start[1],
                az = row.step[2] * xa + row.start[2];
    const float cx = yb * az - ay, cy = ax - xb * az, cz = xb * ay - yb * ax;
    const float dx = yb * tz - ty, dy = tx - xb * tz, dz = xb * ty - yb * tx;
    const float cc = cx * cx + cy * cy + cz * cz, dd = dx * dx + dy * dy + dz * dz;
    const float solved = -(cx * dx + cy * dy + cz * dz) / std::max(dd, 1e-18f);
    const float new_rho = std::min(std::max(solved, min_rho), max_rho);
    const float z = 1.0f / new_rho, old_z = 1.0f / std::max(old_rho, min_rho);
    const float expected_z = !fresh & (old_rho > min_rho) ? old_z : z;
    const float ux = ya * oz - oy, uy = ox - xa * oz, uz = xa * oy - ya * ox;
    const float across = ux * ux + uy * uy + uz * uz;
    const float along = expected_z * (xa * xa + ya * ya + 1.0f) - (xa * ox + ya * oy + oz);
    const float sine = std::sqrt(across / std::max(across + along * along, 1e-30f));
    const float in_b = z * az + tz, inverse = 1.0f / std::max(in_b, min_depth);
    const float off_u = fx_b * ((z * ax + tx) * inverse - xb);
    const float off_v = fy_b * ((z * ay + ty) * inverse - yb);
    const bool good = (solved > min_rho) & (z > min_depth) & (in_b > min_depth) &
                      (off_u * off_u + off_v * off_v < most_off) & (sine > min_sine) &
                      (cc > min_cross_sq) & (valid[x] != 0);
    const float sigma = angle / (expected_z * std::max(sine, 1e-6f));
    // Fusion.
    const float trust = std::max(sure[x], least_sure);
    const float floor = measurement_floor * (fresh ? new_rho : old_rho);
    const float new_variance = std::max(sigma * sigma / trust, floor * floor);
    const float distance = new_rho - old_rho, both = new_variance + old_variance;
    const bool agrees = fresh | (distance * distance < gate * both);
    const float share = old_variance / both;
    const float mean = old_rho + share * distance;
    const float merged = fresh ? new_rho : mean;
    const float own_variance = fresh ? new_variance : new_variance * share;
    const float fused = fused_floor * merged;
    const float merged_variance = std::max(own_variance, fused * fused);
    // Nothing that is no number passes a comparison.
    const bool sound = good & (std::fabs(merged) <= largest) & (merged_variance <= largest);
    const bool use = sound & agrees;
    const float grown = old_variance * inflation;
    changed_rho[x] = merged;
    changed_variance[x] = use ? merged_variance : grown;
    use_rho[x] = use ? 1 : 0;
    use_variance[x] = sound ? 1 : 0;
    measured += good ? 1 : 0;
  }
  for (int x = 0; x < count; x++) {
    if (use_rho[x]) rho[x] = (double)changed_rho[x];
    if (use_variance[x]) variance[x] = (double)changed_variance[x];
  }
  return measured;
}

inline int fuse_depths(const FuseDepths& in) {
  int measured = 0;
  for (int y = 0; y < in.height; y++) {
    const FuseRow row(in, y);
    for (int x = 0; x < in.width; x += kFuseAtOnce)
      measured += fuse_pixels(in, row, y, x, std::min(kFuseAtOnce, in.width - x));
  }
  return measured;
}

}  // namespace aq

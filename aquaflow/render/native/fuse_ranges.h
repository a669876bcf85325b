// How far places lie from the surface that one view shows, added to what other views say. What each
// line does and why is in aquaflow/survey/export/mesh/surface.py, whose constants come in.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace aq {

struct FuseRanges {
  const double* places;                    // [M, 3]
  const float *ranges, *sigmas, *cosines;  // [H, W]
  double *total, *weights;                 // [M], come in and go out
  int32_t* near;                           // [M], likewise
  int64_t count;                           // M
  int32_t width, height;
  double fx, fy, cx, cy;
  double R[9], t[3];      // of the camera in the frame of the places
  double nearest_z, far;  // depth and range between which a view counts
  double reach_sigmas, least_reach, most_reach;
};

inline void fuse_ranges(const FuseRanges& in) {
  const double *R = in.R, *t = in.t;
  for (int64_t i = 0; i < in.count; i++) {
    const double* at = in.places + 3 * i;
    const double dx = at[0] - t[0], dy = at[1] - t[1], dz = at[2] - t[2];
    const double x = R[0] * dx + R[3] * dy + R[6] * dz;
    const double y = R[1] * dx + R[4] * dy + R[7] * dz;
    const double z = R[2] * dx + R[5] * dy + R[8] * dz;
    if (!(z > in.nearest_z)) continue;
    const double u = in.fx * x / z + in.cx - 0.5, v = in.fy * y / z + in.cy - 0.5;
    if (!(u >= 0.0 && v >= 0.0 && u < in.width - 1 && v < in.height - 1)) continue;
    const size_t column = (size_t)u, row = (size_t)v;
    const double right = u - (double)column, down = v - (double)row;
    const float* around = in.ranges + row * in.width + column;
    const double top = around[0] * (1.0 - right) + around[1] * right;
    const double bottom = around[in.width] * (1.0 - right) + around[in.width + 1] * right;
    const double range = top * (1.0 - down) + bottom * down;
    const size_t nearest = (size_t)(v + 0.5) * in.width + (size_t)(u + 0.5);
    const double cosine = in.cosines[nearest], sigma = in.sigmas[nearest];
    const double distance = (range - std::sqrt(x * x + y * y + z * z)) * cosine;
    const double reach = std::min(std::max(in.reach_sigmas * sigma, in.least_reach), in.most_reach);
    // Nothing that is no number passes a comparison.
    if (!(distance >= -reach && range < in.far)) continue;
    const double weight = cosine / (sigma * sigma);
    in.total[i] += weight * std::min(distance, reach);
    in.weights[i] += weight;
    in.near[i] += distance <= reach ? 1 : 0;
  }
}

}  // namespace aq

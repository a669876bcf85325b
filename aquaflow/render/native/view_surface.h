// The surface that one view of a map shows, and where places lie in its picture: what meshes are
// fused and coloured from (aquaflow/survey/export/mesh/view_surfaces.py).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace aq {

struct ViewSurface {
  const float *ranges, *sigmas, *cosines;  // [H, W]
  int32_t width, height;
  double fx, fy, cx, cy;
  double R[9], t[3];                             // of the camera in the frame of the places
  double reach_sigmas, least_reach, most_reach;  // of the distance within which it counts

  double reach(double sigma) const {
    return std::min(std::max(reach_sigmas * sigma, least_reach), most_reach);
  }
};

struct PlaceInView {
  double u, v, range;
};

// False of what lies nearer than a depth.
inline bool find_in_view(const ViewSurface& view, const double* place, double nearest_z,
                         PlaceInView* out) {
  const double *R = view.R, *t = view.t;
  const double dx = place[0] - t[0], dy = place[1] - t[1], dz = place[2] - t[2];
  const double x = R[0] * dx + R[3] * dy + R[6] * dz;
  const double y = R[1] * dx + R[4] * dy + R[7] * dz;
  const double z = R[2] * dx + R[5] * dy + R[8] * dz;
  if (!(z > nearest_z)) return false;  // nor what is no number
  *out = {view.fx * x / z + view.cx, view.fy * y / z + view.cy, std::sqrt(x * x + y * y + z * z)};
  return true;
}

}  // namespace aq

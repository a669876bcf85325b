// How far places lie from the surface that one view shows, added to what other views say. What each
// line does and why is in aquaflow/survey/export/mesh/surface.py, whose constants come in.
#pragma once

#include "view_surface.h"

namespace aq {

struct FuseRanges {
  ViewSurface view;
  const double* places;     // [M, 3]
  double *total, *weights;  // [M], come in and go out
  int32_t* near;            // [M], likewise
  int64_t count;            // M
  double nearest_z, far;    // depth and range between which a view counts
};

inline void fuse_ranges(const FuseRanges& in) {
  const ViewSurface& view = in.view;
  PlaceInView at;
  for (int64_t i = 0; i < in.count; i++) {
    if (!find_in_view(view, in.places + 3 * i, in.nearest_z, &at)) continue;
    const double u = at.u - 0.5, v = at.v - 0.5;
    if (!(u >= 0.0 && v >= 0.0 && u < view.width - 1 && v < view.height - 1)) continue;
    const size_t column = (size_t)u, row = (size_t)v;
    const double right = u - (double)column, down = v - (double)row;
    const float* around = view.ranges + row * view.width + column;
    const double top = around[0] * (1.0 - right) + around[1] * right;
    const double bottom = around[view.width] * (1.0 - right) + around[view.width + 1] * right;
    const double range = top * (1.0 - down) + bottom * down;
    const size_t nearest = (size_t)(v + 0.5) * view.width + (size_t)(u + 0.5);
    const double cosine = view.cosines[nearest], sigma = view.sigmas[nearest];
    const double distance = (range - at.range) * cosine, reach = view.reach(sigma);
    // Nothing that is no number passes a comparison.
    if (!(distance >= -reach && range < in.far)) continue;
    const double weight = cosine / (sigma * sigma);
    in.total[i] += weight * std::min(distance, reach);
    in.weights[i] += weight;
    in.near[i] += distance <= reach ? 1 : 0;
  }
}

}  // namespace aq

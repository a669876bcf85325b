// What one view says of places on the surface, added to what other views say: their colour, and how
// well they are known. What each line does and why is in
// aquaflow/survey/export/mesh/seen_places.py, whose constants come in.
#pragma once

#include <cstring>

#include "view_surface.h"

namespace aq {

struct SeePlaces {
  ViewSurface view;
  const double* places;  // [M, 3]
  int64_t count;         // M
};

// Calls add(place, range, cosine, pixel) for each place that the view shows.
template <class Add>
inline void each_seen_place(const SeePlaces& in, const Add& add) {
  const ViewSurface& view = in.view;
  PlaceInView at;
  for (int64_t i = 0; i < in.count; i++) {
    if (!find_in_view(view, in.places + 3 * i, 0.0, &at)) continue;
    if (!(at.u >= 0.0 && at.v >= 0.0 && at.u < view.width && at.v < view.height)) continue;
    const size_t pixel = (size_t)at.v * view.width + (size_t)at.u;
    const double cosine = view.cosines[pixel];
    const double distance = std::abs(view.ranges[pixel] - at.range) * cosine;
    // Nothing that is no number passes a comparison.
    if (distance <= view.reach(view.sigmas[pixel])) add(i, at.range, cosine, pixel);
  }
}

struct PlaceColours {
  const uint16_t* radiance;  // [3, H, W] float16
  double *total, *weights;   // [M, 3] and [M], come in and go out
  double* nearest;           // [M], likewise
};

// Of a finite float16: its exponent is 112 less than that of a float32.
inline float from_half(uint16_t half) {
  const uint32_t bits = (uint32_t)(half & 0x8000) << 16 | (uint32_t)(half & 0x7fff) << 13;
  float value;
  std::memcpy(&value, &bits, sizeof value);
  return value * 0x1p112f;
}

inline void add_colours(const SeePlaces& in, const PlaceColours& out) {
  const size_t pixels = (size_t)in.view.width * in.view.height;
  each_seen_place(in, [&](int64_t i, double range, double cosine, size_t pixel) {
    const double share = cosine / range, weight = share * share;
    for (int c = 0; c < 3; c++)
      out.total[3 * i + c] += weight * from_half(out.radiance[c * pixels + pixel]);
    out.weights[i] += weight;
    out.nearest[i] = std::min(out.nearest[i], range);
  });
}

struct PlaceInformation {
  double sigma_px;      // of where a view shows a place
  double* information;  // [M, 3, 3], come in and go out
  double* footprint;    // [M], likewise
};

inline void add_information(const SeePlaces& in, const PlaceInformation& out) {
  const double* t = in.view.t;
  each_seen_place(in, [&](int64_t i, double range, double, size_t) {
    const double* place = in.places + 3 * i;
    const double ray[3] = {(place[0] - t[0]) / range, (place[1] - t[1]) / range,
                           (place[2] - t[2]) / range};
    const double width = range / in.view.fx, sigma = out.sigma_px * width;
    const double weight = 1.0 / (sigma * sigma);
    double* sums = out.information + 9 * i;
    for (int row = 0; row < 3; row++)
      for (int column = 0; column < 3; column++)
        sums[3 * row + column] += weight * ((row == column) - ray[row] * ray[column]);
    out.footprint[i] = std::min(out.footprint[i], width);
  });
}

}  // namespace aq

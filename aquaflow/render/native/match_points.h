// Dense matches between two pictures by points and descriptors of their pixels. What each step does
// and why is in aquaflow/prior/dense_matching.py, whose constants come in; the names are theirs.
// What a part computes is of its own pixels only: results do not depend on the number of threads.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "plane.h"
#include "pool.h"

namespace aq {

struct ProjectRays {
  const float* rays;    // [h, w, 3] unit rays of the picture that is searched; all are numbers
  const float* wanted;  // [count, 3] unit rays of the points that are sought
  Size size;
  int count;
  int iterations;
  float damping, least_damping, most_damping, least_slope, still_px;
  float* pixels;  // [count, 2] px: starts come in, matches go out
  float* off;     // [count] px between the ray found and the ray wanted
};

// The bilinear ray at an index in [0, w - 1] x [0, h - 1], less the wanted one, and its
// derivatives.
struct RayError {
  RayError(const ProjectRays& in, const float* wanted, float x, float y) {
    const int left = std::min((int)x, in.size.width - 2),
              top = std::min((int)y, in.size.height - 2);
    const float fx = x - (float)left, fy = y - (float)top;
    const float* up = in.rays + 3 * ((size_t)top * in.size.width + left);
    const float* down = up + 3 * (size_t)in.size.width;
    for (int k = 0; k < 3; k++) {
      const float above = up[k + 3] - up[k], below = down[k + 3] - down[k];
      const float first = up[k] + fx * above, second = down[k] + fx * below;
      const float e = first + fy * (second - first) - wanted[k];
      const float dx = above + fy * (below - above), dy = second - first;
      cost += e * e, ex += dx * e, ey += dy * e;
      xx += dx * dx, xy += dx * dy, yy += dy * dy;
    }
  }
  float cost = 0.0f, ex = 0.0f, ey = 0.0f, xx = 0.0f, xy = 0.0f, yy = 0.0f;
};

inline void project_ray(const ProjectRays& in, int i) {
  const float most_x = (float)(in.size.width - 1), most_y = (float)(in.size.height - 1);
  const float* wanted = in.wanted + 3 * (size_t)i;
  float* pixel = in.pixels + 2 * (size_t)i;
  // In this order a start that is no number is the first pixel.
  float x = std::min(most_x, std::max(0.0f, pixel[0] - 0.5f));
  float y = std::min(most_y, std::max(0.0f, pixel[1] - 0.5f));
  RayError at(in, wanted, x, y);
  float damping = in.damping;
  for (int step = 0; step < in.iterations; step++) {
    const float more = damping * 0.5f * (at.xx + at.yy) + in.least_slope;
    const float xx = at.xx + more, yy = at.yy + more;
    const float inverse = 1.0f / (xx * yy - at.xy * at.xy);
    const float dx = (at.xy * at.ey - yy * at.ex) * inverse;
    const float dy = (at.xy * at.ex - xx * at.ey) * inverse;
    const float to_x = std::min(most_x, std::max(0.0f, x + dx));
    const float to_y = std::min(most_y, std::max(0.0f, y + dy));
    const RayError there(in, wanted, to_x, to_y);
    const float moved = std::max(std::fabs(to_x - x), std::fabs(to_y - y));
    const bool better = there.cost < at.cost;
    if (better) x = to_x, y = to_y, at = there;
    damping = better ? std::max(damping * 0.1f, in.least_damping) : damping * 10.0f;
    if (moved < in.still_px || damping > in.most_damping) break;
  }
  pixel[0] = x + 0.5f;
  pixel[1] = y + 0.5f;
  in.off[i] = std::sqrt(at.cost / std::max(0.5f * (at.xx + at.yy), in.least_slope));
}

struct SearchDescriptors {
  const float* a;  // [count, d]
  const float* b;  // [h, w, d]
  Size size;
  int count, d;
  const int* dilations;  // [levels] px
  int levels, radius;
  float least_curvature;
  float* pixels;  // [count, 2] px: where the search begins comes in, matches go out
  float* score;   // [count] product at the match; 0 where there is none
};

inline float descriptor_product(const SearchDescriptors& in, const float* a, int x, int y) {
  const float* b = in.b + ((size_t)y * in.size.width + x) * in.d;
  float sum = 0.0f;
#pragma omp simd reduction(+ : sum)
  for (int k = 0; k < in.d; k++) sum += a[k] * b[k];
  return sum;
}

// Top of the parabola through three scores, from the middle; ``flat`` where there is no top.
inline float peak_of(float before, float top, float after, float least_curvature, float flat) {
  const float curvature = 2.0f * top - before - after;
  if (!(curvature > least_curvature)) return flat;
  return std::min(0.5f, std::max(-0.5f, 0.5f * (after - before) / curvature));
}

inline void search_descriptor(const SearchDescriptors& in, int i) {
  const int width = in.size.width, height = in.size.height;
  const float* a = in.a + (size_t)i * in.d;
  float* pixel = in.pixels + 2 * (size_t)i;
  in.score[i] = 0.0f;
  if (!(pixel[0] >= 0.0f && pixel[0] <= (float)width && pixel[1] >= 0.0f &&
        pixel[1] <= (float)height))
    return;
  const int start_x = std::min((int)pixel[0], width - 1);
  const int start_y = std::min((int)pixel[1], height - 1);
  int x = start_x, y = start_y;
  float best = descriptor_product(in, a, x, y);
  if (!(std::fabs(best) <= 3e38f)) best = -3e38f;
  for (int level = 0; level < in.levels; level++) {
    const int step = in.dilations[level], from_x = x, from_y = y;
    for (int down = -in.radius; down <= in.radius; down++) {
      const int to_y = from_y + down * step;
      if (to_y < 0 || to_y >= height) continue;
      for (int right = -in.radius; right <= in.radius; right++) {
        const int to_x = from_x + right * step;
        if (to_x < 0 || to_x >= width) continue;
        const float score = descriptor_product(in, a, to_x, to_y);
        // Nothing that is no number, or has no end, is better.
        if (score > best && score <= 3e38f) best = score, x = to_x, y = to_y;
      }
    }
  }
  if (!(best > -3e38f)) return;
  in.score[i] = best;
  const float own_x = x == start_x ? pixel[0] - (float)x - 0.5f : 0.0f;
  const float own_y = y == start_y ? pixel[1] - (float)y - 0.5f : 0.0f;
  float shift_x = own_x, shift_y = own_y;
  if (x > 0 && x < width - 1)
    shift_x = peak_of(descriptor_product(in, a, x - 1, y), best,
                      descriptor_product(in, a, x + 1, y), in.least_curvature, own_x);
  if (y > 0 && y < height - 1)
    shift_y = peak_of(descriptor_product(in, a, x, y - 1), best,
                      descriptor_product(in, a, x, y + 1), in.least_curvature, own_y);
  pixel[0] = (float)x + 0.5f + shift_x;
  pixel[1] = (float)y + 0.5f + shift_y;
}

template <class In>
void for_each_match(const In& in, int threads, void (*match)(const In&, int)) {
  constexpr int kGrain = 256;
  Pool::run(threads, [&](int part) {
    const int end = part_begin(in.count, kGrain, threads, part + 1);
    for (int i = part_begin(in.count, kGrain, threads, part); i < end; i++) match(in, i);
  });
}

}  // namespace aq

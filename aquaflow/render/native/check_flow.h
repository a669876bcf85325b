// Forward-backward check of a flow. What each line does and why is in aquaflow/prior/flow.py
// (``check_by_numpy``), whose constants come in; the names are theirs.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "plane.h"

namespace aq {

struct CheckFlow {
  const float *forward, *backward;     // [H, W, 2] px, a to b and b to a
  const float *texture_a, *texture_b;  // [H, W]
  float border_px, most_error_px, least_texture;
};

inline void check_flow(const CheckFlow in, Size size, float* error, uint8_t* valid) {
  const int width = size.width;
  const float most_x = (float)(width - 1), most_y = (float)(size.height - 1);
  for (int y = 0; y < size.height; y++) {
    const size_t first = (size_t)y * width;
#pragma omp simd
    for (int x = 0; x < width; x++) {
      const size_t i = first + x;
      const float u = in.forward[2 * i], v = in.forward[2 * i + 1];
      const float to_x = (float)x + 0.5f + u, to_y = (float)y + 0.5f + v;
      // Between four pixels; in this order what is no number leads to the first one.
      const float at_x = std::min(most_x, std::max(0.0f, to_x - 0.5f));
      const float at_y = std::min(most_y, std::max(0.0f, to_y - 0.5f));
      const int left = (int)at_x, top = (int)at_y;
      const int right = std::min(left + 1, width - 1), down = std::min(top + 1, size.height - 1);
      const float fx = at_x - (float)left, fy = at_y - (float)top;
      const float w00 = (1.0f - fx) * (1.0f - fy), w10 = fx * (1.0f - fy), w01 = (1.0f - fx) * fy,
                  w11 = fx * fy;
      const int i00 = top * width + left, i10 = top * width + right, i01 = down * width + left,
                i11 = down * width + right;
      const float *back = in.backward, *texture = in.texture_b;
      const float back_u =
          w00 * back[2 * i00] + w10 * back[2 * i10] + w01 * back[2 * i01] + w11 * back[2 * i11];
      const float back_v = w00 * back[2 * i00 + 1] + w10 * back[2 * i10 + 1] +
                           w01 * back[2 * i01 + 1] + w11 * back[2 * i11 + 1];
      const float there =
          w00 * texture[i00] + w10 * texture[i10] + w01 * texture[i01] + w11 * texture[i11];
      const float off_u = u + back_u, off_v = v + back_v;
      const float off = std::sqrt(off_u * off_u + off_v * off_v);
      error[i] = off;
      valid[i] = (to_x > in.border_px) & (to_x < (float)width - in.border_px) &
                 (to_y > in.border_px) & (to_y < (float)size.height - in.border_px) &
                 (off < in.most_error_px) & (in.texture_a[i] > in.least_texture) &
                 (there > in.least_texture);
    }
  }
}

}  // namespace aq

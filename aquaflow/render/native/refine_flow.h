// One symmetric Gauss-Newton step of a dense flow; what it does and why is in
// aquaflow/prior/flow.py, whose constants come in.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "plane.h"

namespace aq {

struct RefineFlow {
  const uint8_t *a, *b;  // [H, W]
  const float* flow;     // [H, W, 2] px, a to b
  Size size;
  Taps contrast, window;
  float grey_noise, most_step_px, singular;
};

class FlowRefiner {
 public:
  // out [H, W, 2]; it may be in.flow. Every stage goes through the picture once, row by row, and
  // keeps rows instead of pictures wherever the next stage needs no others.
  void run(const RefineFlow& in, float* out) {
    const size_t count = in.size.count();
    for (auto* plane : {&u_, &v_, &here_, &there_, &left_, &mean_}) plane->resize(count);
    for (auto& product : products_) product.resize(count);
    for (auto& row : rows_) row.resize((size_t)in.size.width);
    split(in);
    warp(in);
    compare_contrast(in);
    multiply(in.size);
    solve(in, out);
  }

 private:
  using Plane = std::vector<float>;

  // Weights of the four pixels around: Keys' cubic convolution with -0.75, as OpenCV has it.
  struct Cubic {
    explicit Cubic(float f) {
      constexpr float kA = -0.75f;
      const float e = f + 1.0f, g = 1.0f - f;
      a = ((kA * e - 5.0f * kA) * e + 8.0f * kA) * e - 4.0f * kA;
      b = ((kA + 2.0f) * f - (kA + 3.0f)) * f * f + 1.0f;
      c = ((kA + 2.0f) * g - (kA + 3.0f)) * g * g + 1.0f;
      d = 1.0f - a - b - c;
    }
    float a, b, c, d;
  };

  // Four neighbours of a row at once: eight of these are faster than sixteen gathered values.
  typedef float Four __attribute__((vector_size(16)));
  static Four four_at(const float* from) {
    Four out;
    std::memcpy(&out, from, sizeof out);
    return out;
  }

  // there_: b where the flow leads; its border is repeated outside.
  void warp(const RefineFlow& in) {
    constexpr int kPad = 4;
    const int width = in.size.width, height = in.size.height, stride = width + 2 * kPad;
    padded_.resize((size_t)stride * (height + 2 * kPad));
    for (int y = -kPad; y < height + kPad; y++) {
      const uint8_t* row = in.b + (size_t)std::clamp(y, 0, height - 1) * width;
      float* to = padded_.data() + (size_t)(y + kPad) * stride + kPad;
      for (int x = -kPad; x < 0; x++) to[x] = (float)row[0];
      for (int x = 0; x < width; x++) to[x] = (float)row[x];
      for (int x = width; x < width + kPad; x++) to[x] = (float)row[width - 1];
    }
    corner_.resize(width);
    for (auto& weights : weights_) weights.resize(width);
    for (int y = 0; y < height; y++) warp_row(in, y, stride, kPad);
  }

  void warp_row(const RefineFlow& in, int y, int stride, int pad) {
    const int width = in.size.width;
    const float most_x = (float)width + 1.0f, most_y = (float)in.size.height + 1.0f;
    const float *u = u_.data() + (size_t)y * width, *v = v_.data() + (size_t)y * width;
    float *xa = weights_[0].data(), *xb = weights_[1].data(), *xc = weights_[2].data(),
          *xd = weights_[3].data(), *ya = weights_[4].data(), *yb = weights_[5].data(),
          *yc = weights_[6].data(), *yd = weights_[7].data();
    int* corner = corner_.data();
#pragma omp simd
    for (int x = 0; x < width; x++) {
      // In this order a flow that is no number leads to the rim, and not out of the picture.
      const float at_x = std::min(most_x, std::max(-2.0f, (float)x + u[x]));
      const float at_y = std::min(most_y, std::max(-2.0f, (float)y + v[x]));
      // Both are -2 or more: rounding towards zero after adding 2 is rounding down.
      const int left = (int)(at_x + 2.0f) - 2, top = (int)(at_y + 2.0f) - 2;
      const Cubic across(at_x - (float)left), down(at_y - (float)top);
      xa[x] = across.a, xb[x] = across.b, xc[x] = across.c, xd[x] = across.d;
      ya[x] = down.a, yb[x] = down.b, yc[x] = down.c, yd[x] = down.d;
      corner[x] = top * stride + left;
    }
    const float* first = padded_.data() + (pad - 1) * (stride + 1);
    float* out = there_.data() + (size_t)y * width;
    for (int x = 0; x < width; x++) {
      const float* from = first + corner[x];
      const Four column = ya[x] * four_at(from) + yb[x] * four_at(from + stride) +
                          yc[x] * four_at(from + 2 * stride) + yd[x] * four_at(from + 3 * stride);
      out[x] = (xa[x] * column[0] + xb[x] * column[1]) + (xc[x] * column[2] + xd[x] * column[3]);
    }
  }

  void split(const RefineFlow& in) {
    float *u = u_.data(), *v = v_.data(), *here = here_.data();
    const int count = (int)in.size.count();
#pragma omp simd
    for (int i = 0; i < count; i++) {
      u[i] = in.flow[2 * i];
      v[i] = in.flow[2 * i + 1];
      here[i] = (float)in.a[i];
    }
  }

  // left_ and mean_: difference and mean of both pictures, each of mean 0 and contrast 1 around
  // every pixel.
  void compare_contrast(const RefineFlow& in) {
    const int width = in.size.width;
    const float *here = rows_[0].data(), *there = rows_[1].data();
    for (int y = 0; y < in.size.height; y++) {
      normalise_row(in, here_.data(), y, rows_[0].data());
      normalise_row(in, there_.data(), y, rows_[1].data());
      float *left = left_.data() + (size_t)y * width, *mean = mean_.data() + (size_t)y * width;
#pragma omp simd
      for (int x = 0; x < width; x++) {
        left[x] = here[x] - there[x];
        mean[x] = 0.5f * (here[x] + there[x]);
      }
    }
  }

  void normalise_row(const RefineFlow& in, const float* plane, int y, float* out) {
    float *mean = rows_[2].data(), *square = rows_[3].data();
    filter_.row_and_square(plane, in.size, in.contrast, y, mean, square);
    const float* value = plane + (size_t)y * in.size.width;
    const float noise = in.grey_noise * in.grey_noise;
#pragma omp simd
    for (int x = 0; x < in.size.width; x++) {
      const float variance = std::max(square[x] - mean[x] * mean[x], 0.0f);
      out[x] = (value[x] - mean[x]) / std::sqrt(variance + noise);
    }
  }

  // products_: gx gx, gy gy, gx gy, gx e, gy e, with the gradient of both pictures' mean.
  void multiply(Size size) {
    const int width = size.width;
    const float *gx = rows_[0].data(), *gy = rows_[1].data();
    for (int y = 0; y < size.height; y++) {
      gradient_row(mean_.data(), size, y, rows_[0].data(), rows_[1].data());
      const size_t first = (size_t)y * width;
      float *xx = products_[0].data() + first, *yy = products_[1].data() + first,
            *xy = products_[2].data() + first, *xe = products_[3].data() + first,
            *ye = products_[4].data() + first;
      const float* left = left_.data() + first;
#pragma omp simd
      for (int x = 0; x < width; x++) {
        xx[x] = gx[x] * gx[x];
        yy[x] = gy[x] * gy[x];
        xy[x] = gx[x] * gy[x];
        xe[x] = gx[x] * left[x];
        ye[x] = gy[x] * left[x];
      }
    }
  }

  void solve(const RefineFlow& in, float* out) {
    const int width = in.size.width;
    const float *u = rows_[9].data(), *v = rows_[10].data();
    for (int y = 0; y < in.size.height; y++) {
      for (int k = 0; k < 5; k++)
        filter_.row(products_[k].data(), in.size, in.window, y, rows_[k].data());
      gradient_row(u_.data(), in.size, y, rows_[5].data(), rows_[6].data());
      gradient_row(v_.data(), in.size, y, rows_[7].data(), rows_[8].data());
      solve_row(in, (size_t)y * width);
      float* to = out + 2 * (size_t)y * width;
      for (int x = 0; x < width; x++) {
        to[2 * x] = u[x];
        to[2 * x + 1] = v[x];
      }
    }
  }

  // The new flow goes into rows of its own: so the loop is made of vectors.
  void solve_row(const RefineFlow& in, size_t first) {
    const float *xx_ = rows_[0].data(), *yy_ = rows_[1].data(), *xy_ = rows_[2].data(),
                *xe_ = rows_[3].data(), *ye_ = rows_[4].data(), *ux = rows_[5].data(),
                *uy = rows_[6].data(), *vx = rows_[7].data(), *vy = rows_[8].data(),
                *u = u_.data() + first, *v = v_.data() + first;
    float *new_u = rows_[9].data(), *new_v = rows_[10].data();
    const float singular = in.singular, most = in.most_step_px;
#pragma omp simd
    for (int i = 0; i < in.size.width; i++) {
      const float xy = xy_[i], xe = xe_[i], ye = ye_[i];
      const float damping = singular * (xx_[i] + yy_[i]) + 1e-6f;
      const float xx = xx_[i] + damping, yy = yy_[i] + damping;
      const float inverse = 1.0f / (xx * yy - xy * xy);
      const float x = (yy * xe - xy * ye) * inverse, y = (xx * ye - xy * xe) * inverse;
      // The step is in a; through the warp, 1 + d flow / d pixel, it becomes one in b.
      const float step_x = x + ux[i] * x + uy[i] * y;
      const float step_y = y + vx[i] * x + vy[i] * y;
      const float length = std::sqrt(step_x * step_x + step_y * step_y);
      const float shorten = most / std::max(length, most);
      new_u[i] = u[i] + step_x * shorten;
      new_v[i] = v[i] + step_y * shorten;
    }
  }

  Plane u_, v_, here_, there_, left_, mean_, products_[5], padded_, weights_[8], rows_[11];
  std::vector<int> corner_;
  Filter filter_;
};

}  // namespace aq

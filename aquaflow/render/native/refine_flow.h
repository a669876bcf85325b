// One symmetric Gauss-Newton step of a dense flow; what it does and why is in
// aquaflow/prior/refinement.py, whose constants come in.
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
  // out [H, W, 2]; it may be in.flow.
  void run(const RefineFlow& in, float* out) {
    const size_t count = in.size.count();
    for (auto* plane :
         {&u_, &v_, &here_, &there_, &gx_, &gy_, &products_[0], &products_[1], &products_[2],
          &products_[3], &products_[4], &slope_[0], &slope_[1], &slope_[2], &slope_[3]})
      plane->resize(count);
    for (size_t i = 0; i < count; i++) {
      u_[i] = in.flow[2 * i];
      v_[i] = in.flow[2 * i + 1];
      here_[i] = (float)in.a[i];
    }
    warp(in);
    normalise_contrast(in, here_);
    normalise_contrast(in, there_);
    multiply(in.size);
    for (auto& product : products_) filter_.run(product.data(), in.size, in.window, product.data());
    gradient(u_.data(), in.size, slope_[0].data(), slope_[1].data());
    gradient(v_.data(), in.size, slope_[2].data(), slope_[3].data());
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

  void normalise_contrast(const RefineFlow& in, Plane& plane) {
    const size_t count = in.size.count();
    Plane &mean = products_[0], &square = products_[1];
    for (size_t i = 0; i < count; i++) square[i] = plane[i] * plane[i];
    filter_.run(plane.data(), in.size, in.contrast, mean.data());
    filter_.run(square.data(), in.size, in.contrast, square.data());
    const float noise = in.grey_noise * in.grey_noise;
    for (size_t i = 0; i < count; i++) {
      const float variance = std::max(square[i] - mean[i] * mean[i], 0.0f);
      plane[i] = (plane[i] - mean[i]) / std::sqrt(variance + noise);
    }
  }

  // products_: gx gx, gy gy, gx gy, gx e, gy e, with the gradient of both pictures' mean.
  void multiply(Size size) {
    Plane& mean = products_[0];
    const size_t count = size.count();
    for (size_t i = 0; i < count; i++) mean[i] = 0.5f * (here_[i] + there_[i]);
    gradient(mean.data(), size, gx_.data(), gy_.data());
    for (size_t i = 0; i < count; i++) {
      const float x = gx_[i], y = gy_[i], left = here_[i] - there_[i];
      products_[0][i] = x * x;
      products_[1][i] = y * y;
      products_[2][i] = x * y;
      products_[3][i] = x * left;
      products_[4][i] = y * left;
    }
  }

  void solve(const RefineFlow& in, float* out) {
    const int width = in.size.width;
    for (int y = 0; y < in.size.height; y++) {
      const size_t first = (size_t)y * width;
      solve_row(in, first);
      const float *u = gx_.data() + first, *v = gy_.data() + first;
      for (int x = 0; x < width; x++) {
        out[2 * (first + x)] = u[x];
        out[2 * (first + x) + 1] = v[x];
      }
    }
  }

  // gx_ and gy_ become the new flow: into rows of their own, the loop is made of vectors.
  void solve_row(const RefineFlow& in, size_t first) {
    const float *xx_ = products_[0].data() + first, *yy_ = products_[1].data() + first,
                *xy_ = products_[2].data() + first, *xe_ = products_[3].data() + first,
                *ye_ = products_[4].data() + first, *ux = slope_[0].data() + first,
                *uy = slope_[1].data() + first, *vx = slope_[2].data() + first,
                *vy = slope_[3].data() + first, *u = u_.data() + first, *v = v_.data() + first;
    float *new_u = gx_.data() + first, *new_v = gy_.data() + first;
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

  Plane u_, v_, here_, there_, gx_, gy_, products_[5], slope_[4], padded_, weights_[8];
  std::vector<int> corner_;
  Filter filter_;
};

}  // namespace aq

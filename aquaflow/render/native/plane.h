// Planes of floats, and the separable symmetric filters that dense matching needs of them. Borders
// are mirrored without repeating the outermost pixel, as OpenCV does by default.
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

namespace aq {

struct Size {
  int width, height;
  size_t count() const { return (size_t)width * height; }
};

// A symmetric filter: taps[k] at distance k, up to ``radius``.
struct Taps {
  const float* taps;
  int radius;
};

inline int mirrored(int at, int count) {
  if (count == 1) return 0;
  while (at < 0 || at >= count) at = at < 0 ? -at : 2 * (count - 1) - at;
  return at;
}

class Filter {
 public:
  // out may be in.
  void run(const float* in, Size size, Taps f, float* out) {
    // Of a radius that is known, a sum stays in a register until it is complete.
    if (f.radius == 7) return run<7>(in, size, f, out);
    if (f.radius == 6) return run<6>(in, size, f, out);
    run<0>(in, size, f, out);
  }

 private:
  template <int Radius>
  void run(const float* in, Size size, Taps f, float* out) {
    const int pad = f.radius, width = size.width;
    row_.resize((size_t)width + 2 * pad);
    columns_.resize(size.count());
    for (int y = 0; y < size.height; y++)
      down<Radius>(in, size, f, y, columns_.data() + (size_t)y * width);
    for (int y = 0; y < size.height; y++) {
      const float* column = columns_.data() + (size_t)y * width;
      std::copy_n(column, width, row_.data() + pad);
      for (int x = 1; x <= pad; x++) {
        row_[pad - x] = column[mirrored(-x, width)];
        row_[pad + width - 1 + x] = column[mirrored(width - 1 + x, width)];
      }
      across<Radius>(row_.data() + pad, width, f, out + (size_t)y * width);
    }
  }

  template <int Radius>
  static void down(const float* in, Size size, Taps f, int y, float* out) {
    const int width = size.width;
    const float* here = in + (size_t)y * width;
    const auto row = [&](int at) { return in + (size_t)mirrored(at, size.height) * width; };
    if constexpr (Radius > 0) {
      const float *above[Radius], *below[Radius];
      float taps[Radius + 1];
      std::copy_n(f.taps, Radius + 1, taps);
      for (int k = 0; k < Radius; k++) above[k] = row(y - k - 1), below[k] = row(y + k + 1);
#pragma omp simd
      for (int x = 0; x < width; x++) {
        float sum = taps[0] * here[x];
#pragma GCC unroll 8
        for (int k = 0; k < Radius; k++) sum += taps[k + 1] * (above[k][x] + below[k][x]);
        out[x] = sum;
      }
    } else {
      for (int x = 0; x < width; x++) out[x] = f.taps[0] * here[x];
      for (int k = 1; k <= f.radius; k++) {
        const float *above = row(y - k), *below = row(y + k), tap = f.taps[k];
#pragma omp simd
        for (int x = 0; x < width; x++) out[x] += tap * (above[x] + below[x]);
      }
    }
  }

  template <int Radius>
  static void across(const float* row, int width, Taps f, float* out) {
    if constexpr (Radius > 0) {
      float taps[Radius + 1];
      std::copy_n(f.taps, Radius + 1, taps);
#pragma omp simd
      for (int x = 0; x < width; x++) {
        float sum = taps[0] * row[x];
#pragma GCC unroll 8
        for (int k = 1; k <= Radius; k++) sum += taps[k] * (row[x - k] + row[x + k]);
        out[x] = sum;
      }
    } else {
      for (int x = 0; x < width; x++) out[x] = f.taps[0] * row[x];
      for (int k = 1; k <= f.radius; k++) {
        const float tap = f.taps[k];
#pragma omp simd
        for (int x = 0; x < width; x++) out[x] += tap * (row[x - k] + row[x + k]);
      }
    }
  }

  std::vector<float> row_, columns_;
};

// Scharr's derivative along x and y, per pixel.
inline void gradient(const float* in, Size size, float* along_x, float* along_y) {
  constexpr float kSide = 3.0f / 32.0f, kMiddle = 10.0f / 32.0f;
  const int width = size.width;
  for (int y = 0; y < size.height; y++) {
    const float* above = in + (size_t)mirrored(y - 1, size.height) * width;
    const float* here = in + (size_t)y * width;
    const float* below = in + (size_t)mirrored(y + 1, size.height) * width;
    float *gx = along_x + (size_t)y * width, *gy = along_y + (size_t)y * width;
    const auto at = [&](int x, int left, int right) {
      gx[x] = kSide * (above[right] - above[left] + below[right] - below[left]) +
              kMiddle * (here[right] - here[left]);
      gy[x] = kSide * (below[left] - above[left] + below[right] - above[right]) +
              kMiddle * (below[x] - above[x]);
    };
    at(0, mirrored(-1, width), mirrored(1, width));
#pragma omp simd
    for (int x = 1; x < width - 1; x++) at(x, x - 1, x + 1);
    at(width - 1, mirrored(width - 2, width), mirrored(width, width));
  }
}

}  // namespace aq

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
  // Row y of the filtered plane.
  void row(const float* in, Size size, Taps f, int y, float* out) {
    // Of a radius that is known, a sum stays in a register until it is complete.
    if (f.radius == 7) return row<7>(in, size, f, y, out, nullptr);
    if (f.radius == 6) return row<6>(in, size, f, y, out, nullptr);
    row<0>(in, size, f, y, out, nullptr);
  }

  // The same, and that of the squares of the plane.
  void row_and_square(const float* in, Size size, Taps f, int y, float* out, float* square) {
    if (f.radius == 7) return row<7>(in, size, f, y, out, square);
    row<0>(in, size, f, y, out, square);
  }

 private:
  template <int Radius>
  void row(const float* in, Size size, Taps f, int y, float* out, float* square) {
    const size_t padded = (size_t)size.width + 2 * f.radius;
    row_.resize(padded);
    square_.resize(padded);
    float *sums = row_.data() + f.radius, *squares = square_.data() + f.radius;
    above_.resize(f.radius);
    below_.resize(f.radius);
    for (int k = 1; k <= f.radius; k++) {
      above_[k - 1] = in + (size_t)mirrored(y - k, size.height) * size.width;
      below_[k - 1] = in + (size_t)mirrored(y + k, size.height) * size.width;
    }
    const float* here = in + (size_t)y * size.width;
    if (square == nullptr) {
      down<Radius, false>(here, size.width, f, sums, squares);
    } else {
      down<Radius, true>(here, size.width, f, sums, squares);
      mirror(squares, size.width, f.radius);
      across<Radius>(squares, size.width, f, square);
    }
    mirror(sums, size.width, f.radius);
    across<Radius>(sums, size.width, f, out);
  }

  static void mirror(float* row, int width, int pad) {
    for (int x = 1; x <= pad; x++) {
      row[-x] = row[mirrored(-x, width)];
      row[width - 1 + x] = row[mirrored(width - 1 + x, width)];
    }
  }

  template <int Radius, bool Squares>
  void down(const float* here, int width, Taps f, float* out, float* squares) {
    const int radius = Radius > 0 ? Radius : f.radius;
    if constexpr (Radius > 0) {
      const float *above[Radius], *below[Radius];
      float taps[Radius + 1];
      std::copy_n(f.taps, Radius + 1, taps);
      std::copy_n(above_.data(), Radius, above);
      std::copy_n(below_.data(), Radius, below);
#pragma omp simd
      for (int x = 0; x < width; x++) {
        float sum = taps[0] * here[x], square = taps[0] * here[x] * here[x];
#pragma GCC unroll 8
        for (int k = 0; k < Radius; k++) {
          const float a = above[k][x], b = below[k][x];
          sum += taps[k + 1] * (a + b);
          if (Squares) square += taps[k + 1] * (a * a + b * b);
        }
        out[x] = sum;
        if (Squares) squares[x] = square;
      }
    } else {
      for (int x = 0; x < width; x++) {
        float sum = f.taps[0] * here[x], square = f.taps[0] * here[x] * here[x];
        for (int k = 0; k < radius; k++) {
          const float a = above_[k][x], b = below_[k][x];
          sum += f.taps[k + 1] * (a + b);
          square += f.taps[k + 1] * (a * a + b * b);
        }
        out[x] = sum;
        if (Squares) squares[x] = square;
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

  std::vector<float> row_, square_;
  std::vector<const float*> above_, below_;
};

// Scharr's derivative of row y along x and y, per pixel.
inline void gradient_row(const float* in, Size size, int y, float* gx, float* gy) {
  constexpr float kSide = 3.0f / 32.0f, kMiddle = 10.0f / 32.0f;
  const int width = size.width;
  const float* above = in + (size_t)mirrored(y - 1, size.height) * width;
  const float* here = in + (size_t)y * width;
  const float* below = in + (size_t)mirrored(y + 1, size.height) * width;
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

}  // namespace aq

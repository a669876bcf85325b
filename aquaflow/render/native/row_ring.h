// The rows of an image's maps that a vertical window reaches, so that no map is ever kept as a
// whole.
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

#include "constants.h"

namespace aq {

constexpr int kSsimRadius = kSsimWindow / 2, kChannels = 3;
constexpr int kRowPad = 16;  // at least kSsimRadius * kChannels zeros on either side of a row
// Two rows' windows share what they read: twelve rows, not twice eleven.
constexpr int kRowsAtOnce = 2;
constexpr int kRingRows = kSsimWindow - 1 + kRowsAtOnce;

// One map row of 3 W floats between zero pads, in a ring addressed by image row.
template <int Maps>
class RowRing {
 public:
  explicit RowRing(int floats)
      : stride_(floats + 2 * kRowPad), data_((size_t)kRingRows * Maps * stride_) {}
  float* row(int y, int map) {
    const int slot = (y % kRingRows + kRingRows) % kRingRows;
    return data_.data() + ((size_t)slot * Maps + map) * stride_ + kRowPad;
  }
  void clear(int y) {
    for (int map = 0; map < Maps; map++) std::fill_n(row(y, map) - kRowPad, stride_, 0.0f);
  }

 private:
  size_t stride_;
  std::vector<float> data_;
};

}  // namespace aq

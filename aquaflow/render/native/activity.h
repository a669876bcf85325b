// Which tiles of the picture are drawn.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace aq {

struct TileBox {
  int x0, x1, y0, y1;  // inclusive
};

class ActiveTiles {
 public:
  // active [tiles_y, tiles_x], or null for all.
  void set(const uint8_t* active, int tiles_x, int tiles_y) {
    all_ = active == nullptr;
    if (all_) return;
    tiles_x_ = tiles_x;
    active_.assign(active, active + (size_t)tiles_x * tiles_y);
    count_before_.assign((size_t)(tiles_x + 1) * (tiles_y + 1), 0);
    for (int y = 0; y < tiles_y; y++)
      for (int x = 0; x < tiles_x; x++)
        count_before(x + 1, y + 1) = count_before(x + 1, y) + count_before(x, y + 1) -
                                     count_before(x, y) + (active[y * tiles_x + x] != 0);
  }

  bool contains(int tile) const { return all_ || active_[tile]; }

  bool touch(const TileBox& b) const {
    return all_ || count_before(b.x1 + 1, b.y1 + 1) - count_before(b.x0, b.y1 + 1) -
                           count_before(b.x1 + 1, b.y0) + count_before(b.x0, b.y0) >
                       0;
  }

 private:
  // Active tiles above and left of a tile's corner: a summed-area table.
  int32_t& count_before(int x, int y) { return count_before_[(size_t)y * (tiles_x_ + 1) + x]; }
  int32_t count_before(int x, int y) const { return count_before_[(size_t)y * (tiles_x_ + 1) + x]; }

  bool all_ = true;
  int tiles_x_ = 0;
  std::vector<uint8_t> active_;
  std::vector<int32_t> count_before_;
};

}  // namespace aq

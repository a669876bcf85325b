// What a forward pass leaves for its backward pass: projected Gaussians and tile lists.
#pragma once

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <ratio>
#include <vector>

#include "activity.h"
#include "constants.h"
#include "simd.h"

namespace aq {

enum Stage { kProject, kTileLists, kBlend, kBlendBackward, kProjectBackward, kStages };

constexpr int kBlocksX = kTile / kBlockW, kBlocksY = kTile / kBlockH;
constexpr int kBlocks = kBlocksX * kBlocksY;
constexpr int kGradientFloats = 16;  // one cache line per Gaussian and thread
constexpr int kCacheLine = 64;

// One bit per block of a tile.
#if defined(__AVX2__)
typedef uint32_t BlockMask;
#else
typedef uint64_t BlockMask;
#endif
static_assert(kBlocks <= 8 * (int)sizeof(BlockMask), "a tile has more blocks than a mask has bits");
constexpr BlockMask kAllBlocks = BlockMask(~BlockMask(0)) >> (8 * sizeof(BlockMask) - kBlocks);

// Corners of the blocks of a tile, and their products: a table is cheaper than int to float.
struct BlockOffsets {
  float x[kBlocks], y[kBlocks], xx[kBlocks], xy[kBlocks], yy[kBlocks];
  constexpr BlockOffsets() : x(), y(), xx(), xy(), yy() {
    for (int b = 0; b < kBlocks; b++) {
      x[b] = (float)(b % kBlocksX * kBlockW);
      y[b] = (float)(b / kBlocksX * kBlockH);
      xx[b] = x[b] * x[b];
      xy[b] = x[b] * y[b];
      yy[b] = y[b] * y[b];
    }
  }
};
constexpr BlockOffsets kOffsets;

// A projected Gaussian, one cache line. log2 alpha(x, y) = qa dx^2 + qb dx dy + qc dy^2 +
// log2_opacity with dx = x - u, dy = y - v and pixel centres at whole numbers.
struct alignas(kCacheLine) Splat {
  float u, v, qa, qb, qc, log2_opacity;
  float colour[4];
  float extent_x, extent_y;  // half size of the box where alpha reaches kMinAlpha, pixels
  float slope_x, slope_y;    // -b/a and -b/c: lines where the conic is least along a row or column
  float conic_a, conic_b;
};
static_assert(sizeof(Splat) == kCacheLine, "a splat must fill one cache line");

struct Camera {
  float w[3][3], d[3];                               // world -> camera: t = w x + d
  float fx, fy, cx, cy;                              // pixels
  float tan_x_min, tan_x_max, tan_y_min, tan_y_max;  // where the Jacobian's ray is clamped
  int width, height;
};

struct TileEntry {
  uint32_t splat;
  BlockMask blocks;
};

struct TileHit {
  uint32_t tile, splat;
  BlockMask blocks;
};

template <class T>
struct AlignedBuffer {
  std::vector<T> storage;
  T* reserve(size_t count) {
    const size_t slack = kCacheLine / sizeof(T);
    if (storage.size() < count + slack) storage.resize(count + slack);
    const uintptr_t raw = (uintptr_t)storage.data();
    return (T*)((raw + kCacheLine - 1) & ~(uintptr_t)(kCacheLine - 1));
  }
};

struct Context {
  double stage_ms[kStages] = {};  // wall time; backward's are zero until it has run
  int count = 0, visible = 0, threads = 1, channels = 3;
  int tiles_x = 0, tiles_y = 0;
  Camera camera{};
  ActiveTiles active;
  std::vector<Splat> splats;            // [count], storage order
  std::vector<float> depth;             // [count], metres; negative = culled
  std::vector<uint32_t> key, key_swap;  // radix sort
  std::vector<uint32_t> order, order_swap;
  std::vector<int32_t> tile_offset;        // [tiles + 1]
  std::vector<int32_t> tile_cursor;        // [threads, tiles]
  std::vector<std::vector<TileHit>> hits;  // per thread
  std::vector<TileEntry> entries;          // front to back inside each tile
  std::vector<float> transmittance;        // [H, W] what is left behind the last Gaussian
  std::vector<int64_t> work_before;        // [tiles + 1] work of drawing the tiles before
  AlignedBuffer<float> gradient;           // [threads, count, kGradientFloats]

  int tiles() const { return tiles_x * tiles_y; }

  template <class Work>
  void timed(Stage stage, const Work& work) {
    const auto start = std::chrono::steady_clock::now();
    work();
    const std::chrono::duration<double, std::milli> passed =
        std::chrono::steady_clock::now() - start;
    stage_ms[stage] = passed.count();
  }

  // Contiguous runs of tiles with about equal work, as the forward pass found it; contiguity keeps
  // splats in the core's cache.
  int first_tile(int part) const {
    const int64_t target = work_before.back() * part / threads;
    return (int)(std::lower_bound(work_before.begin(), work_before.end(), target) -
                 work_before.begin());
  }
};

// The tiles that the box around a splat's ellipse touches on the picture; some tile for a culled
// splat, whose numbers may be none (zero comes first: it wins against NaN).
AQ_INLINE TileBox tile_box(const Context& ctx, const Splat& s) {
  const auto clamped = [](float pixel, int tiles) {
    return (int)std::min(std::max(0.0f, pixel * (1.0f / kTile)), (float)(tiles - 1));
  };
  return {clamped(s.u - s.extent_x, ctx.tiles_x), clamped(s.u + s.extent_x, ctx.tiles_x),
          clamped(s.v - s.extent_y, ctx.tiles_y), clamped(s.v + s.extent_y, ctx.tiles_y)};
}

}  // namespace aq

// Front-to-back lists of splats for every tile: radix sort by depth, then an exact ellipse test
// that also says which blocks of the tile a splat reaches.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <utility>
#include <vector>

#include "activity.h"
#include "constants.h"
#include "context.h"
#include "pool.h"
#include "simd.h"

namespace aq {

constexpr int kPrefetchDistance = 6;

// Sorts ctx.order by depth (positive floats order like their bits). Stable, hence deterministic.
static void sort_by_depth(Context& ctx) {
  constexpr int kDigitBits = 11, kDigits = 1 << kDigitBits, kPasses = 3;
  const int n = ctx.visible;
  uint32_t count[kPasses][kDigits] = {};
  uint32_t *key = ctx.key.data(), *key_to = ctx.key_swap.data();
  uint32_t *order = ctx.order.data(), *order_to = ctx.order_swap.data();
  for (int i = 0; i < n; i++)
    for (int pass = 0; pass < kPasses; pass++)
      count[pass][(key[i] >> (kDigitBits * pass)) & (kDigits - 1)]++;
  for (int pass = 0; pass < kPasses; pass++) {
    uint32_t start = 0;
    for (int d = 0; d < kDigits; d++) {
      const uint32_t c = count[pass][d];
      count[pass][d] = start;
      start += c;
    }
    for (int i = 0; i < n; i++) {
      const uint32_t to = count[pass][(key[i] >> (kDigitBits * pass)) & (kDigits - 1)]++;
      key_to[to] = key[i];
      order_to[to] = order[i];
    }
    std::swap(key, key_to);
    std::swap(order, order_to);
  }
  ctx.key.swap(ctx.key_swap);  // three passes: the result lies in the other buffers
  ctx.order.swap(ctx.order_swap);
}

static void collect_visible(Context& ctx) {
  for (auto* v : {&ctx.key, &ctx.key_swap, &ctx.order, &ctx.order_swap})
    if ((int)v->size() < ctx.count) v->resize(ctx.count);
  int n = 0;
  for (int i = 0; i < ctx.count; i++) {
    ctx.order[n] = i;
    std::memcpy(&ctx.key[n], &ctx.depth[i], 4);
    n += ctx.depth[i] > 0;
  }
  ctx.visible = n;
}

constexpr int kBlockVecs = (kBlocks + kLanes - 1) / kLanes;

// Corners of all blocks of a tile, one block per lane.
struct BlockCorners {
  Vec x[kBlockVecs], y[kBlockVecs];
};

AQ_INLINE BlockCorners block_corners() {
  BlockCorners c;
  for (int j = 0; j < kBlockVecs; j++)
    for (int lane = 0; lane < kLanes; lane++) {
      const int block = j * kLanes + lane;
      c.x[j][lane] = (float)(block % kBlocksX * kBlockW);
      c.y[j][lane] = (float)(block / kBlocksX * kBlockH);
    }
  return c;
}

// Blocks in whose pixel centres' rectangle alpha reaches kMinAlpha. The largest exponent over a
// rectangle lies at the nearest column or row, or where the conic is least along it.
AQ_INLINE BlockMask reached_blocks(const Splat& s, float u, float v, const BlockCorners& corners) {
  constexpr float kSlack = 1e-4f;  // the drawing loop evaluates the exponent in another order
  const Vec limit = splat(kLog2MinAlpha - s.log2_opacity - kSlack), zero = splat(0.0f);
  BlockMask out = 0;
  for (int j = 0; j < kBlockVecs; j++) {
    const Vec x0 = corners.x[j] - u, x1 = x0 + (float)(kBlockW - 1);
    const Vec y0 = corners.y[j] - v, y1 = y0 + (float)(kBlockH - 1);
    const Vec x_near = max(x0, min(x1, zero)), y_near = max(y0, min(y1, zero));
    const Vec y_best = max(y0, min(y1, s.slope_y * x_near)),
              x_best = max(x0, min(x1, s.slope_x * y_near));
    const Vec column = (s.qa * x_near + s.qb * y_best) * x_near + s.qc * y_best * y_best;
    const Vec row = (s.qa * x_best + s.qb * y_near) * x_best + s.qc * y_near * y_near;
    out |= (BlockMask)bits(greater(max(column, row), limit)) << (j * kLanes);
  }
  return out;
}

// Hits of the splats [n part / parts, n (part + 1) / parts) in depth order, and their number per
// tile.
static size_t find_hits(Context& ctx, int part) {
  const BlockCorners corners = block_corners();
  const int begin = (int)((int64_t)ctx.visible * part / ctx.threads);
  const int end = (int)((int64_t)ctx.visible * (part + 1) / ctx.threads);
  int32_t* per_tile = ctx.tile_cursor.data() + (size_t)part * ctx.tiles();
  std::fill(per_tile, per_tile + ctx.tiles(), 0);
  std::vector<TileHit>& hits = ctx.hits[part];
  size_t n = 0;
  for (int k = begin; k < end; k++) {
    if (k + kPrefetchDistance < end)
      __builtin_prefetch(&ctx.splats[ctx.order[k + kPrefetchDistance]]);
    const Splat& s = ctx.splats[ctx.order[k]];
    const TileBox box = tile_box(ctx, s);
    const size_t need = n + (size_t)(box.x1 - box.x0 + 1) * (box.y1 - box.y0 + 1);
    if (need > hits.size()) hits.resize(2 * need + 1024);
    for (int y = box.y0; y <= box.y1; y++)
      for (int x = box.x0; x <= box.x1; x++) {
        const int tile = y * ctx.tiles_x + x;
        if (!ctx.active.contains(tile)) continue;
        const BlockMask blocks =
            reached_blocks(s, s.u - (float)(x * kTile), s.v - (float)(y * kTile), corners);
        hits[n] = {(uint32_t)tile, ctx.order[k], blocks};
        n += blocks != 0;  // no branch: the next hit overwrites an empty one
        per_tile[tile] += blocks != 0;
      }
  }
  return n;
}

// Turns the threads' counts into cursors: tile by tile, earlier (nearer) threads first.
static void place_tiles(Context& ctx) {
  int64_t next = 0;
  for (int tile = 0; tile < ctx.tiles(); tile++) {
    ctx.tile_offset[tile] = (int32_t)next;
    for (int part = 0; part < ctx.threads; part++) {
      int32_t& cursor = ctx.tile_cursor[(size_t)part * ctx.tiles() + tile];
      const int32_t n = cursor;
      cursor = (int32_t)next;
      next += n;
    }
  }
  if (next > INT32_MAX) throw std::length_error("tile lists");  // 16 GB of them
  ctx.tile_offset[ctx.tiles()] = (int32_t)next;
  if ((int64_t)ctx.entries.size() < next) ctx.entries.resize(next);
}

static void build_tile_lists(Context& ctx) {
  collect_visible(ctx);
  sort_by_depth(ctx);
  ctx.tile_offset.resize(ctx.tiles() + 1);
  ctx.tile_cursor.resize((size_t)ctx.threads * ctx.tiles());
  if ((int)ctx.hits.size() < ctx.threads) ctx.hits.resize(ctx.threads);
  size_t found[kMaxThreads];
  Pool::run(ctx.threads, [&](int part) { found[part] = find_hits(ctx, part); });
  place_tiles(ctx);
  Pool::run(ctx.threads, [&](int part) {
    int32_t* cursor = ctx.tile_cursor.data() + (size_t)part * ctx.tiles();
    for (size_t k = 0; k < found[part]; k++) {
      const TileHit& hit = ctx.hits[part][k];
      ctx.entries[cursor[hit.tile]++] = {hit.splat, hit.blocks};
    }
  });
}

}  // namespace aq

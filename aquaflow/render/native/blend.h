// Drawing: every tile blends its splats front to back; backward walks the same lists in the same
// order.
//
// Front-to-back backward: what lies behind a splat is the pixel's total minus the prefix, so no
// transmittance is recovered by division and every threshold decides exactly as it did forward.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "constants.h"
#include "context.h"
#include "moments.h"
#include "pool.h"
#include "simd.h"
#include "tiles.h"

namespace aq {

// Pixel offsets inside a block, and their products.
struct BlockPixels {
  Vec x, y, xx, xy, yy;
};

AQ_INLINE BlockPixels block_pixels() {
  BlockPixels p;
  for (int i = 0; i < kLanes; i++) {
    p.x[i] = (float)(i % kBlockW);
    p.y[i] = (float)(i / kBlockW);
  }
  p.xx = p.x * p.x;
  p.xy = p.x * p.y;
  p.yy = p.y * p.y;
  return p;
}

// First-order part of a splat's exponent at every block's corner: the exponent at offset (x, y) in
// a block is value + slope_x x + slope_y y + (qa x^2 + qb x y + qc y^2).
struct alignas(kCacheLine) BlockExpansion {
  float value[kBlockVecs * kLanes], slope_x[kBlockVecs * kLanes], slope_y[kBlockVecs * kLanes];
};

AQ_INLINE void expand(const Splat& s, float u, float v, const BlockCorners& corners,
                      BlockExpansion& e) {
  for (int j = 0; j < kBlockVecs; j++) {
    const Vec dx = corners.x[j] - u, dy = corners.y[j] - v;
    const Vec slope_x = (2 * s.qa) * dx + s.qb * dy, slope_y = (2 * s.qc) * dy + s.qb * dx;
    *(Vec*)(e.slope_x + j * kLanes) = slope_x;
    *(Vec*)(e.slope_y + j * kLanes) = slope_y;
    *(Vec*)(e.value + j * kLanes) = 0.5f * (dx * slope_x + dy * slope_y) + s.log2_opacity;
  }
}

AQ_INLINE int lowest(BlockMask m) {
  return sizeof(BlockMask) == 4 ? __builtin_ctz((uint32_t)m) : __builtin_ctzll(m);
}

// Calls visit(pixel index, block, lane) for the pixels of a tile that lie on the image.
template <class Visit>
AQ_INLINE void each_pixel(const Camera& cam, int left, int top, const Visit& visit) {
  for (int block = 0; block < kBlocks; block++)
    for (int lane = 0; lane < kLanes; lane++) {
      const int x = left + block % kBlocksX * kBlockW + lane % kBlockW;
      const int y = top + block / kBlocksX * kBlockH + lane / kBlockW;
      if (x < cam.width && y < cam.height) visit((size_t)y * cam.width + x, block, lane);
    }
}

// A tile that nothing reaches; its transmittance is never read.
template <int C>
static void clear_tile(const Camera& cam, int left, int top, float* image, float* alpha) {
  const int columns = std::min(kTile, cam.width - left), bottom = std::min(top + kTile, cam.height);
  for (int y = top; y < bottom; y++) {
    const size_t p = (size_t)y * cam.width + left;
    std::fill_n(image + p * C, columns * C, 0.0f);
    std::fill_n(alpha + p, columns, 0.0f);
  }
}

// Returns the work: blocks visited, and the rest in units of that.
template <int C>
static int64_t blend_tile(Context& ctx, int tile, float* image, float* alpha) {
  constexpr int64_t kTileWork = 64, kEntryWork = 2;
  const BlockPixels px = block_pixels();
  const BlockCorners corners = block_corners();
  const int left = tile % ctx.tiles_x * kTile, top = tile / ctx.tiles_x * kTile;
  const int end = ctx.tile_offset[tile + 1];
  if (ctx.tile_offset[tile] == end) {
    clear_tile<C>(ctx.camera, left, top, image, alpha);
    return 0;
  }
  Vec T[kBlocks], colour[kBlocks][C];
  for (int b = 0; b < kBlocks; b++) {
    T[b] = splat(0.0f);  // off the image: saturated from the start
    for (int c = 0; c < C; c++) colour[b][c] = splat(0.0f);
  }
  each_pixel(ctx.camera, left, top, [&](size_t, int b, int lane) { T[b][lane] = 1.0f; });
  BlockExpansion e;
  BlockMask live = kAllBlocks;
  int64_t work = kTileWork;
  const TileEntry* entries = ctx.entries.data();
  for (int k = ctx.tile_offset[tile]; k < end && live; k++) {
    if (k + kPrefetchDistance < end)
      __builtin_prefetch(&ctx.splats[entries[k + kPrefetchDistance].splat]);
    BlockMask blocks = entries[k].blocks & live;
    if (!blocks) continue;
    const Splat& s = ctx.splats[entries[k].splat];
    const Vec quadratic = s.qa * px.xx + s.qb * px.xy + s.qc * px.yy;
    expand(s, s.u - (float)left, s.v - (float)top, corners, e);
    work += kEntryWork + __builtin_popcountll(blocks);
    do {
      const int b = lowest(blocks);
      blocks &= blocks - 1;
      const Vec exponent = quadratic + e.slope_x[b] * px.x + e.slope_y[b] * px.y + e.value[b];
      const Vec Tb = T[b];
      const Mask open = greater(Tb, splat(kMinTransmittance));
      live &= ~((BlockMask)(!any(open)) << b);
      const Mask drawn = greater(exponent, splat(kLog2MinAlpha)) & open;
      const Vec w = keep(drawn, min(splat(kMaxAlpha), exp2(exponent))) * Tb;
      T[b] = Tb - w;
#pragma GCC unroll 4
      for (int c = 0; c < C; c++) colour[b][c] += w * s.colour[c];
    } while (blocks);
  }
  each_pixel(ctx.camera, left, top, [&](size_t p, int b, int lane) {
    for (int c = 0; c < C; c++) image[p * C + c] = colour[b][c][lane];
    alpha[p] = 1.0f - T[b][lane];
    ctx.transmittance[p] = T[b][lane];
  });
  return work;
}

struct ImageGradients {
  const float* image;    // [H, W, C] as drawn
  const float* g_image;  // [H, W, C] dL/dimage
  const float* g_alpha;  // [H, W] dL/dalpha
};

template <int C>
struct BlockState {
  Vec T, behind, g_colour[C];
};

// behind = dL/d(what is still to come), the total at first.
template <int C>
AQ_INLINE void start_backward(const Context& ctx, int left, int top, const ImageGradients& g,
                              BlockState<C>* state) {
  for (int b = 0; b < kBlocks; b++) {
    state[b].T = state[b].behind = splat(0.0f);
    for (int c = 0; c < C; c++) state[b].g_colour[c] = splat(0.0f);
  }
  each_pixel(ctx.camera, left, top, [&](size_t p, int b, int lane) {
    float behind = -ctx.transmittance[p] * g.g_alpha[p];
    for (int c = 0; c < C; c++) {
      behind += g.image[p * C + c] * g.g_image[p * C + c];
      state[b].g_colour[c][lane] = g.g_image[p * C + c];
    }
    state[b].behind[lane] = behind;
    state[b].T[lane] = 1.0f;
  });
}

// Moments about the tile's corner -> about the splat's centre (u, v), still per lane.
AQ_INLINE void centre_moments(const BlockPixels& px, float u, float v, MomentLanes& m) {
  const Vec dx = px.x - u, dy = px.y - v;
  const Vec gx = m.lane[kGx] + dx * m.lane[kG], gy = m.lane[kGy] + dy * m.lane[kG];
  m.lane[kGxx] = m.lane[kGxx] + dx * (m.lane[kGx] + gx);
  m.lane[kGyy] = m.lane[kGyy] + dy * (m.lane[kGy] + gy);
  m.lane[kGxy] = m.lane[kGxy] + dx * m.lane[kGy] + dy * gx;
  m.lane[kGx] = gx;
  m.lane[kGy] = gy;
}

template <int C>
static void blend_tile_backward(const Context& ctx, int tile, const ImageGradients& g,
                                float* gradient) {
  const BlockPixels px = block_pixels();
  const BlockCorners corners = block_corners();
  const int left = tile % ctx.tiles_x * kTile, top = tile / ctx.tiles_x * kTile;
  const int end = ctx.tile_offset[tile + 1];
  if (ctx.tile_offset[tile] == end) return;
  BlockState<C> state[kBlocks];
  start_backward<C>(ctx, left, top, g, state);
  BlockExpansion e;
  BlockMask live = kAllBlocks;
  const TileEntry* entries = ctx.entries.data();
  for (int k = ctx.tile_offset[tile]; k < end && live; k++) {
    if (k + kPrefetchDistance < end) {
      const uint32_t soon = entries[k + kPrefetchDistance].splat;
      __builtin_prefetch(&ctx.splats[soon]);
      __builtin_prefetch(gradient + (size_t)soon * kGradientFloats, 1);
    }
    BlockMask blocks = entries[k].blocks & live;
    if (!blocks) continue;
    const uint32_t id = entries[k].splat;
    const Splat& s = ctx.splats[id];
    const float u = s.u - (float)left, v = s.v - (float)top;
    const Vec quadratic = s.qa * px.xx + s.qb * px.xy + s.qc * px.yy;
    expand(s, u, v, corners, e);
    MomentLanes m;
#pragma GCC unroll 10
    for (int i = 0; i < kMoments; i++) m.lane[i] = splat(0.0f);
    do {
      const int b = lowest(blocks);
      blocks &= blocks - 1;
      BlockState<C>& at = state[b];
      const Vec exponent = quadratic + e.slope_x[b] * px.x + e.slope_y[b] * px.y + e.value[b];
      const Vec T = at.T, raw = exp2(exponent);
      const Mask open = greater(T, splat(kMinTransmittance));
      live &= ~((BlockMask)(!any(open)) << b);
      const Mask drawn = greater(exponent, splat(kLog2MinAlpha)) & open;
      const Vec alpha = keep(drawn, min(splat(kMaxAlpha), raw)), w = alpha * T;
      at.T = T - w;
      Vec dot = at.g_colour[0] * s.colour[0];
#pragma GCC unroll 4
      for (int c = 1; c < C; c++) dot += at.g_colour[c] * s.colour[c];
      const Vec own = w * dot, behind = at.behind - own;
      at.behind = behind;
      // a clamped alpha has no gradient
      const Vec ga =
          keep(greater(splat(kMaxAlpha), raw), own - behind * (alpha / (splat(1.0f) - alpha)));
#pragma GCC unroll 4
      for (int c = 0; c < C; c++) m.lane[kColour + c] += w * at.g_colour[c];
      m.lane[kG] += ga;
      m.lane[kGx] += kOffsets.x[b] * ga;
      m.lane[kGy] += kOffsets.y[b] * ga;
      m.lane[kGxx] += kOffsets.xx[b] * ga;
      m.lane[kGxy] += kOffsets.xy[b] * ga;
      m.lane[kGyy] += kOffsets.yy[b] * ga;
    } while (blocks);
    centre_moments(px, u, v, m);
    add_moments(gradient + (size_t)id * kGradientFloats, m);
  }
}

// Threads take tiles as they come: no tile depends on another, so the picture does not depend on
// that.
template <int C>
static void blend(Context& ctx, float* image, float* alpha) {
  ctx.transmittance.resize((size_t)ctx.camera.width * ctx.camera.height);
  ctx.work_before.assign(ctx.tiles() + 1, 0);
  std::atomic<int> next{0};
  Pool::run(ctx.threads, [&](int) {
    for (int tile; (tile = next.fetch_add(1, std::memory_order_relaxed)) < ctx.tiles();)
      ctx.work_before[tile + 1] = blend_tile<C>(ctx, tile, image, alpha);
  });
  for (int tile = 0; tile < ctx.tiles(); tile++) ctx.work_before[tile + 1] += ctx.work_before[tile];
}

// Returns per-thread sums [threads, count, kGradientFloats]; slots as moment_slot says.
template <int C>
static const float* blend_backward(Context& ctx, const ImageGradients& g) {
  const size_t stride = (size_t)ctx.count * kGradientFloats;
  float* gradient = ctx.gradient.reserve(stride * ctx.threads);
  Pool::run(ctx.threads, [&](int part) {
    float* mine = gradient + stride * part;
    std::memset(mine, 0, stride * sizeof(float));
    const int end = ctx.first_tile(part + 1);
    for (int tile = ctx.first_tile(part); tile < end; tile++)
      blend_tile_backward<C>(ctx, tile, g, mine);
  });
  return gradient;
}

}  // namespace aq

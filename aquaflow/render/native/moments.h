// What the tiles sum up for one Gaussian: moments of g = alpha dL/dalpha over its pixels, with dx,
// dy measured from its centre, and the colour gradient. One cache line per Gaussian and thread.
#pragma once

#if defined(__AVX2__)
#include <immintrin.h>
#endif

#include "simd.h"

namespace aq {

enum Moment { kG, kGx, kGy, kGxx, kGxy, kGyy, kColour };
constexpr int kMoments = 10;

struct MomentLanes {
  Vec lane[kMoments];
};

#if defined(__AVX512F__)

// The lane-sums of ten vectors come out of one transposing tree: four lanes of moments 0, 4, 8, -,
// then 1, 5, 9, -, and so on.
AQ_INLINE constexpr int moment_slot(int moment) { return 4 * (moment % 4) + moment / 4; }

AQ_INLINE __m512 fold_halves(__m512 a, __m512 b) {
  return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xEE));
}
AQ_INLINE __m512 fold_quarters(__m512 a, __m512 b) {
  return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xDD));
}
AQ_INLINE __m512 fold_lanes(__m512 a, __m512 b) {
  return _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
}
AQ_INLINE __m512 fold_pairs(__m512 a, __m512 b) {
  const __m512d x = _mm512_castps_pd(a), y = _mm512_castps_pd(b);
  return _mm512_add_ps(_mm512_castpd_ps(_mm512_unpacklo_pd(x, y)),
                       _mm512_castpd_ps(_mm512_unpackhi_pd(x, y)));
}

AQ_INLINE void add_moments(float* to, const MomentLanes& m) {
  const __m512 zero = _mm512_setzero_ps();
  const auto at = [&](int i) { return (__m512)m.lane[i]; };
  const __m512 a = fold_quarters(fold_halves(at(0), at(1)), fold_halves(at(2), at(3)));
  const __m512 b = fold_quarters(fold_halves(at(4), at(5)), fold_halves(at(6), at(7)));
  const __m512 c = fold_quarters(fold_halves(at(8), at(9)), zero);
  *(Vec*)to += (Vec)fold_pairs(fold_lanes(a, b), fold_lanes(c, zero));
}

#elif defined(__AVX2__)

AQ_INLINE constexpr int moment_slot(int moment) { return moment; }

// Sums within each 128-bit half: of a, b, c, d in this order.
AQ_INLINE __m256 fold_four(Vec a, Vec b, Vec c, Vec d) {
  return _mm256_hadd_ps(_mm256_hadd_ps((__m256)a, (__m256)b), _mm256_hadd_ps((__m256)c, (__m256)d));
}

AQ_INLINE void add_moments(float* to, const MomentLanes& m) {
  const __m256 low = fold_four(m.lane[0], m.lane[1], m.lane[2], m.lane[3]);
  const __m256 high = fold_four(m.lane[4], m.lane[5], m.lane[6], m.lane[7]);
  const __m256 rest = fold_four(m.lane[8], m.lane[9], m.lane[8], m.lane[9]);
  const __m256 sums = _mm256_add_ps(_mm256_permute2f128_ps(low, high, 0x20),
                                    _mm256_permute2f128_ps(low, high, 0x31));
  _mm256_store_ps(to, _mm256_add_ps(_mm256_load_ps(to), sums));
  const __m128 last = _mm_add_ps(_mm256_castps256_ps128(rest), _mm256_extractf128_ps(rest, 1));
  _mm_store_ps(to + 8, _mm_add_ps(_mm_load_ps(to + 8), last));  // slots 10, 11 are not read
}

#else

AQ_INLINE constexpr int moment_slot(int moment) { return moment; }

AQ_INLINE void add_moments(float* to, const MomentLanes& m) {
#pragma GCC unroll 10
  for (int i = 0; i < kMoments; i++) to[i] += sum(m.lane[i]);
}

#endif

}  // namespace aq

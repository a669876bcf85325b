// One vector register = one block of pixels. GCC/clang vector extensions, intrinsics only where the
// extension is slow. Widths: 4x4 pixels for AVX-512, 4x2 for AVX2, 4x1 for SSE4 and NEON.
#pragma once

#include <cstdint>
#if defined(__AVX2__)
#include <immintrin.h>
#endif

#define AQ_INLINE static inline __attribute__((always_inline))

namespace aq {

#if defined(__AVX512F__)
constexpr int kBlockW = 4, kBlockH = 4;
#elif defined(__AVX2__)
constexpr int kBlockW = 4, kBlockH = 2;
#else
constexpr int kBlockW = 4, kBlockH = 1;
#endif
constexpr int kLanes = kBlockW * kBlockH;

typedef float Vec __attribute__((vector_size(kLanes * 4), aligned(kLanes * 4)));
typedef int32_t VecInt __attribute__((vector_size(kLanes * 4), aligned(kLanes * 4)));

AQ_INLINE Vec splat(float x) {
  Vec r;
  for (int i = 0; i < kLanes; i++) r[i] = x;
  return r;
}

#if defined(__AVX512F__)

typedef __mmask16 Mask;
AQ_INLINE Mask greater(Vec a, Vec b) {
  return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ);
}
AQ_INLINE bool any(Mask m) { return m != 0; }
AQ_INLINE uint32_t bits(Mask m) { return m; }
AQ_INLINE Vec keep(Mask m, Vec a) { return (Vec)_mm512_maskz_mov_ps(m, (__m512)a); }
AQ_INLINE Vec min(Vec a, Vec b) { return (Vec)_mm512_min_ps((__m512)a, (__m512)b); }
AQ_INLINE Vec max(Vec a, Vec b) { return (Vec)_mm512_max_ps((__m512)a, (__m512)b); }
AQ_INLINE float sum(Vec a) { return _mm512_reduce_add_ps((__m512)a); }

#elif defined(__AVX2__)

typedef VecInt Mask;
AQ_INLINE Mask greater(Vec a, Vec b) { return a > b; }
AQ_INLINE uint32_t bits(Mask m) { return (uint32_t)_mm256_movemask_ps((__m256)m); }
AQ_INLINE bool any(Mask m) { return bits(m) != 0; }
AQ_INLINE Vec keep(Mask m, Vec a) { return (Vec)((VecInt)a & m); }
AQ_INLINE Vec min(Vec a, Vec b) { return (Vec)_mm256_min_ps((__m256)a, (__m256)b); }
AQ_INLINE Vec max(Vec a, Vec b) { return (Vec)_mm256_max_ps((__m256)a, (__m256)b); }
AQ_INLINE VecInt nearest(Vec a) { return (VecInt)_mm256_cvtps_epi32((__m256)a); }
AQ_INLINE float sum(Vec a) {
  __m128 h = _mm_add_ps(_mm256_castps256_ps128((__m256)a), _mm256_extractf128_ps((__m256)a, 1));
  h = _mm_add_ps(h, _mm_movehl_ps(h, h));
  return _mm_cvtss_f32(_mm_add_ss(h, _mm_shuffle_ps(h, h, 1)));
}

#else

typedef VecInt Mask;
typedef int64_t Halves __attribute__((vector_size(kLanes * 4)));
AQ_INLINE Mask greater(Vec a, Vec b) { return a > b; }
AQ_INLINE uint32_t bits(Mask m) {
  const Mask b = m & Mask{1, 2, 4, 8};
  return (uint32_t)((b[0] | b[1]) | (b[2] | b[3]));
}
AQ_INLINE bool any(Mask m) {
  const Halves h = (Halves)m;
  return (h[0] | h[1]) != 0;
}
AQ_INLINE Vec keep(Mask m, Vec a) { return (Vec)((VecInt)a & m); }
AQ_INLINE Vec min(Vec a, Vec b) { return a < b ? a : b; }
AQ_INLINE Vec max(Vec a, Vec b) { return a > b ? a : b; }
AQ_INLINE VecInt nearest(Vec a) {  // of a in [-16, 16]; the conversion itself cuts off
  return __builtin_convertvector(a + splat(16.5f), VecInt) - 16;
}
AQ_INLINE float sum(Vec a) { return (a[0] + a[1]) + (a[2] + a[3]); }

#endif

// 2^x, relative error 3e-6 for x in [-16, 16]; what lies outside is masked by the callers. The
// polynomial is the one of fourth degree with the least relative error on [-1/2, 1/2] and value 1
// at 0.
AQ_INLINE Vec exp2(Vec x) {
#if defined(__AVX512F__)
  const Vec whole = (Vec)_mm512_roundscale_ps((__m512)x, _MM_FROUND_TO_NEAREST_INT);
#else
  const VecInt n = nearest(x);
  const Vec whole = __builtin_convertvector(n, Vec);
#endif
  const Vec f = x - whole;
  Vec p = splat(9.58104707e-3f) * f + splat(5.5905971e-2f);
  p = p * f + splat(0.240241451f);
  p = p * f + splat(0.693124328f);
  p = p * f + splat(1.0f);
#if defined(__AVX512F__)
  return (Vec)_mm512_scalef_ps((__m512)p, (__m512)whole);
#else
  return (Vec)((VecInt)p + (n << 23));
#endif
}

}  // namespace aq

// The exponential of one number in a loop that becomes vectors.
#pragma once

#include <cstring>

namespace aq {

// 2^y, relative error 2e-7, given n, y rounded to an integer: 2^n by the exponent bits, the rest by
// the Taylor series of 2^f on [-1/2, 1/2]. The callers round, each as its range of y allows.
inline float two_to(float y, int n) {
  const float f = y - (float)n;
  float p = 1.5403530e-4f;
  p = p * f + 1.3333558e-3f;
  p = p * f + 9.6181291e-3f;
  p = p * f + 5.5504109e-2f;
  p = p * f + 2.4022651e-1f;
  p = p * f + 6.9314718e-1f;
  p = p * f + 1.0f;
  const int bits = (n + 127) << 23;
  float power;
  std::memcpy(&power, &bits, sizeof power);
  return p * power;
}

}  // namespace aq

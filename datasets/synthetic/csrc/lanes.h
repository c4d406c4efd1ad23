// Eight floats, whatever the instruction set: additions, products, quotients and roots, which IEEE 754 rounds exactly, so that
// every processor computes the same numbers.
#pragma once

#if defined(__SSE2__)
#include <immintrin.h>
#endif
#include <math.h>

#include <cstdint>

#include "bench/native/inline.h"

namespace headbench::HEADBENCH_ISA {

typedef float Float8 __attribute__((vector_size(32)));
typedef std::int32_t Int8 __attribute__((vector_size(32)));

HEADBENCH_INLINE Float8 load(const float* p) {
  Float8 a;
  __builtin_memcpy(&a, p, sizeof a);
  return a;
}
HEADBENCH_INLINE Float8 all(float x) { return Float8{x, x, x, x, x, x, x, x}; }
HEADBENCH_INLINE Float8 select(Int8 m, Float8 a, Float8 b) { return (Float8)(((Int8)a & m) | ((Int8)b & ~m)); }

#if defined(__AVX2__)
HEADBENCH_INLINE Float8 min(Float8 a, Float8 b) { return (Float8)_mm256_min_ps((__m256)a, (__m256)b); }
HEADBENCH_INLINE Float8 max(Float8 a, Float8 b) { return (Float8)_mm256_max_ps((__m256)a, (__m256)b); }
HEADBENCH_INLINE Float8 root(Float8 a) { return (Float8)_mm256_sqrt_ps((__m256)a); }
HEADBENCH_INLINE unsigned bits(Int8 m) { return static_cast<unsigned>(_mm256_movemask_ps((__m256)m)); }
#else
HEADBENCH_INLINE Float8 min(Float8 a, Float8 b) { return select(a < b, a, b); }
HEADBENCH_INLINE Float8 max(Float8 a, Float8 b) { return select(a > b, a, b); }
HEADBENCH_INLINE Float8 root(Float8 a) {
  for (int i = 0; i < 8; ++i) a[i] = sqrtf(a[i]);
  return a;
}
HEADBENCH_INLINE unsigned bits(Int8 m) {
#if defined(__SSE2__)
  __m128 halves[2];
  __builtin_memcpy(halves, &m, sizeof m);
  return static_cast<unsigned>(_mm_movemask_ps(halves[0]) | _mm_movemask_ps(halves[1]) << 4);
#else
  unsigned found = 0;
  for (int i = 0; i < 8; ++i) found |= static_cast<unsigned>(m[i] & 1) << i;
  return found;
#endif
}
#endif

HEADBENCH_INLINE float sum(Float8 a) {
  return ((a[0] + a[1]) + (a[2] + a[3])) + ((a[4] + a[5]) + (a[6] + a[7]));
}

}  // namespace headbench::HEADBENCH_ISA

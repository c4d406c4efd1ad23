// Functions of vectors, whatever their width. Included after a simd header.
#pragma once

#include <cstdint>

#include "inlining.h"

namespace headbench::HEADBENCH_ISA {

constexpr int W = Real::lanes;
constexpr float kLog2e = 1.4426950408889634f;
constexpr float kLn2 = 0.6931471805599453f;

// Lowest bit of a non-zero word, as an index.
HEADBENCH_INLINE int lowest_bit(std::uint64_t bits) {
#if defined(__GNUC__) || defined(__clang__)
  return __builtin_ctzll(bits);
#else
  int index = 0;
  while (!(bits & 1)) bits >>= 1, ++index;
  return index;
#endif
}

// 2^x for x up to 127, not below about 2^-126; relative error below 2e-7.
HEADBENCH_INLINE Real exp2(Real x) {
  Real f;
  if constexpr (!kAnyPower) x = max(x, -126.0f);
  const Real n = round(x, f);
  // Minimax in relative error on [-1/2, 1/2] with the constant held at 1, so that whole powers are exact.
  Real p = 1.32647273e-3f;
  p = fma(p, f, 9.67151299e-3f);
  p = fma(p, f, 5.55073358e-2f);
  p = fma(p, f, 0.240222424f);
  p = fma(p, f, 0.693147004f);
  p = fma(p, f, 1.0f);
  return scale_by_power(p, n);
}

}  // namespace headbench::HEADBENCH_ISA

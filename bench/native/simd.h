// Vectors of floats, one to a lane: `Real` and `Mask` of the instruction set that is compiled for, and functions of them.
//
// Code written in them is compiled once per instruction set, into the namespace HEADBENCH_ISA (see instruction_sets.h).
// Its headers must define nothing outside of that namespace that could be compiled for one instruction set and, the
// linker keeping only one copy, be run on a processor that lacks it: no templates of the standard library.
#pragma once

#include <cstdint>

#include "inline.h"

#ifdef HEADBENCH_ISA
#if defined(HEADBENCH_ISA_avx512)
#include "simd_avx512.h"
#elif defined(HEADBENCH_ISA_avx2)
#include "simd_avx2.h"
#elif defined(HEADBENCH_ISA_neon)
#include "simd_neon.h"
#else
#include "simd_portable.h"
#endif

namespace headbench::HEADBENCH_ISA {

constexpr int W = Real::lanes;
constexpr float kLog2e = 1.4426950408889634f;
constexpr float kLn2 = 0.6931471805599453f;

// Lowest and highest bit of a non-zero word, as indices.
HEADBENCH_INLINE int lowest_bit(std::uint64_t bits) { return __builtin_ctzll(bits); }
HEADBENCH_INLINE int highest_bit(std::uint64_t bits) { return 63 - __builtin_clzll(bits); }

#if !defined(HEADBENCH_ISA_avx512)
// Write the numbers of the lanes that are set, counted from `first`, to a list with room for all lanes; how many they are.
HEADBENCH_INLINE int list_lanes(Mask set, int first, std::int32_t* list) {
  int count = 0;
  for (int lane = 0; lane < W; ++lane) {
    list[count] = first + lane;
    count += bits(set) >> lane & 1;
  }
  return count;
}
#endif

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
#endif

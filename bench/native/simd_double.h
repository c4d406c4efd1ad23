// Eight doubles at once: the compiler's own vectors, which it maps to whatever registers there are. The order in which
// numbers are added is that of the source, so that every instruction set gives the same bits.
#pragma once

#include "simd.h"

namespace headbench::HEADBENCH_ISA {
namespace {

constexpr int kDoubles = 8;
typedef double Doubles __attribute__((vector_size(kDoubles * sizeof(double))));

HEADBENCH_INLINE Doubles all(double value) { return Doubles{} + value; }
HEADBENCH_INLINE Doubles load(const double* from) {
  Doubles out;
  __builtin_memcpy(&out, from, sizeof out);
  return out;
}
HEADBENCH_INLINE void store(double* to, const Doubles& value) { __builtin_memcpy(to, &value, sizeof value); }

}  // namespace
}  // namespace headbench::HEADBENCH_ISA

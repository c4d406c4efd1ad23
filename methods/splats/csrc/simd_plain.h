// Four floats in plain C++, for compilers without vector extensions. Those turn the fixed-length
// loops into vector instructions as far as they can.
#pragma once

#include <math.h>

#include <cstdint>
#include <cstring>

#include "inlining.h"

namespace headbench::HEADBENCH_ISA {

struct alignas(16) Real {
  static constexpr int lanes = 4;
  float v[4];
  Real() = default;
  Real(float x) : v{x, x, x, x} {}
};

struct alignas(16) Mask {
  std::int32_t v[4];  // 0 or -1
};

#define HEADBENCH_LANES(type, expression)            \
  type r;                                            \
  for (int i = 0; i < 4; ++i) r.v[i] = (expression); \
  return r

HEADBENCH_INLINE Real load(const float* p) { HEADBENCH_LANES(Real, p[i]); }
HEADBENCH_INLINE void store(float* p, Real a) {
  for (int i = 0; i < 4; ++i) p[i] = a.v[i];
}
HEADBENCH_INLINE Real operator+(Real a, Real b) { HEADBENCH_LANES(Real, a.v[i] + b.v[i]); }
HEADBENCH_INLINE Real operator-(Real a, Real b) { HEADBENCH_LANES(Real, a.v[i] - b.v[i]); }
HEADBENCH_INLINE Real operator*(Real a, Real b) { HEADBENCH_LANES(Real, a.v[i] * b.v[i]); }
HEADBENCH_INLINE Real operator/(Real a, Real b) { HEADBENCH_LANES(Real, a.v[i] / b.v[i]); }
HEADBENCH_INLINE Real fma(Real a, Real b, Real c) { HEADBENCH_LANES(Real, a.v[i] * b.v[i] + c.v[i]); }
HEADBENCH_INLINE Real fnma(Real a, Real b, Real c) { HEADBENCH_LANES(Real, c.v[i] - a.v[i] * b.v[i]); }
HEADBENCH_INLINE Real min(Real a, Real b) { HEADBENCH_LANES(Real, a.v[i] < b.v[i] ? a.v[i] : b.v[i]); }
HEADBENCH_INLINE Real max(Real a, Real b) { HEADBENCH_LANES(Real, a.v[i] > b.v[i] ? a.v[i] : b.v[i]); }
HEADBENCH_INLINE Real sqrt(Real a) { HEADBENCH_LANES(Real, sqrtf(a.v[i])); }
HEADBENCH_INLINE Real reciprocal(Real a) { HEADBENCH_LANES(Real, 1.0f / a.v[i]); }
HEADBENCH_INLINE Real ceil(Real a) { HEADBENCH_LANES(Real, ceilf(a.v[i])); }
HEADBENCH_INLINE Real floor(Real a) { HEADBENCH_LANES(Real, floorf(a.v[i])); }
HEADBENCH_INLINE Mask operator>(Real a, Real b) { HEADBENCH_LANES(Mask, a.v[i] > b.v[i] ? -1 : 0); }
HEADBENCH_INLINE Mask operator>=(Real a, Real b) { HEADBENCH_LANES(Mask, a.v[i] >= b.v[i] ? -1 : 0); }
HEADBENCH_INLINE Mask operator&(Mask a, Mask b) { HEADBENCH_LANES(Mask, a.v[i] & b.v[i]); }
HEADBENCH_INLINE Real select(Mask m, Real a, Real b) { HEADBENCH_LANES(Real, m.v[i] ? a.v[i] : b.v[i]); }
HEADBENCH_INLINE Real zero_unless(Mask m, Real a) { HEADBENCH_LANES(Real, m.v[i] ? a.v[i] : 0.0f); }
HEADBENCH_INLINE bool any(Mask m) { return (m.v[0] | m.v[1] | m.v[2] | m.v[3]) != 0; }
HEADBENCH_INLINE std::uint32_t bits(Mask m) {
  return (m.v[0] & 1u) | (m.v[1] & 2u) | (m.v[2] & 4u) | (m.v[3] & 8u);
}

#undef HEADBENCH_LANES

// Split x into the nearest whole number and the rest in [-1/2, 1/2].
HEADBENCH_INLINE Real round(Real a, Real& rest) {
  constexpr float magic = 12582912.0f;  // 1.5 2^23: adding it drops the fraction
  Real whole = (a + Real(magic)) - Real(magic);
  rest = a - whole;
  return whole;
}

// a 2^n for whole n from -126 to 127.
constexpr bool kAnyPower = false;
HEADBENCH_INLINE Real scale_by_power(Real a, Real n) {
  Real r;
  for (int i = 0; i < 4; ++i) {
    const std::int32_t bits = (static_cast<std::int32_t>(n.v[i]) + 127) << 23;
    float power;
    std::memcpy(&power, &bits, sizeof power);
    r.v[i] = a.v[i] * power;
  }
  return r;
}

// Of one vector: nothing to do.
HEADBENCH_INLINE void transpose_rows(Real*) {}

// Within every four floats: element i of vector j and element j of vector i change places.
HEADBENCH_INLINE void transpose_quads(Real* q) {
  Real t[4];
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) t[i].v[j] = q[j].v[i];
  for (int i = 0; i < 4; ++i) q[i] = t[i];
}

// No instruction gathers the same bit of several words.
constexpr bool kTestsBits = false;
template <int bits, class Take>
HEADBENCH_INLINE void test_bits(const std::uint32_t*, const Take&) {}

}  // namespace headbench::HEADBENCH_ISA

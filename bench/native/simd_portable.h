// Four floats in the vector extension of GCC and Clang: SSE2, NEON or whatever the platform's baseline has.
#pragma once

#include <math.h>

#include <cstdint>

namespace headbench::HEADBENCH_ISA {

typedef float Float4 __attribute__((vector_size(16)));
typedef std::int32_t Int4 __attribute__((vector_size(16)));

struct Real {
  static constexpr int lanes = 4;
  Float4 v;
  Real() = default;
  Real(Float4 x) : v(x) {}
  Real(float x) : v(Float4{x, x, x, x}) {}
};

struct Mask {
  Int4 v;  // 0 or -1
};

HEADBENCH_INLINE Real load(const float* p) {
  Real a;
  __builtin_memcpy(&a.v, p, sizeof a.v);
  return a;
}
HEADBENCH_INLINE Real load_int16(const std::int16_t* p) {
  return __builtin_convertvector((Int4{p[0], p[1], p[2], p[3]}), Float4);
}
HEADBENCH_INLINE void store(float* p, Real a) { __builtin_memcpy(p, &a.v, sizeof a.v); }
HEADBENCH_INLINE Real operator+(Real a, Real b) { return a.v + b.v; }
HEADBENCH_INLINE Real operator-(Real a, Real b) { return a.v - b.v; }
HEADBENCH_INLINE Real operator*(Real a, Real b) { return a.v * b.v; }
HEADBENCH_INLINE Real operator/(Real a, Real b) { return a.v / b.v; }
HEADBENCH_INLINE Real fma(Real a, Real b, Real c) { return a.v * b.v + c.v; }
HEADBENCH_INLINE Real fnma(Real a, Real b, Real c) { return c.v - a.v * b.v; }
HEADBENCH_INLINE Mask operator>(Real a, Real b) { return {a.v > b.v}; }
HEADBENCH_INLINE Mask operator>=(Real a, Real b) { return {a.v >= b.v}; }
HEADBENCH_INLINE Mask operator&(Mask a, Mask b) { return {a.v & b.v}; }
HEADBENCH_INLINE Real select(Mask m, Real a, Real b) { return (Float4)(((Int4)a.v & m.v) | ((Int4)b.v & ~m.v)); }
HEADBENCH_INLINE Real zero_unless(Mask m, Real a) { return (Float4)((Int4)a.v & m.v); }
HEADBENCH_INLINE Real min(Real a, Real b) { return select({a.v < b.v}, a, b); }
HEADBENCH_INLINE Real max(Real a, Real b) { return select({a.v > b.v}, a, b); }
HEADBENCH_INLINE Real sqrt(Real a) { return Float4{sqrtf(a.v[0]), sqrtf(a.v[1]), sqrtf(a.v[2]), sqrtf(a.v[3])}; }
HEADBENCH_INLINE Real ceil(Real a) { return Float4{ceilf(a.v[0]), ceilf(a.v[1]), ceilf(a.v[2]), ceilf(a.v[3])}; }
HEADBENCH_INLINE Real floor(Real a) {
  return Float4{floorf(a.v[0]), floorf(a.v[1]), floorf(a.v[2]), floorf(a.v[3])};
}
HEADBENCH_INLINE bool any(Mask m) { return (m.v[0] | m.v[1] | m.v[2] | m.v[3]) != 0; }
HEADBENCH_INLINE std::uint32_t bits(Mask m) {
  return (m.v[0] & 1u) | (m.v[1] & 2u) | (m.v[2] & 4u) | (m.v[3] & 8u);
}
HEADBENCH_INLINE Real reciprocal(Real a) { return Real(1.0f) / a; }

// Split x into the nearest whole number and the rest in [-1/2, 1/2].
HEADBENCH_INLINE Real round(Real a, Real& rest) {
  constexpr float magic = 12582912.0f;  // 1.5 2^23: adding it drops the fraction
  const Real whole = (a + Real(magic)) - Real(magic);
  rest = a - whole;
  return whole;
}

// a 2^n for whole n from -126 to 127.
constexpr bool kAnyPower = false;
HEADBENCH_INLINE Real scale_by_power(Real a, Real n) {
  return a.v * (Float4)((__builtin_convertvector(n.v, Int4) + 127) << 23);
}

// Of one vector: nothing to do.
HEADBENCH_INLINE void transpose_rows(Real*) {}

// Within every four floats: element i of vector j and element j of vector i change places.
HEADBENCH_INLINE void transpose_quads(Real* q) {
  const Float4 a = q[0].v, b = q[1].v, c = q[2].v, d = q[3].v;
  q[0] = Float4{a[0], b[0], c[0], d[0]};
  q[1] = Float4{a[1], b[1], c[1], d[1]};
  q[2] = Float4{a[2], b[2], c[2], d[2]};
  q[3] = Float4{a[3], b[3], c[3], d[3]};
}

// No instruction gathers the same bit of several words.
constexpr bool kTestsBits = false;
template <int bits, class Take>
HEADBENCH_INLINE void test_bits(const std::uint32_t*, const Take&) {}

}  // namespace headbench::HEADBENCH_ISA

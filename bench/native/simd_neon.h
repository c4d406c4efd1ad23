// Four floats: NEON as every 64-bit ARM processor has it.
#pragma once

#include <arm_neon.h>

#include <cstdint>

namespace headbench::HEADBENCH_ISA {

struct Real {
  static constexpr int lanes = 4;
  float32x4_t v;
  Real() = default;
  Real(float32x4_t x) : v(x) {}
  Real(float x) : v(vdupq_n_f32(x)) {}
};

struct Mask {
  uint32x4_t v;  // all bits or none
};

HEADBENCH_INLINE Real load(const float* p) { return vld1q_f32(p); }
HEADBENCH_INLINE Real load_int16(const std::int16_t* p) {
  return vcvtq_f32_s32(vmovl_s16(vld1_s16(p)));
}
HEADBENCH_INLINE void store(float* p, Real a) { vst1q_f32(p, a.v); }
HEADBENCH_INLINE Real operator+(Real a, Real b) { return vaddq_f32(a.v, b.v); }
HEADBENCH_INLINE Real operator-(Real a, Real b) { return vsubq_f32(a.v, b.v); }
HEADBENCH_INLINE Real operator*(Real a, Real b) { return vmulq_f32(a.v, b.v); }
HEADBENCH_INLINE Real operator/(Real a, Real b) { return vdivq_f32(a.v, b.v); }
HEADBENCH_INLINE Real fma(Real a, Real b, Real c) { return vfmaq_f32(c.v, a.v, b.v); }
HEADBENCH_INLINE Real fnma(Real a, Real b, Real c) { return vfmsq_f32(c.v, a.v, b.v); }
// Of a number and NaN the number, as the other instruction sets give it where NaN comes first.
HEADBENCH_INLINE Real min(Real a, Real b) { return vminnmq_f32(a.v, b.v); }
HEADBENCH_INLINE Real max(Real a, Real b) { return vmaxnmq_f32(a.v, b.v); }
HEADBENCH_INLINE Real sqrt(Real a) { return vsqrtq_f32(a.v); }
HEADBENCH_INLINE Real ceil(Real a) { return vrndpq_f32(a.v); }
HEADBENCH_INLINE Real floor(Real a) { return vrndmq_f32(a.v); }
HEADBENCH_INLINE Mask operator>(Real a, Real b) { return {vcgtq_f32(a.v, b.v)}; }
HEADBENCH_INLINE Mask operator>=(Real a, Real b) { return {vcgeq_f32(a.v, b.v)}; }
HEADBENCH_INLINE Mask operator&(Mask a, Mask b) { return {vandq_u32(a.v, b.v)}; }
HEADBENCH_INLINE Real select(Mask m, Real a, Real b) { return vbslq_f32(m.v, a.v, b.v); }
HEADBENCH_INLINE Real zero_unless(Mask m, Real a) {
  return vreinterpretq_f32_u32(vandq_u32(m.v, vreinterpretq_u32_f32(a.v)));
}
HEADBENCH_INLINE bool any(Mask m) { return vmaxvq_u32(m.v) != 0; }
HEADBENCH_INLINE std::uint32_t bits(Mask m) {
  constexpr std::uint32_t places[4] = {1, 2, 4, 8};
  return vaddvq_u32(vandq_u32(m.v, vld1q_u32(places)));
}
HEADBENCH_INLINE Real reciprocal(Real a) { return Real(1.0f) / a; }

// Split x into the nearest whole number and the rest in [-1/2, 1/2].
HEADBENCH_INLINE Real round(Real a, Real& rest) {
  const Real whole = vrndnq_f32(a.v);
  rest = a - whole;
  return whole;
}

// a 2^n for whole n from -126 to 127.
constexpr bool kAnyPower = false;
HEADBENCH_INLINE Real scale_by_power(Real a, Real n) {
  const int32x4_t exponent = vaddq_s32(vcvtq_s32_f32(n.v), vdupq_n_s32(127));
  return a * Real(vreinterpretq_f32_s32(vshlq_n_s32(exponent, 23)));
}

// Of one vector: nothing to do.
HEADBENCH_INLINE void transpose_rows(Real*) {}

HEADBENCH_INLINE Real low_halves(float32x4_t a, float32x4_t b) {
  return vreinterpretq_f32_f64(vtrn1q_f64(vreinterpretq_f64_f32(a), vreinterpretq_f64_f32(b)));
}
HEADBENCH_INLINE Real high_halves(float32x4_t a, float32x4_t b) {
  return vreinterpretq_f32_f64(vtrn2q_f64(vreinterpretq_f64_f32(a), vreinterpretq_f64_f32(b)));
}

// Within every four floats: element i of vector j and element j of vector i change places.
HEADBENCH_INLINE void transpose_quads(Real* q) {
  const float32x4_t a = vtrn1q_f32(q[0].v, q[1].v), b = vtrn2q_f32(q[0].v, q[1].v);
  const float32x4_t c = vtrn1q_f32(q[2].v, q[3].v), d = vtrn2q_f32(q[2].v, q[3].v);
  q[0] = low_halves(a, c);
  q[1] = low_halves(b, d);
  q[2] = high_halves(a, c);
  q[3] = high_halves(b, d);
}

// No instruction gathers the same bit of several words.
constexpr bool kTestsBits = false;
template <int bits, class Take>
HEADBENCH_INLINE void test_bits(const std::uint32_t*, const Take&) {}

}  // namespace headbench::HEADBENCH_ISA

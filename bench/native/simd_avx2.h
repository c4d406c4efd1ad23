// Eight floats: AVX2 with fused multiply-add.
#pragma once

#include <immintrin.h>

#include <cstdint>

namespace headbench::HEADBENCH_ISA {

struct Real {
  static constexpr int lanes = 8;
  __m256 v;
  Real() = default;
  Real(__m256 x) : v(x) {}
  Real(float x) : v(_mm256_set1_ps(x)) {}
};

struct Mask {
  __m256 v;
};

HEADBENCH_INLINE Real load(const float* p) { return _mm256_loadu_ps(p); }
HEADBENCH_INLINE Real load_int16(const std::int16_t* p) {
  return _mm256_cvtepi32_ps(_mm256_cvtepi16_epi32(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))));
}
HEADBENCH_INLINE void store(float* p, Real a) { _mm256_storeu_ps(p, a.v); }
HEADBENCH_INLINE Real operator+(Real a, Real b) { return _mm256_add_ps(a.v, b.v); }
HEADBENCH_INLINE Real operator-(Real a, Real b) { return _mm256_sub_ps(a.v, b.v); }
HEADBENCH_INLINE Real operator*(Real a, Real b) { return _mm256_mul_ps(a.v, b.v); }
HEADBENCH_INLINE Real operator/(Real a, Real b) { return _mm256_div_ps(a.v, b.v); }
HEADBENCH_INLINE Real fma(Real a, Real b, Real c) { return _mm256_fmadd_ps(a.v, b.v, c.v); }
HEADBENCH_INLINE Real fnma(Real a, Real b, Real c) { return _mm256_fnmadd_ps(a.v, b.v, c.v); }
HEADBENCH_INLINE Real min(Real a, Real b) { return _mm256_min_ps(a.v, b.v); }
HEADBENCH_INLINE Real max(Real a, Real b) { return _mm256_max_ps(a.v, b.v); }
HEADBENCH_INLINE Real sqrt(Real a) { return _mm256_sqrt_ps(a.v); }
HEADBENCH_INLINE Real ceil(Real a) { return _mm256_ceil_ps(a.v); }
HEADBENCH_INLINE Real floor(Real a) { return _mm256_floor_ps(a.v); }
HEADBENCH_INLINE Mask operator>(Real a, Real b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GT_OQ)}; }
HEADBENCH_INLINE Mask operator>=(Real a, Real b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
HEADBENCH_INLINE Mask operator&(Mask a, Mask b) { return {_mm256_and_ps(a.v, b.v)}; }
HEADBENCH_INLINE Real select(Mask m, Real a, Real b) { return _mm256_blendv_ps(b.v, a.v, m.v); }
HEADBENCH_INLINE Real zero_unless(Mask m, Real a) { return _mm256_and_ps(m.v, a.v); }
HEADBENCH_INLINE bool any(Mask m) { return _mm256_movemask_ps(m.v) != 0; }
HEADBENCH_INLINE std::uint32_t bits(Mask m) { return static_cast<std::uint32_t>(_mm256_movemask_ps(m.v)); }

// One Newton step on the 12-bit estimate: 1 to 2 units in the last place.
HEADBENCH_INLINE Real reciprocal(Real a) {
  const Real r = _mm256_rcp_ps(a.v);
  return fma(r, fnma(a, r, 1.0f), r);
}

// Split x into the nearest whole number and the rest in [-1/2, 1/2].
HEADBENCH_INLINE Real round(Real a, Real& rest) {
  const Real whole = _mm256_round_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
  rest = a - whole;
  return whole;
}

// a 2^n for whole n from -126 to 127.
constexpr bool kAnyPower = false;
HEADBENCH_INLINE Real scale_by_power(Real a, Real n) {
  const __m256i exponent = _mm256_add_epi32(_mm256_cvtps_epi32(n.v), _mm256_set1_epi32(127));
  return a * Real(_mm256_castsi256_ps(_mm256_slli_epi32(exponent, 23)));
}

// Of lanes / 4 vectors: the i-th four floats of vector j and the j-th of vector i change places.
HEADBENCH_INLINE void transpose_rows(Real* r) {
  const __m256 a = r[0].v;
  r[0].v = _mm256_permute2f128_ps(a, r[1].v, 0x20);
  r[1].v = _mm256_permute2f128_ps(a, r[1].v, 0x31);
}

// Within every four floats: element i of vector j and element j of vector i change places.
HEADBENCH_INLINE void transpose_quads(Real* q) {
  const __m256 a = _mm256_unpacklo_ps(q[0].v, q[1].v), b = _mm256_unpackhi_ps(q[0].v, q[1].v);
  const __m256 c = _mm256_unpacklo_ps(q[2].v, q[3].v), d = _mm256_unpackhi_ps(q[2].v, q[3].v);
  q[0].v = _mm256_shuffle_ps(a, c, 0x44);
  q[1].v = _mm256_shuffle_ps(a, c, 0xee);
  q[2].v = _mm256_shuffle_ps(b, d, 0x44);
  q[3].v = _mm256_shuffle_ps(b, d, 0xee);
}

// Hand `take` for each of the lowest `bits` bits which of the W words have it set.
constexpr bool kTestsBits = true;
template <int bits, class Take>
HEADBENCH_INLINE void test_bits(const std::uint32_t* words, const Take& take) {
  __m256i w = _mm256_slli_epi32(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(words)), 32 - bits);
  for (int b = bits - 1; b >= 0; --b) {
    take(b, static_cast<unsigned>(_mm256_movemask_ps(_mm256_castsi256_ps(w))));
    w = _mm256_add_epi32(w, w);
  }
}

}  // namespace headbench::HEADBENCH_ISA

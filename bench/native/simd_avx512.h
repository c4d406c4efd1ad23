// Sixteen floats: AVX-512 (F, DQ, BW, VL).
#pragma once

#include <immintrin.h>

#include <cstdint>

namespace headbench::HEADBENCH_ISA {

struct Real {
  static constexpr int lanes = 16;
  __m512 v;
  Real() = default;
  Real(__m512 x) : v(x) {}
  Real(float x) : v(_mm512_set1_ps(x)) {}
};

struct Mask {
  __mmask16 v;
};

HEADBENCH_INLINE Real load(const float* p) { return _mm512_loadu_ps(p); }
HEADBENCH_INLINE Real load_int16(const std::int16_t* p) {
  return _mm512_cvtepi32_ps(_mm512_cvtepi16_epi32(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(p))));
}
HEADBENCH_INLINE void store(float* p, Real a) { _mm512_storeu_ps(p, a.v); }
HEADBENCH_INLINE Real operator+(Real a, Real b) { return _mm512_add_ps(a.v, b.v); }
HEADBENCH_INLINE Real operator-(Real a, Real b) { return _mm512_sub_ps(a.v, b.v); }
HEADBENCH_INLINE Real operator*(Real a, Real b) { return _mm512_mul_ps(a.v, b.v); }
HEADBENCH_INLINE Real operator/(Real a, Real b) { return _mm512_div_ps(a.v, b.v); }
HEADBENCH_INLINE Real fma(Real a, Real b, Real c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }
HEADBENCH_INLINE Real fnma(Real a, Real b, Real c) { return _mm512_fnmadd_ps(a.v, b.v, c.v); }
HEADBENCH_INLINE Real min(Real a, Real b) { return _mm512_min_ps(a.v, b.v); }
HEADBENCH_INLINE Real max(Real a, Real b) { return _mm512_max_ps(a.v, b.v); }
HEADBENCH_INLINE Real sqrt(Real a) { return _mm512_sqrt_ps(a.v); }
HEADBENCH_INLINE Real ceil(Real a) { return _mm512_roundscale_ps(a.v, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC); }
HEADBENCH_INLINE Real floor(Real a) { return _mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
HEADBENCH_INLINE Mask operator>(Real a, Real b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
HEADBENCH_INLINE Mask operator>=(Real a, Real b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
HEADBENCH_INLINE Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.v & b.v)}; }
HEADBENCH_INLINE Real select(Mask m, Real a, Real b) { return _mm512_mask_mov_ps(b.v, m.v, a.v); }
HEADBENCH_INLINE Real zero_unless(Mask m, Real a) { return _mm512_maskz_mov_ps(m.v, a.v); }
HEADBENCH_INLINE bool any(Mask m) { return m.v != 0; }
HEADBENCH_INLINE std::uint32_t bits(Mask m) { return m.v; }

// Write the numbers of the lanes that are set, counted from `first`, to a list with room for all lanes; how many they are.
HEADBENCH_INLINE int list_lanes(Mask set, int first, std::int32_t* list) {
  const __m512i lanes = _mm512_add_epi32(_mm512_set1_epi32(first), _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15));
  _mm512_storeu_si512(list, _mm512_maskz_compress_epi32(set.v, lanes));
  return __builtin_popcount(set.v);
}

// One Newton step on the 14-bit estimate: 1 to 2 units in the last place.
HEADBENCH_INLINE Real reciprocal(Real a) {
  const Real r = _mm512_rcp14_ps(a.v);
  return fma(r, fnma(a, r, 1.0f), r);
}

// Split x into the nearest whole number and the rest in [-1/2, 1/2]; exact, also for huge values.
HEADBENCH_INLINE Real round(Real a, Real& rest) {
  rest = _mm512_reduce_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
  return a - rest;
}

// a 2^n for any whole n: what is too small becomes zero.
constexpr bool kAnyPower = true;
HEADBENCH_INLINE Real scale_by_power(Real a, Real n) { return _mm512_scalef_ps(a.v, n.v); }

// Of lanes / 4 vectors: the i-th four floats of vector j and the j-th of vector i change places.
HEADBENCH_INLINE void transpose_rows(Real* r) {
  const __m512 a = _mm512_shuffle_f32x4(r[0].v, r[1].v, 0x44), b = _mm512_shuffle_f32x4(r[0].v, r[1].v, 0xee);
  const __m512 c = _mm512_shuffle_f32x4(r[2].v, r[3].v, 0x44), d = _mm512_shuffle_f32x4(r[2].v, r[3].v, 0xee);
  r[0].v = _mm512_shuffle_f32x4(a, c, 0x88);
  r[1].v = _mm512_shuffle_f32x4(a, c, 0xdd);
  r[2].v = _mm512_shuffle_f32x4(b, d, 0x88);
  r[3].v = _mm512_shuffle_f32x4(b, d, 0xdd);
}

// Within every four floats: element i of vector j and element j of vector i change places.
HEADBENCH_INLINE void transpose_quads(Real* q) {
  const __m512 a = _mm512_unpacklo_ps(q[0].v, q[1].v), b = _mm512_unpackhi_ps(q[0].v, q[1].v);
  const __m512 c = _mm512_unpacklo_ps(q[2].v, q[3].v), d = _mm512_unpackhi_ps(q[2].v, q[3].v);
  q[0].v = _mm512_shuffle_ps(a, c, 0x44);
  q[1].v = _mm512_shuffle_ps(a, c, 0xee);
  q[2].v = _mm512_shuffle_ps(b, d, 0x44);
  q[3].v = _mm512_shuffle_ps(b, d, 0xee);
}

// Hand `take` for each of the lowest `bits` bits which of the W words have it set.
constexpr bool kTestsBits = true;
template <int bits, class Take>
HEADBENCH_INLINE void test_bits(const std::uint32_t* words, const Take& take) {
  const __m512i w = _mm512_loadu_si512(words);
  for (int b = 0; b < bits; ++b) take(b, _mm512_test_epi32_mask(w, _mm512_set1_epi32(1 << b)));
}

}  // namespace headbench::HEADBENCH_ISA

// Colours of spherical harmonics, one splat per lane.
#pragma once

#include "avatar.h"
#include "directions.h"

namespace headbench::HEADBENCH_ISA {

// Real spherical harmonics above degree 0 of unit vectors, in the order and with the constants of sh.py.
template <int degree>
HEADBENCH_INLINE void harmonics_basis(Real x, Real y, Real z, Real* basis) {
  if constexpr (degree >= 1) {
    const Real c = 0.4886025119029199f;
    basis[0] = Real(0.0f) - c * y;
    basis[1] = c * z;
    basis[2] = Real(0.0f) - c * x;
  }
  if constexpr (degree >= 2) {
    const Real xx = x * x, yy = y * y, zz = z * z, c = 1.0925484305920792f;
    basis[3] = c * x * y;
    basis[4] = Real(0.0f) - c * y * z;
    basis[5] = Real(0.31539156525252005f) * (zz + zz - xx - yy);
    basis[6] = Real(0.0f) - c * x * z;
    basis[7] = Real(0.5462742152960396f) * (xx - yy);
    if constexpr (degree >= 3) {
      const Real c0 = -0.5900435899266435f, c2 = -0.4570457994644658f;
      const Real four = Real(4.0f) * zz - xx - yy, three = 3.0f;
      basis[8] = c0 * y * (three * xx - yy);
      basis[9] = Real(2.890611442640554f) * x * y * z;
      basis[10] = c2 * y * four;
      basis[11] = Real(0.3731763325901154f) * z * (zz + zz - three * (xx + yy));
      basis[12] = c2 * x * four;
      basis[13] = Real(1.445305721320277f) * z * (xx - yy);
      basis[14] = c0 * x * (xx - three * yy);
    }
  }
}

template <int degree>
inline void shade_degree(const Harmonics& in, std::int64_t begin, std::int64_t end) {
  constexpr int kCount = (degree + 1) * (degree + 1);
  static_assert(kHarmonicsBlock % W == 0);
  Gathered<3> color;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    Real d[3];
    directions_from(in.center, in.means, in.turns, in.binding, first, used, d);
    Real basis[kCount > 1 ? kCount - 1 : 1];
    harmonics_basis<degree>(d[0], d[1], d[2], basis);
    const float* block = in.coefficients + first / kHarmonicsBlock * (3 * kCount * kHarmonicsBlock) + first % kHarmonicsBlock;
    for (int channel = 0; channel < 3; ++channel, block += kCount * kHarmonicsBlock) {
      Real sum = fma(load(block), 0.28209479177387814f, 0.5f);
      for (int k = 1; k < kCount; ++k) sum = fma(load(block + k * kHarmonicsBlock), basis[k - 1], sum);
      color.keep(channel, max(sum, 0.0f));
    }
    for (int lane = 0; lane < used; ++lane) color.put(in.colors + 3 * (first + lane), lane);
  }
}

// `begin` is a multiple of kHarmonicsBlock.
inline void shade(const Harmonics& in, std::int64_t begin, std::int64_t end) {
  switch (in.degree) {
    case 0: return shade_degree<0>(in, begin, end);
    case 1: return shade_degree<1>(in, begin, end);
    case 2: return shade_degree<2>(in, begin, end);
    default: return shade_degree<3>(in, begin, end);
  }
}

}  // namespace headbench::HEADBENCH_ISA

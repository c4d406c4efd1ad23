// Spherical harmonics of directions, one to a lane.
#pragma once

#include "simd.h"

namespace headbench::HEADBENCH_ISA {

// Real spherical harmonics above degree 0 of unit vectors, in the order and with the constants of methods/ops/harmonics.py.
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

}  // namespace headbench::HEADBENCH_ISA

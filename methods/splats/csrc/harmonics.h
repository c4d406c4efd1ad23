// Colours of spherical harmonics, one splat per lane.
#pragma once

#include "avatar.h"
#include "directions.h"
#include "harmonics_basis.h"

namespace headbench::HEADBENCH_ISA {

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

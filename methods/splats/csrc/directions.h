// Ways from the camera to splats, one splat per lane.
#pragma once

#include "gathered.h"

namespace headbench::HEADBENCH_ISA {

// Unit vectors from `center` to the means of `used` splats from `first` on, turned by those of their triangles if any.
HEADBENCH_INLINE void directions_from(const float* center, const float* means, const float* turns,
                                      const std::int64_t* binding, std::int64_t first, int used, Real* direction) {
  Gathered<3> mean;
  Gathered<9> turn;
  for (int lane = 0; lane < W; ++lane) {
    const std::int64_t splat = first + (lane < used ? lane : 0);
    mean.set(means + 3 * splat, lane);
    if (turns) turn.set(turns + 9 * binding[splat], lane);
  }
  Real d[3];
  for (int k = 0; k < 3; ++k) d[k] = mean[k] - Real(center[k]);
  const Real square = max(fma(d[0], d[0], fma(d[1], d[1], d[2] * d[2])), 1e-24f), scale = Real(1.0f) / sqrt(square);
  for (int k = 0; k < 3; ++k) d[k] = d[k] * scale;
  for (int row = 0; row < 3; ++row)
    direction[row] = turns ? fma(turn[3 * row], d[0], fma(turn[3 * row + 1], d[1], turn[3 * row + 2] * d[2])) : d[row];
}

}  // namespace headbench::HEADBENCH_ISA

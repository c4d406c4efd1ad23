// Splats to the world, one splat per lane.
#pragma once

#include "avatar.h"
#include "gathered.h"

namespace headbench::HEADBENCH_ISA {

inline void carry(const Carry& in, std::int64_t begin, std::int64_t end) {
  Gathered<9> rotation;
  Gathered<4> turn, quat;
  Gathered<3> center, mean, scale;
  Gathered<1> size;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    for (int lane = 0; lane < W; ++lane) {
      const std::int64_t splat = first + (lane < used ? lane : 0), triangle = in.binding[splat];
      rotation.set(in.rotations + 9 * triangle, lane);
      center.set(in.centers + 3 * triangle, lane);
      size.set(in.sizes + triangle, lane);
      turn.set(in.quaternions + 4 * triangle, lane);
      mean.set(in.means + 3 * splat, lane);
      quat.set(in.quats + 4 * splat, lane);
      scale.set(in.scales + 3 * splat, lane);
    }
    const Real k = size[0], x = mean[0], y = mean[1], z = mean[2];
    for (int row = 0; row < 3; ++row) {
      const Real turned = fma(rotation[3 * row], x, fma(rotation[3 * row + 1], y, rotation[3 * row + 2] * z));
      mean.keep(row, fma(k, turned, center[row]));
      scale.keep(row, k * scale[row]);
    }
    const Real a = turn[0], b = turn[1], c = turn[2], d = turn[3];
    const Real w = quat[0], i = quat[1], j = quat[2], l = quat[3];
    quat.keep(0, a * w - b * i - c * j - d * l);
    quat.keep(1, b * w + a * i - d * j + c * l);
    quat.keep(2, c * w + d * i + a * j - b * l);
    quat.keep(3, d * w - c * i + b * j + a * l);
    for (int lane = 0; lane < used; ++lane) {
      mean.put(in.world_means + 3 * (first + lane), lane);
      quat.put(in.world_quats + 4 * (first + lane), lane);
      scale.put(in.world_scales + 3 * (first + lane), lane);
    }
  }
}

}  // namespace headbench::HEADBENCH_ISA

// The offset network, few splats at a time. Most units of a trained network's first layer are off at any one splat, and
// neighbours share them: a group's second layer takes only the units that are on at one of its splats. What is left
// out is exactly 0, so that nothing changes but the time.
#pragma once

#include "avatar.h"
#include "layers.h"

namespace headbench::HEADBENCH_ISA {

// Floats: first layer, second layer, values of the units that are on, their largest, their numbers.
inline std::size_t offset_scratch(int units, int hidden) {
  return static_cast<std::size_t>(kSplatGroup) * (2 * units + hidden) + 2 * static_cast<std::size_t>(units) + 1;
}

// First layer of a splat after its ReLU.
HEADBENCH_INLINE void first_layer(const OffsetNetwork& net, std::int64_t splat, float* out) {
  const float* lower[3];
  Real upper_weight[3], lower_weight[3];
  for (int axis = 0; axis < 3; ++axis) {
    lower[axis] = net.table + static_cast<std::size_t>(net.rows[3 * splat + axis]) * net.units;
    upper_weight[axis] = net.fractions[3 * splat + axis];
    lower_weight[axis] = Real(1.0f) - upper_weight[axis];
  }
  for (int unit = 0; unit < net.units; unit += W) {
    Real sum = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
      sum = fma(load(lower[axis] + unit), lower_weight[axis], sum);
      sum = fma(load(lower[axis] + net.units + unit), upper_weight[axis], sum);
    }
    store(out + unit, max(sum, 0.0f));
  }
}

// Offsets of entries [begin, end); `scratch` has offset_scratch floats.
inline void offset_network(const OffsetNetwork& net, std::int64_t begin, std::int64_t end, float* scratch) {
  float* first = scratch;
  float* second = first + kSplatGroup * net.units;
  float* on = second + kSplatGroup * net.hidden;
  float* largest = on + kSplatGroup * net.units;
  std::int32_t* units = reinterpret_cast<std::int32_t*>(largest + net.units);
  for (std::int64_t start = begin; start < end; start += kSplatGroup) {
    const int used = end - start < kSplatGroup ? static_cast<int>(end - start) : kSplatGroup;
    for (int s = 0; s < kSplatGroup; ++s) first_layer(net, start + (s < used ? s : 0), first + s * net.units);
    for (int unit = 0; unit < net.units; unit += W) {
      Real most = load(first + unit);
      for (int s = 1; s < kSplatGroup; ++s) most = max(most, load(first + s * net.units + unit));
      store(largest + unit, most);
    }
    int count = 0;
    for (int unit = 0; unit < net.units; ++unit) {
      units[count] = unit;
      count += largest[unit] > 0.0f;
    }
    for (int i = 0; i < count; ++i)
      for (int s = 0; s < kSplatGroup; ++s) on[i * kSplatGroup + s] = first[s * net.units + units[i]];
    const float* starts[kSplatGroup];
    for (int s = 0; s < kSplatGroup; ++s) starts[s] = net.second_bias;
    dense_layer(starts, net.second, net.hidden, on, kSplatGroup, units, count, second);
    for (int output = 0; output < net.outputs; ++output) {
      float sums[kSplatGroup];
      dots(second, net.last + static_cast<std::size_t>(output) * net.hidden, net.hidden, sums);
      for (int s = 0; s < used; ++s)
        net.offsets[net.splats[start + s] * net.outputs + output] = sums[s] + net.last_bias[output];
    }
  }
}

}  // namespace headbench::HEADBENCH_ISA

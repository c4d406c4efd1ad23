// Rows of a few numbers as vectors of one number each, and back.
#pragma once

#include "projection.h"

namespace headbench::HEADBENCH_ISA {

// Numbers of W rows side by side, component by component. Lanes beyond the last row hold a copy of the first.
template <int components>
struct Gathered {
  alignas(64) float values[components][W];

  HEADBENCH_INLINE void set(const float* row, int lane) {
    for (int k = 0; k < components; ++k) values[k][lane] = row[k];
  }
  HEADBENCH_INLINE void put(float* row, int lane) const {
    for (int k = 0; k < components; ++k) row[k] = values[k][lane];
  }
  HEADBENCH_INLINE Real operator[](int k) const { return load(values[k]); }
  HEADBENCH_INLINE void keep(int k, Real value) { store(values[k], value); }
};

HEADBENCH_INLINE int lanes_used(std::int64_t first, std::int64_t end) {
  return end - first < W ? static_cast<int>(end - first) : W;
}

}  // namespace headbench::HEADBENCH_ISA

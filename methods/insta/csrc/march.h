// Samples of many rays.
#pragma once

#include <cstdint>
#include <vector>

#include "marcher.h"

namespace headbench::insta {

struct Rays {
  std::int64_t count;
  const float *origins, *directions;  // (R, 3), directions of unit length
  const std::int32_t* first;          // (R,) lattice index to start at
  const float* jitter;                // (R,) in [0, 1)
  std::int32_t samples_max;
};

struct Samples {
  std::vector<float> positions, directions;  // (N, 3) canonical; directions of unit length
  std::vector<float> distances;                // (N,) metres from the surface, posed
  std::vector<std::int32_t> rays, indices, triangles;
  std::vector<std::int32_t> next;  // (R,) lattice index to continue at; -1 where nothing is left
};

// The next samples of every ray, at most `samples_max` of each.
Samples march(const Marcher& marcher, const Rays& rays, int threads);

}  // namespace headbench::insta

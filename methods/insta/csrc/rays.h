// Samples of many rays, and rays through the field without gradients: marched, evaluated and composited task by task.
#pragma once

#include <cstdint>
#include <vector>

#include "bench/native/instruction_sets.h"
#include "field.h"
#include "marcher.h"

namespace headbench {

HEADBENCH_VARIANTS(insta::Kernels, kernels)

}  // namespace headbench

namespace headbench::insta {

struct Rays {
  std::int64_t count;
  const float *origins, *directions;  // (R, 3), directions of unit length
  const float* jitter;                // (R,) in [0, 1)
};

struct Samples {
  std::vector<float> positions, directions;  // (N, 3) canonical; directions of unit length
  std::vector<float> distances;                // (N,) metres from the surface, posed
  std::vector<std::int32_t> rays, indices, triangles;
  std::vector<std::int32_t> next;  // (R,) lattice index to continue at; -1 where nothing is left
};

// The next samples of every ray from its lattice index `first` (R,) on, at most `samples_max` of each.
Samples march(const Marcher& marcher, const Rays& rays, const std::int32_t* first, std::int32_t samples_max, int threads);

struct Rounds {
  std::int32_t samples;  // of a ray between two looks at its transmittance
  float stop_transmittance;
};

struct Seen {
  float* color;          // (R, 3) not yet composited on anything
  float* transmittance;  // (R,)
};

// `starts` is that of `Kernels`, `mouth` (F,) says where its second row counts. Returns the number of samples.
std::int64_t render(const Marcher& marcher, const Kernels& kernels, const Field& field, const float* starts,
                    const std::uint8_t* mouth, float step, const Rays& all, const Rounds& rounds, const Seen& seen,
                    int threads);

}  // namespace headbench::insta

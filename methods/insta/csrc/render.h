// Rays through the field without gradients: marched, evaluated and composited task by task.
#pragma once

#include <cstdint>
#include <vector>

#include "instruction_sets.h"
#include "marcher.h"

namespace headbench::insta {

struct View {
  std::int64_t count;
  const float *origins, *directions, *jitter;  // (R, 3), (R, 3), (R,)
  std::int32_t round_samples;                  // of a ray between two looks at its transmittance
  float stop_transmittance;
};

struct Seen {
  float* color;          // (R, 3) not yet composited on anything
  float* transmittance;  // (R,)
};

// `starts` is that of `InstructionSet`, `mouth` (F,) says where its second row counts. Returns the number of samples.
std::int64_t render(const Marcher& marcher, const InstructionSet& set, const Field& field, const float* starts,
                    const std::uint8_t* mouth, float step, const View& view, const Seen& seen, int threads);

}  // namespace headbench::insta

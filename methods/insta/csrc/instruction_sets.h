// What is compiled once per instruction set.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "field.h"
#include "search.h"

namespace headbench::insta {

struct InstructionSet {
  const char* name;
  Nearest nearest;
  std::size_t (*scratch)(const Field& field);  // floats
  // Values of `count` samples at steps of `step` metres. `starts` is (2, outputs of the first layer): what the
  // conditions add to that layer's sums outside the mouth and at it.
  void (*evaluate)(const Field& field, const float* starts, float step, const Points& points, std::int64_t count,
                   const Values& values, float* scratch);
};

// Those that this machine can run, the fastest first.
const std::vector<const InstructionSet*>& instruction_sets();

}  // namespace headbench::insta

// The stages of this instruction set as a table. Included once per instruction set, after its simd header.
#pragma once

#include "backward.h"
#include "binning.h"
#include "carry.h"
#include "color_network.h"
#include "forward.h"
#include "harmonics.h"
#include "measure.h"
#include "offset_network.h"
#include "projection_backward.h"
#include "triangles.h"

namespace headbench::HEADBENCH_ISA {

inline std::size_t scratch_floats(int channels) {
  const std::size_t forward = forward_scratch(channels), backward = backward_scratch(channels);
  return forward > backward ? forward : backward;
}

extern const Stages stages;
const Stages stages = {HEADBENCH_ISA_NAME, W,          project,      find_entries,     scratch_floats,
                       draw_tile,          draw_tile_backward, project_backward, count_work,
                       multiply_add,       kChains,    triangles,    carry,        shade,
                       color_scratch,      color_network, offset_scratch,   offset_network};

}  // namespace headbench::HEADBENCH_ISA

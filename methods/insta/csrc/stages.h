// The table of this instruction set. Included once per instruction set, after its simd header.
#pragma once

#include "evaluate.h"
#include "instruction_sets.h"
#include "nearest.h"

namespace headbench::HEADBENCH_ISA {

extern const insta::InstructionSet instruction_set;
const insta::InstructionSet instruction_set = {HEADBENCH_ISA_NAME, nearest, scratch, evaluate};

}  // namespace headbench::HEADBENCH_ISA

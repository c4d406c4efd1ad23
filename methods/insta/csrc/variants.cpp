// The search for triangles and the field's evaluation for one instruction set; compiled once for each.
#include "bench/native/simd.h"

#include "evaluate.h"
#include "nearest.h"

namespace headbench::HEADBENCH_ISA {

extern const insta::Kernels kernels;
const insta::Kernels kernels = {HEADBENCH_ISA_NAME, nearest, encode, scratch, evaluate};

}  // namespace headbench::HEADBENCH_ISA

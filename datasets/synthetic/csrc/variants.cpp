// Rays and light for one instruction set; compiled once for each.
#include "shade.h"

namespace headbench::HEADBENCH_ISA {

extern const light::Kernels light_kernels;
const light::Kernels light_kernels = {HEADBENCH_ISA_NAME, see, direct, bounce, shade};

}  // namespace headbench::HEADBENCH_ISA

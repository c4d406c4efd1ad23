#define HEADBENCH_ISA neon
#define HEADBENCH_ISA_NAME "neon"
#include "../../splats/csrc/simd_neon.h"
// The vectors come first: what is included next is written in them.
#include "stages.h"

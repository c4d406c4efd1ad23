#define HEADBENCH_ISA avx2
#define HEADBENCH_ISA_NAME "avx2"
#include "../../splats/csrc/simd_avx2.h"
// The vectors come first: what is included next is written in them.
#include "stages.h"

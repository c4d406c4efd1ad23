#define HEADBENCH_ISA avx512
#define HEADBENCH_ISA_NAME "avx512"
#include "../../splats/csrc/simd_avx512.h"
// The vectors come first: what is included next is written in them.
#include "stages.h"

#define HEADBENCH_ISA avx512
#define HEADBENCH_ISA_NAME "avx512"
#include "simd_avx512.h"
// The vectors come first: the stages are written in them.
#include "stages.h"

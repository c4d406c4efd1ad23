#define HEADBENCH_ISA avx512
#define HEADBENCH_ISA_NAME "avx512"
#include "simd_avx512.h"
// The instruction set comes first: the stages are written in its vectors.
#include "stages.h"

#define HEADBENCH_ISA avx2
#define HEADBENCH_ISA_NAME "avx2"
#include "simd_avx2.h"
// The instruction set comes first: the stages are written in its vectors.
#include "stages.h"

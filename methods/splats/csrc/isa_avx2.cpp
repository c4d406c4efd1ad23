#define HEADBENCH_ISA avx2
#define HEADBENCH_ISA_NAME "avx2"
#include "simd_avx2.h"
// The vectors come first: the stages are written in them.
#include "stages.h"

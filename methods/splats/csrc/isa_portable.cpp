#define HEADBENCH_ISA portable
#define HEADBENCH_ISA_NAME "portable"
#include "simd_portable.h"
// The instruction set comes first: the stages are written in its vectors.
#include "stages.h"

#define HEADBENCH_ISA neon
#define HEADBENCH_ISA_NAME "neon"
#include "simd_neon.h"
// The vectors come first: the stages are written in them.
#include "stages.h"

#define HEADBENCH_ISA portable
#define HEADBENCH_ISA_NAME "portable"
#if defined(__GNUC__) && !defined(HEADBENCH_PLAIN)
#include "simd_vector4.h"
#else
#include "simd_plain.h"
#endif
// The vectors come first: the stages are written in them.
#include "stages.h"

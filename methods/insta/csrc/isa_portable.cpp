#define HEADBENCH_ISA portable
#define HEADBENCH_ISA_NAME "portable"
#if defined(__GNUC__) && !defined(HEADBENCH_PLAIN)
#include "../../splats/csrc/simd_vector4.h"
#else
#include "../../splats/csrc/simd_plain.h"
#endif
// The vectors come first: what is included next is written in them.
#include "stages.h"

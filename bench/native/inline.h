// Macros of code that is compiled once per instruction set, see simd.h.
#pragma once

// Vector values must stay in registers: small functions on them are inlined whatever the compiler's estimate says.
#define HEADBENCH_INLINE inline __attribute__((always_inline))
// Ask for a cache line that will be read soon.
#define HEADBENCH_PREFETCH(address) __builtin_prefetch(address)

// The name of the instruction set that is compiled for, as a string.
#define HEADBENCH_STRING(name) #name
#define HEADBENCH_STRING_OF(name) HEADBENCH_STRING(name)
#define HEADBENCH_ISA_NAME HEADBENCH_STRING_OF(HEADBENCH_ISA)

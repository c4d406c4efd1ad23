// Vector values must stay in registers: small functions on them are inlined whatever the compiler's estimate says.
#pragma once

#if defined(__GNUC__) || defined(__clang__)
#define HEADBENCH_INLINE inline __attribute__((always_inline))
#elif defined(_MSC_VER)
#define HEADBENCH_INLINE __forceinline
#else
#define HEADBENCH_INLINE inline
#endif

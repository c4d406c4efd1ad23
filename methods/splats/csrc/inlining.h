// Vector values must stay in registers: small functions on them are inlined whatever the compiler's estimate says.
#pragma once

#if defined(__GNUC__) || defined(__clang__)
#define HEADBENCH_INLINE inline __attribute__((always_inline))
#elif defined(_MSC_VER)
#define HEADBENCH_INLINE __forceinline
#else
#define HEADBENCH_INLINE inline
#endif

// Ask for a cache line that will be read, or written, soon. Macros, so that no compiled copy can be shared between
// instruction sets.
#if defined(__GNUC__) || defined(__clang__)
#define HEADBENCH_PREFETCH(address) __builtin_prefetch(address)
#define HEADBENCH_PREFETCH_WRITE(address) __builtin_prefetch(address, 1)
#else
#define HEADBENCH_PREFETCH(address) static_cast<void>(address)
#define HEADBENCH_PREFETCH_WRITE(address) static_cast<void>(address)
#endif

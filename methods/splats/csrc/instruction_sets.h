// The variants of the stages this machine can run.
#pragma once

#include <vector>

#include "scene.h"

namespace headbench {

namespace portable {
extern const Stages stages;
}

#ifdef HEADBENCH_NEON
namespace neon {
extern const Stages stages;
}
#endif

#ifdef HEADBENCH_X86
namespace avx2 {
extern const Stages stages;
}
namespace avx512 {
extern const Stages stages;
}
#endif

// Fastest first; the portable one is always there.
inline std::vector<const Stages*> runnable_stages() {
  std::vector<const Stages*> found;
#ifdef HEADBENCH_X86
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl"))
    found.push_back(&avx512::stages);
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) found.push_back(&avx2::stages);
#endif
#ifdef HEADBENCH_NEON
  found.push_back(&neon::stages);  // part of every 64-bit ARM processor
#endif
  found.push_back(&portable::stages);
  return found;
}

}  // namespace headbench

// The variants of the stages this machine can run.
#pragma once

#include <vector>

#include "processor.h"
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
  if (runs_avx512()) found.push_back(&avx512::stages);
  if (runs_avx2()) found.push_back(&avx2::stages);
#endif
#ifdef HEADBENCH_NEON
  found.push_back(&neon::stages);  // part of every 64-bit ARM processor
#endif
  found.push_back(&portable::stages);
  return found;
}

}  // namespace headbench

#include "../../splats/csrc/processor.h"
#include "instruction_sets.h"

namespace headbench {

namespace portable {
extern const insta::InstructionSet instruction_set;
}

#ifdef HEADBENCH_NEON
namespace neon {
extern const insta::InstructionSet instruction_set;
}
#endif

#ifdef HEADBENCH_X86
namespace avx2 {
extern const insta::InstructionSet instruction_set;
}
namespace avx512 {
extern const insta::InstructionSet instruction_set;
}
#endif

namespace insta {

namespace {

std::vector<const InstructionSet*> runnable() {
  std::vector<const InstructionSet*> found;
#ifdef HEADBENCH_X86
  if (runs_avx512()) found.push_back(&avx512::instruction_set);
  if (runs_avx2()) found.push_back(&avx2::instruction_set);
#endif
#ifdef HEADBENCH_NEON
  found.push_back(&neon::instruction_set);  // part of every 64-bit ARM processor
#endif
  found.push_back(&portable::instruction_set);
  return found;
}

}  // namespace

const std::vector<const InstructionSet*>& instruction_sets() {
  static const std::vector<const InstructionSet*> found = runnable();
  return found;
}

}  // namespace insta
}  // namespace headbench

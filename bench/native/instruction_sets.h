// Variants of a kernel for several instruction sets, and the choice among them when it is run.
//
// kernel.cmake compiles one source file of a kernel several times, each time with HEADBENCH_ISA defined as the name of an
// instruction set and the namespace of what is compiled. The file defines a table of functions,
//   namespace headbench::HEADBENCH_ISA { extern const Table table; const Table table = {HEADBENCH_ISA_NAME, ...}; }
// and `HEADBENCH_VARIANTS(Table, table)` in namespace headbench declares the tables of all of them and the function
// `runnable_table()`: those that this machine can run, the fastest first. A table's first member is `const char* name`.
#pragma once

#include <initializer_list>
#include <stdexcept>
#include <string>
#include <vector>

#define HEADBENCH_DECLARE_SET(Table, table, set) \
  namespace set {                                \
  extern const Table table;                      \
  }
#if defined(HEADBENCH_AVX512)
#define HEADBENCH_DECLARE(Table, table) \
  HEADBENCH_DECLARE_SET(Table, table, avx512) HEADBENCH_DECLARE_SET(Table, table, avx2)
#define HEADBENCH_RUNNABLE(table) runs_avx512() ? &avx512::table : nullptr, runs_avx2() ? &avx2::table : nullptr
#elif defined(HEADBENCH_X86)
#define HEADBENCH_DECLARE(Table, table) HEADBENCH_DECLARE_SET(Table, table, avx2)
#define HEADBENCH_RUNNABLE(table) runs_avx2() ? &avx2::table : nullptr
#elif defined(HEADBENCH_NEON)
#define HEADBENCH_DECLARE(Table, table) HEADBENCH_DECLARE_SET(Table, table, neon)
#define HEADBENCH_RUNNABLE(table) &neon::table  // part of every 64-bit ARM processor
#else
#define HEADBENCH_DECLARE(Table, table)
#define HEADBENCH_RUNNABLE(table) nullptr
#endif

#define HEADBENCH_VARIANTS(Table, table)                                             \
  HEADBENCH_DECLARE(Table, table)                                                    \
  HEADBENCH_DECLARE_SET(Table, table, portable)                                      \
  inline std::vector<const Table*> runnable_##table() {                              \
    std::vector<const Table*> found;                                                 \
    using Tables = std::initializer_list<const Table*>;                              \
    for (const Table* each : Tables{HEADBENCH_RUNNABLE(table), &portable::table})    \
      if (each) found.push_back(each);                                               \
    return found;                                                                    \
  }

namespace headbench {

#if defined(HEADBENCH_X86)
inline bool runs_avx512() {
  __builtin_cpu_init();
  return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
         __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
}

inline bool runs_avx2() {
  __builtin_cpu_init();
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
}
#endif

template <class Table>
const Table& variant_of(const std::vector<const Table*>& variants, const std::string& name) {
  for (const Table* variant : variants)
    if (name == variant->name) return *variant;
  throw std::invalid_argument("instruction set " + name + " is not available here");
}

template <class Table>
std::vector<std::string> names_of(const std::vector<const Table*>& variants) {
  std::vector<std::string> names;
  for (const Table* variant : variants) names.emplace_back(variant->name);
  return names;
}

}  // namespace headbench

// How functions of the Python module run a kernel.
#pragma once

#include <string>

#include "bench/native/arguments.h"
#include "frame.h"

namespace headbench {

inline const Kernels& kernels_of(const std::string& instruction_set) {
  return variant_of(runnable_kernels(), instruction_set);
}

// Run a kernel for `count` triangles or splats, no two of which write to one place, without the interpreter's lock.
template <class In>
void run(void (*kernel)(const In&, std::int64_t, std::int64_t), const In& in, std::int64_t count, int threads) {
  const nanobind::gil_scoped_release unlocked;
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernel(in, begin, end); });
}

}  // namespace headbench

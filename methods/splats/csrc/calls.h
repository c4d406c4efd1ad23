// How functions of the Python module run a kernel.
#pragma once

#include <string>
#include <vector>

#include "bench/native/arguments.h"
#include "frame.h"

namespace headbench {

inline const Kernels& kernels_of(const std::string& instruction_set) {
  return variant_of(runnable_kernels(), instruction_set);
}

// Items by a key: those of key k are order[starts[k]] to order[starts[k + 1] - 1], in ascending order.
struct Groups {
  std::vector<std::uint32_t> starts, order;
};

template <class KeyOf>
Groups group_by_key(std::int64_t count, std::int64_t keys, const KeyOf& key_of) {
  Groups groups{std::vector<std::uint32_t>(keys + 1, 0), std::vector<std::uint32_t>(count)};
  for (std::int64_t item = 0; item < count; ++item) ++groups.starts[key_of(item) + 1];
  for (std::int64_t key = 0; key < keys; ++key) groups.starts[key + 1] += groups.starts[key];
  std::vector<std::uint32_t> next(groups.starts.begin(), groups.starts.end() - 1);
  for (std::int64_t item = 0; item < count; ++item) groups.order[next[key_of(item)]++] = static_cast<std::uint32_t>(item);
  return groups;
}

// Run a kernel for `count` triangles or splats, no two of which write to one place, without the interpreter's lock.
template <class In>
void run(void (*kernel)(const In&, std::int64_t, std::int64_t), const In& in, std::int64_t count, int threads) {
  const nanobind::gil_scoped_release unlocked;
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernel(in, begin, end); });
}

}  // namespace headbench

// Triangles, splats and rows dealt out to threads, no two of which write to one place.
#pragma once

#include <algorithm>

#include "bench/native/module.h"
#include "bench/native/thread_pool.h"
#include "frame.h"

namespace headbench {

constexpr std::int64_t kPerTask = 1024;

template <class T>
bool below(const T* values, std::size_t count, std::size_t limit) {
  bool all = true;
  for (std::size_t i = 0; i < count; ++i) all &= values[i] >= 0 && static_cast<std::size_t>(values[i]) < limit;
  return all;
}

template <class Body>
void share_out(std::size_t count, int threads, const Body& body) {
  const std::int64_t all = static_cast<std::int64_t>(count);
  ThreadPool::instance().run((all + kPerTask - 1) / kPerTask, std::max(threads, 1),
                             [&](std::int64_t task, int worker) {
                               const std::int64_t begin = task * kPerTask;
                               body(begin, std::min(begin + kPerTask, all), worker);
                             });
}

// Memory of each worker's own.
class Scratch {
 public:
  Scratch(std::size_t floats, int threads) : stride_((floats + 15) / 16 * 16) {
    memory_.resize(stride_ * static_cast<std::size_t>(std::max(threads, 1)));
  }
  float* of(int worker) const { return memory_.data() + stride_ * static_cast<std::size_t>(worker); }

 private:
  std::size_t stride_;
  Buffer<float> memory_;
};

}  // namespace headbench

// Parallel loops, sums and memory of the kernels. Chunks do not depend on the number of threads, and every sum has a fixed
// order: results are equal bit for bit for any number of threads, as long as no two chunks write to one place.
#pragma once

#include <algorithm>
#include <cstdint>
#include <type_traits>

#include "thread_pool.h"
#include "workspace.h"

namespace headbench {

inline std::int64_t divided_up(std::int64_t value, std::int64_t by) { return (value + by - 1) / by; }
inline std::int64_t rounded_up(std::int64_t value, std::int64_t step) { return divided_up(value, step) * step; }

// Call body(begin, end) or body(begin, end, worker) for each chunk of `count` items, worker below `threads`, and wait. As
// for `ThreadPool::run`, `body` must not throw.
template <class Body>
void parallel_for(std::int64_t count, std::int64_t chunk, int threads, const Body& body) {
  ThreadPool::instance().run(divided_up(count, chunk), threads, [&](std::int64_t task, int worker) {
    const std::int64_t begin = task * chunk, end = std::min(begin + chunk, count);
    if constexpr (std::is_invocable_v<Body, std::int64_t, std::int64_t, int>)
      body(begin, end, worker);
    else
      body(begin, end);
  });
}

// Call body(begin, end, part, worker) for each chunk, which adds to `part`, `size` zeros at first. Parts are added in the
// order of their chunks; the sums are the first `size` numbers of `sums`.
template <class T, class Body>
void parallel_sum(std::int64_t count, std::int64_t chunk, std::int64_t size, int threads, Buffer<T>& sums, const Body& body) {
  constexpr std::int64_t kSumsPerTask = 8192, kLine = 64 / sizeof(T);
  const std::int64_t chunks = std::max<std::int64_t>(divided_up(count, chunk), 1), stride = rounded_up(size, kLine);
  sums.resize(stride * chunks);
  std::fill_n(sums.data(), size, T{0});
  parallel_for(count, chunk, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
    T* part = sums.data() + begin / chunk * stride;
    std::fill_n(part, size, T{0});
    body(begin, end, part, worker);
  });
  parallel_for(size, kSumsPerTask, threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t other = 1; other < chunks; ++other) {
      const T* part = sums.data() + other * stride;
      for (std::int64_t i = begin; i < end; ++i) sums.data()[i] += part[i];
    }
  });
}

// Uninitialised floats of each worker's own, on cache-line boundaries.
class Scratch {
 public:
  Scratch(std::size_t floats, int threads) : stride_(rounded_up(floats, 16)), memory_(stride_ * std::max(threads, 1)) {}
  float* of(int worker) const { return memory_.data() + stride_ * static_cast<std::size_t>(worker); }

 private:
  std::size_t stride_;
  Buffer<float> memory_;
};

}  // namespace headbench

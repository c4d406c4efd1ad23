// Memory of kernels, kept from one call to the next: getting megabytes again from the system costs a page fault for
// every four kilobytes.
#pragma once

#include <cstddef>

namespace headbench::workspace {

// The most that is kept for later, in bytes, over all threads; blocks beyond it go back to the system.
constexpr std::size_t kKeptMax = std::size_t{256} << 20;

// At least `bytes` of uninitialised memory on a cache-line boundary. Throws std::bad_alloc.
void* take(std::size_t bytes);

// Give back what `take(bytes)` gave.
void give(void* block, std::size_t bytes);

}  // namespace headbench::workspace

namespace headbench {

// Uninitialised memory on cache-line boundaries.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(std::size_t count) { resize(count); }
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { release(); }

  T* resize(std::size_t count) {
    release();
    data_ = static_cast<T*>(workspace::take(count * sizeof(T)));
    bytes_ = count * sizeof(T);
    return data_;
  }
  void release() {
    workspace::give(data_, bytes_);
    data_ = nullptr;
  }
  T* data() const { return data_; }

 private:
  T* data_ = nullptr;
  std::size_t bytes_ = 0;
};

}  // namespace headbench

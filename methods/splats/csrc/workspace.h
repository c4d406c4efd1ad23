// Memory for frames, kept from one frame to the next: getting megabytes anew from the system costs a page fault for
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

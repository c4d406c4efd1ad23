#include "workspace.h"

#include <array>
#include <mutex>
#include <new>
#include <vector>

namespace headbench::workspace {

namespace {

constexpr std::align_val_t kAlignment{64};
constexpr std::size_t kSmallest = 4096;  // below that the system's allocator is fast enough
constexpr int kClasses = 4 * 52;         // four sizes to an octave

// The size class of a request, and the bytes of every block in it: at most a quarter more than was asked for.
int size_class(std::size_t bytes, std::size_t& rounded) {
  int octave = 0;
  while ((kSmallest << (octave + 1)) < bytes) ++octave;
  const std::size_t base = kSmallest << octave, step = base / 4;
  const std::size_t steps = bytes > base ? (bytes - base + step - 1) / step : 0;
  rounded = base + steps * step;
  return 4 * octave + static_cast<int>(steps);
}

struct Kept {
  std::mutex mutex;
  std::array<std::vector<void*>, kClasses + 1> blocks;
  std::size_t bytes = 0;
};

// Never destroyed: frames may outlive everything else of the process.
Kept& kept() {
  static Kept* instance = new Kept;
  return *instance;
}

}  // namespace

void* take(std::size_t bytes) {
  if (bytes < kSmallest) return ::operator new(bytes ? bytes : 1, kAlignment);
  std::size_t rounded;
  const int index = size_class(bytes, rounded);
  {
    // Never waiting: in a forked child the lock may be held by a thread that is not there.
    Kept& store = kept();
    std::unique_lock<std::mutex> lock(store.mutex, std::try_to_lock);
    if (lock && !store.blocks[index].empty()) {
      void* block = store.blocks[index].back();
      store.blocks[index].pop_back();
      store.bytes -= rounded;
      return block;
    }
  }
  return ::operator new(rounded, kAlignment);
}

void give(void* block, std::size_t bytes) {
  if (!block) return;
  if (bytes >= kSmallest) {
    std::size_t rounded;
    const int index = size_class(bytes, rounded);
    Kept& store = kept();
    std::unique_lock<std::mutex> lock(store.mutex, std::try_to_lock);
    if (lock && store.bytes + rounded <= kKeptMax) {
      try {
        store.blocks[index].push_back(block);
        store.bytes += rounded;
        return;
      } catch (const std::bad_alloc&) {
        // No memory to remember it: release it.
      }
    }
  }
  ::operator delete(block, kAlignment);
}

}  // namespace headbench::workspace

// One rendered frame: drives the stages, and keeps what the backward pass needs.
//
//   forward   project (splats) -> sort by depth -> find pairs (splats) -> fill tiles -> draw (tiles)
//   backward  draw backward (tiles), a record for every pair -> gather and project backward (splats)
//
// What stands in parentheses is dealt out to threads. No two threads write to one place, and every sum has a fixed
// order, so that results are equal bit for bit for any number of threads.
#pragma once

#include <array>
#include <cstddef>
#include <new>

#include "scene.h"

namespace headbench {

// Uninitialised memory on cache-line boundaries.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { release(); }

  T* resize(std::size_t count) {
    release();
    data_ = static_cast<T*>(::operator new(count ? count * sizeof(T) : 1, std::align_val_t{64}));
    return data_;
  }
  void release() {
    ::operator delete(data_, std::align_val_t{64});
    data_ = nullptr;
  }
  T* data() const { return data_; }

 private:
  T* data_ = nullptr;
};

// The stages of a frame that are timed.
enum Stage { kProject, kSort, kFindPairs, kDraw, kDrawBackward, kProjectBackward, kStageCount };
constexpr const char* kStageNames[kStageCount] = {"project", "sort",          "find pairs",
                                                  "draw",    "draw backward", "project backward"};

class Frame {
 public:
  // Draws at once. Throws std::length_error where splats touch more tiles than 32 bits can count.
  Frame(const View& view, const Splats& splats, const ImageOut& out, std::int32_t* radii, const Stages& stages,
        int threads);

  // `splats` must hold the same values as when drawn. Adds to the splats' gradients in `grads`, so that views can be
  // summed; overwrites `background` (C,) and `view_gradient` (kViewGradient,).
  void backward(const Splats& splats, Gradients grads, float* background, float* view_gradient, int threads);

  // Processor time of the calling thread by stage, of the last pass each; with one thread that is all there was.
  const std::array<double, kStageCount>& stage_seconds() const { return seconds_; }

  // Count the work of drawing; `splats` as for `backward`.
  Work work(const Splats& splats) const;

  // Whether these inputs can be the ones drawn: arrays of the same sizes.
  bool fits(const Splats& splats) const {
    return splats.count == count_ && splats.channels == channels_ && (splats.offset != nullptr) == has_offset_;
  }
  bool fits(std::size_t width, std::size_t height) const {
    return width == static_cast<std::size_t>(view_.width) && height == static_cast<std::size_t>(view_.height);
  }

 private:
  void list_visible(std::int64_t count);
  void sort_by_depth();
  void reserve_entries();
  void fill_tiles(int threads);

  const View view_;
  const Stages& stages_;
  const std::int64_t count_;
  const int channels_;
  const bool has_offset_;
  FrameData data_{};
  std::int64_t visible_count_ = 0;
  Buffer<float> records_, depths_, transmittances_, last_;
  Buffer<Rect> rects_;
  Buffer<std::uint32_t> entry_begin_, entry_count_, visible_, order_, tile_begin_, entry_tiles_;
  Buffer<std::uint64_t> entry_blocks_;
  Buffer<Pair> pairs_;
  std::size_t entries_ = 0;
  std::array<double, kStageCount> seconds_{};
};

// Processor time of the calling thread, seconds; wall time where the system does not tell.
double thread_seconds();

}  // namespace headbench

// One rendered frame: calls the kernels, and keeps what the backward pass needs.
//
//   forward   project (splats) -> sort by depth -> find pairs (splats) -> draw (tiles)
//   backward  draw backward (tiles), a record for every pair -> gather and project backward (splats)
//
// Memory, with N splats, C <= 8 channels, P pairs, R >= P tiles in the splats' bounding rectangles: 96 N + 16 P + 20 R +
// 8 pixels bytes while drawing, of which 76 N + 16 P + 4 R + 8 pixels are kept for the backward pass, and 64 P more during
// that pass alone. Up to workspace::kKeptMax of it is kept for the frames to come.
//
// What stands in parentheses is dealt out to threads. No two threads write to one place, and every sum has a fixed
// order, so that results are equal bit for bit for any number of threads.
#pragma once

#include <array>

#include "bench/native/instruction_sets.h"
#include "bench/native/parallel.h"
#include "scene.h"

namespace headbench {

// The stages of a frame that are timed.
enum Stage { kProject, kSort, kFindPairs, kDraw, kDrawBackward, kProjectBackward, kStageCount };
constexpr const char* kStageNames[kStageCount] = {"project", "sort",          "find pairs",
                                                  "draw",    "draw backward", "project backward"};

HEADBENCH_VARIANTS(Kernels, kernels)

constexpr std::int64_t kPerTask = 1024;  // splats or triangles that a thread takes at a time

class Frame {
 public:
  // Draws at once. Throws std::length_error where splats touch more tiles than 32 bits can count.
  Frame(const Camera& view, const Splats& splats, const ImageOut& out, std::int32_t* radii, const Kernels& kernels,
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
  void list_drawn(std::int64_t count);
  void sort_by_depth();
  void reserve_entries();
  void fill_tiles(const Splats& splats, int threads);
  EntryRange fetch_entries(const std::uint32_t* order, std::int64_t i, std::int64_t end) const;

  const Camera view_;
  const Kernels& kernels_;
  const std::int64_t count_;
  const int channels_;
  const bool has_offset_;
  FrameData data_{};
  std::int64_t drawn_count_ = 0;
  Buffer<float> records_, transmittances_, last_;
  Buffer<double> depths_;
  Buffer<Rect> rects_;
  Buffer<EntryRange> ranges_;
  Buffer<Entry> entries_;
  Buffer<std::uint32_t> drawn_, order_, tile_begin_, places_;
  Buffer<Pair> pairs_;
  std::size_t entry_count_ = 0;
  std::array<double, kStageCount> seconds_{};
};

// Processor time of the calling thread, seconds; wall time where the system has no such clock.
double thread_seconds();

}  // namespace headbench

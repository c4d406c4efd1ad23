#include "frame.h"

#include <time.h>

#include <algorithm>
#include <chrono>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <utility>
#include <vector>

#include "bench/native/simd.h"

namespace headbench {

namespace {

// Gives each stage the time since the one before it ended.
class StageClock {
 public:
  explicit StageClock(std::array<double, kStageCount>& seconds) : seconds_(seconds), then_(thread_seconds()) {}
  void ends(Stage stage) {
    const double now = thread_seconds();
    seconds_[stage] = now - then_;
    then_ = now;
  }

 private:
  std::array<double, kStageCount>& seconds_;
  double then_;
};

}  // namespace

double thread_seconds() {
#ifdef CLOCK_THREAD_CPUTIME_ID
  timespec now;
  if (clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now) == 0)
    return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
#endif
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

Frame::Frame(const Camera& view, const Splats& splats, const ImageOut& out, std::int32_t* radii,
             const Kernels& kernels, int threads)
    : view_(view),
      kernels_(kernels),
      count_(splats.count),
      channels_(splats.channels),
      has_offset_(splats.offset != nullptr) {
  StageClock clock(seconds_);
  const std::size_t count = static_cast<std::size_t>(splats.count);
  const std::size_t tiles = static_cast<std::size_t>(view.tiles_x) * view.tiles_y;
  data_.records = records_.resize(count * rounded_up(kGeometry + splats.channels, kRecordUnit));
  data_.depths = depths_.resize(count);
  data_.radii = radii;
  data_.rects = rects_.resize(count);
  data_.ranges = ranges_.resize(count);
  data_.transmittances = transmittances_.resize(tiles * kTilePixels);
  data_.last = last_.resize(tiles * kTilePixels);

  parallel_for(splats.count, kPerTask, threads,
               [&](std::int64_t begin, std::int64_t end) { kernels.project(view_, splats, data_, begin, end); });
  clock.ends(kProject);
  list_drawn(splats.count);
  sort_by_depth();
  clock.ends(kSort);
  reserve_entries();
  fill_tiles(splats, threads);
  clock.ends(kFindPairs);

  const Scratch scratch(kernels.scratch_floats(splats.channels), threads);
  parallel_for(tiles, 1, threads, [&](std::int64_t tile, std::int64_t, int worker) {
    kernels.draw_tile(view_, splats, data_, out, static_cast<int>(tile), scratch.of(worker));
  });
  clock.ends(kDraw);
  // Of these the backward pass needs nothing.
  depths_.release();
  rects_.release();
  order_.release();
  entries_.release();
  data_.radii = nullptr;
}

void Frame::list_drawn(std::int64_t count) {
  std::uint32_t* drawn = drawn_.resize(static_cast<std::size_t>(count));
  for (std::int64_t splat = 0; splat < count; ++splat) {
    drawn[drawn_count_] = static_cast<std::uint32_t>(splat);
    drawn_count_ += data_.depths[splat] > 0.0;
  }
  data_.drawn = drawn;
}

// Stable: splats at one depth keep the order of their indices. A radix sort by depth rounded to float32, positive, so
// that its bits sort as whole numbers do; then what is equal in float32 is sorted by the depth itself.
void Frame::sort_by_depth() {
  constexpr int kBits = 11, kPasses = 3, kBins = 1 << kBits;
  const std::size_t count = static_cast<std::size_t>(drawn_count_);
  Buffer<std::uint32_t> key_buffers[2], other;
  std::uint32_t *keys = key_buffers[0].resize(count), *next_keys = key_buffers[1].resize(count);
  std::uint32_t *values = order_.resize(count), *next_values = other.resize(count);
  std::vector<std::uint32_t> bins(kPasses * kBins, 0);
  for (std::size_t i = 0; i < count; ++i) {
    values[i] = data_.drawn[i];
    const float rounded = static_cast<float>(data_.depths[values[i]]);
    std::memcpy(&keys[i], &rounded, sizeof rounded);
    for (int pass = 0; pass < kPasses; ++pass) ++bins[pass * kBins + (keys[i] >> (kBits * pass) & (kBins - 1))];
  }
  for (int pass = 0; pass < kPasses; ++pass) {
    std::uint32_t* starts = bins.data() + pass * kBins;
    std::uint32_t total = 0;
    for (int bin = 0; bin < kBins; ++bin) total += std::exchange(starts[bin], total);
    for (std::size_t i = 0; i < count; ++i) {
      const std::uint32_t place = starts[keys[i] >> (kBits * pass) & (kBins - 1)]++;
      next_keys[place] = keys[i];
      next_values[place] = values[i];
    }
    std::swap(keys, next_keys);
    std::swap(values, next_values);
  }
  for (std::size_t begin = 0, end; begin < count; begin = end) {
    for (end = begin + 1; end < count && keys[end] == keys[begin];) ++end;
    if (end - begin > 1)
      std::stable_sort(values + begin, values + end, [this](std::uint32_t a, std::uint32_t b) {
        return data_.depths[a] < data_.depths[b];
      });
  }
  // An odd number of passes ends in the other buffer.
  static_assert(kPasses % 2 == 1);
  std::copy(values, values + count, next_values);
  data_.order = order_.data();
}

// Give every splat as many entries as its rectangle has tiles; what it does not use is never touched.
void Frame::reserve_entries() {
  for (std::int64_t i = 0; i < drawn_count_; ++i) {
    const std::uint32_t splat = data_.drawn[i];
    const Rect& rect = data_.rects[splat];
    data_.ranges[splat].begin = static_cast<std::uint32_t>(entry_count_);
    entry_count_ += std::size_t{1} * (rect.x1 - rect.x0 + 1) * (rect.y1 - rect.y0 + 1);
    if (entry_count_ > std::numeric_limits<std::uint32_t>::max())
      throw std::length_error("the splats touch more tiles than 32 bits can count");
  }
  data_.entries = entries_.resize(entry_count_);
}

// Counting sort of the entries into tiles. Splats are dealt with in depth order, cut into as many pieces as there
// are threads; a piece's pairs go behind those of the pieces before it, so the lists do not depend on the cut.
void Frame::fill_tiles(const Splats& splats, int threads) {
  parallel_for(drawn_count_, kPerTask, threads,
               [&](std::int64_t begin, std::int64_t end) { kernels_.find_entries(view_, splats, data_, begin, end); });

  const std::size_t tiles = static_cast<std::size_t>(view_.tiles_x) * view_.tiles_y;
  const std::int64_t pieces = std::max<std::int64_t>(1, std::min<std::int64_t>(threads, drawn_count_ / kPerTask));
  const auto piece_begin = [&](std::int64_t piece) { return drawn_count_ * piece / pieces; };
  std::vector<std::uint32_t> places(pieces * tiles, 0);
  // All splats at once may be counted in any order: the one in which they lie in memory is the fastest.
  const std::uint32_t* counted = pieces == 1 ? data_.drawn : data_.order;
  parallel_for(pieces, 1, threads, [&](std::int64_t piece, std::int64_t) {
    std::uint32_t* counts = &places[piece * tiles];
    const std::int64_t end = piece_begin(piece + 1);
    for (std::int64_t i = piece_begin(piece); i < end; ++i) {
      const EntryRange range = fetch_entries(counted, i, end);
      for (std::uint32_t entry = range.begin; entry < range.begin + range.count; ++entry)
        ++counts[data_.entries[entry].tile];
    }
  });

  data_.tile_begin = tile_begin_.resize(tiles + 1);
  std::uint32_t total = 0;
  for (std::size_t tile = 0; tile < tiles; ++tile) {
    data_.tile_begin[tile] = total;
    for (std::int64_t piece = 0; piece < pieces; ++piece) total += std::exchange(places[piece * tiles + tile], total);
    // Indices within a tile are kept as floats.
    if (total - data_.tile_begin[tile] > 1u << std::numeric_limits<float>::digits)
      throw std::length_error("more than 2^24 splats touch one tile");
  }
  data_.tile_begin[tiles] = total;

  data_.pairs = pairs_.resize(total);
  data_.places = places_.resize(entry_count_);
  parallel_for(pieces, 1, threads, [&](std::int64_t piece, std::int64_t) {
    std::uint32_t* place = &places[piece * tiles];
    const std::int64_t end = piece_begin(piece + 1);
    for (std::int64_t i = piece_begin(piece); i < end; ++i) {
      const EntryRange range = fetch_entries(data_.order, i, end);
      for (std::uint32_t entry = range.begin; entry < range.begin + range.count; ++entry) {
        const std::uint32_t to = place[data_.entries[entry].tile]++;
        data_.pairs[to] = {data_.entries[entry].blocks, data_.order[i]};
        data_.places[entry] = to;
      }
    }
  });
}

// The entries of splat order[i], while those of the splats a little further on are already asked for.
EntryRange Frame::fetch_entries(const std::uint32_t* order, std::int64_t i, std::int64_t end) const {
  constexpr int kRangesAhead = 24, kEntriesAhead = 12;
  if (i + kRangesAhead < end) HEADBENCH_PREFETCH(data_.ranges + order[i + kRangesAhead]);
  if (i + kEntriesAhead < end) HEADBENCH_PREFETCH(data_.entries + data_.ranges[order[i + kEntriesAhead]].begin);
  return data_.ranges[order[i]];
}

void Frame::backward(const Splats& splats, Gradients grads, float* background, float* view_gradient, int threads) {
  StageClock clock(seconds_);
  const std::int64_t tiles = static_cast<std::int64_t>(view_.tiles_x) * view_.tiles_y;
  const int channels = splats.channels;
  const Scratch scratch(kernels_.scratch_floats(channels), threads);
  Buffer<float> records;
  grads.record_stride = static_cast<int>(rounded_up(kMoments + channels, kernels_.lanes));
  grads.records = records.resize(data_.tile_begin[tiles] * std::size_t{1} * grads.record_stride);
  std::vector<double> tile_background(static_cast<std::size_t>(tiles) * channels);
  grads.background = tile_background.data();
  parallel_for(tiles, 1, threads, [&](std::int64_t tile, std::int64_t, int worker) {
    kernels_.draw_tile_backward(view_, splats, data_, grads, static_cast<int>(tile), scratch.of(worker));
  });

  clock.ends(kDrawBackward);

  Buffer<double> by_view;
  parallel_sum(drawn_count_, kPerTask, kViewGradient, threads, by_view,
               [&](std::int64_t begin, std::int64_t end, double* part, int) {
                 kernels_.project_backward(view_, splats, data_, grads, begin, end, part);
               });
  for (int c = 0; c < channels; ++c) {
    double sum = 0.0;
    for (std::int64_t tile = 0; tile < tiles; ++tile) sum += tile_background[tile * channels + c];
    background[c] = static_cast<float>(sum);
  }
  for (int k = 0; k < kViewGradient; ++k) view_gradient[k] = static_cast<float>(by_view.data()[k]);
  clock.ends(kProjectBackward);
}

Work Frame::work(const Splats& splats) const {
  const Scratch scratch(kernels_.scratch_floats(splats.channels), 1);
  Work work;
  for (int tile = 0; tile < view_.tiles_x * view_.tiles_y; ++tile)
    kernels_.count_work(view_, splats, data_, tile, scratch.of(0), work);
  return work;
}

}  // namespace headbench

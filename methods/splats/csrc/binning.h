// Which blocks of which tiles a splat reaches, exactly: row by row, the span of pixels inside the ellipse
// where alpha >= 1/255.
#pragma once

#include "tile.h"

namespace headbench::HEADBENCH_ISA {

// First and last block column, over the whole image, that one band of pixel rows touches.
struct Span {
  int first, last;
};

// Spans of a tile row's bands. `radius2` is the level of the ellipse in the units of u² + v².
inline void find_spans(const View& view, const float* record, float radius2, int tile_y, Span* spans) {
  alignas(64) float low[kTile], high[kTile];
  const Real x = record[kMeanX], y = record[kMeanY], inv_l11 = 1.0f / record[kL11];
  const Real slope = record[kL21] / record[kL11], l22 = record[kL22];
  for (int row = 0; row < kTile; row += W) {
    alignas(64) float centers[W];
    for (int lane = 0; lane < W; ++lane) centers[lane] = static_cast<float>(tile_y * kTile + row + lane) + 0.5f;
    const Real dy = load(centers) - y, v = l22 * dy;
    const Real left = fnma(v, v, radius2);
    const Mask crossed = left >= Real(0.0f);
    const Real half = sqrt(max(left, 0.0f)) * inv_l11, middle = fnma(slope, dy, x);
    store(low + row, select(crossed, middle - half, 3e38f));
    store(high + row, select(crossed, middle + half, -3e38f));
  }
  const float width = static_cast<float>(view.width);
  for (int band = 0; band < kBands; ++band) {
    float lo = low[band * kBlockHeight], hi = high[band * kBlockHeight];
    for (int row = 1; row < kBlockHeight; ++row) {
      const float a = low[band * kBlockHeight + row], b = high[band * kBlockHeight + row];
      lo = a < lo ? a : lo;
      hi = b > hi ? b : hi;
    }
    // A hundredth of a pixel of slack covers rounding; it costs at most a block tested in vain. Clamped while
    // still floats, since huge splats exceed the integers.
    lo = lo - 0.51f;
    hi = hi - 0.49f;
    if (!(hi >= 0.0f && lo <= width - 1.0f && lo <= hi)) {
      spans[band] = {1, 0};
      continue;
    }
    const int first = lo > 0.0f ? static_cast<int>(ceilf(lo)) : 0;
    const int last = hi < width - 1.0f ? static_cast<int>(hi) : view.width - 1;
    spans[band] = first <= last ? Span{first / kBlockWidth, last / kBlockWidth} : Span{1, 0};
  }
}

inline void find_pairs(const View& view, const FrameData& frame, std::int64_t begin, std::int64_t end,
                       std::uint32_t* tile_counts) {
  constexpr int ahead = 8;
  for (std::int64_t i = begin; i < end; ++i) {
    if (i + ahead < end) {
      const std::size_t next = frame.order[i + ahead];
      prefetch(frame.records + next * frame.record_stride);
      prefetch(frame.rects + next);
    }
    const std::uint32_t splat = frame.order[i];
    const float* record = frame.records + static_cast<std::size_t>(splat) * frame.record_stride;
    const Rect rect = frame.rects[splat];
    // The slack keeps pixels that pass the drawing's own test by a rounding.
    const float radius2 = record[kLog2Opacity] - kLog2AlphaMin + 1e-5f;
    std::uint32_t entry = frame.entry_begin[splat];
    for (int tile_y = rect.y0; tile_y <= rect.y1; ++tile_y) {
      Span spans[kBands];
      find_spans(view, record, radius2, tile_y, spans);
      int first = view.tiles_x, last = -1;
      for (int band = 0; band < kBands; ++band) {
        if (spans[band].first > spans[band].last) continue;
        const int a = spans[band].first / kColumns, b = spans[band].last / kColumns;
        first = a < first ? a : first;
        last = b > last ? b : last;
      }
      // Rounding must not carry an entry past the places reserved for the rectangle.
      first = first > rect.x0 ? first : rect.x0;
      last = last < rect.x1 ? last : rect.x1;
      for (int tile_x = first; tile_x <= last; ++tile_x) {
        std::uint64_t blocks = 0;
        for (int band = 0; band < kBands; ++band) {
          const int a = spans[band].first - tile_x * kColumns, b = spans[band].last - tile_x * kColumns;
          const int lo = a > 0 ? a : 0, hi = b < kColumns - 1 ? b : kColumns - 1;
          if (lo <= hi) blocks |= static_cast<std::uint64_t>((2u << hi) - (1u << lo)) << (kColumns * band);
        }
        if (!blocks) continue;
        const std::uint32_t tile = static_cast<std::uint32_t>(tile_y * view.tiles_x + tile_x);
        frame.entry_tiles[entry] = tile;
        frame.entry_blocks[entry] = blocks;
        ++entry;
        ++tile_counts[tile];
      }
    }
    frame.entry_count[splat] = entry - frame.entry_begin[splat];
  }
}

}  // namespace headbench::HEADBENCH_ISA

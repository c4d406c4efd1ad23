// Which blocks of which tiles a splat reaches, exactly: row by row, the span of pixels inside the ellipse
// where alpha >= alpha_min.
#pragma once

#include "tile.h"

namespace headbench::HEADBENCH_ISA {

// A vector has a band of pixel rows per lane. It holds several tile rows, or a tile row takes several vectors.
constexpr int kSpans = W > kBands ? W : kBands;
constexpr int kTileRows = kSpans / kBands;

// First and last block column, over the whole image, that the bands of kTileRows tile rows touch; first > last where
// one touches none.
struct Spans {
  alignas(64) float first[kSpans], last[kSpans];
};

// `radius2` is the level of the ellipse in the units of u² + v².
HEADBENCH_INLINE void find_spans(const Camera& view, const float* record, float radius2, int tile_y, Spans& spans) {
  const Real x = record[kMeanX], inv_l11 = 1.0f / record[kL11], slope = record[kL21] / record[kL11];
  const Real l22 = record[kL22], nowhere = 3e38f;
  const Real width = static_cast<float>(view.width), per_block = 1.0f / kBlockWidth;
  for (int band = 0; band < kSpans; band += W) {
    alignas(64) float tops[W];
    for (int lane = 0; lane < W; ++lane) tops[lane] = static_cast<float>((band + lane) * kBlockHeight);
    const Real above = load(tops) + Real(static_cast<float>(tile_y * kTile) + 0.5f - record[kMeanY]);
    Real low = nowhere, high = Real(0.0f) - nowhere;
    for (int row = 0; row < kBlockHeight; ++row) {
      const Real dy = above + Real(static_cast<float>(row)), v = l22 * dy, rest = fnma(v, v, radius2);
      const Mask crossed = rest >= Real(0.0f);
      const Real half = sqrt(max(rest, 0.0f)) * inv_l11, middle = fnma(slope, dy, x);
      low = select(crossed, min(low, middle - half), low);
      high = select(crossed, max(high, middle + half), high);
    }
    // From the ends of the span to the pixel centres inside. A hundredth of a pixel of slack covers rounding; it
    // costs at most a block tested in vain. Clamped to just outside the image, where the numbers are small again.
    const Real first = max(min(ceil(low - Real(0.51f)), width), 0.0f);
    const Real last = min(max(floor(high - Real(0.49f)), -1.0f), width - Real(1.0f));
    const Mask touched = last >= first;
    store(spans.first + band, select(touched, floor(first * per_block), width));
    store(spans.last + band, select(touched, floor(last * per_block), -1.0f));
  }
}

// Tiles whose columns of blocks are worked on at a time: as whole numbers up to 2^24 floats are exact sets of bits.
constexpr int kGroup = 24 / kColumns;

// Columns of blocks that each band touches, a bit each, from column `left` on; false where there are none.
HEADBENCH_INLINE bool find_columns(const Spans& spans, int left, float* columns) {
  const Real offset = static_cast<float>(left), one = 1.0f;
  bool found = false;
  for (int band = 0; band < kSpans; band += W) {
    const Real lo = max(load(spans.first + band) - offset, 0.0f);
    const Real end = max(min(load(spans.last + band) - offset + one, static_cast<float>(kGroup * kColumns)), 0.0f);
    const Mask touched = end > lo;
    const Real run = scale_by_power(one, end) - scale_by_power(one, min(lo, end));
    store(columns + band, zero_unless(touched, run));
    found = found || any(touched);
  }
  return found;
}

// Enter the tiles of up to kTileRows tile rows whose bands' spans are given; gives the next free entry.
HEADBENCH_INLINE std::uint32_t enter_tile_rows(const Camera& view, const FrameData& frame, const Rect& rect, int tile_y,
                                               const Spans& spans, std::uint32_t entry) {
  const int rows = rect.y1 - tile_y + 1 < kTileRows ? rect.y1 - tile_y + 1 : kTileRows;
  for (int group = rect.x0; group <= rect.x1; group += kGroup) {
    alignas(64) float columns[kSpans];
    if (!find_columns(spans, group * kColumns, columns)) continue;
    const int width = rect.x1 - group + 1 < kGroup ? rect.x1 - group + 1 : kGroup;
    // One loop over all tiles, as its end is hard to foresee; an untouched tile's entry is written over.
    int x = 0;
    const float* row = columns;
    std::uint32_t tile = static_cast<std::uint32_t>(tile_y * view.tiles_x + group);
    for (int tiles = rows * width; tiles > 0; --tiles) {
      std::uint64_t blocks = 0;
      for (int band = 0; band < kBands; ++band) {
        const std::uint32_t run = static_cast<std::uint32_t>(static_cast<std::int32_t>(row[band]));
        blocks |= static_cast<std::uint64_t>(run >> (x * kColumns) & ((1u << kColumns) - 1)) << (kColumns * band);
      }
      frame.entries[entry] = {blocks, tile + static_cast<std::uint32_t>(x)};
      entry += blocks != 0;
      const bool row_ends = ++x == width;
      x = row_ends ? 0 : x;
      row += row_ends ? kBands : 0;
      tile += row_ends ? static_cast<std::uint32_t>(view.tiles_x) : 0;
    }
  }
  return entry;
}

inline void find_entries(const Camera& view, const Splats& splats, const FrameData& frame, std::int64_t begin,
                         std::int64_t end) {
  const int stride = record_stride(splats.channels);
  for (std::int64_t i = begin; i < end; ++i) {
    const std::uint32_t splat = frame.drawn[i];
    const float* record = frame.records + static_cast<std::size_t>(splat) * stride;
    const Rect rect = frame.rects[splat];
    // The slack keeps pixels that pass the drawing's own test by a rounding.
    const float radius2 = record[kLog2Opacity] - view.log2_alpha_min + 1e-5f;
    std::uint32_t entry = frame.ranges[splat].begin;
    for (int tile_y = rect.y0; tile_y <= rect.y1; tile_y += kTileRows) {
      Spans spans;
      find_spans(view, record, radius2, tile_y, spans);
      entry = enter_tile_rows(view, frame, rect, tile_y, spans, entry);
    }
    frame.ranges[splat].count = entry - frame.ranges[splat].begin;
  }
}

}  // namespace headbench::HEADBENCH_ISA

// Which blocks of which tiles a splat reaches, exactly: row by row, the span of pixels inside the ellipse
// where alpha >= 1/255.
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
HEADBENCH_INLINE void find_spans(const View& view, const float* record, float radius2, int tile_y, Spans& spans) {
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

// Enter the tiles of one tile row, whose bands' spans are given; gives the next free entry.
HEADBENCH_INLINE std::uint32_t enter_tile_row(const View& view, const FrameData& frame, const Rect& rect, int tile_y,
                                              const float* first, const float* last, std::uint32_t entry) {
  int firsts[kBands], lasts[kBands];
  int leftmost = view.tiles_x * kColumns, rightmost = -1;
  for (int band = 0; band < kBands; ++band) {
    firsts[band] = static_cast<int>(first[band]);
    lasts[band] = static_cast<int>(last[band]);
    leftmost = firsts[band] < leftmost ? firsts[band] : leftmost;
    rightmost = lasts[band] > rightmost ? lasts[band] : rightmost;
  }
  if (rightmost < 0) return entry;
  // Rounding must not carry an entry past the places reserved for the rectangle.
  const int begin = leftmost / kColumns > rect.x0 ? leftmost / kColumns : rect.x0;
  const int end = rightmost / kColumns < rect.x1 ? rightmost / kColumns : rect.x1;
  // As many tiles at a time as a word has bits for: the columns a band touches are a run of them.
  constexpr int kGroup = 64 / kColumns;
  constexpr std::uint64_t kAll = ~std::uint64_t{0};
  for (int group = begin; group <= end; group += kGroup) {
    std::uint64_t columns[kBands];
    for (int band = 0; band < kBands; ++band) {
      const int a = firsts[band] - group * kColumns, b = lasts[band] - group * kColumns;
      const int lo = a > 0 ? a : 0, hi = b < 63 ? b : 63;
      columns[band] = lo <= hi ? kAll >> (63 - hi) & kAll << lo : 0;
    }
    const int group_end = group + kGroup - 1 < end ? group + kGroup - 1 : end;
    for (int tile_x = group; tile_x <= group_end; ++tile_x) {
      std::uint64_t blocks = 0;
      for (int band = 0; band < kBands; ++band) {
        blocks |= (columns[band] & ((1 << kColumns) - 1)) << (kColumns * band);
        columns[band] >>= kColumns;
      }
      if (!blocks) continue;
      frame.entries[entry++] = {blocks, static_cast<std::uint32_t>(tile_y * view.tiles_x + tile_x)};
    }
  }
  return entry;
}

inline void find_entries(const View& view, const FrameData& frame, std::int64_t begin, std::int64_t end) {
  for (std::int64_t i = begin; i < end; ++i) {
    const std::uint32_t splat = frame.visible[i];
    const float* record = frame.records + static_cast<std::size_t>(splat) * frame.record_stride;
    const Rect rect = frame.rects[splat];
    // The slack keeps pixels that pass the drawing's own test by a rounding.
    const float radius2 = record[kLog2Opacity] - kLog2AlphaMin + 1e-5f;
    std::uint32_t entry = frame.ranges[splat].begin;
    for (int tile_y = rect.y0; tile_y <= rect.y1; tile_y += kTileRows) {
      Spans spans;
      find_spans(view, record, radius2, tile_y, spans);
      for (int row = 0; row < kTileRows && tile_y + row <= rect.y1; ++row)
        entry = enter_tile_row(view, frame, rect, tile_y + row, spans.first + row * kBands, spans.last + row * kBands,
                               entry);
    }
    frame.ranges[splat].count = entry - frame.ranges[splat].begin;
  }
}

}  // namespace headbench::HEADBENCH_ISA

// A tile as blocks of W pixels, its splats in chunks, and the one expression for alpha.
#pragma once

#include "projection.h"

namespace headbench::HEADBENCH_ISA {

// A block is 4 pixels wide and as tall as a vector fills; lane = 4 row + column.
constexpr int kBlockWidth = 4;
constexpr int kBlockHeight = W / kBlockWidth;
constexpr int kBands = kTile / kBlockHeight;
constexpr int kColumns = kTile / kBlockWidth;
constexpr int kBlocks = kBands * kColumns;
static_assert(kBlocks <= 64, "Pair::blocks has 64 bits");

// Splats worked on at a time: their parameters and block lists stay in the first-level cache.
constexpr int kChunk = 256;

struct Block {
  int left, top;          // of the block, pixels of the image
  int x, y;               // the same within the tile
  Real pixel_x, pixel_y;  // centres within the tile
  Mask inside;            // lanes inside the image
};

HEADBENCH_INLINE Block block_of(const View& view, int tile, int index) {
  Block b;
  const int tile_left = tile % view.tiles_x * kTile, tile_top = tile / view.tiles_x * kTile;
  b.x = index % kColumns * kBlockWidth;
  b.y = index / kColumns * kBlockHeight;
  b.left = tile_left + b.x;
  b.top = tile_top + b.y;
  alignas(64) float x[W], y[W];
  for (int lane = 0; lane < W; ++lane) {
    x[lane] = static_cast<float>(b.x + lane % kBlockWidth) + 0.5f;
    y[lane] = static_cast<float>(b.y + lane / kBlockWidth) + 0.5f;
  }
  b.pixel_x = load(x);
  b.pixel_y = load(y);
  b.inside = (Real(static_cast<float>(view.width - tile_left)) > b.pixel_x) &
             (Real(static_cast<float>(view.height - tile_top)) > b.pixel_y);
  return b;
}

// Lowest bit of a non-zero word, as an index.
HEADBENCH_INLINE int lowest_bit(std::uint64_t bits) {
#if defined(__GNUC__) || defined(__clang__)
  return __builtin_ctzll(bits);
#else
  int index = 0;
  while (!(bits & 1)) bits >>= 1, ++index;
  return index;
#endif
}

// A row of a chunk's parameters is the splat's record with the mean counted from the tile's corner, where a float
// resolves it, and in place of its rest the index in the tile's list.
constexpr int kIndex = kRestX;

// A chunk of a tile's list: parameters side by side, and for every block the chunk's splats that reach it.
struct Chunk {
  int stride;          // floats per row of params
  float* params;       // (kChunk, stride)
  std::uint16_t* list;  // (kBlocks, kChunk) rows of params
  int listed[kBlocks];
};

// Floats per row of parameters.
constexpr int param_stride(int channels) { return (kGeometry + channels + 3) / 4 * 4; }

inline std::size_t chunk_floats(int channels) {
  return static_cast<std::size_t>(kChunk) * param_stride(channels) + kBlocks * kChunk / 2;
}

// Fill the chunk with pairs [begin, end) of the tile's list, for the blocks in `wanted`.
inline void fill_chunk(const View& view, const Splats& splats, const FrameData& frame, int tile, int begin, int end,
                       std::uint64_t wanted, float* scratch, Chunk& chunk) {
  const Pair* tile_pairs = frame.pairs + frame.tile_begin[tile];
  const float left = static_cast<float>(tile % view.tiles_x * kTile);
  const float top = static_cast<float>(tile / view.tiles_x * kTile);
  chunk.stride = param_stride(splats.channels);
  chunk.params = scratch;
  chunk.list = reinterpret_cast<std::uint16_t*>(scratch + kChunk * chunk.stride);
  for (int b = 0; b < kBlocks; ++b) chunk.listed[b] = 0;
  const int used = kGeometry + splats.channels;
  constexpr int ahead = 24;
  for (int i = begin; i < end; ++i) {
    if (i + ahead < end)
      HEADBENCH_PREFETCH(frame.records + static_cast<std::size_t>(tile_pairs[i + ahead].splat) * frame.record_stride);
    std::uint64_t blocks = tile_pairs[i].blocks & wanted;
    if (!blocks) continue;
    const float* record = frame.records + static_cast<std::size_t>(tile_pairs[i].splat) * frame.record_stride;
    float* row = chunk.params + (i - begin) * chunk.stride;
    for (int k = 0; k < used; ++k) row[k] = record[k];
    row[kMeanX] = (record[kMeanX] - left) + record[kRestX];
    row[kMeanY] = (record[kMeanY] - top) + record[kRestY];
    row[kIndex] = static_cast<float>(i);
    for (; blocks; blocks &= blocks - 1) {
      const int b = lowest_bit(blocks);
      chunk.list[b * kChunk + chunk.listed[b]++] = static_cast<std::uint16_t>(i - begin);
    }
  }
}

// 2^x for x up to 127, not below about 2^-126; relative error below 2e-7.
HEADBENCH_INLINE Real exp2(Real x) {
  Real f;
  if constexpr (!kAnyPower) x = max(x, -126.0f);
  const Real n = round(x, f);
  // Minimax in relative error on [-1/2, 1/2] with the constant held at 1, so that whole powers are exact.
  Real p = 1.32647273e-3f;
  p = fma(p, f, 9.67151299e-3f);
  p = fma(p, f, 5.55073358e-2f);
  p = fma(p, f, 0.240222424f);
  p = fma(p, f, 0.693147004f);
  p = fma(p, f, 1.0f);
  return scale_by_power(p, n);
}

struct Alpha {
  Mask passes;  // alpha >= 1/255
  Real raw;     // before the clamp; meaningless where it does not pass
  Real u, v;    // log2 alpha = log2 opacity - u² - v²
};

// Alpha of the splat in `row` at a block's pixels. Forward and backward both come here: were the two to differ
// by a rounding, pixels at a threshold would get gradients of another image.
HEADBENCH_INLINE Alpha alpha_of(const float* row, const Block& block) {
  const Real dx = block.pixel_x - Real(row[kMeanX]), dy = block.pixel_y - Real(row[kMeanY]);
  const Real u = fma(row[kL11], dx, Real(row[kL21]) * dy), v = Real(row[kL22]) * dy;
  const Real exponent = fnma(v, v, fnma(u, u, row[kLog2Opacity]));
  return {exponent >= Real(kLog2AlphaMin), exp2(exponent), u, v};
}

}  // namespace headbench::HEADBENCH_ISA

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

// Column and row of each lane's pixel within its block, for the widest vectors.
alignas(64) constexpr float kLaneColumns[16] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
alignas(64) constexpr float kLaneRows[16] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

HEADBENCH_INLINE Block block_of(const Camera& view, int tile, int index) {
  Block b;
  const int tile_left = tile % view.tiles_x * kTile, tile_top = tile / view.tiles_x * kTile;
  b.x = index % kColumns * kBlockWidth;
  b.y = index / kColumns * kBlockHeight;
  b.left = tile_left + b.x;
  b.top = tile_top + b.y;
  b.pixel_x = Real(static_cast<float>(b.x) + 0.5f) + load(kLaneColumns);
  b.pixel_y = Real(static_cast<float>(b.y) + 0.5f) + load(kLaneRows);
  b.inside = (Real(static_cast<float>(view.width - tile_left)) > b.pixel_x) &
             (Real(static_cast<float>(view.height - tile_top)) > b.pixel_y);
  return b;
}

// A row of a chunk's parameters is the splat's record with the mean counted from the tile's corner, where a float
// resolves it, and in place of its rest the index in the tile's list.
constexpr int kIndex = kRestX;

// Splats of a chunk that a word has bits for.
constexpr int kWordBits = 64;
constexpr int kWords = kChunk / kWordBits;

// A chunk of a tile's list: parameters side by side, and for every block a bit for each of the chunk's splats that
// reaches it.
struct Chunk {
  float* params;  // (kChunk, record_stride)
  int words;      // in use
  alignas(64) std::uint64_t hits[kBlocks * kWords];

  const std::uint64_t* hits_of(int block) const { return hits + block * kWords; }
  bool reaches(int block) const {
    std::uint64_t all = 0;
    for (int word = 0; word < words; ++word) all |= hits_of(block)[word];
    return all != 0;
  }
};

inline std::size_t chunk_floats(int channels) { return static_cast<std::size_t>(kChunk) * record_stride(channels); }

// From the blocks of a word's splats to the splats of every block: a transposed matrix of bits.
HEADBENCH_INLINE void transpose_bits(const std::uint64_t* blocks, std::uint64_t* hits) {
  if constexpr (kTestsBits) {
    alignas(64) std::uint32_t narrow[kWordBits];
    for (int i = 0; i < kWordBits; ++i) narrow[i] = static_cast<std::uint32_t>(blocks[i]);
    for (int b = 0; b < kBlocks; ++b) hits[b * kWords] = 0;
    for (int group = 0; group < kWordBits; group += W)
      test_bits<kBlocks>(narrow + group, [&](int b, std::uint64_t set) { hits[b * kWords] |= set << group; });
  } else {
    for (int b = 0; b < kBlocks; ++b) hits[b * kWords] = 0;
    for (int i = 0; i < kWordBits; ++i)
      for (std::uint64_t rest = blocks[i]; rest; rest &= rest - 1)
        hits[lowest_bit(rest) * kWords] |= std::uint64_t{1} << i;
  }
}

// Fill the chunk with pairs [begin, end) of the tile's list, for the blocks in `wanted`. C = 0 means that the number of
// channels is known only at run time.
template <int C>
inline void fill_chunk(const Camera& view, const Splats& splats, const FrameData& frame, int tile, int begin, int end,
                       std::uint64_t wanted, Chunk& chunk) {
  const Pair* pairs = frame.pairs + frame.tile_begin[tile];
  const int stride = record_stride(C ? C : splats.channels);
  const float left = static_cast<float>(tile % view.tiles_x * kTile);
  const float top = static_cast<float>(tile / view.tiles_x * kTile);
  // Records are asked for in good time, those of the next tile's first splats too.
  constexpr std::uint32_t ahead = 24;
  const std::uint32_t last = frame.tile_begin[view.tiles_x * view.tiles_y] - frame.tile_begin[tile] - 1;
  chunk.words = (end - begin + kWordBits - 1) / kWordBits;
  for (int word = 0; word < chunk.words; ++word) {
    const int word_begin = begin + word * kWordBits, rest = end - word_begin;
    const int used = rest < kWordBits ? rest : kWordBits;
    std::uint64_t blocks[kWordBits];
    for (int i = 0; i < used; ++i) {
      const std::uint32_t pair = static_cast<std::uint32_t>(word_begin + i), later = pair + ahead;
      HEADBENCH_PREFETCH(frame.records + static_cast<std::size_t>(pairs[later < last ? later : last].splat) * stride);
      blocks[i] = pairs[pair].blocks & wanted;
      if (!blocks[i]) continue;
      const float* record = frame.records + static_cast<std::size_t>(pairs[pair].splat) * stride;
      float* row = chunk.params + (word * kWordBits + i) * stride;
      for (int k = 0; k < stride; k += W) store(row + k, load(record + k));
      row[kMeanX] = (record[kMeanX] - left) + record[kRestX];
      row[kMeanY] = (record[kMeanY] - top) + record[kRestY];
      row[kIndex] = static_cast<float>(pair);
    }
    for (int i = used; i < kWordBits; ++i) blocks[i] = 0;
    transpose_bits(blocks, chunk.hits + word);
  }
}

// Ask for the rows of an image, `channels` numbers a pixel, that a tile covers.
HEADBENCH_INLINE void prefetch_tile(const Camera& view, const float* image, int channels, int tile) {
  if (tile >= view.tiles_x * view.tiles_y) return;
  const int left = tile % view.tiles_x * kTile, top = tile / view.tiles_x * kTile;
  const int bottom = top + kTile < view.height ? top + kTile : view.height;
  for (int y = top; y < bottom; ++y) {
    const float* row = image + (static_cast<std::size_t>(y) * view.width + left) * channels;
    for (int k = 0; k < kTile * channels; k += 16) HEADBENCH_PREFETCH(row + k);
  }
}

struct Alpha {
  Mask passes;  // alpha >= alpha_min
  Real raw;     // before the clamp; meaningless where it does not pass
  Real u, v;    // log2 alpha = log2 opacity - u² - v²
};

// Alpha of the splat in `row` at a block's pixels. Forward and backward both come here: were the two to differ
// by a rounding, pixels at a threshold would get gradients of another image.
HEADBENCH_INLINE Alpha alpha_of(const Camera& view, const float* row, const Block& block) {
  const Real dx = block.pixel_x - Real(row[kMeanX]), dy = block.pixel_y - Real(row[kMeanY]);
  const Real u = fma(row[kL11], dx, Real(row[kL21]) * dy), v = Real(row[kL22]) * dy;
  const Real exponent = fnma(v, v, fnma(u, u, row[kLog2Opacity]));
  return {exponent >= Real(view.log2_alpha_min), exp2(exponent), u, v};
}

}  // namespace headbench::HEADBENCH_ISA

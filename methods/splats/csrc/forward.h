// Front-to-back compositing of one tile.
#pragma once

#include "tile.h"

namespace headbench::HEADBENCH_ISA {

// What a block carries from chunk to chunk: (kFront + C) vectors.
enum FrontField {
  kRunning,     // transmittance, going on past the stop so that one product is all that links two splats
  kRemaining,   // transmittance at the stop
  kLastDrawn,   // index in the tile's list
  kFront        // then the colours
};

inline std::size_t forward_scratch(int channels) {
  return chunk_floats(channels) + static_cast<std::size_t>(kBlocks) * (kFront + channels) * W;
}

// Composite one block's list over its state; false once no pixel lets light through. C = 0 means that the
// number of channels is known only at run time.
template <int C>
inline bool composite_block(const Camera& view, const Chunk& chunk, int index, const Block& block, int channels, float* state) {
  constexpr int kColors = C ? C : kChannelsMax;
  constexpr int kStep = 8;  // splats between two looks at whether the block is finished
  const int count = C ? C : channels, stride = record_stride(count);
  const Real stop = view.transmittance_min;
  Real running = load(state + kRunning * W), remaining = load(state + kRemaining * W);
  Real last = load(state + kLastDrawn * W);
  Real colors[kColors];
  for (int c = 0; c < count; ++c) colors[c] = load(state + (kFront + c) * W);
  bool open = true;
  for (int word = 0; word < chunk.words && open; ++word) {
    const float* rows = chunk.params + word * kWordBits * stride;
    int step = kStep;
    for (std::uint64_t hits = chunk.hits_of(index)[word]; hits && open; hits &= hits - 1) {
      const float* row = rows + lowest_bit(hits) * stride;
      const Alpha a = alpha_of(view, row, block);
      const Real alpha = zero_unless(a.passes, min(a.raw, kAlphaMax));
      const Real next = fnma(alpha, running, running);
      const Mask open_lanes = next > stop;
      const Real weight = zero_unless(open_lanes, alpha * running);
      for (int c = 0; c < count; ++c) colors[c] = fma(weight, row[kGeometry + c], colors[c]);
      remaining = select(open_lanes, next, remaining);
      last = select(open_lanes & a.passes, row[kIndex], last);
      running = next;
      if (--step) continue;
      step = kStep;
      open = any(running > stop);
      // Far below the stop, but out of reach of slow denormal arithmetic.
      running = max(running, 1e-12f);
    }
  }
  store(state + kRunning * W, running);
  store(state + kRemaining * W, remaining);
  store(state + kLastDrawn * W, last);
  for (int c = 0; c < count; ++c) store(state + (kFront + c) * W, colors[c]);
  return open;
}

template <int C>
inline void write_block(const Camera& view, const Splats& splats, const FrameData& frame, const ImageOut& out,
                        int tile, int index, const Block& block, float* state) {
  const int channels = C ? C : splats.channels;
  const Real remaining = load(state + kRemaining * W);
  store(frame.transmittances + static_cast<std::size_t>(tile) * kTilePixels + index * W, remaining);
  for (int c = 0; c < channels; ++c) {
    float* color = state + (kFront + c) * W;
    store(color, fma(remaining, splats.background[c], load(color)));
  }
  alignas(64) float alpha[W];
  store(alpha, Real(1.0f) - remaining);
  store(frame.last + static_cast<std::size_t>(tile) * kTilePixels + index * W, load(state + kLastDrawn * W));
  const int columns = view.width - block.left < kBlockWidth ? view.width - block.left : kBlockWidth;
  const int rows = view.height - block.top < kBlockHeight ? view.height - block.top : kBlockHeight;
  for (int row = 0; row < rows; ++row) {
    const std::size_t pixel = static_cast<std::size_t>(block.top + row) * view.width + block.left;
    for (int column = 0; column < columns; ++column) {
      const int lane = row * kBlockWidth + column;
      float* image = out.image + (pixel + column) * channels;
      for (int c = 0; c < channels; ++c) image[c] = state[(kFront + c) * W + lane];
      out.alpha[pixel + column] = alpha[lane];
    }
  }
}

template <int C>
inline void draw_tile_with(const Camera& view, const Splats& splats, const FrameData& frame, const ImageOut& out,
                           int tile, float* scratch) {
  const int channels = splats.channels, state_floats = (kFront + channels) * W;
  float* states = scratch;
  Chunk chunk;
  chunk.params = scratch + kBlocks * state_floats;
  std::uint64_t open = 0;
  for (int b = 0; b < kBlocks; ++b) {
    const Block block = block_of(view, tile, b);
    float* state = states + b * state_floats;
    store(state + kRunning * W, zero_unless(block.inside, 1.0f));
    store(state + kRemaining * W, 1.0f);
    store(state + kLastDrawn * W, -1.0f);
    for (int c = 0; c < channels; ++c) store(state + (kFront + c) * W, 0.0f);
    if (any(block.inside)) open |= std::uint64_t{1} << b;
  }
  const std::uint64_t drawn = open;
  prefetch_tile(view, out.image, channels, tile);
  prefetch_tile(view, out.alpha, 1, tile);

  const int count = static_cast<int>(frame.tile_begin[tile + 1] - frame.tile_begin[tile]);
  for (int begin = 0; begin < count && open; begin += kChunk) {
    const int end = begin + kChunk < count ? begin + kChunk : count;
    fill_chunk<C>(view, splats, frame, tile, begin, end, open, chunk);
    for (int b = 0; b < kBlocks; ++b) {
      if (!chunk.reaches(b)) continue;
      if (!composite_block<C>(view, chunk, b, block_of(view, tile, b), channels, states + b * state_floats))
        open &= ~(std::uint64_t{1} << b);
    }
  }
  for (int b = 0; b < kBlocks; ++b)
    if (drawn >> b & 1)
      write_block<C>(view, splats, frame, out, tile, b, block_of(view, tile, b), states + b * state_floats);
}

inline void draw_tile(const Camera& view, const Splats& splats, const FrameData& frame, const ImageOut& out,
                      int tile, float* scratch) {
  if (splats.channels == 3) draw_tile_with<3>(view, splats, frame, out, tile, scratch);
  else draw_tile_with<0>(view, splats, frame, out, tile, scratch);
}

}  // namespace headbench::HEADBENCH_ISA

// Back-to-front derivative of one tile.
//
// With T the transmittance before a splat, w = alpha T its weight, g the pixel's colour gradient and D the sum of
// w_j c_j·g over all splats behind plus what reaches the background,
//   dL/dcolour = Σ w g,     dL/dalpha = T c·g - D / (1 - alpha).
// T is recovered by division: alpha <= 0.99 keeps the error at a few roundings per splat.
#pragma once

#include "tile.h"

namespace headbench::HEADBENCH_ISA {

// What a block carries from chunk to chunk: (kBack + C) vectors.
enum BackField {
  kTransmittance,  // before the splats already passed
  kBehind,         // D
  kStart,          // index of the pixel's last splat
  kBack            // then the colour gradients
};

// Floats per gradient record.
constexpr int gradient_stride(int channels) { return (kMoments + channels + W - 1) / W * W; }

inline std::size_t backward_scratch(int channels) {
  return chunk_floats(channels) + static_cast<std::size_t>(kBlocks) * (kBack + channels) * W +
         gradient_stride(channels);
}

// Pixels' v and w of up to W splats, kept until they can be summed over pixels for W splats at once. The W splats are four
// groups of kBlockHeight. After the two transposes below, splat i of the batch is at lane `place(i)`.
struct Batch {
  alignas(64) float v[W * W], w[W * W];
  alignas(64) float mean_x[W], mean_y[W];
  float* target[W];
};

HEADBENCH_INLINE int place(int splat) { return 4 * (splat % kBlockHeight) + splat / kBlockHeight; }

// The rows of the block, for one group of splats: row r as vector r, splat by four floats, column by float.
HEADBENCH_INLINE void load_rows(const float* pixels, int group, Real* rows) {
  for (int r = 0; r < kBlockHeight; ++r) rows[r] = load(pixels + (group * kBlockHeight + r) * W);
  transpose_rows(rows);
}

// Sum over columns: after transposing, each of the four groups is a column.
HEADBENCH_INLINE Real sum_columns(Real* groups) {
  transpose_quads(groups);
  return (groups[0] + groups[3]) + (groups[1] + groups[2]);
}

// Sums over the block's pixels of v times 1, x, y, x², xy, y², in lane `place(i)` that of splat i. About the block's centre
// first: small numbers, so that moving them to the splat's mean loses nothing.
HEADBENCH_INLINE void sum_moments(const Batch& batch, const Block& block, Real* out) {
  Real plain[4], by_y[4], by_yy[4];
  for (int group = 0; group < 4; ++group) {
    Real rows[kBlockHeight];
    load_rows(batch.v, group, rows);
    plain[group] = by_y[group] = by_yy[group] = 0.0f;
    for (int r = 0; r < kBlockHeight; ++r) {
      const float y = static_cast<float>(r) - 0.5f * (kBlockHeight - 1);
      plain[group] = plain[group] + rows[r];
      by_y[group] = fma(y, rows[r], by_y[group]);
      by_yy[group] = fma(y * y, rows[r], by_yy[group]);
    }
  }
  transpose_quads(plain);
  transpose_quads(by_y);
  const Real outer = plain[0] + plain[3], inner = plain[1] + plain[2];
  const Real m = outer + inner, mxx = fma(2.25f, outer, Real(0.25f) * inner), myy = sum_columns(by_yy);
  const Real mx = fma(1.5f, plain[3] - plain[0], Real(0.5f) * (plain[2] - plain[1]));
  const Real my = (by_y[0] + by_y[3]) + (by_y[1] + by_y[2]);
  const Real mxy = fma(1.5f, by_y[3] - by_y[0], Real(0.5f) * (by_y[2] - by_y[1]));
  const Real ox = Real(static_cast<float>(block.x) + 0.5f * kBlockWidth) - load(batch.mean_x);
  const Real oy = Real(static_cast<float>(block.y) + 0.5f * kBlockHeight) - load(batch.mean_y);
  const Real dx = fma(ox, m, mx), dy = fma(oy, m, my);
  out[kSum] = m;
  out[kSumX] = dx;
  out[kSumY] = dy;
  out[kSumXX] = fma(ox, mx + dx, mxx);
  out[kSumXY] = fma(ox, my, fma(oy, dx, mxy));
  out[kSumYY] = fma(oy, my + dy, myy);
}

// Sum the first `used` of the batch over the block's pixels and add to the splats' gradient records. `by_row` is
// the block's colour gradients, channel by channel, each row four times over: see `repeat_rows`.
template <int C>
inline void flush(Batch& batch, int used, const Block& block, int channels, const float* by_row, float* spare) {
  const int count = C ? C : channels, width = gradient_stride(count);
  for (int i = used; i < W; ++i) {
    store(batch.v + i * W, 0.0f);
    store(batch.w + i * W, 0.0f);
    batch.mean_x[place(i)] = batch.mean_y[place(i)] = 0.0f;
    batch.target[i] = spare;
  }

  constexpr int kRoom = gradient_stride(C ? C : kChannelsMax);
  Real sums[kRoom];
  sum_moments(batch, block, sums);
  Real rows[4 * kBlockHeight];
  for (int group = 0; group < 4; ++group) load_rows(batch.w, group, rows + group * kBlockHeight);
  for (int c = 0; c < count; ++c) {
    Real groups[4];
    for (int group = 0; group < 4; ++group) {
      groups[group] = rows[group * kBlockHeight] * load(by_row + c * kBlockHeight * W);
      for (int r = 1; r < kBlockHeight; ++r)
        groups[group] = fma(rows[group * kBlockHeight + r], load(by_row + (c * kBlockHeight + r) * W), groups[group]);
    }
    sums[kMoments + c] = sum_columns(groups);
  }
  int filled = kMoments + count;
  while (filled < width) sums[filled++] = 0.0f;

  // Back to one record per splat, by the same two transposes.
  for (int k = 0; k < width; k += 4) transpose_quads(sums + k);
  for (int part = 0; part < width; part += W)
    for (int group = 0; group < 4; ++group) {
      for (int r = 0; r < kBlockHeight; ++r) rows[r] = sums[part + 4 * r + group];
      transpose_rows(rows);
      for (int r = 0; r < kBlockHeight; ++r) {
        float* target = batch.target[group * kBlockHeight + r] + part;
        store(target, load(target) + rows[r]);
      }
    }
}

// Every row of the block's colour gradients, four floats, repeated to fill a vector: transposing equal vectors does it.
HEADBENCH_INLINE void repeat_rows(const float* colors, int channels, float* by_row) {
  for (int c = 0; c < channels; ++c) {
    Real rows[kBlockHeight];
    for (int r = 0; r < kBlockHeight; ++r) rows[r] = load(colors + c * W);
    transpose_rows(rows);
    for (int r = 0; r < kBlockHeight; ++r) store(by_row + (c * kBlockHeight + r) * W, rows[r]);
  }
}

// Walk one block's list from its end; `gradients` are the chunk's records, row by row. Nothing is made of what is added
// to `spare`.
template <int C>
inline void composite_block_backward(const Camera& view, const Chunk& chunk, int index, const Block& block,
                                     int channels, float* state, float* gradients, float* spare) {
  constexpr int kColors = C ? C : 1;
  const int count = C ? C : channels, stride = record_stride(count), width = gradient_stride(count);
  const float* colors = state + kBack * W;
  alignas(64) float by_row[(C ? C : kChannelsMax) * kBlockHeight * W];
  repeat_rows(colors, count, by_row);
  Real transmittance = load(state + kTransmittance * W), behind = load(state + kBehind * W);
  const Real start = load(state + kStart * W);
  Real g[kColors];
  if constexpr (C != 0)
    for (int c = 0; c < C; ++c) g[c] = load(colors + c * W);
  Batch batch;
  int used = 0;
  for (int word = chunk.words - 1; word >= 0; --word) {
    for (std::uint64_t hits = chunk.hits_of(index)[word]; hits;) {
      const int bit = highest_bit(hits), in_chunk = word * kWordBits + bit;
      hits ^= std::uint64_t{1} << bit;
      const float* row = chunk.params + in_chunk * stride;
      const Mask reached = start >= Real(row[kIndex]);
      const Alpha a = alpha_of(view, row, block);
      const Mask drawn = a.passes & reached;
      if (!any(drawn)) continue;
      const Real alpha = zero_unless(drawn, min(a.raw, kAlphaMax));
      const Real inverse = reciprocal(Real(1.0f) - alpha);
      transmittance = transmittance * inverse;
      const Real weight = alpha * transmittance;
      Real along = 0.0f;
      for (int c = 0; c < count; ++c) {
        if constexpr (C != 0) along = fma(row[kGeometry + c], g[c], along);
        else along = fma(row[kGeometry + c], load(colors + c * W), along);
      }
      const Real dalpha = fnma(behind, inverse, transmittance * along);
      behind = fma(weight, along, behind);
      const Mask unclamped = Real(kAlphaMax) >= a.raw;
      const Real value = zero_unless(unclamped, alpha * dalpha);
      store(batch.v + used * W, value);
      store(batch.w + used * W, weight);
      batch.mean_x[place(used)] = row[kMeanX];
      batch.mean_y[place(used)] = row[kMeanY];
      batch.target[used] = gradients + in_chunk * width;
      if (++used == W) {
        flush<C>(batch, W, block, channels, by_row, spare);
        used = 0;
      }
    }
  }
  if (used) flush<C>(batch, used, block, channels, by_row, spare);
  store(state + kTransmittance * W, transmittance);
  store(state + kBehind * W, behind);
}

// Read a block's gradients into its state, and add those of the background, lane by lane, to `background`.
template <int C>
inline void read_block(const Camera& view, const Splats& splats, const FrameData& frame, const Gradients& grads,
                       int tile, int index, const Block& block, float* state, Real* background) {
  const int channels = C ? C : splats.channels;
  const std::size_t kept = static_cast<std::size_t>(tile) * kTilePixels + index * W;
  const Real remaining = load(frame.transmittances + kept), last = load(frame.last + kept);
  alignas(64) float alpha[W];
  store(alpha, 0.0f);
  for (int c = 0; c < channels; ++c) store(state + (kBack + c) * W, 0.0f);
  const int columns = view.width - block.left < kBlockWidth ? view.width - block.left : kBlockWidth;
  const int rows = view.height - block.top < kBlockHeight ? view.height - block.top : kBlockHeight;
  for (int row = 0; row < rows; ++row) {
    const std::size_t pixel = static_cast<std::size_t>(block.top + row) * view.width + block.left;
    const float* image = grads.image + pixel * channels;
    for (int column = 0; column < columns; ++column) {
      alpha[row * kBlockWidth + column] = grads.alpha[pixel + column];
      for (int c = 0; c < channels; ++c)
        state[(kBack + c) * W + row * kBlockWidth + column] = image[column * channels + c];
    }
  }
  Real through = Real(0.0f) - load(alpha);
  for (int c = 0; c < channels; ++c) {
    const Real g = load(state + (kBack + c) * W);
    through = fma(g, splats.background[c], through);
    background[c] = fma(g, remaining, background[c]);
  }
  store(state + kBehind * W, through * remaining);
  store(state + kTransmittance * W, remaining);
  store(state + kStart * W, last);
}

template <int C>
inline void draw_tile_backward_with(const Camera& view, const Splats& splats, const FrameData& frame,
                                    const Gradients& grads, int tile, float* scratch) {
  const int channels = C ? C : splats.channels, state_floats = (kBack + channels) * W;
  const int width = gradient_stride(channels);
  float* states = scratch;
  float* spare = states + kBlocks * state_floats;
  Chunk chunk;
  chunk.params = spare + width;

  // The next tile's gradients come while this one is worked on.
  prefetch_tile(view, grads.image, channels, tile + 1);
  prefetch_tile(view, grads.alpha, 1, tile + 1);
  Real background[C ? C : kChannelsMax];
  for (int c = 0; c < channels; ++c) background[c] = 0.0f;
  for (int b = 0; b < kBlocks; ++b) {
    const Block block = block_of(view, tile, b);
    float* state = states + b * state_floats;
    if (any(block.inside)) read_block<C>(view, splats, frame, grads, tile, b, block, state, background);
    else store(state + kStart * W, -1.0f);
  }
  for (int c = 0; c < channels; ++c) {
    alignas(64) float lanes[W];
    store(lanes, background[c]);
    double sum = 0.0;
    for (int lane = 0; lane < W; ++lane) sum += lanes[lane];
    grads.background[static_cast<std::size_t>(tile) * channels + c] = sum;
  }

  float* records = grads.records + static_cast<std::size_t>(frame.tile_begin[tile]) * width;
  const int count = static_cast<int>(frame.tile_begin[tile + 1] - frame.tile_begin[tile]);
  for (int begin = (count - 1) / kChunk * kChunk; begin >= 0 && count; begin -= kChunk) {
    const int end = begin + kChunk < count ? begin + kChunk : count;
    const Real first = static_cast<float>(begin);
    std::uint64_t wanted = 0;
    for (int b = 0; b < kBlocks; ++b)
      if (any(load(states + b * state_floats + kStart * W) >= first)) wanted |= std::uint64_t{1} << b;
    float* sums = records + static_cast<std::size_t>(begin) * width;
    for (int i = 0; i < (end - begin) * width; i += W) store(sums + i, 0.0f);
    if (!wanted) continue;
    fill_chunk<C>(view, splats, frame, tile, begin, end, wanted, chunk);
    for (int b = 0; b < kBlocks; ++b)
      if (chunk.reaches(b))
        composite_block_backward<C>(view, chunk, b, block_of(view, tile, b), channels, states + b * state_floats, sums,
                                    spare);
  }
}

inline void draw_tile_backward(const Camera& view, const Splats& splats, const FrameData& frame,
                               const Gradients& grads, int tile, float* scratch) {
  if (splats.channels == 3) draw_tile_backward_with<3>(view, splats, frame, grads, tile, scratch);
  else draw_tile_backward_with<0>(view, splats, frame, grads, tile, scratch);
}

}  // namespace headbench::HEADBENCH_ISA

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

// Floats per gradient record, with or without the absolute gradients.
constexpr int gradient_stride(int channels, bool absolute) {
  return (kMoments + channels + (absolute ? kAbsolutes : 0) + W - 1) / W * W;
}

inline std::size_t backward_scratch(int channels) {
  return chunk_floats(channels) + static_cast<std::size_t>(kBlocks) * (kBack + channels) * W +
         static_cast<std::size_t>(kChunk + 1) * gradient_stride(channels, true);
}

// Pixels' v and w of up to W splats, kept until they can be summed over pixels for W splats at once; and what the
// absolute gradients are sums of.
template <bool Absolute>
struct Batch {
  alignas(64) float v[W * W], w[W * W];
  alignas(64) float absolute[kAbsolutes][Absolute ? W * W : 1];
  alignas(64) float mean_x[W], mean_y[W];
  float* target[W];
  int used = 0;
};

// Sum the batch over the block's pixels and add to the splats' gradient records. In a transposed batch a lane
// is a splat and every pixel is one vector, so that the sums are plain vector arithmetic.
template <int C, bool Absolute>
inline void flush(Batch<Absolute>& batch, const Block& block, int channels, const float* colors, float* spare) {
  const int count = C ? C : channels, width = gradient_stride(count, Absolute);
  for (int i = batch.used; i < W; ++i) {
    store(batch.v + i * W, 0.0f);
    store(batch.w + i * W, 0.0f);
    if constexpr (Absolute)
      for (int k = 0; k < kAbsolutes; ++k) store(batch.absolute[k] + i * W, 0.0f);
    batch.mean_x[i] = batch.mean_y[i] = 0.0f;
    batch.target[i] = spare;
  }
  batch.used = 0;

  constexpr int kRoom = gradient_stride(C ? C : kChannelsMax, Absolute);
  alignas(64) float sums[kRoom * W];
  Real pixels[W];
  load_transposed(batch.v, pixels);
  // Moments about the block's centre first: small numbers, so that moving them to the mean loses nothing.
  Real m = 0.0f, mx = 0.0f, my = 0.0f, mxx = 0.0f, mxy = 0.0f, myy = 0.0f;
  for (int row = 0; row < kBlockHeight; ++row) {
    const Real* v = pixels + kBlockWidth * row;
    const Real outer = v[0] + v[3], inner = v[1] + v[2], s = outer + inner;
    const Real sx = fma(1.5f, v[3] - v[0], Real(0.5f) * (v[2] - v[1]));
    const float y = static_cast<float>(row) - 0.5f * (kBlockHeight - 1);
    m = m + s;
    mx = mx + sx;
    my = fma(y, s, my);
    mxx = fma(2.25f, outer, fma(0.25f, inner, mxx));
    mxy = fma(y, sx, mxy);
    myy = fma(y * y, s, myy);
  }
  const Real ox = Real(static_cast<float>(block.left) + 0.5f * kBlockWidth) - load(batch.mean_x);
  const Real oy = Real(static_cast<float>(block.top) + 0.5f * kBlockHeight) - load(batch.mean_y);
  const Real dx = fma(ox, m, mx), dy = fma(oy, m, my);
  store(sums + kSum * W, m);
  store(sums + kSumX * W, dx);
  store(sums + kSumY * W, dy);
  store(sums + kSumXX * W, fma(ox, mx + dx, mxx));
  store(sums + kSumXY * W, fma(ox, my, fma(oy, dx, mxy)));
  store(sums + kSumYY * W, fma(oy, my + dy, myy));

  load_transposed(batch.w, pixels);
  for (int c = 0; c < count; ++c) {
    Real even = 0.0f, odd = 0.0f;
    for (int lane = 0; lane < W; lane += 2) {
      even = fma(pixels[lane], colors[c * W + lane], even);
      odd = fma(pixels[lane + 1], colors[c * W + lane + 1], odd);
    }
    store(sums + (kMoments + c) * W, even + odd);
  }
  if constexpr (Absolute)
    for (int k = 0; k < kAbsolutes; ++k) {
      load_transposed(batch.absolute[k], pixels);
      Real sum = pixels[0];
      for (int lane = 1; lane < W; ++lane) sum = sum + pixels[lane];
      store(sums + (kMoments + count + k) * W, sum);
    }
  for (int k = kMoments + count + (Absolute ? kAbsolutes : 0); k < width; ++k) store(sums + k * W, 0.0f);

  for (int part = 0; part < width; part += W) {
    load_transposed(sums + part * W, pixels);
    for (int i = 0; i < W; ++i) store(batch.target[i] + part, load(batch.target[i] + part) + pixels[i]);
  }
}

// Walk one block's list from its end; `gradients` are the chunk's records, row by row, and one spare.
template <int C, bool Absolute>
inline void composite_block_backward(const Chunk& chunk, int index, const Block& block, int channels,
                                     float* state, float* gradients, int gradient_floats) {
  constexpr int kColors = C ? C : 1;
  const int count = C ? C : channels;
  const std::uint16_t* list = chunk.list + index * kChunk;
  const float* colors = state + kBack * W;
  Real transmittance = load(state + kTransmittance * W), behind = load(state + kBehind * W);
  const Real start = load(state + kStart * W);
  Real g[kColors];
  if constexpr (C != 0)
    for (int c = 0; c < C; ++c) g[c] = load(colors + c * W);
  Batch<Absolute> batch;
  for (int i = chunk.listed[index] - 1; i >= 0; --i) {
    const float* row = chunk.params + list[i] * chunk.stride;
    const Mask reached = start >= Real(row[kGeometry + count]);
    const Alpha a = alpha_of(row, block);
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
    store(batch.v + batch.used * W, value);
    if constexpr (Absolute) {
      store(batch.absolute[0] + batch.used * W, absolute(value * a.u));
      const Real along_y = fma(row[kL21], a.u, Real(row[kL22]) * a.v);
      store(batch.absolute[1] + batch.used * W, absolute(value * along_y));
    }
    store(batch.w + batch.used * W, weight);
    batch.mean_x[batch.used] = row[kMeanX];
    batch.mean_y[batch.used] = row[kMeanY];
    batch.target[batch.used] = gradients + list[i] * gradient_floats;
    if (++batch.used == W) flush<C, Absolute>(batch, block, channels, colors, gradients + kChunk * gradient_floats);
  }
  if (batch.used) flush<C, Absolute>(batch, block, channels, colors, gradients + kChunk * gradient_floats);
  store(state + kTransmittance * W, transmittance);
  store(state + kBehind * W, behind);
}

// Read a block's gradients into its state; gives the index of the last splat any of its pixels drew, or -1.
inline int read_block(const View& view, const Splats& splats, const FrameData& frame, const Gradients& grads,
                      int tile, int index, const Block& block, float* state, double* background) {
  const int channels = splats.channels;
  const float* remaining = frame.transmittances + static_cast<std::size_t>(tile) * kTilePixels + index * W;
  const float* last = frame.last + static_cast<std::size_t>(tile) * kTilePixels + index * W;
  for (int c = 0; c < channels; ++c) store(state + (kBack + c) * W, 0.0f);
  store(state + kBehind * W, 0.0f);
  store(state + kTransmittance * W, load(remaining));
  store(state + kStart * W, load(last));
  const int columns = view.width - block.left < kBlockWidth ? view.width - block.left : kBlockWidth;
  const int rows = view.height - block.top < kBlockHeight ? view.height - block.top : kBlockHeight;
  float furthest = -1.0f;
  for (int row = 0; row < rows; ++row) {
    const std::size_t pixel = static_cast<std::size_t>(block.top + row) * view.width + block.left;
    for (int column = 0; column < columns; ++column) {
      const int lane = row * kBlockWidth + column;
      const float* image = grads.image + (pixel + column) * channels;
      float through = -grads.alpha[pixel + column];
      for (int c = 0; c < channels; ++c) {
        state[(kBack + c) * W + lane] = image[c];
        through += image[c] * splats.background[c];
        background[c] += static_cast<double>(image[c]) * remaining[lane];
      }
      state[kBehind * W + lane] = through * remaining[lane];
      furthest = last[lane] > furthest ? last[lane] : furthest;
    }
  }
  return static_cast<int>(furthest);
}

template <int C, bool Absolute>
inline void draw_tile_backward_with(const View& view, const Splats& splats, const FrameData& frame,
                                    const Gradients& grads, int tile, float* scratch) {
  const int channels = splats.channels, state_floats = (kBack + channels) * W, stride = grads.entry_stride;
  float* states = scratch;
  float* sums = states + kBlocks * state_floats;
  float* chunk_scratch = sums + (kChunk + 1) * stride;

  double* background = grads.background + static_cast<std::size_t>(tile) * channels;
  for (int c = 0; c < channels; ++c) background[c] = 0.0;
  int furthest[kBlocks];
  for (int b = 0; b < kBlocks; ++b) {
    const Block block = block_of(view, tile, b);
    furthest[b] = any(block.inside) ? read_block(view, splats, frame, grads, tile, b, block,
                                                 states + b * state_floats, background)
                                    : -1;
  }

  const Pair* pairs = frame.pairs + frame.tile_begin[tile];
  const int count = static_cast<int>(frame.tile_begin[tile + 1] - frame.tile_begin[tile]);
  for (int begin = (count - 1) / kChunk * kChunk; begin >= 0 && count; begin -= kChunk) {
    const int end = begin + kChunk < count ? begin + kChunk : count;
    std::uint64_t wanted = 0;
    for (int b = 0; b < kBlocks; ++b)
      if (furthest[b] >= begin) wanted |= std::uint64_t{1} << b;
    for (int i = 0; i < (end - begin) * stride; i += W) store(sums + i, 0.0f);
    if (wanted) {
      Chunk chunk;
      fill_chunk(splats, frame, pairs, begin, end, wanted, chunk_scratch, chunk);
      for (int b = 0; b < kBlocks; ++b)
        if (chunk.listed[b])
          composite_block_backward<C, Absolute>(chunk, b, block_of(view, tile, b), channels, states + b * state_floats,
                                      sums, stride);
    }
    for (int i = begin; i < end; ++i) {
      float* entry = grads.entries + static_cast<std::size_t>(pairs[i].entry) * stride;
      for (int k = 0; k < stride; k += W) store(entry + k, load(sums + (i - begin) * stride + k));
    }
  }
}

template <bool Absolute>
inline void draw_tile_backward_as(const View& view, const Splats& splats, const FrameData& frame,
                               const Gradients& grads, int tile, float* scratch) {
  switch (splats.channels) {
    case 1: return draw_tile_backward_with<1, Absolute>(view, splats, frame, grads, tile, scratch);
    case 3: return draw_tile_backward_with<3, Absolute>(view, splats, frame, grads, tile, scratch);
    case 4: return draw_tile_backward_with<4, Absolute>(view, splats, frame, grads, tile, scratch);
    default: return draw_tile_backward_with<0, Absolute>(view, splats, frame, grads, tile, scratch);
  }
}

inline void draw_tile_backward(const View& view, const Splats& splats, const FrameData& frame,
                               const Gradients& grads, int tile, float* scratch) {
  if (grads.means2d_abs) return draw_tile_backward_as<true>(view, splats, frame, grads, tile, scratch);
  draw_tile_backward_as<false>(view, splats, frame, grads, tile, scratch);
}

}  // namespace headbench::HEADBENCH_ISA

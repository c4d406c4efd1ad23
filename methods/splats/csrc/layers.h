// Layers of small networks for a few splats at a time.
#pragma once

#include "projection.h"

namespace headbench::HEADBENCH_ISA {

constexpr int kSplatGroup = 8;                   // splats
constexpr int kColumnVectors = W == 16 ? 2 : 1;  // a group's accumulators fit into the registers
static_assert(kUnitsStep % W == 0);

template <int vectors>
HEADBENCH_INLINE void dense_columns(const float* const* starts, const float* weights, int width, const float* inputs,
                                    int stride, const std::int32_t* rows, int count, int column, float* out) {
  Real sums[kSplatGroup][vectors];
  for (int s = 0; s < kSplatGroup; ++s)
    for (int v = 0; v < vectors; ++v) sums[s][v] = load(starts[s] + column + v * W);
  for (int i = 0; i < count; ++i) {
    const float* row = weights + static_cast<std::size_t>(rows[i]) * width + column;
    Real weight[vectors];
    for (int v = 0; v < vectors; ++v) weight[v] = load(row + v * W);
    for (int s = 0; s < kSplatGroup; ++s) {
      const Real value = inputs[i * stride + s];
      for (int v = 0; v < vectors; ++v) sums[s][v] = fma(value, weight[v], sums[s][v]);
    }
  }
  for (int s = 0; s < kSplatGroup; ++s)
    for (int v = 0; v < vectors; ++v) store(out + s * width + column + v * W, max(sums[s][v], 0.0f));
}

// relu(start + sum over i of input i times row rows[i] of the weights), `width` numbers for each splat of a group.
// Splat s finds input i at inputs[i stride + s].
inline void dense_layer(const float* const* starts, const float* weights, int width, const float* inputs, int stride,
                        const std::int32_t* rows, int count, float* out) {
  int column = 0;
  for (; column + kColumnVectors * W <= width; column += kColumnVectors * W)
    dense_columns<kColumnVectors>(starts, weights, width, inputs, stride, rows, count, column, out);
  for (; column < width; column += W)
    dense_columns<1>(starts, weights, width, inputs, stride, rows, count, column, out);
}

// Products of each row of a group, `width` numbers, with the same weights.
HEADBENCH_INLINE void dots(const float* rows, const float* weights, int width, float* out) {
  static_assert(kSplatGroup % 4 == 0);
  for (int s = 0; s < kSplatGroup; s += 4) {
    Real sums[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    for (int k = 0; k < width; k += W) {
      const Real weight = load(weights + k);
      for (int i = 0; i < 4; ++i) sums[i] = fma(load(rows + (s + i) * width + k), weight, sums[i]);
    }
    transpose_quads(sums);
    alignas(64) float lanes[W];
    store(lanes, (sums[0] + sums[1]) + (sums[2] + sums[3]));
    for (int i = 0; i < 4; ++i) {
      float sum = lanes[i];
      for (int quad = 4; quad < W; quad += 4) sum += lanes[quad + i];
      out[s + i] = sum;
    }
  }
}

}  // namespace headbench::HEADBENCH_ISA

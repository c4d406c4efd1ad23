// Small networks for a few splats at a time: offsets of splats, and their colours by direction.
#pragma once

#include "pose.h"

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

// The offset network. Most units of a trained network's first layer are off at any one splat, and neighbours share them: a
// group's second layer takes only the units that are on at one of its splats. What is left out is exactly 0.

// Floats: first layer, second layer, values of the units that are on, their largest, their numbers.
inline std::size_t offset_scratch(int units, int hidden) {
  return static_cast<std::size_t>(kSplatGroup) * (2 * units + hidden) + 2 * static_cast<std::size_t>(units) + 1;
}

// First layer of a splat after its ReLU.
HEADBENCH_INLINE void first_layer(const OffsetNetwork& net, std::int64_t splat, float* out) {
  const float* lower[3];
  Real upper_weight[3], lower_weight[3];
  for (int axis = 0; axis < 3; ++axis) {
    lower[axis] = net.table + static_cast<std::size_t>(net.rows[3 * splat + axis]) * net.units;
    upper_weight[axis] = net.fractions[3 * splat + axis];
    lower_weight[axis] = Real(1.0f) - upper_weight[axis];
  }
  for (int unit = 0; unit < net.units; unit += W) {
    Real sum = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
      sum = fma(load(lower[axis] + unit), lower_weight[axis], sum);
      sum = fma(load(lower[axis] + net.units + unit), upper_weight[axis], sum);
    }
    store(out + unit, max(sum, 0.0f));
  }
}

// Offsets of entries [begin, end); `scratch` has offset_scratch floats.
inline void offset_network(const OffsetNetwork& net, std::int64_t begin, std::int64_t end, float* scratch) {
  float* first = scratch;
  float* second = first + kSplatGroup * net.units;
  float* on = second + kSplatGroup * net.hidden;
  float* largest = on + kSplatGroup * net.units;
  std::int32_t* units = reinterpret_cast<std::int32_t*>(largest + net.units);
  for (std::int64_t start = begin; start < end; start += kSplatGroup) {
    const int used = end - start < kSplatGroup ? static_cast<int>(end - start) : kSplatGroup;
    for (int s = 0; s < kSplatGroup; ++s) first_layer(net, start + (s < used ? s : 0), first + s * net.units);
    for (int unit = 0; unit < net.units; unit += W) {
      Real most = load(first + unit);
      for (int s = 1; s < kSplatGroup; ++s) most = max(most, load(first + s * net.units + unit));
      store(largest + unit, most);
    }
    int count = 0;
    for (int unit = 0; unit < net.units; ++unit) {
      units[count] = unit;
      count += largest[unit] > 0.0f;
    }
    for (int i = 0; i < count; ++i)
      for (int s = 0; s < kSplatGroup; ++s) on[i * kSplatGroup + s] = first[s * net.units + units[i]];
    const float* starts[kSplatGroup];
    for (int s = 0; s < kSplatGroup; ++s) starts[s] = net.second_bias;
    dense_layer(starts, net.second, net.hidden, on, kSplatGroup, units, count, second);
    for (int output = 0; output < net.outputs; ++output) {
      float sums[kSplatGroup];
      dots(second, net.last + static_cast<std::size_t>(output) * net.hidden, net.hidden, sums);
      for (int s = 0; s < used; ++s)
        net.offsets[net.splats[start + s] * net.outputs + output] = sums[s] + net.last_bias[output];
    }
  }
}

constexpr int kBatch = W > kSplatGroup ? W : kSplatGroup;

// Sine and cosine of numbers in [-1, 1]: Taylor series, whose next terms are below 2e-10.
HEADBENCH_INLINE void sine_cosine(Real x, Real& sine, Real& cosine) {
  const Real square = x * x;
  sine = fma(square, -1.0f / 39916800.0f, 1.0f / 362880.0f);
  sine = fma(square, sine, -1.0f / 5040.0f);
  sine = fma(square, sine, 1.0f / 120.0f);
  sine = fma(square, sine, -1.0f / 6.0f);
  sine = fma(square * sine, x, x);
  cosine = fma(square, 1.0f / 479001600.0f, -1.0f / 3628800.0f);
  cosine = fma(square, cosine, 1.0f / 40320.0f);
  cosine = fma(square, cosine, -1.0f / 720.0f);
  cosine = fma(square, cosine, 1.0f / 24.0f);
  cosine = fma(square, cosine, -0.5f);
  cosine = fma(square, cosine, 1.0f);
}

// The encoding of methods/ours/inference.py, `encode_columns`, for the W splats in one column of `out`.
HEADBENCH_INLINE void encode(const Real* direction, float* out) {
  constexpr int kFrequencies = (kEncoding - 3) / 6;
  for (int k = 0; k < 3; ++k) {
    store(out + k * kBatch, direction[k]);
    Real sine, cosine;
    sine_cosine(direction[k], sine, cosine);
    for (int n = 0; n < kFrequencies; ++n) {
      store(out + (3 + 6 * n + k) * kBatch, sine);
      store(out + (6 + 6 * n + k) * kBatch, cosine);
      // sin 2a = 2 sin a cos a, cos 2a = 1 - 2 sin^2 a.
      const Real twice = sine + sine, next = twice * cosine;
      cosine = fnma(twice, sine, 1.0f);
      sine = next;
    }
  }
}

inline std::size_t color_scratch(int hidden) { return static_cast<std::size_t>(kSplatGroup) * hidden; }

// Colours of splats [begin, end); `scratch` has color_scratch floats.
inline void color_network(const ColorNetwork& net, std::int64_t begin, std::int64_t end, float* scratch) {
  alignas(64) float encoded[kEncoding * kBatch] = {};
  std::int32_t rows[kEncoding];
  for (int k = 0; k < kEncoding; ++k) rows[k] = k;
  for (std::int64_t first = begin; first < end; first += kBatch) {
    for (int offset = 0; offset < kBatch && first + offset < end; offset += W) {
      Real direction[3];
      directions_from(net.center, net.means, net.rotations, net.binding, first + offset,
                      lanes_used(first + offset, end), direction);
      for (int k = 0; k < 3; ++k) direction[k] = Real(0.0f) - direction[k];
      encode(direction, encoded + offset);
    }
    for (int offset = 0; offset < kBatch && first + offset < end; offset += kSplatGroup) {
      const std::int64_t splat = first + offset;
      const int used = end - splat < kSplatGroup ? static_cast<int>(end - splat) : kSplatGroup;
      const float* starts[kSplatGroup];
      for (int s = 0; s < kSplatGroup; ++s) starts[s] = net.positions + (splat + (s < used ? s : 0)) * net.hidden;
      dense_layer(starts, net.second, net.hidden, encoded + offset, kBatch, rows, kEncoding, scratch);
      for (int channel = 0; channel < 3; ++channel) {
        float sums[kSplatGroup];
        dots(scratch, net.last + channel * net.hidden, net.hidden, sums);
        for (int s = 0; s < used; ++s) {
          const float color = 0.5f + 0.28209479177387814f * sums[s];
          net.colors[3 * (splat + s) + channel] = color > 0.0f ? color : 0.0f;
        }
      }
    }
  }
}

}  // namespace headbench::HEADBENCH_ISA

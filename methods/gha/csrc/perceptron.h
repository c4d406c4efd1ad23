// Perceptrons at tiles of points, forward and backward.
#pragma once

#include "products.h"

namespace headbench::HEADBENCH_ISA {

using gha::kTileRows;
using gha::Layer;
using gha::Perceptron;

// tanh(x) to 2e-7 of it: a series near zero, and elsewhere 1 - 2 / (exp(2 |x|) + 1) with the sign of x.
HEADBENCH_INLINE Real tanh(Real x) {
  const Real size = max(x, Real(0.0f) - x), square = x * x;
  const Real power = exp2(min(size, 20.0f) * Real(2.0f * kLog2e));
  const Real far = Real(1.0f) - Real(2.0f) / (power + Real(1.0f));
  Real near = 21844.0f / 6081075.0f;
  near = fma(near, Real(0.0f) - square, 1382.0f / 155925.0f);
  near = fma(near, Real(0.0f) - square, 62.0f / 2835.0f);
  near = fma(near, Real(0.0f) - square, 17.0f / 315.0f);
  near = fma(near, Real(0.0f) - square, 2.0f / 15.0f);
  near = fma(near, Real(0.0f) - square, 1.0f / 3.0f);
  near = fma(near * (Real(0.0f) - square), x, x);
  return select(Real(0.4f) > size, near, select(x > Real(0.0f), far, Real(0.0f) - far));
}

// A tile: its place in tables of rows and of values, and rows, those used and whole blocks of them.
struct Tile {
  std::int64_t condition, first;
  int used, rows;
};

HEADBENCH_INLINE Tile tile_of(const Perceptron& net, std::int64_t tile) {
  const std::int64_t first = tile % net.tiles * kTileRows, left = net.count - first;
  const int used = left < kTileRows ? static_cast<int>(left) : kTileRows;
  return {tile / net.tiles, first, used, whole_units(used)};
}

// The inputs of a tile's points; zeros where there are none.
inline void gather(const Perceptron& net, const Tile& tile, float* out) {
  for (int r = 0; r < tile.rows; ++r) {
    float* to = out + r * net.point_stride;
    int k = 0;
    if (r < tile.used) {
      const float* from = net.points + net.rows[tile.first + r] * net.point_inputs;
      for (; k < net.point_inputs; ++k) to[k] = from[k];
    }
    for (; k < net.point_stride; ++k) to[k] = 0.0f;
  }
}

inline int widest(const Perceptron& net) {
  int most = 0;
  for (int l = 0; l < net.layers; ++l) most = net.layer[l].outputs > most ? net.layer[l].outputs : most;
  return most;
}

inline std::size_t forward_scratch(const Perceptron& net) {
  return static_cast<std::size_t>(kTileRows) * (net.point_stride + 2 * widest(net));
}

inline void forward_tile(const Perceptron& net, std::int64_t number, float* scratch) {
  const Tile tile = tile_of(net, number);
  float *points = scratch, *even = points + kTileRows * net.point_stride, *odd = even + kTileRows * widest(net);
  gather(net, tile, points);
  float* before = nullptr;
  for (int l = 0; l < net.layers; ++l) {
    const Layer& layer = net.layer[l];
    Part parts[2];
    int count = 0;
    if (layer.inputs) parts[count++] = {before, layer.inputs, 1, layer.of_hidden, layer.outputs, layer.inputs};
    if (layer.takes_points)
      parts[count++] = {points, net.point_stride, 1, layer.of_points, layer.outputs, net.point_inputs};
    const bool inner = l < net.layers - 1;
    float* out = inner && layer.kept ? layer.kept + number * kTileRows * layer.outputs : l % 2 ? odd : even;
    product(parts, count, tile.rows, layer.outputs, layer.bias + tile.condition * layer.outputs, 0, out, layer.outputs);
    const int all = tile.rows * layer.outputs;
    if (inner)
      for (int k = 0; k < all; k += W) {
        const Real value = load(out + k);
        store(out + k, max(value, Real(net.slope) * value));
      }
    else if (net.squashed)
      for (int k = 0; k < all; k += W) store(out + k, tanh(load(out + k)));
    before = out;
  }
  const int stride = net.layer[net.layers - 1].outputs;
  float* values = net.values + (tile.condition * net.count + tile.first) * net.outputs;
  for (int r = 0; r < tile.used; ++r) {
    for (int k = 0; k < net.outputs; ++k) values[r * net.outputs + k] = before[r * stride + k];
    if (net.influence) {
      const float share = net.influence[tile.first + r];
      float* to = net.total + net.rows[tile.first + r] * net.outputs;
      for (int k = 0; k < net.outputs; ++k) to[k] += share * values[r * net.outputs + k];
    }
  }
}

inline std::size_t backward_scratch(const Perceptron& net) {
  return static_cast<std::size_t>(kTileRows) * 2 * (net.point_stride + widest(net));
}

// Gradient by the last layer before its activation, zeros where there is nothing, and that by influence.
inline void gradient_of_values(const Perceptron& net, const Tile& tile, float* out) {
  const int stride = net.layer[net.layers - 1].outputs;
  const float* values = net.values + (tile.condition * net.count + tile.first) * net.outputs;
  fill_zero(out, static_cast<std::int64_t>(tile.rows) * stride);
  for (int r = 0; r < tile.used; ++r) {
    const std::int64_t entry = tile.first + r;
    const float* by = net.by_values + net.outputs * (net.influence ? net.rows[entry] : tile.condition * net.count + entry);
    float share = 1.0f;
    if (net.influence) {
      share = net.influence[entry];
      float sum = 0.0f;
      for (int k = 0; k < net.outputs; ++k) sum += by[k] * values[r * net.outputs + k];
      net.by_influence[entry] = sum;
    }
    for (int k = 0; k < net.outputs; ++k) {
      const float value = values[r * net.outputs + k];
      out[r * stride + k] = share * by[k] * (net.squashed ? 1.0f - value * value : 1.0f);
    }
  }
}

inline void backward_tile(const Perceptron& net, std::int64_t number, float* sums, float* scratch) {
  const Tile tile = tile_of(net, number);
  float* points = scratch;
  float* by_points = points + kTileRows * net.point_stride;
  float* by_out = by_points + kTileRows * net.point_stride;
  float* by_in = by_out + kTileRows * widest(net);
  gather(net, tile, points);
  gradient_of_values(net, tile, by_out);
  bool points_begun = false;
  for (int l = net.layers - 1; l >= 0; --l) {
    const Layer& layer = net.layer[l];
    float* by_bias = net.by_biases + number * net.bias_floats + layer.bias_sums;
    for (int k = 0; k < layer.outputs; k += W) {
      Real sum = 0.0f;
      for (int r = 0; r < tile.rows; ++r) sum = sum + load(by_out + r * layer.outputs + k);
      store(by_bias + k, sum);
    }
    if (layer.takes_points) {
      float* to = sums + layer.point_sums;
      const Part of_weights = {by_out, 1, layer.outputs, points, net.point_stride, tile.rows};
      product(&of_weights, 1, layer.outputs, net.point_stride, to, net.point_stride, to, net.point_stride);
      if (net.by_points) {
        const Part of_points = {by_out, layer.outputs, 1, layer.of_points, net.point_stride, layer.outputs};
        product(&of_points, 1, tile.rows, net.point_stride, points_begun ? by_points : nullptr, net.point_stride,
                by_points, net.point_stride);
        points_begun = true;
      }
    }
    if (!layer.inputs) break;
    const float* before = net.layer[l - 1].kept + number * kTileRows * layer.inputs;
    float* to = sums + layer.hidden_sums;
    const Part of_weights = {by_out, 1, layer.outputs, before, layer.inputs, tile.rows};
    product(&of_weights, 1, layer.outputs, layer.inputs, to, layer.inputs, to, layer.inputs);
    const Part of_inputs = {by_out, layer.outputs, 1, layer.of_hidden, layer.inputs, layer.outputs};
    product(&of_inputs, 1, tile.rows, layer.inputs, nullptr, 0, by_in, layer.inputs);
    for (int k = 0; k < tile.rows * layer.inputs; k += W) {
      const Real gradient = load(by_in + k);
      store(by_in + k, select(load(before + k) > Real(0.0f), gradient, Real(net.slope) * gradient));
    }
    float* swap = by_out;
    by_out = by_in;
    by_in = swap;
  }
  if (net.by_points)
    for (int r = 0; r < tile.used; ++r) {
      float* to = net.by_points + net.rows[tile.first + r] * net.point_inputs;
      for (int k = 0; k < net.point_inputs; ++k) to[k] += by_points[r * net.point_stride + k];
    }
}

inline void nearest(const float* points, const float* landmarks, std::int64_t landmark_count, std::int64_t begin,
                    std::int64_t end, std::int32_t* found, float* squared) {
  for (std::int64_t first = begin; first < end; first += W) {
    alignas(64) float at[3][W], numbers[W], distances[W];
    const int used = end - first < W ? static_cast<int>(end - first) : W;
    for (int lane = 0; lane < W; ++lane)
      for (int k = 0; k < 3; ++k) at[k][lane] = points[3 * (first + (lane < used ? lane : 0)) + k];
    const Real x = load(at[0]), y = load(at[1]), z = load(at[2]);
    Real least = 3.0e38f, number = 0.0f;
    for (std::int64_t l = 0; l < landmark_count; ++l) {
      const Real dx = x - Real(landmarks[3 * l]), dy = y - Real(landmarks[3 * l + 1]), dz = z - Real(landmarks[3 * l + 2]);
      const Real distance = fma(dx, dx, fma(dy, dy, dz * dz));
      number = select(least > distance, static_cast<float>(l), number);
      least = min(least, distance);
    }
    store(numbers, number);
    store(distances, least);
    for (int lane = 0; lane < used; ++lane) {
      found[first + lane] = static_cast<std::int32_t>(numbers[lane]);
      squared[first + lane] = distances[lane];
    }
  }
}

// Sine and cosine to 1e-7, of numbers up to some thousands.
HEADBENCH_INLINE void sine_cosine(Real x, Real& sine, Real& cosine) {
  // The nearest multiple of a quarter turn, taken away in three parts.
  Real rest;
  const Real quarters = round(x * Real(0.636619772f), rest);
  Real r = fnma(quarters, 1.5703125f, x);
  r = fnma(quarters, 4.837512969970703125e-4f, r);
  r = fnma(quarters, 7.54978995489188216e-8f, r);
  const Real square = r * r;
  Real s = 1.0f / 362880.0f, c = -1.0f / 3628800.0f;
  s = fma(s, square, -1.0f / 5040.0f);
  s = fma(s, square, 1.0f / 120.0f);
  s = fma(s, square, -1.0f / 6.0f);
  s = fma(s * square, r, r);
  c = fma(c, square, 1.0f / 40320.0f);
  c = fma(c, square, -1.0f / 720.0f);
  c = fma(c, square, 1.0f / 24.0f);
  c = fma(c, square, -0.5f);
  c = fma(c, square, 1.0f);
  const Real quadrant = fnma(floor(quarters * Real(0.25f)), 4.0f, quarters) - Real(2.0f);  // -2 to 1
  const Real apart = quadrant * quadrant;
  const Mask odd = (apart > Real(0.5f)) & (Real(1.5f) > apart);
  const Mask middle = (quadrant > Real(-1.5f)) & (Real(0.5f) > quadrant);
  sine = select(odd, c, s);
  sine = select(quadrant > Real(-0.5f), Real(0.0f) - sine, sine);
  cosine = select(odd, s, c);
  cosine = select(middle, Real(0.0f) - cosine, cosine);
}

inline void encode(const float* points, std::int64_t begin, std::int64_t end, float* encoded) {
  constexpr int kEncoding = gha::kEncoding;
  alignas(64) float columns[kEncoding][W];
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = end - first < W ? static_cast<int>(end - first) : W;
    for (int lane = 0; lane < W; ++lane)
      for (int k = 0; k < 3; ++k) columns[k][lane] = points[3 * (first + (lane < used ? lane : 0)) + k];
    for (int k = 0; k < 3; ++k) {
      float frequency = 1.0f;
      for (int wave = 3; wave < kEncoding; wave += 6, frequency *= 2.0f) {
        Real sine, cosine;
        sine_cosine(load(columns[k]) * Real(frequency), sine, cosine);
        store(columns[wave + k], sine);
        store(columns[wave + 3 + k], cosine);
      }
    }
    for (int lane = 0; lane < used; ++lane) {
      float* to = encoded + (first + lane) * kEncoding;
      for (int k = 0; k < kEncoding; ++k) to[k] = columns[k][lane];
    }
  }
}

inline void encode_backward(const float* encoded, const float* by_encoded, std::int64_t begin, std::int64_t end,
                            float* by_points) {
  for (std::int64_t i = begin; i < end; ++i) {
    const float *values = encoded + i * gha::kEncoding, *by = by_encoded + i * gha::kEncoding;
    for (int k = 0; k < 3; ++k) {
      float sum = by[k], frequency = 1.0f;
      for (int wave = 3; wave < gha::kEncoding; wave += 6, frequency *= 2.0f)
        sum += frequency * (by[wave + k] * values[wave + 3 + k] - by[wave + 3 + k] * values[wave + k]);
      by_points[3 * i + k] = sum;
    }
  }
}

}  // namespace headbench::HEADBENCH_ISA

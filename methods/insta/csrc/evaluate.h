// The field at canonical points, one sample to a lane.
//
// The formulas are those of field.py.
#pragma once

#include "bench/native/spherical_harmonics.h"
#include "field.h"

namespace headbench::HEADBENCH_ISA {

using insta::kDirections;
using insta::Field;
using insta::Layer;
using insta::Level;
using insta::Network;

constexpr int kVectors = 2;                    // of samples at a time: independent sums hide the latency
constexpr int kOutputs = W == 16 ? 8 : 4;      // of a layer at a time: their sums fit into the registers
constexpr int G = kVectors * W;
constexpr float kLogDensityMax = 15.0f;
static_assert(insta::kGroupMax % G == 0);

HEADBENCH_INLINE Real exponential(Real x) { return exp2(min(Real(kLog2e) * x, 126.0f)); }

// The cells that samples lie in on one level.
struct Cells {
  alignas(64) std::uint32_t cell[3][G];
  alignas(64) float part[3][G];
  alignas(64) std::uint32_t row[8][G];  // of the corners
  alignas(64) float weight[8][G];
};

inline void find_cells(const Level& level, const float (*at)[G], Cells& cells) {
  for (int axis = 0; axis < 3; ++axis)
    for (int lane = 0; lane < G; ++lane) {
      const float scaled = at[axis][lane] * level.scale;
      const auto below = static_cast<std::int32_t>(scaled);  // not negative
      cells.cell[axis][lane] = static_cast<std::uint32_t>(below);
      cells.part[axis][lane] = scaled - static_cast<float>(below);
    }
}

inline void find_corner(const Level& level, int corner, Cells& cells) {
  const auto side = static_cast<std::uint32_t>(level.resolution);
  const auto rows = static_cast<std::uint32_t>(level.count);
  const std::uint32_t up[3] = {corner & 1u, corner >> 1 & 1u, corner >> 2 & 1u};
  const bool dense = static_cast<std::uint64_t>(side) * side * side <= rows;
  for (int lane = 0; lane < G; ++lane) {
    const std::uint32_t x = cells.cell[0][lane] + up[0], y = cells.cell[1][lane] + up[1];
    const std::uint32_t z = cells.cell[2][lane] + up[2];
    // Beyond the last sample by one cell at most, where the weight is zero: less than `rows` too far.
    const std::uint32_t flat = x + side * (y + side * z);
    const std::uint32_t wrapped = flat < rows ? flat : flat - rows;
    const std::uint32_t mixed = (x ^ y * 2654435761u ^ z * 805459861u) & (rows - 1);
    cells.row[corner][lane] = dense ? wrapped : mixed;
    float weight = 1;
    for (int axis = 0; axis < 3; ++axis)
      weight *= up[axis] ? cells.part[axis][lane] : 1 - cells.part[axis][lane];
    cells.weight[corner][lane] = weight;
  }
}

// (levels features, G) values at (3, G) positions in [0, 1].
template <int features>
inline void encode_group(const Field& field, const float (*at)[G], float* out) {
  typedef float Row __attribute__((vector_size(features * sizeof(float))));
  Cells cells;
  for (int number = 0; number < field.level_count; ++number) {
    const Level& level = field.levels[number];
    find_cells(level, at, cells);
    for (int corner = 0; corner < 8; ++corner) find_corner(level, corner, cells);
    const float* table = field.table + level.first * features;
    alignas(64) float sums[G][features];
    for (int lane = 0; lane < G; ++lane) {
      Row sum = {};
      for (int corner = 0; corner < 8; ++corner) {
        Row row;
        __builtin_memcpy(&row, table + static_cast<std::size_t>(cells.row[corner][lane]) * features, sizeof row);
        sum += cells.weight[corner][lane] * row;
      }
      __builtin_memcpy(sums[lane], &sum, sizeof sum);
    }
    for (int f = 0; f < features; ++f, out += G)
      for (int lane = 0; lane < G; ++lane) out[lane] = sums[lane][f];
  }
}

inline void encode_group(const Field& field, const float (*at)[G], float* out) {
  switch (field.features) {
    case 1: return encode_group<1>(field, at, out);
    case 2: return encode_group<2>(field, at, out);
    case 4: return encode_group<4>(field, at, out);
    default: return encode_group<8>(field, at, out);
  }
}

// (N, levels features) values at (N, 3) positions in [0, 1].
inline void encode(const Field& field, const float* positions, std::int64_t count, float* out, float* buffer) {
  const int width = field.features * field.level_count;
  for (std::int64_t first = 0; first < count; first += G) {
    const int lanes = static_cast<int>(count - first < G ? count - first : G);
    alignas(64) float at[3][G] = {};
    for (int lane = 0; lane < lanes; ++lane)
      for (int axis = 0; axis < 3; ++axis) {
        const float value = positions[3 * (first + lane) + axis];
        at[axis][lane] = value > 0 ? value < 1 ? value : 1 : 0;  // NaN must not leave the table either
      }
    encode_group(field, at, buffer);
    for (int lane = 0; lane < lanes; ++lane)
      for (int i = 0; i < width; ++i) out[(first + lane) * width + i] = buffer[i * G + lane];
  }
}

// A few outputs of a layer from (inputs, G) values. `start` gives the sums to begin with, by output and vector.
template <int outputs, class Start>
HEADBENCH_INLINE void dense_outputs(const Layer& layer, int inputs, const float* in, int first, const Start& start,
                                    bool rectified, float* out) {
  Real sums[outputs][kVectors];
  for (int o = 0; o < outputs; ++o)
    for (int v = 0; v < kVectors; ++v) sums[o][v] = start(first + o, v);
  const float* weights = layer.weights + static_cast<std::size_t>(first) * layer.inputs;
  for (int i = 0; i < inputs; ++i) {
    Real values[kVectors];
    for (int v = 0; v < kVectors; ++v) values[v] = load(in + i * G + v * W);
    for (int o = 0; o < outputs; ++o) {
      const Real weight = weights[static_cast<std::size_t>(o) * layer.inputs + i];
      for (int v = 0; v < kVectors; ++v) sums[o][v] = fma(weight, values[v], sums[o][v]);
    }
  }
  for (int o = 0; o < outputs; ++o)
    for (int v = 0; v < kVectors; ++v)
      store(out + (first + o) * G + v * W, rectified ? max(sums[o][v], 0.0f) : sums[o][v]);
}

template <class Start>
inline void dense(const Layer& layer, int inputs, const float* in, const Start& start, bool rectified, float* out) {
  int first = 0;
  for (; first + kOutputs <= layer.outputs; first += kOutputs)
    dense_outputs<kOutputs>(layer, inputs, in, first, start, rectified, out);
  for (; first + 2 <= layer.outputs; first += 2) dense_outputs<2>(layer, inputs, in, first, start, rectified, out);
  for (; first < layer.outputs; ++first) dense_outputs<1>(layer, inputs, in, first, start, rectified, out);
}

// A network's outputs in `last`; `even` and `odd` take turns to hold what is between.
template <class Start>
inline void network(const Network& net, int inputs, const float* in, const Start& start, float* even, float* odd,
                    float* last) {
  const auto zero = [](int, int) { return Real(0.0f); };
  for (int number = 0; number < net.count; ++number) {
    const Layer& layer = net.layers[number];
    const bool ends = number + 1 == net.count;
    float* out = ends ? last : number % 2 ? odd : even;
    if (number == 0)
      dense(layer, inputs, in, start, !ends, out);
    else
      dense(layer, layer.inputs, in, zero, !ends, out);
    in = out;
  }
}

inline int widest(const Field& field) {
  int width = field.features * field.level_count;
  for (int which = 0; which < 2; ++which) {
    const Network& net = which ? field.color : field.density;
    for (int number = 0; number < net.count; ++number) {
      const Layer& layer = net.layers[number];
      width = layer.inputs > width ? layer.inputs : width;
      width = layer.outputs > width ? layer.outputs : width;
    }
  }
  return width;
}

inline std::size_t scratch(const Field& field) { return static_cast<std::size_t>(4) * widest(field) * G; }

inline void evaluate(const Field& field, const float* starts, float step, const insta::Points& points,
                     std::int64_t count, const insta::Values& values, float* buffer) {
  const int width = widest(field), units = field.density.layers[0].outputs;
  const int latent = field.density.layers[field.density.count - 1].outputs;
  float *encoded = buffer, *even = encoded + width * G, *odd = even + width * G, *seen = odd + width * G;
  const int features = field.features * field.level_count;
  const Real inverse = 1 / field.side;
  for (std::int64_t first = 0; first < count; first += G) {
    alignas(64) float at[3][G];
    for (int axis = 0; axis < 3; ++axis)
      for (int v = 0; v < kVectors; ++v) {
        const Real inside = (load(points.position[axis] + first + v * W) - Real(field.low[axis])) * inverse;
        store(at[axis] + v * W, min(max(inside, 0.0f), 1.0f));
      }
    encode_group(field, at, encoded);
    Mask mouth[kVectors];
    for (int v = 0; v < kVectors; ++v) mouth[v] = load(points.mouth + first + v * W) > Real(0.0f);
    const auto start = [&](int output, int v) { return select(mouth[v], starts[units + output], starts[output]); };
    network(field.density, features, encoded, start, even, odd, seen);
    for (int v = 0; v < kVectors; ++v) {
      const Real away = load(points.away + first + v * W) / Real(field.scale);
      const Real prior = Real(field.bias) - min(away, field.depth);
      const Real density = exponential(min(load(seen + v * W) + prior, kLogDensityMax));
      store(values.left + first + v * W, exponential(Real(-step) * density));
      Real direction[3], basis[kDirections - 1];
      for (int axis = 0; axis < 3; ++axis) direction[axis] = load(points.direction[axis] + first + v * W);
      harmonics_basis<3>(direction[0], direction[1], direction[2], basis);
      float* to = seen + latent * G + v * W;
      store(to, 0.28209479177387814f);
      for (int k = 1; k < kDirections; ++k) store(to + k * G, basis[k - 1]);
    }
    const auto zero = [](int, int) { return Real(0.0f); };
    network(field.color, field.color.layers[0].inputs, seen, zero, even, odd, encoded);
    for (int channel = 0; channel < 3; ++channel)
      for (int v = 0; v < kVectors; ++v) {
        const Real value = load(encoded + channel * G + v * W);
        store(values.color[channel] + first + v * W, Real(1.0f) / (Real(1.0f) + exponential(Real(0.0f) - value)));
      }
  }
}

}  // namespace headbench::HEADBENCH_ISA

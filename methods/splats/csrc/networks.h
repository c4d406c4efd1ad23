// Small networks for tiles of splats: their offsets, and their colours by direction. Training shares what it can.
#pragma once

#include "pose.h"

namespace headbench::HEADBENCH_ISA {

static_assert(kUnitsStep % W == 0);

// Rows that go through a layer together, and with them the vectors of outputs that registers hold. Few rows, where units that
// are off are left out: each then shares its inputs with fewer others. Two are best forward, four backward.
constexpr int kSplatGroup = 8;
constexpr int kDenseGroup = W == 16 ? 8 : 4, kDenseVectors = 3;
constexpr int kSparseGroup = 4, kSparseVectors = W == 16 ? 4 : 3;
constexpr int kPairGroup = 2, kPairVectors = W == 16 ? 8 : 4;
static_assert(kNetworkTile % kSplatGroup == 0 && kSplatGroup % kSparseGroup == 0 && kSplatGroup % kPairGroup == 0);

// ---- Places on three axes ----

// Where a table is read: between two neighbouring rows on each of three axes. T is float, const or not.
template <class T>
struct Place {
  T* lower[3];
  Real lower_weight[3], upper_weight[3];
};

template <class T>
HEADBENCH_INLINE Place<T> place_of(T* table, int units, const std::int32_t* rows, const float* fractions) {
  Place<T> at;
  for (int axis = 0; axis < 3; ++axis) {
    at.lower[axis] = table + static_cast<std::size_t>(rows[axis]) * units;
    at.upper_weight[axis] = fractions[axis];
    at.lower_weight[axis] = Real(1.0f) - at.upper_weight[axis];
  }
  return at;
}

// What lies there, of the units from `unit` on, all axes added to `sum`.
HEADBENCH_INLINE Real add_place(const Place<const float>& at, int units, int unit, Real sum) {
  for (int axis = 0; axis < 3; ++axis) {
    sum = fma(load(at.lower[axis] + unit), at.lower_weight[axis], sum);
    sum = fma(load(at.lower[axis] + units + unit), at.upper_weight[axis], sum);
  }
  return sum;
}

// ---- Layers ----

// Which inputs of each group of a tile's rows a product takes.
template <int rows>
struct Lists {
  const std::int32_t* inputs;  // `stride` after one group's come the next one's
  int stride;
  int counts[kNetworkTile / rows];
};

// List the units that are on in any of some rows.
template <int rows>
HEADBENCH_INLINE int list_on(const float* values, int stride, int units, std::int32_t* list) {
  int count = 0;
  for (int unit = 0; unit < units; unit += W) {
    Real most = load(values + unit);
    for (int s = 1; s < rows; ++s) most = max(most, load(values + s * stride + unit));
    count += list_lanes(most > Real(0.0f), unit, list + count);
  }
  return count;
}

template <int rows, int vectors>
HEADBENCH_INLINE void product_columns(const float* inputs, int stride, const std::int32_t* list, int count,
                                      const float* weights, int weight_stride, const float* bias, bool relu, float* out,
                                      int out_stride) {
  Real sums[rows][vectors];
  for (int v = 0; v < vectors; ++v) {
    const Real start = bias ? load(bias + v * W) : Real(0.0f);
    for (int s = 0; s < rows; ++s) sums[s][v] = start;
  }
  for (int i = 0; i < count; ++i) {
    const float* row = weights + static_cast<std::size_t>(list[i]) * weight_stride;
    const float* input = inputs + list[i];
    Real weight[vectors];
    for (int v = 0; v < vectors; ++v) weight[v] = load(row + v * W);
    for (int s = 0; s < rows; ++s) {
      const Real value = input[s * stride];
      for (int v = 0; v < vectors; ++v) sums[s][v] = fma(value, weight[v], sums[s][v]);
    }
  }
  for (int s = 0; s < rows; ++s)
    for (int v = 0; v < vectors; ++v) store(out + s * out_stride + v * W, relu ? max(sums[s][v], 0.0f) : sums[s][v]);
}

template <int count>
struct Vectors {
  static constexpr int value = count;
};

// Call body(Vectors<n>, column) until `width` columns are done, n vectors of them at a time: `most`, or else two or one. A
// single one leaves registers idle, so that none is left over where it can be avoided.
template <int most, class Body>
HEADBENCH_INLINE void for_columns(int width, const Body& body) {
  for (int column = 0; column < width;) {
    const int left = (width - column) / W, now = left >= most && left != most + 1 ? most : left >= 2 ? 2 : 1;
    if (now == most)
      body(Vectors<most>{}, column);
    else if (now == 2)
      body(Vectors<2>{}, column);
    else
      body(Vectors<1>{}, column);
    column += now * W;
  }
}

// For the groups of a tile's rows: bias, if any, plus the listed inputs times their rows of the weights, `width` numbers
// a row, at most `most_vectors` vectors of them at a time. Some columns for all groups before the next: their weights stay in the first cache.
template <int rows, int most_vectors>
inline void product(const float* inputs, int stride, const Lists<rows>& lists, int groups, const float* weights,
                    int weight_stride, int width, const float* bias, bool relu, float* out, int out_stride) {
  for_columns<most_vectors>(width, [&](auto vectors, int column) {
    for (int group = 0; group < groups; ++group)
      product_columns<rows, decltype(vectors)::value>(
          inputs + group * rows * stride, stride, lists.inputs + group * lists.stride, lists.counts[group], weights + column,
          weight_stride, bias ? bias + column : nullptr, relu, out + group * rows * out_stride + column, out_stride);
  });
}

// The sums of the lanes of four vectors.
HEADBENCH_INLINE void sum_lanes(Real* four, float* out) {
  transpose_quads(four);
  alignas(64) float lanes[W];
  store(lanes, (four[0] + four[1]) + (four[2] + four[3]));
  for (int i = 0; i < 4; ++i) {
    out[i] = lanes[i];
    for (int quad = 4; quad < W; quad += 4) out[i] += lanes[quad + i];
  }
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
    sum_lanes(sums, out + s);
  }
}

// ---- Offsets ----

// Most units of a trained network's first layer are off at any one splat, and neighbours share them: a group's second
// layer takes only the units that are on at one of its splats. What is left out is exactly 0.

// Floats: both layers of a tile, and the units that are on in its groups.
inline std::size_t offset_scratch(const OffsetNetwork& net) {
  return static_cast<std::size_t>(kNetworkTile) * (net.units + net.hidden) + kNetworkTile / kPairGroup * net.units;
}

// First layer of an entry after its ReLU.
HEADBENCH_INLINE void first_layer(const OffsetNetwork& net, std::int64_t entry, float* out) {
  const Place<const float> at = place_of(net.table, net.units, net.rows + 3 * entry, net.fractions + 3 * entry);
  for (int unit = 0; unit < net.units; unit += W)
    store(out + unit, max(add_place(at, net.units, unit, load(net.first_bias + unit)), 0.0f));
}

// Offsets of entries [begin, end); `begin` is a multiple of kSplatGroup, and `scratch` has offset_scratch floats.
inline void offset_network(const OffsetNetwork& net, std::int64_t begin, std::int64_t end, float* scratch) {
  float* first = scratch;
  float* own = first + kNetworkTile * net.units;
  std::int32_t* list = reinterpret_cast<std::int32_t*>(own + kNetworkTile * net.hidden);
  for (std::int64_t tile = begin; tile < end; tile += kNetworkTile) {
    const int used = end - tile < kNetworkTile ? static_cast<int>(end - tile) : kNetworkTile;
    const int rows = (used + kSplatGroup - 1) / kSplatGroup * kSplatGroup;
    Lists<kPairGroup> on = {list, net.units, {}};
    for (int s = 0; s < rows; ++s) first_layer(net, tile + (s < used ? s : 0), first + s * net.units);
    for (int group = 0; group < rows / kPairGroup; ++group)
      on.counts[group] =
          list_on<kPairGroup>(first + group * kPairGroup * net.units, net.units, net.units, list + group * net.units);
    float* second = net.kept ? net.kept + tile * net.hidden : own;
    product<kPairGroup, kPairVectors>(first, net.units, on, rows / kPairGroup, net.second, net.second_stride, net.hidden, net.second_bias, true,
            second, net.hidden);
    for (int group = 0; group < used; group += kSplatGroup)
      for (int output = 0; output < net.outputs; ++output) {
        float sums[kSplatGroup];
        dots(second + group * net.hidden, net.last + static_cast<std::size_t>(output) * net.hidden, net.hidden, sums);
        for (int s = 0; s < kSplatGroup && group + s < used; ++s)
          net.offsets[net.splats[tile + group + s] * net.outputs + output] = sums[s] + net.last_bias[output];
      }
  }
}

// ---- Colours ----

// Colours of splats [begin, end).
inline void color_network(const ColorNetwork& net, std::int64_t begin, std::int64_t end) {
  constexpr int kTogether = 4, kPair = W == 16 ? 2 : 1;
  Gathered<3> lower, fraction;
  const Real half = 0.5f * static_cast<float>(net.samples - 1), before_last = static_cast<float>(net.samples - 2);
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    Real direction[3];
    directions_from(net.center, net.means, net.rotations, net.binding, first, used, direction);
    for (int axis = 0; axis < 3; ++axis) {
      // From the splat to the camera: the other way.
      const Real along = fnma(direction[axis], half, half), row = floor(max(min(along, before_last), 0.0f));
      lower.keep(axis, row);
      fraction.keep(axis, along - row);
    }
    for (int group = 0; group < used; group += kTogether) {
      Real sums[3][kTogether];
      for (int s = 0; s < kTogether; s += kPair) {
        Place<const float> at[kPair];
        const std::int16_t* known[kPair];
        Real sum[3][kPair];
        for (int k = 0; k < kPair; ++k) {
          const int lane = group + s + k < used ? group + s + k : group;
          std::int32_t rows[3];
          float fractions[3];
          for (int axis = 0; axis < 3; ++axis) rows[axis] = static_cast<std::int32_t>(lower.values[axis][lane]) + axis * net.samples;
          fraction.put(fractions, lane);
          at[k] = place_of(net.table, net.hidden, rows, fractions);
          known[k] = net.positions + (first + lane) * net.hidden;
          // A frame reads them once, from the last cache level.
          for (int unit = 0; unit < net.hidden; unit += 32) HEADBENCH_PREFETCH(known[k] + W * net.hidden + unit);
          for (int channel = 0; channel < 3; ++channel) sum[channel][k] = 0.0f;
        }
        for (int unit = 0; unit < net.hidden; unit += W) {
          const Real step = load(net.steps + unit);
          Real last[3];
          for (int channel = 0; channel < 3; ++channel) last[channel] = load(net.last + channel * net.hidden + unit);
          for (int k = 0; k < kPair; ++k) {
            const Real value = max(add_place(at[k], net.hidden, unit, load_int16(known[k] + unit) * step), 0.0f);
            for (int channel = 0; channel < 3; ++channel) sum[channel][k] = fma(value, last[channel], sum[channel][k]);
          }
        }
        for (int channel = 0; channel < 3; ++channel)
          for (int k = 0; k < kPair; ++k) sums[channel][s + k] = sum[channel][k];
      }
      for (int channel = 0; channel < 3; ++channel) {
        float found[kTogether];
        sum_lanes(sums[channel], found);
        for (int s = 0; s < kTogether && group + s < used; ++s) {
          const float color = 0.5f + 0.28209479177387814f * found[s];
          net.colors[3 * (first + group + s) + channel] = color > 0.0f ? color : 0.0f;
        }
      }
    }
  }
}

}  // namespace headbench::HEADBENCH_ISA

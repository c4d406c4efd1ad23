// The training passes of network_training.h for one instruction set. Activations lie row by row, one row per splat, with
// units or inputs side by side.
#pragma once

#include "network_training.h"
#include "networks.h"

namespace headbench::HEADBENCH_ISA {

static_assert(kGroupRows % kSplatGroup == 0 && kGroupRows % kBatch == 0 && kTrainingTile % kGroupRows == 0);

HEADBENCH_INLINE std::int64_t whole_groups(std::int64_t rows) { return (rows + kGroupRows - 1) / kGroupRows * kGroupRows; }

constexpr int kProductVectors = W == 16 ? 3 : 1;  // with a group's rows, the sums that registers hold

template <int vectors>
HEADBENCH_INLINE void product_columns(const float* inputs, int stride, const std::int32_t* list, int count,
                                      const float* weights, int weight_stride, const float* bias, bool relu, float* out,
                                      int out_stride) {
  Real sums[kSplatGroup][vectors];
  for (int v = 0; v < vectors; ++v) {
    const Real start = bias ? load(bias + v * W) : Real(0.0f);
    for (int s = 0; s < kSplatGroup; ++s) sums[s][v] = start;
  }
  for (int i = 0; i < count; ++i) {
    const float* row = weights + static_cast<std::size_t>(list[i]) * weight_stride;
    const float* input = inputs + list[i];
    Real weight[vectors];
    for (int v = 0; v < vectors; ++v) weight[v] = load(row + v * W);
    for (int s = 0; s < kSplatGroup; ++s) {
      const Real value = input[s * stride];
      for (int v = 0; v < vectors; ++v) sums[s][v] = fma(value, weight[v], sums[s][v]);
    }
  }
  for (int s = 0; s < kSplatGroup; ++s)
    for (int v = 0; v < vectors; ++v) store(out + s * out_stride + v * W, relu ? max(sums[s][v], 0.0f) : sums[s][v]);
}

// Which inputs of each group of a tile's rows a product takes.
struct Lists {
  const std::int32_t* inputs;  // `stride` after one group's come the next one's
  int stride;
  int counts[kTrainingTile / kSplatGroup];
};

// For the groups of a tile's rows: bias, if any, plus the listed inputs times their rows of the weights, `width` numbers
// a row. Some columns for all groups before the next: their weights stay in the first cache.
inline void product(const float* inputs, int stride, const Lists& lists, int groups, const float* weights,
                    int weight_stride, int width, const float* bias, bool relu, float* out, int out_stride) {
  for (int column = 0; column < width;) {
    const int vectors = width - column >= kProductVectors * W ? kProductVectors : width - column >= 2 * W ? 2 : 1;
    for (int group = 0; group < groups; ++group) {
      const float *from = inputs + group * kSplatGroup * stride, *some = weights + column, *start = bias ? bias + column : nullptr;
      const std::int32_t* list = lists.inputs + group * lists.stride;
      const int count = lists.counts[group];
      float* to = out + group * kSplatGroup * out_stride + column;
      if (vectors == kProductVectors)
        product_columns<kProductVectors>(from, stride, list, count, some, weight_stride, start, relu, to, out_stride);
      else if (vectors == 2)
        product_columns<2>(from, stride, list, count, some, weight_stride, start, relu, to, out_stride);
      else
        product_columns<1>(from, stride, list, count, some, weight_stride, start, relu, to, out_stride);
    }
    column += vectors * W;
  }
}

// Rows of a gradient by weights in registers at a time, and vectors of each.
constexpr int kOuterUnits = W == 16 ? 8 : 4;
constexpr int kOuterVectors = W == 16 ? 3 : 2;

template <int vectors>
HEADBENCH_INLINE void outer_columns(const float* left, int left_stride, const std::int32_t* units, const float* right,
                                    int right_stride, int rows, float* sums, int sums_stride) {
  Real sum[kOuterUnits][vectors];
  for (int u = 0; u < kOuterUnits; ++u)
    for (int v = 0; v < vectors; ++v) sum[u][v] = load(sums + static_cast<std::size_t>(units[u]) * sums_stride + v * W);
  const float* starts[kOuterUnits];
  for (int u = 0; u < kOuterUnits; ++u) starts[u] = left + units[u];
  for (int s = 0; s < rows; ++s) {
    Real row[vectors];
    for (int v = 0; v < vectors; ++v) row[v] = load(right + s * right_stride + v * W);
    for (int u = 0; u < kOuterUnits; ++u) {
      const Real value = starts[u][s * left_stride];
      for (int v = 0; v < vectors; ++v) sum[u][v] = fma(value, row[v], sum[u][v]);
    }
  }
  for (int u = 0; u < kOuterUnits; ++u)
    for (int v = 0; v < vectors; ++v) store(sums + static_cast<std::size_t>(units[u]) * sums_stride + v * W, sum[u][v]);
}

// sums[unit][column] += sum over rows of left[row][unit] right[row][column], for the listed units; their number is a
// multiple of kOuterUnits, as no unit is listed twice.
inline void outer_product(const float* left, int left_stride, const std::int32_t* units, int count, const float* right,
                          int right_stride, int rows, int width, float* sums) {
  for (int column = 0; column < width;) {
    const int vectors = width - column >= kOuterVectors * W ? kOuterVectors : width - column >= 2 * W ? 2 : 1;
    for (int u = 0; u < count; u += kOuterUnits) {
      if (vectors == kOuterVectors)
        outer_columns<kOuterVectors>(left, left_stride, units + u, right + column, right_stride, rows, sums + column, width);
      else if (vectors == 2)
        outer_columns<2>(left, left_stride, units + u, right + column, right_stride, rows, sums + column, width);
      else
        outer_columns<1>(left, left_stride, units + u, right + column, right_stride, rows, sums + column, width);
    }
    column += vectors * W;
  }
}

// Ask for what the next tile reads of the forward pass, `most` of the `left` numbers there are: it comes from far away.
HEADBENCH_INLINE void prefetch_floats(const float* from, std::int64_t left, int most) {
  for (int k = 0; k < most && k < left; k += kUnitsStep) __builtin_prefetch(from + k, 0, 2);
}

// Add the lanes that are set to a list, as numbers from `first` on; its new length.
HEADBENCH_INLINE int list_lanes(Mask set, int first, std::int32_t* list, int count) {
  for (std::uint64_t lanes = bits(set); lanes; lanes &= lanes - 1) list[count++] = first + lowest_bit(lanes);
  return count;
}

// ---- Directions ----

// matrix times v, or its transpose times v, of a matrix by rows.
template <class T>
HEADBENCH_INLINE void rotate(const T* m, const Real* v, Real* out) {
  for (int i = 0; i < 3; ++i) out[i] = fma(m[3 * i], v[0], fma(m[3 * i + 1], v[1], Real(m[3 * i + 2]) * v[2]));
}
template <class T>
HEADBENCH_INLINE void rotate_back(const T* m, const Real* v, Real* out) {
  for (int i = 0; i < 3; ++i) out[i] = fma(m[i], v[0], fma(m[3 + i], v[1], Real(m[6 + i]) * v[2]));
}

HEADBENCH_INLINE Real unit_length(const Real* v, Real* unit) {
  const Real length = max(sqrt(dot3(v, v)), 1e-12f);
  for (int k = 0; k < 3; ++k) unit[k] = v[k] / length;
  return length;
}

// Directions of a vector of splats from `first` on, with the steps on the way to them.
struct DirectionSteps {
  Real turn[9], first[3], first_length, second[3], second_length;
};

HEADBENCH_INLINE void direction_steps(const DirectionTraining& in, std::int64_t first, int used, DirectionSteps& out) {
  Gathered<9> turn;
  Gathered<3> mean;
  for (int lane = 0; lane < W; ++lane) {
    const std::int64_t splat = first + (lane < used ? lane : 0);
    turn.set(in.turns + 9 * in.binding[splat], lane);
    mean.set(in.means + 3 * splat, lane);
  }
  for (int k = 0; k < 9; ++k) out.turn[k] = turn[k];
  Real way[3], turned[3];
  for (int k = 0; k < 3; ++k) way[k] = Real(in.center[k]) - mean[k];
  out.first_length = unit_length(way, out.first);
  rotate(out.turn, out.first, turned);
  out.second_length = unit_length(turned, out.second);
}

inline void directions(const DirectionTraining& in, std::int64_t begin, std::int64_t end) {
  Gathered<3> result;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    DirectionSteps steps;
    direction_steps(in, first, used, steps);
    Real direction[3];
    rotate(in.last, steps.second, direction);
    for (int k = 0; k < 3; ++k) result.keep(k, direction[k]);
    for (int lane = 0; lane < used; ++lane) result.put(in.directions + 3 * (first + lane), lane);
  }
}

inline void directions_backward(const DirectionTraining& in, std::int64_t begin, std::int64_t end) {
  Gathered<3> gradient;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    DirectionSteps steps;
    direction_steps(in, first, used, steps);
    for (int lane = 0; lane < W; ++lane) gradient.set(in.by_directions + 3 * (first + (lane < used ? lane : 0)), lane);
    const Real by_direction[3] = {gradient[0], gradient[1], gradient[2]};
    Real by_second[3], by_first[3];
    rotate_back(in.last, by_direction, by_second);
    const Real along_second = dot3(by_second, steps.second);
    for (int k = 0; k < 3; ++k) by_second[k] = fnma(along_second, steps.second[k], by_second[k]) / steps.second_length;
    rotate_back(steps.turn, by_second, by_first);
    const Real along_first = dot3(by_first, steps.first);
    for (int k = 0; k < 3; ++k)
      gradient.keep(k, fnma(by_first[k], 1.0f, along_first * steps.first[k]) / steps.first_length);
    for (int lane = 0; lane < used; ++lane) gradient.put(in.by_means + 3 * (first + lane), lane);
  }
}

// ---- Colour ----

// Where a point lies between samples: the lower one's number, the way to the next, and whether the point was clamped.
struct Between {
  int lower;
  float fraction;
  bool clamped;
};

HEADBENCH_INLINE Between between(const Grid& grid, int axis, float value) {
  // The steps of `plane_features` and `sample_plane`, each rounded as there.
  const float last = static_cast<float>(grid.samples - 1);
  const float unit = (value - grid.low[axis]) / grid.extent[axis];
  const float position = ((2.0f * unit - 1.0f) + 1.0f) * (0.5f * last);
  const float inside = position > 0.0f ? position < last ? position : last : 0.0f;
  int lower = static_cast<int>(inside);
  lower = lower < grid.samples - 2 ? lower : grid.samples - 2;
  return {lower, inside - static_cast<float>(lower), !(position >= 0.0f && position <= last)};
}

HEADBENCH_INLINE void sample_planes(const ColorTraining& net, const float* position, float* out) {
  Between at[3];
  for (int axis = 0; axis < 3; ++axis) at[axis] = between(net.grid, axis, position[axis]);
  for (int plane = 0; plane < kPlanes; ++plane) {
    const Between &x = at[kPlaneAxes[plane][0]], &y = at[kPlaneAxes[plane][1]];
    const int channels = net.channels[plane];
    const float* t = net.planes[plane] + (static_cast<std::size_t>(y.lower) * net.grid.samples + x.lower) * channels;
    const float* b = t + static_cast<std::size_t>(net.grid.samples) * channels;
    const float u = x.fraction, v = y.fraction;
    const float w00 = (1.0f - u) * (1.0f - v), w01 = u * (1.0f - v), w10 = (1.0f - u) * v, w11 = u * v;
    int c = 0;
    for (; c + W <= channels; c += W) {
      const Real top = fma(load(t + channels + c), w01, load(t + c) * Real(w00));
      store(out + c, fma(load(b + channels + c), w11, fma(load(b + c), w10, top)));
    }
    for (; c < channels; ++c) out[c] = w00 * t[c] + w01 * t[channels + c] + w10 * b[c] + w11 * b[channels + c];
    out += channels;
  }
}

// Ask for the texels that `sample_planes` reads.
HEADBENCH_INLINE void prefetch_planes(const ColorTraining& net, const float* position) {
  Between at[3];
  for (int axis = 0; axis < 3; ++axis) at[axis] = between(net.grid, axis, position[axis]);
  for (int plane = 0; plane < kPlanes; ++plane) {
    const int x = at[kPlaneAxes[plane][0]].lower, y = at[kPlaneAxes[plane][1]].lower, channels = net.channels[plane];
    for (int row = 0; row < 2; ++row) {
      const float* texels = net.planes[plane] + (static_cast<std::size_t>(y + row) * net.grid.samples + x) * channels;
      for (int c = 0; c < 2 * channels; c += kUnitsStep) HEADBENCH_PREFETCH(texels + c);
    }
  }
}

// Inputs of entries [first, first + used): features and encoded directions; zeros in the rest of `rows`, whole groups.
inline void color_inputs(const ColorTraining& net, std::int64_t first, int used, int rows, float* out) {
  alignas(64) float encoded[kEncoding * kBatch];
  for (int offset = 0; offset < rows; offset += W) {
    Gathered<3> d;
    for (int lane = 0; lane < W; ++lane)
      d.set(net.directions + 3 * net.splats[first + (offset + lane < used ? offset + lane : 0)], lane);
    const Real direction[3] = {d[0], d[1], d[2]};
    encode(direction, encoded);
    for (int lane = 0; lane < W; ++lane) {
      constexpr std::int64_t ahead = 12;
      const std::int64_t later = first + offset + lane + ahead;
      if (later < net.count) prefetch_planes(net, net.positions + 3 * net.splats[later]);
      float* row = out + (offset + lane) * net.inputs_stride;
      int filled = 0;
      if (offset + lane < used) {
        sample_planes(net, net.positions + 3 * net.splats[first + offset + lane], row);
        for (int k = 0; k < kEncoding; ++k) row[net.features + k] = encoded[k * kBatch + lane];
        filled = net.features + kEncoding;
      }
      for (; filled < net.inputs; ++filled) row[filled] = 0.0f;
    }
  }
}

inline std::size_t color_forward_scratch(const ColorTraining& net) {
  return static_cast<std::size_t>(kTrainingTile + 1) * net.inputs_stride;
}

inline void color_forward(const ColorTraining& net, std::int64_t begin, std::int64_t end, float* scratch) {
  float* inputs = scratch;
  std::int32_t* list = reinterpret_cast<std::int32_t*>(inputs + kTrainingTile * net.inputs_stride);
  const int used_inputs = net.features + kEncoding;
  for (int k = 0; k < used_inputs; ++k) list[k] = k;
  Lists lists = {list, 0, {}};
  for (int& count : lists.counts) count = used_inputs;
  for (std::int64_t first = begin; first < end; first += kTrainingTile) {
    const int used = end - first < kTrainingTile ? static_cast<int>(end - first) : kTrainingTile;
    const int rows = static_cast<int>(whole_groups(used));
    color_inputs(net, first, used, rows, inputs);
    float* hidden = net.kept_hidden + first * net.units;
    product(inputs, net.inputs_stride, lists, rows / kSplatGroup, net.first, net.units_stride, net.units, nullptr, true,
            hidden, net.units);
    for (int group = 0; group < used; group += kSplatGroup)
      for (int channel = 0; channel < 3; ++channel) {
        float sums[kSplatGroup];
        dots(hidden + group * net.units, net.last + static_cast<std::size_t>(channel) * net.units, net.units, sums);
        for (int s = 0; s < kSplatGroup && group + s < used; ++s) {
          const float color = 0.5f + 0.28209479177387814f * sums[s];
          net.colors[3 * net.splats[first + group + s] + channel] = color > 0.0f ? color : 0.0f;
        }
      }
  }
}

// Gradient of the encoding: by sine and cosine of a multiple of each coordinate, whose values the inputs hold.
HEADBENCH_INLINE void encoding_backward(const float* encoded, const float* by_encoded, float* by_direction) {
  for (int k = 0; k < 3; ++k) {
    float sum = by_encoded[k], frequency = 1.0f;
    for (int wave = 3; wave < kEncoding; wave += 6, frequency *= 2.0f)
      sum += frequency * (by_encoded[wave + k] * encoded[wave + 3 + k] - by_encoded[wave + 3 + k] * encoded[wave + k]);
    by_direction[k] = sum;
  }
}

// Gradient by a position of its features' gradients.
HEADBENCH_INLINE void planes_backward(const ColorTraining& net, const Between* at, const float* gradient,
                                      float* by_position) {
  Real by[4] = {0.0f, 0.0f, 0.0f, 0.0f};
  float rest[3] = {0.0f, 0.0f, 0.0f};
  for (int plane = 0; plane < kPlanes; ++plane) {
    const int across = kPlaneAxes[plane][0], down = kPlaneAxes[plane][1], channels = net.channels[plane];
    const Between &x = at[across], &y = at[down];
    const float* t = net.planes[plane] + (static_cast<std::size_t>(y.lower) * net.grid.samples + x.lower) * channels;
    const float* b = t + static_cast<std::size_t>(net.grid.samples) * channels;
    int c = 0;
    for (; c + W <= channels; c += W) {
      const Real t0 = load(t + c), b0 = load(b + c), g = load(gradient + c);
      const Real right = load(t + channels + c) - t0, below = b0 - t0;
      const Real twist = (load(b + channels + c) - b0) - right;
      by[across] = fma(g, fma(twist, y.fraction, right), by[across]);
      by[down] = fma(g, fma(twist, x.fraction, below), by[down]);
    }
    for (; c < channels; ++c) {
      const float right = t[channels + c] - t[c], below = b[c] - t[c], twist = (b[channels + c] - b[c]) - right;
      rest[across] += gradient[c] * (right + y.fraction * twist);
      rest[down] += gradient[c] * (below + x.fraction * twist);
    }
    gradient += channels;
  }
  transpose_quads(by);
  alignas(64) float lanes[W];
  store(lanes, (by[0] + by[1]) + (by[2] + by[3]));
  for (int axis = 0; axis < 3; ++axis) {
    float sum = rest[axis];
    for (int quad = 0; quad < W; quad += 4) sum += lanes[quad + axis];
    const float scale = static_cast<float>(net.grid.samples - 1) / net.grid.extent[axis];
    by_position[axis] = at[axis].clamped ? 0.0f : sum * scale;
  }
}

inline std::size_t color_backward_scratch(const ColorTraining& net) {
  return static_cast<std::size_t>(kTrainingTile) * (net.units_stride + 2 * net.inputs_stride) +
         (kTrainingTile / kSplatGroup + 1) * net.units;
}

inline void color_backward(const ColorTraining& net, const ColorSums& at, std::int64_t begin, std::int64_t end, float* sums,
                           float* scratch) {
  float* by_hidden = scratch;
  float* inputs = by_hidden + kTrainingTile * net.units_stride;
  float* by_inputs = inputs + kTrainingTile * net.inputs_stride;
  std::int32_t* list = reinterpret_cast<std::int32_t*>(by_inputs + kTrainingTile * net.inputs_stride);
  std::int32_t* all = list + kTrainingTile / kSplatGroup * net.units;
  for (int unit = 0; unit < net.units; ++unit) all[unit] = unit;
  for (std::int64_t first = begin; first < end; first += kTrainingTile) {
    const int used = end - first < kTrainingTile ? static_cast<int>(end - first) : kTrainingTile;
    const int groups = (used + kSplatGroup - 1) / kSplatGroup;
    const std::int64_t next = first + kTrainingTile;
    prefetch_floats(net.kept_hidden + next * net.units, next < end ? whole_groups(end - next) * net.units : 0,
                    kTrainingTile * net.units);
    color_inputs(net, first, used, static_cast<int>(whole_groups(used)), inputs);
    Lists on = {list, net.units, {}};
    for (int group = 0; group < groups; ++group) {
      const float* hidden = net.kept_hidden + (first + group * kSplatGroup) * net.units;
      float by_out[3][kSplatGroup];
      for (int s = 0; s < kSplatGroup; ++s)
        for (int channel = 0; channel < 3; ++channel) {
          const int row = group * kSplatGroup + s;
          const std::int64_t k = 3 * net.splats[first + (row < used ? row : 0)] + channel;
          by_out[channel][s] = row < used && net.colors[k] > 0.0f ? 0.28209479177387814f * net.by_colors[k] : 0.0f;
        }
      int count = 0;
      for (int unit = 0; unit < net.units; unit += W) {
        Real last[3], sum[3], most = 0.0f;
        float* to = sums + at.last + unit;
        for (int channel = 0; channel < 3; ++channel) {
          last[channel] = load(net.last + static_cast<std::size_t>(channel) * net.units + unit);
          sum[channel] = load(to + static_cast<std::size_t>(channel) * net.units);
        }
        for (int s = 0; s < kSplatGroup; ++s) {
          const Real value = load(hidden + s * net.units + unit);
          const Real g[3] = {by_out[0][s], by_out[1][s], by_out[2][s]};
          const Real gradient = fma(last[0], g[0], fma(last[1], g[1], last[2] * g[2]));
          store(by_hidden + (group * kSplatGroup + s) * net.units_stride + unit,
                zero_unless(value > Real(0.0f), gradient));
          for (int channel = 0; channel < 3; ++channel) sum[channel] = fma(value, g[channel], sum[channel]);
          most = max(most, value);
        }
        for (int channel = 0; channel < 3; ++channel) store(to + static_cast<std::size_t>(channel) * net.units, sum[channel]);
        count = list_lanes(most > Real(0.0f), unit, list + group * net.units, count);
      }
      on.counts[group] = count;
    }
    outer_product(by_hidden, net.units_stride, all, net.units, inputs, net.inputs_stride, groups * kSplatGroup,
                  net.inputs, sums + at.first);
    product(by_hidden, net.units_stride, on, groups, net.first, net.inputs_stride, net.inputs, nullptr, false, by_inputs,
            net.inputs_stride);
    for (int s = 0; s < used; ++s) {
      const std::int64_t entry = first + s, splat = net.splats[entry];
      const float* gradient = by_inputs + s * net.inputs_stride;
      float* kept = net.by_features + entry * net.features;
      for (int k = 0; k < net.features; ++k) kept[k] = gradient[k];
      Between at_samples[3];
      for (int axis = 0; axis < 3; ++axis) at_samples[axis] = between(net.grid, axis, net.positions[3 * splat + axis]);
      for (int k = 0; k < 2; ++k) net.lower[k][entry] = at_samples[k + 1].lower;
      planes_backward(net, at_samples, gradient, net.by_positions + 3 * splat);
      encoding_backward(inputs + s * net.inputs_stride + net.features, gradient + net.features,
                        net.by_directions + 3 * splat);
    }
  }
}

inline void scatter_plane(const ColorTraining& net, int plane, int row, const std::uint32_t* order, std::int64_t count,
                          int first, int last) {
  const int across = kPlaneAxes[plane][0], down = kPlaneAxes[plane][1], channels = net.channels[plane];
  int skipped = 0;
  for (int k = 0; k < plane; ++k) skipped += net.channels[k];
  const float* features = net.by_features + skipped;
  constexpr std::int64_t ahead = 8;
  for (std::int64_t i = 0; i < count; ++i) {
    if (i + ahead < count) {
      const float* later = features + static_cast<std::size_t>(order[i + ahead]) * net.features;
      for (int k = 0; k < channels; k += 16) HEADBENCH_PREFETCH(later + k);
    }
    const float* gradient = features + static_cast<std::size_t>(order[i]) * net.features;
    const float* position = net.positions + 3 * net.splats[order[i]];
    const Between x = between(net.grid, across, position[across]), y = between(net.grid, down, position[down]);
    for (int side = 0; side < 2; ++side) {
      if (row + side < first || row + side > last) continue;
      const float weight = side ? y.fraction : 1.0f - y.fraction;
      const float left = weight * (1.0f - x.fraction), right = weight * x.fraction;
      float* to = net.by_planes[plane] + (static_cast<std::size_t>(row + side) * net.grid.samples + x.lower) * channels;
      int c = 0;
      for (; c + W <= channels; c += W) {
        const Real g = load(gradient + c);
        store(to + c, fma(g, left, load(to + c)));
        store(to + channels + c, fma(g, right, load(to + channels + c)));
      }
      for (; c < channels; ++c) {
        to[c] += left * gradient[c];
        to[channels + c] += right * gradient[c];
      }
    }
  }
}

// ---- Lines ----

// First hidden layer of an entry, after its ReLU.
HEADBENCH_INLINE void line_first(const LineTraining& net, std::int64_t entry, float* out) {
  const float* lower[3];
  Real upper_weight[3], lower_weight[3];
  for (int axis = 0; axis < 3; ++axis) {
    lower[axis] = net.table + static_cast<std::size_t>(net.rows[3 * entry + axis]) * net.units;
    upper_weight[axis] = net.fractions[3 * entry + axis];
    lower_weight[axis] = Real(1.0f) - upper_weight[axis];
  }
  for (int unit = 0; unit < net.units; unit += W) {
    Real sum = load(net.bias_0 + unit);
    for (int axis = 0; axis < 3; ++axis) {
      sum = fma(load(lower[axis] + unit), lower_weight[axis], sum);
      sum = fma(load(lower[axis] + net.units + unit), upper_weight[axis], sum);
    }
    store(out + unit, max(sum, 0.0f));
  }
}

inline std::size_t line_forward_scratch(const LineTraining& net) {
  return static_cast<std::size_t>(kTrainingTile) * net.units_stride + kTrainingTile / kSplatGroup * net.units;
}

// List the units that are on in any row of a group.
template <class RowOf>
HEADBENCH_INLINE int list_on(int units, const RowOf& row, std::int32_t* list) {
  int count = 0;
  for (int unit = 0; unit < units; unit += W) {
    Real most = load(row(0) + unit);
    for (int s = 1; s < kSplatGroup; ++s) most = max(most, load(row(s) + unit));
    count = list_lanes(most > Real(0.0f), unit, list, count);
  }
  return count;
}

inline void line_forward(const LineTraining& net, std::int64_t begin, std::int64_t end, float* scratch) {
  float* first = scratch;
  std::int32_t* list = reinterpret_cast<std::int32_t*>(first + kTrainingTile * net.units_stride);
  for (std::int64_t tile = begin; tile < end; tile += kTrainingTile) {
    const int used = end - tile < kTrainingTile ? static_cast<int>(end - tile) : kTrainingTile;
    const int groups = (used + kSplatGroup - 1) / kSplatGroup;
    Lists on = {list, net.units, {}};
    for (int group = 0; group < groups; ++group) {
      float* rows = first + group * kSplatGroup * net.units_stride;
      for (int s = 0; s < kSplatGroup; ++s) {
        const int row = group * kSplatGroup + s;
        line_first(net, tile + (row < used ? row : 0), rows + s * net.units_stride);
      }
      on.counts[group] = list_on(net.units, [&](int s) { return rows + s * net.units_stride; }, list + group * net.units);
    }
    float* second = net.kept + tile * net.units;
    product(first, net.units_stride, on, groups, net.weight_1, net.units_stride, net.units, net.bias_1, true, second,
            net.units);
    for (int group = 0; group < used; group += kSplatGroup)
      for (int output = 0; output < net.outputs; ++output) {
        float sums[kSplatGroup];
        dots(second + group * net.units, net.weight_2 + static_cast<std::size_t>(output) * net.units, net.units, sums);
        for (int s = 0; s < kSplatGroup && group + s < used; ++s)
          net.offsets[net.splats[tile + group + s] * net.outputs + output] = sums[s] + net.bias_2[output];
      }
  }
}

inline std::size_t line_backward_scratch(const LineTraining& net) {
  return static_cast<std::size_t>(3 * kTrainingTile) * net.units_stride + kTrainingTile * net.outputs +
         (kTrainingTile / kSplatGroup + 1) * net.units;
}

// Add the gradient of an entry's first layer to its bias and to the rows of the table that it was interpolated from.
HEADBENCH_INLINE void add_first(const LineTraining& net, const LineSums& at, std::int64_t entry, const float* first,
                                const float* by_first, float* sums) {
  float* lower[3];
  Real upper_weight[3], lower_weight[3];
  for (int axis = 0; axis < 3; ++axis) {
    lower[axis] = sums + at.table + static_cast<std::size_t>(net.rows[3 * entry + axis]) * net.units;
    upper_weight[axis] = net.fractions[3 * entry + axis];
    lower_weight[axis] = Real(1.0f) - upper_weight[axis];
  }
  for (int unit = 0; unit < net.units; unit += W) {
    const Mask on = load(first + unit) > Real(0.0f);
    if (!any(on)) continue;
    const Real gradient = zero_unless(on, load(by_first + unit));
    store(sums + at.bias_0 + unit, load(sums + at.bias_0 + unit) + gradient);
    for (int axis = 0; axis < 3; ++axis) {
      float* to = lower[axis] + unit;
      store(to, fma(gradient, lower_weight[axis], load(to)));
      store(to + net.units, fma(gradient, upper_weight[axis], load(to + net.units)));
    }
  }
}

inline void line_backward(const LineTraining& net, const LineSums& at, std::int64_t begin, std::int64_t end, float* sums,
                          float* scratch) {
  const int units = net.units, stride = net.units_stride, outputs = net.outputs;
  float* first = scratch;
  float* by_second = first + kTrainingTile * stride;
  float* by_first = by_second + kTrainingTile * stride;
  float* by_out = by_first + kTrainingTile * stride;
  std::int32_t* list = reinterpret_cast<std::int32_t*>(by_out + kTrainingTile * outputs);
  std::int32_t* anywhere = list + kTrainingTile / kSplatGroup * units;
  for (std::int64_t tile = begin; tile < end; tile += kTrainingTile) {
    const int used = end - tile < kTrainingTile ? static_cast<int>(end - tile) : kTrainingTile;
    const int groups = (used + kSplatGroup - 1) / kSplatGroup, rows = groups * kSplatGroup;
    const float* second[kTrainingTile];
    for (int s = 0; s < rows; ++s) {
      const std::int64_t entry = net.entries[tile + (s < used ? s : 0)];
      second[s] = net.kept + entry * units;
      if (tile + kTrainingTile + s < end)
        prefetch_floats(net.kept + net.entries[tile + kTrainingTile + s] * units, units, units);
      line_first(net, entry, first + s * stride);
      for (int output = 0; output < outputs; ++output) {
        const float gradient = s < used ? net.by_offsets[net.splats[entry] * outputs + output] : 0.0f;
        by_out[s * outputs + output] = gradient;
        sums[at.bias_2 + output] += gradient;
      }
    }
    Lists on = {list, units, {}};
    int anywhere_count = 0;
    for (int unit = 0; unit < units; unit += W) {
      Real by_bias = load(sums + at.bias_1 + unit), most_anywhere = 0.0f;
      for (int group = 0; group < groups; ++group) {
        Real most = 0.0f;
        for (int s = group * kSplatGroup; s < (group + 1) * kSplatGroup; ++s) {
          const Real value = load(second[s] + unit);
          Real gradient = 0.0f;
          for (int output = 0; output < outputs; ++output)
            gradient = fma(load(net.weight_2 + static_cast<std::size_t>(output) * units + unit),
                           by_out[s * outputs + output], gradient);
          gradient = zero_unless(value > Real(0.0f), gradient);
          store(by_second + s * stride + unit, gradient);
          by_bias = by_bias + gradient;
          most = max(most, value);
        }
        on.counts[group] = list_lanes(most > Real(0.0f), unit, list + group * units, on.counts[group]);
        most_anywhere = max(most_anywhere, most);
      }
      store(sums + at.bias_1 + unit, by_bias);
      anywhere_count = list_lanes(most_anywhere > Real(0.0f), unit, anywhere, anywhere_count);
      for (int output = 0; output < outputs; ++output) {
        float* to = sums + at.weight_2 + static_cast<std::size_t>(output) * units + unit;
        Real sum = load(to);
        for (int s = 0; s < rows; ++s) sum = fma(load(second[s] + unit), by_out[s * outputs + output], sum);
        store(to, sum);
      }
    }
    // As many as are dealt with together: units that are off add zero.
    for (int unit = 0; anywhere_count % kOuterUnits; ++unit) {
      bool listed = false;
      for (int k = 0; k < anywhere_count; ++k) listed |= anywhere[k] == unit;
      if (!listed) anywhere[anywhere_count++] = unit;
    }
    outer_product(by_second, stride, anywhere, anywhere_count, first, stride, rows, units, sums + at.weight_1);
    product(by_second, stride, on, groups, net.weight_1, stride, units, nullptr, false, by_first, stride);
    for (int s = 0; s < used; ++s)
      add_first(net, at, net.entries[tile + s], first + s * stride, by_first + s * stride, sums);
  }
}

inline void add(float* to, const float* from, std::size_t count) {
  std::size_t k = 0;
  for (; k + W <= count; k += W) store(to + k, load(to + k) + load(from + k));
  for (; k < count; ++k) to[k] += from[k];
}

extern const NetworkKernels network_kernels;
const NetworkKernels network_kernels = {
    HEADBENCH_ISA_NAME,     directions,     directions_backward, color_forward_scratch, color_forward,
    color_backward_scratch, color_backward, scatter_plane,       line_forward_scratch,  line_forward,
    line_backward_scratch,  line_backward,  add};

}  // namespace headbench::HEADBENCH_ISA

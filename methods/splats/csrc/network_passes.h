// The training passes of network_training.h for one instruction set. Activations lie row by row, one row per splat, with
// units or inputs side by side.
#pragma once

#include "network_training.h"
#include "networks.h"

namespace headbench::HEADBENCH_ISA {

static_assert(kGroupRows % kSplatGroup == 0 && kGroupRows % W == 0 && kNetworkTile % kGroupRows == 0);

HEADBENCH_INLINE std::int64_t whole_groups(std::int64_t rows) { return (rows + kGroupRows - 1) / kGroupRows * kGroupRows; }

constexpr int kOuterVectors = W == 16 ? 6 : 3;  // of the colours' inputs, with kSparseGroup rows

// sums[unit][column] += sum over a group's rows of left[row][unit] right[row][column], for the listed units.
template <int rows, int vectors>
HEADBENCH_INLINE void outer_columns(const float* left, int left_stride, const std::int32_t* units, int count,
                                    const float* right, int right_stride, float* sums, int sums_stride) {
  Real row[rows][vectors];
  for (int s = 0; s < rows; ++s)
    for (int v = 0; v < vectors; ++v) row[s][v] = load(right + s * right_stride + v * W);
  for (int i = 0; i < count; ++i) {
    const float* values = left + units[i];
    float* to = sums + static_cast<std::size_t>(units[i]) * sums_stride;
    Real sum[vectors];
    for (int v = 0; v < vectors; ++v) sum[v] = load(to + v * W);
    for (int s = 0; s < rows; ++s) {
      const Real value = values[s * left_stride];
      for (int v = 0; v < vectors; ++v) sum[v] = fma(value, row[s][v], sum[v]);
    }
    for (int v = 0; v < vectors; ++v) store(to + v * W, sum[v]);
  }
}

// The same for all groups of a tile, `width` columns, at most `most_vectors` vectors of them at a time.
template <int rows, int most_vectors>
inline void outer_product(const float* left, int left_stride, const Lists<rows>& lists, int groups, const float* right,
                          int right_stride, int width, float* sums) {
  for_columns<most_vectors>(width, [&](auto vectors, int column) {
    for (int group = 0; group < groups; ++group)
      outer_columns<rows, decltype(vectors)::value>(
          left + group * rows * left_stride, left_stride, lists.inputs + group * lists.stride, lists.counts[group],
          right + group * rows * right_stride + column, right_stride, sums + column, width);
  });
}

// Ask for what the next tile reads of the forward pass, `most` of the `left` numbers there are: it comes from far away.
HEADBENCH_INLINE void prefetch_floats(const float* from, std::int64_t left, int most) {
  for (int k = 0; k < most && k < left; k += kUnitsStep) __builtin_prefetch(from + k, 0, 2);
}

// ---- Positions and directions ----

// matrix times v, or its transpose times v, of a matrix by rows.
template <class T>
HEADBENCH_INLINE void rotate(const T* m, const Real* v, Real* out) {
  for (int i = 0; i < 3; ++i) out[i] = fma(m[3 * i], v[0], fma(m[3 * i + 1], v[1], Real(m[3 * i + 2]) * v[2]));
}
template <class T>
HEADBENCH_INLINE void rotate_back(const T* m, const Real* v, Real* out) {
  for (int i = 0; i < 3; ++i) out[i] = fma(m[i], v[0], fma(m[3 + i], v[1], Real(m[6 + i]) * v[2]));
}

template <bool backward>
inline void positions(const PositionTraining& in, std::int64_t begin, std::int64_t end) {
  Gathered<9> linear;
  Gathered<3> center, value;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    for (int lane = 0; lane < W; ++lane) {
      const std::int64_t splat = first + (lane < used ? lane : 0), triangle = in.binding[splat];
      linear.set(in.linear + 9 * triangle, lane);
      if (!backward) center.set(in.centers + 3 * triangle, lane);
      value.set(in.values + 3 * splat, lane);
    }
    Real matrix[9], out[3];
    for (int k = 0; k < 9; ++k) matrix[k] = linear[k];
    const Real from[3] = {value[0], value[1], value[2]};
    backward ? rotate_back(matrix, from, out) : rotate(matrix, from, out);
    for (int k = 0; k < 3; ++k) value.keep(k, backward ? out[k] : out[k] + center[k]);
    for (int lane = 0; lane < used; ++lane) value.put(in.out + 3 * (first + lane), lane);
  }
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
  for (int k = 0; k < 3; ++k) out.first[k] = Real(in.center[k]) - mean[k];
  out.first_length = normalise3(out.first, 1e-24f);
  rotate(out.turn, out.first, out.second);
  out.second_length = normalise3(out.second, 1e-24f);
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
    for (int lane = 0; lane < used; ++lane) result.put(in.out + 3 * (first + lane), lane);
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
    for (int lane = 0; lane < used; ++lane) gradient.put(in.out + 3 * (first + lane), lane);
  }
}

// ---- Colour ----

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

// The encoding of methods/ops/planes.py, `encode`, of W directions: W numbers of each input side by side.
HEADBENCH_INLINE void encode(const Real* direction, float* out) {
  constexpr int kFrequencies = (kEncoding - 3) / 6;
  for (int k = 0; k < 3; ++k) {
    store(out + k * W, direction[k]);
    Real sine, cosine;
    sine_cosine(direction[k], sine, cosine);
    for (int n = 0; n < kFrequencies; ++n) {
      store(out + (3 + 6 * n + k) * W, sine);
      store(out + (6 + 6 * n + k) * W, cosine);
      // sin 2a = 2 sin a cos a, cos 2a = 1 - 2 sin^2 a.
      const Real twice = sine + sine, next = twice * cosine;
      cosine = fnma(twice, sine, 1.0f);
      sine = next;
    }
  }
}

// Where a point lies between samples: the lower one's number, the way to the next, and whether the point was clamped.
struct Between {
  int lower;
  float fraction;
  bool clamped;
};

HEADBENCH_INLINE Between between(const ColorTraining& net, std::int64_t splat, int axis) {
  const std::int32_t lower = net.lower[3 * splat + axis];
  return {lower < 0 ? ~lower : lower, net.fractions[3 * splat + axis], lower < 0};
}

// Find where splats lie, by the steps of `plane_features` and `sample_plane`, each rounded as there.
inline void find_places(const ColorTraining& net, std::int64_t begin, std::int64_t end) {
  const Real last = static_cast<float>(net.grid.samples - 1), before_last = static_cast<float>(net.grid.samples - 2);
  const Real half = 0.5f * static_cast<float>(net.grid.samples - 1), zero = 0.0f, one = 1.0f;
  Gathered<3> value, lower, clamped;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    for (int lane = 0; lane < W; ++lane) value.set(net.positions + 3 * (first + (lane < used ? lane : 0)), lane);
    for (int axis = 0; axis < 3; ++axis) {
      const Real unit = (value[axis] - Real(net.grid.low[axis])) / Real(net.grid.extent[axis]);
      const Real position = ((Real(2.0f) * unit - one) + one) * half;
      const Real inside = select(position > zero, min(position, last), zero), row = min(floor(inside), before_last);
      lower.keep(axis, row);
      value.keep(axis, inside - row);
      clamped.keep(axis, select((position >= zero) & (last >= position), zero, one));
    }
    for (int lane = 0; lane < used; ++lane) {
      value.put(net.fractions + 3 * (first + lane), lane);
      for (int axis = 0; axis < 3; ++axis) {
        const std::int32_t row = static_cast<std::int32_t>(lower.values[axis][lane]);
        net.lower[3 * (first + lane) + axis] = clamped.values[axis][lane] != 0.0f ? ~row : row;
      }
    }
  }
}

HEADBENCH_INLINE void sample_planes(const ColorTraining& net, std::int64_t splat, float* out) {
  Between at[3];
  for (int axis = 0; axis < 3; ++axis) at[axis] = between(net, splat, axis);
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
HEADBENCH_INLINE void prefetch_planes(const ColorTraining& net, std::int64_t splat) {
  Between at[3];
  for (int axis = 0; axis < 3; ++axis) at[axis] = between(net, splat, axis);
  for (int plane = 0; plane < kPlanes; ++plane) {
    const int x = at[kPlaneAxes[plane][0]].lower, y = at[kPlaneAxes[plane][1]].lower, channels = net.channels[plane];
    for (int row = 0; row < 2; ++row) {
      const float* texels = net.planes[plane] + (static_cast<std::size_t>(y + row) * net.grid.samples + x) * channels;
      for (int c = 0; c < 2 * channels; c += kUnitsStep) HEADBENCH_PREFETCH(texels + c);
    }
  }
}

// Inputs of splats [first, first + used): features and encoded directions; zeros in the rest of `rows`, whole groups. Splats
// to `end` have their places.
inline void color_inputs(const ColorTraining& net, std::int64_t first, int used, int rows, std::int64_t end, float* out) {
  alignas(64) float encoded[kEncoding * W];
  for (int offset = 0; offset < rows; offset += W) {
    Gathered<3> d;
    for (int lane = 0; lane < W; ++lane)
      d.set(net.directions + 3 * (first + (offset + lane < used ? offset + lane : 0)), lane);
    const Real direction[3] = {d[0], d[1], d[2]};
    encode(direction, encoded);
    for (int lane = 0; lane < W; ++lane) {
      constexpr std::int64_t ahead = 12;
      const std::int64_t later = first + offset + lane + ahead;
      if (later < end) prefetch_planes(net, later);
      float* row = out + (offset + lane) * net.inputs_stride;
      int filled = 0;
      if (offset + lane < used) {
        sample_planes(net, first + offset + lane, row);
        for (int k = 0; k < kEncoding; ++k) row[net.features + k] = encoded[k * W + lane];
        filled = net.features + kEncoding;
      }
      for (; filled < net.inputs; ++filled) row[filled] = 0.0f;
    }
  }
}

inline std::size_t color_forward_scratch(const ColorTraining& net) {
  return static_cast<std::size_t>(kNetworkTile + 1) * net.inputs_stride;
}

inline void color_forward(const ColorTraining& net, std::int64_t begin, std::int64_t end, float* scratch) {
  float* inputs = scratch;
  std::int32_t* list = reinterpret_cast<std::int32_t*>(inputs + kNetworkTile * net.inputs_stride);
  const int used_inputs = net.features + kEncoding;
  for (int k = 0; k < used_inputs; ++k) list[k] = k;
  Lists<kDenseGroup> lists = {list, 0, {}};
  for (int& count : lists.counts) count = used_inputs;
  find_places(net, begin, end);
  for (std::int64_t first = begin; first < end; first += kNetworkTile) {
    const int used = end - first < kNetworkTile ? static_cast<int>(end - first) : kNetworkTile;
    const int rows = static_cast<int>(whole_groups(used));
    color_inputs(net, first, used, rows, end, inputs);
    float* hidden = net.kept_hidden + first * net.units;
    product<kDenseGroup, kDenseVectors>(inputs, net.inputs_stride, lists, rows / kDenseGroup, net.first,
                                        net.units_stride, net.units, nullptr, true, hidden, net.units);
    for (int group = 0; group < used; group += kSplatGroup)
      for (int channel = 0; channel < 3; ++channel) {
        float sums[kSplatGroup];
        dots(hidden + group * net.units, net.last + static_cast<std::size_t>(channel) * net.units, net.units, sums);
        for (int s = 0; s < kSplatGroup && group + s < used; ++s) {
          const float color = 0.5f + 0.28209479177387814f * sums[s];
          net.colors[3 * (first + group + s) + channel] = color > 0.0f ? color : 0.0f;
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
  return static_cast<std::size_t>(kNetworkTile) * (net.units_stride + net.inputs_stride) +
         kNetworkTile / kSparseGroup * net.units;
}

inline void color_backward(const ColorTraining& net, const ColorSums& at, std::int64_t begin, std::int64_t end, float* sums,
                           float* scratch) {
  float* by_hidden = scratch;
  float* inputs = by_hidden + kNetworkTile * net.units_stride;
  std::int32_t* list = reinterpret_cast<std::int32_t*>(inputs + kNetworkTile * net.inputs_stride);
  for (std::int64_t first = begin; first < end; first += kNetworkTile) {
    const int used = end - first < kNetworkTile ? static_cast<int>(end - first) : kNetworkTile;
    const int groups = (used + kSparseGroup - 1) / kSparseGroup;
    const std::int64_t next = first + kNetworkTile;
    prefetch_floats(net.kept_hidden + next * net.units, next < end ? whole_groups(end - next) * net.units : 0,
                    kNetworkTile * net.units);
    color_inputs(net, first, used, static_cast<int>(whole_groups(used)), end, inputs);
    Lists<kSparseGroup> on = {list, net.units, {}};
    for (int group = 0; group < groups; ++group) {
      const float* hidden = net.kept_hidden + (first + group * kSparseGroup) * net.units;
      float by_out[3][kSparseGroup];
      for (int s = 0; s < kSparseGroup; ++s)
        for (int channel = 0; channel < 3; ++channel) {
          const int row = group * kSparseGroup + s;
          const std::int64_t k = 3 * (first + (row < used ? row : 0)) + channel;
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
        for (int s = 0; s < kSparseGroup; ++s) {
          const Real value = load(hidden + s * net.units + unit);
          const Real g[3] = {by_out[0][s], by_out[1][s], by_out[2][s]};
          const Real gradient = fma(last[0], g[0], fma(last[1], g[1], last[2] * g[2]));
          store(by_hidden + (group * kSparseGroup + s) * net.units_stride + unit,
                zero_unless(value > Real(0.0f), gradient));
          for (int channel = 0; channel < 3; ++channel) sum[channel] = fma(value, g[channel], sum[channel]);
          most = max(most, value);
        }
        for (int channel = 0; channel < 3; ++channel) store(to + static_cast<std::size_t>(channel) * net.units, sum[channel]);
        count += list_lanes(most > Real(0.0f), unit, list + group * net.units + count);
      }
      on.counts[group] = count;
    }
    outer_product<kSparseGroup, kOuterVectors>(by_hidden, net.units_stride, on, groups, inputs, net.inputs_stride,
                                               net.inputs, sums + at.first);
    float* by_inputs = net.by_inputs + first * net.inputs;
    if (net.by_positions)
      product<kSparseGroup, kOuterVectors>(by_hidden, net.units_stride, on, groups, net.first, net.inputs_stride,
                                           net.inputs, nullptr, false, by_inputs, net.inputs);
    else  // features alone
      product<kSparseGroup, kSparseVectors>(by_hidden, net.units_stride, on, groups, net.first, net.inputs_stride,
                                            (net.features + kUnitsStep - 1) / kUnitsStep * kUnitsStep, nullptr, false,
                                            by_inputs, net.inputs);
    for (int s = 0; s < used && net.by_positions; ++s) {
      const std::int64_t splat = first + s;
      const float* gradient = by_inputs + s * net.inputs;
      Between at_samples[3];
      for (int axis = 0; axis < 3; ++axis) at_samples[axis] = between(net, splat, axis);
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
  const float* features = net.by_inputs + skipped;
  constexpr std::int64_t ahead = 8;
  for (std::int64_t i = 0; i < count; ++i) {
    if (i + ahead < count) {
      const float* later = features + static_cast<std::size_t>(order[i + ahead]) * net.inputs;
      for (int k = 0; k < channels; k += 16) HEADBENCH_PREFETCH(later + k);
    }
    const float* gradient = features + static_cast<std::size_t>(order[i]) * net.inputs;
    const Between x = between(net, order[i], across), y = between(net, order[i], down);
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

inline std::size_t line_backward_scratch(const LineTraining& in) {
  return static_cast<std::size_t>(3 * kNetworkTile) * in.units_stride + kNetworkTile * in.net.outputs +
         kNetworkTile / kSparseGroup * in.net.units;
}

// Add the gradient of an entry's first layer to the rows of the table that it was interpolated from.
HEADBENCH_INLINE void add_first(const OffsetNetwork& net, const LineSums& at, std::int64_t entry, const float* first,
                                const float* by_first, float* sums) {
  const Place<float> place = place_of(sums + at.table, net.units, net.rows + 3 * entry, net.fractions + 3 * entry);
  for (int unit = 0; unit < net.units; unit += W) {
    const Mask on = load(first + unit) > Real(0.0f);
    if (!any(on)) continue;
    const Real gradient = zero_unless(on, load(by_first + unit));
    for (int axis = 0; axis < 3; ++axis) {
      float* to = place.lower[axis] + unit;
      store(to, fma(gradient, place.lower_weight[axis], load(to)));
      store(to + net.units, fma(gradient, place.upper_weight[axis], load(to + net.units)));
    }
  }
}

inline void line_backward(const LineTraining& in, const LineSums& at, std::int64_t begin, std::int64_t end, float* sums,
                          float* scratch) {
  const OffsetNetwork& net = in.net;
  const int units = net.units, stride = in.units_stride, outputs = net.outputs;
  float* first = scratch;
  float* by_second = first + kNetworkTile * stride;
  float* by_first = by_second + kNetworkTile * stride;
  float* by_out = by_first + kNetworkTile * stride;
  std::int32_t* list = reinterpret_cast<std::int32_t*>(by_out + kNetworkTile * outputs);
  for (std::int64_t tile = begin; tile < end; tile += kNetworkTile) {
    const int used = end - tile < kNetworkTile ? static_cast<int>(end - tile) : kNetworkTile;
    const int groups = (used + kSparseGroup - 1) / kSparseGroup, rows = groups * kSparseGroup;
    const float* second[kNetworkTile];
    for (int s = 0; s < rows; ++s) {
      const std::int64_t entry = in.entries[tile + (s < used ? s : 0)];
      second[s] = net.kept + entry * units;
      if (tile + kNetworkTile + s < end)
        prefetch_floats(net.kept + in.entries[tile + kNetworkTile + s] * units, units, units);
      first_layer(net, entry, first + s * stride);
      for (int output = 0; output < outputs; ++output) {
        const float gradient = s < used ? in.by_offsets[net.splats[entry] * outputs + output] : 0.0f;
        by_out[s * outputs + output] = gradient;
        sums[at.bias_2 + output] += gradient;
      }
    }
    Lists<kSparseGroup> on = {list, units, {}};
    for (int unit = 0; unit < units; unit += W) {
      Real by_bias = load(sums + at.bias_1 + unit);
      for (int group = 0; group < groups; ++group) {
        Real most = 0.0f, sum = 0.0f;
        for (int s = group * kSparseGroup; s < (group + 1) * kSparseGroup; ++s) {
          const Real value = load(second[s] + unit);
          Real gradient = 0.0f;
          for (int output = 0; output < outputs; ++output)
            gradient = fma(load(net.last + static_cast<std::size_t>(output) * units + unit),
                           by_out[s * outputs + output], gradient);
          gradient = zero_unless(value > Real(0.0f), gradient);
          store(by_second + s * stride + unit, gradient);
          sum = sum + gradient;
          most = max(most, value);
        }
        by_bias = by_bias + sum;
        on.counts[group] += list_lanes(most > Real(0.0f), unit, list + group * units + on.counts[group]);
      }
      store(sums + at.bias_1 + unit, by_bias);
      for (int output = 0; output < outputs; ++output) {
        float* to = sums + at.weight_2 + static_cast<std::size_t>(output) * units + unit;
        Real parts[kSparseGroup] = {load(to)};
        for (int k = 1; k < kSparseGroup; ++k) parts[k] = 0.0f;
        for (int s = 0; s < rows; s += kSparseGroup)
          for (int k = 0; k < kSparseGroup; ++k)
            parts[k] = fma(load(second[s + k] + unit), by_out[(s + k) * outputs + output], parts[k]);
        for (int k = 1; k < kSparseGroup; ++k) parts[0] = parts[0] + parts[k];
        store(to, parts[0]);
      }
    }
    outer_product<kSparseGroup, kSparseVectors>(by_second, stride, on, groups, first, stride, units, sums + at.weight_1);
    product<kSparseGroup, kSparseVectors>(by_second, stride, on, groups, in.second_by_output, stride, units, nullptr, false,
                                          by_first, stride);
    for (int s = 0; s < used; ++s)
      add_first(net, at, in.entries[tile + s], first + s * stride, by_first + s * stride, sums);
  }
}

extern const NetworkKernels network_kernels;
const NetworkKernels network_kernels = {
    HEADBENCH_ISA_NAME, positions<false>, positions<true>, directions,     directions_backward, color_forward_scratch, color_forward,
    color_backward_scratch, color_backward, scatter_plane,       offset_scratch,        offset_network,
    line_backward_scratch,  line_backward};

}  // namespace headbench::HEADBENCH_ISA

// The training passes of the two networks of "ours" as a Python module's classes. Splats are dealt out to threads in
// chunks that do not depend on their number; a chunk's gradients by weights are summed in an accumulator of its own, and
// accumulators are added in order. A row of a plane belongs to one thread, which adds to it splat by splat. Results are
// therefore equal bit for bit for any number of threads.
#include "network_training.h"

#include <nanobind/stl/unique_ptr.h>

#include <algorithm>
#include <cstring>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "bench/native/module.h"
#include "frame.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench {
namespace {

constexpr std::int64_t kChunkMin = 2048;  // splats
constexpr std::int64_t kChunksMax = 32;
constexpr int kBandRows = 16;  // of a plane

// A multiple of kUnitsStep as an odd number of cache lines.
int odd_stride(std::int64_t width) {
  static_assert(kUnitsStep * sizeof(float) == 64);
  return static_cast<int>(width + (width / kUnitsStep % 2 ? 0 : kUnitsStep));
}

// (rows, columns) numbers in rows of `stride`, zeros behind them.
Buffer<float>& pad(Buffer<float>& to, const float* from, std::int64_t rows, std::int64_t columns, std::int64_t padded_rows,
                   std::int64_t stride) {
  std::memset(to.resize(padded_rows * stride), 0, padded_rows * stride * sizeof(float));
  for (std::int64_t row = 0; row < rows; ++row) std::copy_n(from + row * columns, columns, to.data() + row * stride);
  return to;
}

Buffer<float>& pad_transposed(Buffer<float>& to, const float* from, std::int64_t rows, std::int64_t columns,
                              std::int64_t padded_rows, std::int64_t stride) {
  std::memset(to.resize(padded_rows * stride), 0, padded_rows * stride * sizeof(float));
  for (std::int64_t row = 0; row < rows; ++row)
    for (std::int64_t column = 0; column < columns; ++column)
      to.data()[column * stride + row] = from[row * columns + column];
  return to;
}

void unpad(const float* from, std::int64_t rows, std::int64_t columns, std::int64_t stride, float* to) {
  for (std::int64_t row = 0; row < rows; ++row) std::copy_n(from + row * stride, columns, to + row * columns);
}

// Splats to a part of a sum: enough that the parts are few.
std::int64_t summed_chunk(std::int64_t count) {
  return std::max(kChunkMin, rounded_up(divided_up(count, kChunksMax), kNetworkTile));
}

// Order of `count` places by their (count, 3) lower samples: by the last number, then the middle one, then the first.
// Neighbours come beside each other: they read the same rows, and turn the same units on.
std::vector<std::uint32_t> order_of_places(const std::int32_t* lower, std::int64_t count, int samples) {
  std::vector<std::uint32_t> order(count), next(count), starts(samples);
  for (std::int64_t i = 0; i < count; ++i) order[i] = static_cast<std::uint32_t>(i);
  for (int axis = 0; axis < 3; ++axis) {
    std::fill(starts.begin(), starts.end(), 0);
    for (std::int64_t i = 0; i < count; ++i) ++starts[lower[3 * i + axis]];
    std::uint32_t total = 0;
    for (std::uint32_t& start : starts) total += std::exchange(start, total);
    for (const std::uint32_t i : order) next[starts[lower[3 * i + axis]]++] = i;
    order.swap(next);
  }
  return order;
}

Grid grid_of(const Array<const float, 2, 3>& box, std::size_t samples) {
  require(samples >= 2 && samples < (std::size_t{1} << 15));
  Grid grid{};
  for (int axis = 0; axis < 3; ++axis) {
    grid.low[axis] = box(0, axis);
    grid.extent[axis] = box(1, axis) - box(0, axis);
  }
  grid.samples = static_cast<int>(samples);
  return grid;
}

using Plane = Array<const float, -1, -1>;

// What both passes over the colours are given.
struct ColorInputs {
  Array<const float, -1, 3> positions, directions;
  Plane xy, xz, yz, first, last;
  Array<const float, 2, 3> box;
};

class ColorPass {
 public:
  ColorPass(const ColorInputs& in, const Array<float, -1, 3>& colors, const NetworkKernels& kernels, int threads)
      : kernels_(kernels), count_(static_cast<std::int64_t>(in.positions.shape(0))) {
    ColorTraining net = describe(in);
    require(colors.shape(0) == in.positions.shape(0));
    net.kept_hidden = hidden_.resize(rounded_up(count_, kGroupRows) * net.units);
    net.lower = lower_.resize(3 * count_);
    net.fractions = fractions_.resize(3 * count_);
    net.colors = colors.data();
    Buffer<float> first, last;
    net.first = pad_transposed(first, in.first.data(), hidden_units_, input_count_, net.inputs, net.units_stride).data();
    net.last = pad(last, in.last.data(), 3, hidden_units_, 3, net.units).data();
    nb::gil_scoped_release unlocked;
    const Scratch scratch(kernels_.color_forward_scratch(net), threads);
    parallel_for(count_, kChunkMin, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
      kernels_.color_forward(net, begin, end, scratch.of(worker));
    });
  }

  void backward(const ColorInputs& in, const Array<const float, -1, 3>& colors, const Array<const float, -1, 3>& by_colors,
                const Array<float, -1, 3>& by_positions, const Array<float, -1, 3>& by_directions,
                const Array<float, -1, -1>& by_xy, const Array<float, -1, -1>& by_xz, const Array<float, -1, -1>& by_yz,
                const Array<float, -1, -1>& by_first, const Array<float, -1, -1>& by_last, int threads) const {
    ColorTraining net = describe(in);
    const std::size_t all = in.positions.shape(0);
    require(colors.shape(0) == all && by_colors.shape(0) == all);
    const std::size_t wanted = by_positions.shape(0);
    require((wanted == all || wanted == 0) && by_directions.shape(0) == wanted);
    require(by_first.shape(0) == in.first.shape(0) && by_first.shape(1) == in.first.shape(1));
    require(by_last.shape(0) == 3 && by_last.shape(1) == in.last.shape(1));
    const Array<float, -1, -1>* by_planes[kPlanes] = {&by_xy, &by_xz, &by_yz};
    for (int plane = 0; plane < kPlanes; ++plane) {
      require(by_planes[plane]->shape(0) == in.xy.shape(0));
      require(static_cast<int>(by_planes[plane]->shape(1)) == net.channels[plane]);
      net.by_planes[plane] = by_planes[plane]->data();
    }
    net.kept_hidden = hidden_.data();
    net.lower = lower_.data();
    net.fractions = fractions_.data();
    net.colors = const_cast<float*>(colors.data());
    net.by_colors = by_colors.data();
    net.by_positions = wanted ? by_positions.data() : nullptr;
    net.by_directions = wanted ? by_directions.data() : nullptr;
    Buffer<float> first, last, by_features, sums;
    net.first = pad(first, in.first.data(), hidden_units_, input_count_, net.units, net.inputs_stride).data();
    net.last = pad(last, in.last.data(), 3, hidden_units_, 3, net.units).data();
    net.by_features = by_features.resize(count_ * net.features);
    const std::size_t of_first = static_cast<std::size_t>(net.units) * net.inputs;
    const ColorSums at{0, of_first, of_first + std::size_t{3} * net.units};
    float *first_out = by_first.data(), *last_out = by_last.data();
    nb::gil_scoped_release unlocked;
    const Scratch scratch(kernels_.color_backward_scratch(net), threads);
    parallel_sum(count_, summed_chunk(count_), at.end, threads, sums,
                 [&](std::int64_t begin, std::int64_t end, float* part, int worker) {
                   kernels_.color_backward(net, at, begin, end, part, scratch.of(worker));
                 });
    unpad(sums.data() + at.first, hidden_units_, input_count_, net.inputs, first_out);
    unpad(sums.data() + at.last, 3, hidden_units_, net.units, last_out);
    scatter(net, threads);
  }

 private:
  ColorTraining describe(const ColorInputs& in) {
    hidden_units_ = static_cast<std::int64_t>(in.first.shape(0));
    input_count_ = static_cast<std::int64_t>(in.first.shape(1));
    return std::as_const(*this).describe(in);
  }

  ColorTraining describe(const ColorInputs& in) const {
    ColorTraining net{};
    std::size_t samples = 2;
    while (samples * samples < in.xy.shape(0)) ++samples;
    net.grid = grid_of(in.box, samples);
    const Plane* planes[kPlanes] = {&in.xy, &in.xz, &in.yz};
    for (int plane = 0; plane < kPlanes; ++plane) {
      require(planes[plane]->shape(0) == samples * samples);
      net.channels[plane] = static_cast<int>(planes[plane]->shape(1));
      net.features += net.channels[plane];
      net.planes[plane] = planes[plane]->data();
    }
    require(static_cast<std::int64_t>(in.positions.shape(0)) == count_ && in.directions.shape(0) == in.positions.shape(0));
    require(static_cast<std::int64_t>(in.first.shape(0)) == hidden_units_);
    require(static_cast<std::int64_t>(in.first.shape(1)) == input_count_ && input_count_ == net.features + kEncoding);
    require(in.last.shape(0) == 3 && static_cast<std::int64_t>(in.last.shape(1)) == hidden_units_);
    net.units = static_cast<int>(rounded_up(hidden_units_, kUnitsStep));
    net.inputs = static_cast<int>(rounded_up(input_count_, kUnitsStep));
    net.units_stride = odd_stride(net.units);
    net.inputs_stride = odd_stride(net.inputs);
    net.count = count_;
    net.positions = in.positions.data();
    net.directions = in.directions.data();
    return net;
  }

  static std::int32_t row_of(const ColorTraining& net, std::int64_t splat, int axis) {
    const std::int32_t lower = net.lower[3 * splat + axis];
    return lower < 0 ? ~lower : lower;
  }

  // Gradients by the planes: splats in the order of their lower row of samples, rows dealt out in bands.
  void scatter(const ColorTraining& net, int threads) const {
    const int samples = net.grid.samples;
    Buffer<std::uint32_t> orders[2];
    std::vector<std::uint32_t> starts[2], next[2];
    for (int k = 0; k < 2; ++k) {
      orders[k].resize(count_);
      starts[k].assign(samples + 1, 0);
      next[k].resize(samples);
    }
    parallel_for(2, 1, threads, [&](std::int64_t k, std::int64_t) {
      const int axis = static_cast<int>(k) + 1;
      std::vector<std::uint32_t>& from = starts[k];
      for (std::int64_t i = 0; i < count_; ++i) ++from[row_of(net, i, axis) + 1];
      for (int row = 0; row < samples; ++row) from[row + 1] += from[row];
      std::copy(from.begin(), from.end() - 1, next[k].begin());
      for (std::int64_t i = 0; i < count_; ++i) orders[k].data()[next[k][row_of(net, i, axis)]++] = static_cast<std::uint32_t>(i);
    });
    const std::int64_t bands = divided_up(samples, kBandRows);
    parallel_for(kPlanes * bands, 1, threads, [&](std::int64_t task, std::int64_t) {
      const int plane = static_cast<int>(task / bands), k = kPlaneAxes[plane][1] - 1;
      const int first = static_cast<int>(task % bands) * kBandRows, last = std::min(first + kBandRows, samples) - 1;
      const std::size_t row_floats = static_cast<std::size_t>(samples) * net.channels[plane];
      std::fill_n(net.by_planes[plane] + first * row_floats, (last - first + 1) * row_floats, 0.0f);
      for (int row = std::max(first - 1, 0); row <= last; ++row)
        kernels_.scatter_plane(net, plane, row, orders[k].data() + starts[k][row], starts[k][row + 1] - starts[k][row],
                               first, last);
    });
  }

  const NetworkKernels& kernels_;
  const std::int64_t count_;
  std::int64_t hidden_units_ = 0, input_count_ = 0;
  Buffer<float> hidden_, fractions_;
  Buffer<std::int32_t> lower_;
};

// The weights that both passes over the lines are given.
struct LineWeights {
  Array<const float, -1, -1> table;
  Array<const float, -1> bias_0;
  Array<const float, -1, -1> weight_1;
  Array<const float, -1> bias_1;
  Array<const float, -1, -1> weight_2;
  Array<const float, -1> bias_2;
};

class LinePass {
 public:
  LinePass(const LineWeights& in, const Array<const float, -1, 3>& positions, const Array<const float, 2, 3>& box,
           const Array<float, -1, -1>& offsets, const NetworkKernels& kernels, int threads)
      : kernels_(kernels), all_(positions.shape(0)), hidden_(in.bias_0.shape(0)), outputs_(in.bias_2.shape(0)),
        table_rows_(in.table.shape(0)) {
    require(offsets.shape(0) == all_ && offsets.shape(1) == outputs_ && table_rows_ % 3 == 0);
    find_places(grid_of(box, table_rows_ / 3), box, positions.data());
    Padded weights(*this, in, true);
    OffsetNetwork net = describe(weights);
    net.kept = kept_.resize(rounded_up(count_, kGroupRows) * net.units);
    net.offsets = offsets.data();
    nb::gil_scoped_release unlocked;
    const Scratch scratch(kernels_.offset_scratch(net), threads);
    parallel_for(count_, kChunkMin, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
      kernels_.offset_network(net, begin, end, scratch.of(worker));
    });
  }

  void backward(const LineWeights& in, const Array<const float, -1, -1>& by_offsets, const Array<float, -1, -1>& by_table,
                const Array<float, -1>& by_bias_0, const Array<float, -1, -1>& by_weight_1,
                const Array<float, -1>& by_bias_1, const Array<float, -1, -1>& by_weight_2,
                const Array<float, -1>& by_bias_2, int threads) const {
    require(by_offsets.shape(0) == all_ && by_offsets.shape(1) == outputs_);
    require(by_table.shape(0) == table_rows_ && by_table.shape(1) == hidden_ && by_bias_0.shape(0) == hidden_);
    require(by_weight_1.shape(0) == hidden_ && by_weight_1.shape(1) == hidden_ && by_bias_1.shape(0) == hidden_);
    require(by_weight_2.shape(0) == outputs_ && by_weight_2.shape(1) == hidden_ && by_bias_2.shape(0) == outputs_);
    Padded weights(*this, in, false);
    LineTraining net{describe(weights), weights.weight_1.data(), odd_stride(weights.units), 0, nullptr, by_offsets.data()};
    net.net.kept = kept_.data();
    Buffer<std::int64_t> entries;
    entries.resize(count_);
    for (std::int64_t entry = 0, found = 0; entry < count_; ++entry) {
      const float* gradient = net.by_offsets + splats_.data()[entry] * outputs_;
      bool any = false;
      for (std::size_t output = 0; output < outputs_; ++output) any |= gradient[output] != 0.0f;
      entries.data()[found] = entry;
      found += any;
      net.count = found;
    }
    net.entries = entries.data();
    const std::size_t units = static_cast<std::size_t>(weights.units);
    LineSums at{};
    at.weight_1 = table_rows_ * units;
    at.bias_1 = at.weight_1 + units * units;
    at.weight_2 = at.bias_1 + units;
    at.bias_2 = at.weight_2 + outputs_ * units;
    at.end = at.bias_2 + outputs_;
    const std::pair<float*, float*> written[] = {
        {by_table.data(), by_bias_0.data()}, {by_weight_1.data(), by_bias_1.data()}, {by_weight_2.data(), by_bias_2.data()}};
    nb::gil_scoped_release unlocked;
    Buffer<float> sums;
    const Scratch scratch(kernels_.line_backward_scratch(net), threads);
    parallel_sum(net.count, summed_chunk(net.count), at.end, threads, sums,
                 [&](std::int64_t begin, std::int64_t end, float* part, int worker) {
                   kernels_.line_backward(net, at, begin, end, part, scratch.of(worker));
                 });
    const float* from = sums.data();
    unpad(from + at.table, table_rows_, hidden_, units, written[0].first);
    // An entry's two weights on an axis add up to 1: what the first axis' rows were given is what the bias gets.
    std::fill_n(written[0].second, hidden_, 0.0f);
    for (std::size_t row = 0; row < table_rows_ / 3; ++row)
      for (std::size_t unit = 0; unit < hidden_; ++unit) written[0].second[unit] += from[at.table + row * units + unit];
    unpad(from + at.weight_1, hidden_, hidden_, units, written[1].first);
    unpad(from + at.bias_1, 1, hidden_, units, written[1].second);
    unpad(from + at.weight_2, outputs_, hidden_, units, written[2].first);
    unpad(from + at.bias_2, 1, outputs_, outputs_, written[2].second);
  }

 private:
  // Weights with zeros added; those of the second layer transposed for the forward pass.
  struct Padded {
    Buffer<float> table, bias_0, weight_1, bias_1, weight_2;
    const float* bias_2;
    int units;
    Padded(const LinePass& pass, const LineWeights& in, bool transposed) {
      const std::int64_t hidden = static_cast<std::int64_t>(pass.hidden_), outputs = static_cast<std::int64_t>(pass.outputs_);
      const std::int64_t width = rounded_up(hidden, kUnitsStep);
      require(in.table.shape(0) == pass.table_rows_ && in.table.shape(1) == pass.hidden_ && in.bias_0.shape(0) == pass.hidden_);
      require(in.weight_1.shape(0) == pass.hidden_ && in.weight_1.shape(1) == pass.hidden_);
      require(in.bias_1.shape(0) == pass.hidden_ && in.weight_2.shape(0) == pass.outputs_);
      require(in.weight_2.shape(1) == pass.hidden_ && in.bias_2.shape(0) == pass.outputs_);
      const std::int64_t rows = static_cast<std::int64_t>(pass.table_rows_);
      pad(table, in.table.data(), rows, hidden, rows, width);
      pad(bias_0, in.bias_0.data(), 1, hidden, 1, width);
      (transposed ? pad_transposed : pad)(weight_1, in.weight_1.data(), hidden, hidden, width, odd_stride(width));
      pad(bias_1, in.bias_1.data(), 1, hidden, 1, width);
      pad(weight_2, in.weight_2.data(), outputs, hidden, outputs, width);
      bias_2 = in.bias_2.data();
      units = static_cast<int>(width);
    }
  };

  OffsetNetwork describe(const Padded& weights) const {
    OffsetNetwork net{};
    net.units = net.hidden = weights.units;
    net.outputs = static_cast<int>(outputs_);
    net.second_stride = odd_stride(weights.units);
    net.table = weights.table.data();
    net.first_bias = weights.bias_0.data();
    net.rows = rows_.data();
    net.fractions = fractions_.data();
    net.second = weights.weight_1.data();
    net.second_bias = weights.bias_1.data();
    net.last = weights.weight_2.data();
    net.last_bias = weights.bias_2;
    net.splats = splats_.data();
    return net;
  }

  // The splats in the box, in the order of their places on the lines, which are as `line_position` has them.
  void find_places(const Grid& grid, const Array<const float, 2, 3>& box, const float* positions) {
    const float last = static_cast<float>(grid.samples - 1);
    Buffer<std::int64_t> found;
    Buffer<std::int32_t> lower;
    Buffer<float> rest;
    found.resize(all_);
    lower.resize(3 * all_);
    rest.resize(3 * all_);
    std::int64_t count = 0;
    for (std::size_t splat = 0; splat < all_; ++splat) {
      const float* position = positions + 3 * splat;
      bool inside = true;
      for (int axis = 0; axis < 3; ++axis) inside &= position[axis] >= box(0, axis) && position[axis] <= box(1, axis);
      if (!inside) continue;
      for (int axis = 0; axis < 3; ++axis) {
        const float along = (position[axis] - grid.low[axis]) / grid.extent[axis] * last;
        const float clamped = along > 0.0f ? std::min(along, last) : 0.0f;  // also of NaN, in a box without extent
        const int row = std::min(static_cast<int>(clamped), grid.samples - 2);
        lower.data()[3 * count + axis] = row;
        rest.data()[3 * count + axis] = clamped - static_cast<float>(row);
      }
      found.data()[count++] = static_cast<std::int64_t>(splat);
    }
    count_ = count;
    const std::vector<std::uint32_t> order = order_of_places(lower.data(), count, grid.samples);
    splats_.resize(count);
    rows_.resize(3 * count);
    fractions_.resize(3 * count);
    for (std::int64_t i = 0; i < count; ++i) {
      const std::uint32_t from = order[i];
      splats_.data()[i] = found.data()[from];
      for (int axis = 0; axis < 3; ++axis) {
        rows_.data()[3 * i + axis] = lower.data()[3 * from + axis] + axis * grid.samples;
        fractions_.data()[3 * i + axis] = rest.data()[3 * from + axis];
      }
    }
  }

  const NetworkKernels& kernels_;
  const std::size_t all_, hidden_, outputs_, table_rows_;
  std::int64_t count_ = 0;
  Buffer<std::int64_t> splats_;
  Buffer<std::int32_t> rows_;
  Buffer<float> fractions_, kept_;
};

const NetworkKernels& kernels_of(const std::string& instruction_set) {
  return variant_of(runnable_network_kernels(), instruction_set);
}

void position_training(const Array<const std::int64_t, -1>& binding, const Array<const float, -1, 9>& linear,
                       const Array<const float, -1, 3>& centers, const Array<const float, -1, 3>& values,
                       const Array<float, -1, 3>& out, bool backward, const std::string& instruction_set, int threads) {
  const std::size_t count = values.shape(0);
  require(binding.shape(0) == count && out.shape(0) == count && linear.shape(0) == centers.shape(0));
  require(below(binding.data(), count, linear.shape(0)));
  const PositionTraining in{binding.data(), linear.data(), centers.data(), values.data(), out.data()};
  const NetworkKernels& kernels = kernels_of(instruction_set);
  nb::gil_scoped_release unlocked;
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) {
    (backward ? kernels.positions_backward : kernels.positions)(in, begin, end);
  });
}

void direction_training(const Array<const std::int64_t, -1>& binding, const Array<const float, -1, 3, 3>& turns,
                        const Array<const float, 3, 3>& last, const Array<const float, 3>& center,
                        const Array<const float, -1, 3>& means, const Array<const float, -1, 3>& by_directions,
                        const Array<float, -1, 3>& out, const std::string& instruction_set, int threads) {
  const std::size_t count = means.shape(0);
  const bool backward = by_directions.shape(0) != 0;
  require(binding.shape(0) == count && out.shape(0) == count && (!backward || by_directions.shape(0) == count));
  require(below(binding.data(), count, turns.shape(0)));
  DirectionTraining in{binding.data(), turns.data(), {}, {}, means.data(), out.data(), by_directions.data(), out.data()};
  std::copy_n(last.data(), 9, in.last);
  std::copy_n(center.data(), 3, in.center);
  const NetworkKernels& kernels = kernels_of(instruction_set);
  nb::gil_scoped_release unlocked;
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) {
    (backward ? kernels.directions_backward : kernels.directions)(in, begin, end);
  });
}

}  // namespace

void bind_network_training(nb::module_& m) {
  m.def("position_training", &position_training, "binding"_a, "linear"_a, "centers"_a, "values"_a, "out"_a,
        "backward"_a, "instruction_set"_a, "threads"_a,
        "Write canonical positions of local means; backward, the gradients by the means of those by the positions.");
  m.def("direction_training", &direction_training, "binding"_a, "turns"_a, "last"_a, "center"_a, "means"_a,
        "by_directions"_a, "out"_a, "instruction_set"_a, "threads"_a,
        "Write canonical directions; or, where gradients by them are given, the gradients by the means.");
  using Values = Array<const float, -1, -1>;
  using Vectors = Array<const float, -1, 3>;
  using Vector = Array<const float, -1>;
  nb::class_<ColorPass>(m, "ColorPass", "Colours of the colour network in training, kept for their gradients.")
      .def("backward", [](const ColorPass& pass, const Vectors& positions, const Vectors& directions, const Plane& xy,
                          const Plane& xz, const Plane& yz, const Values& first, const Values& last,
                          const Array<const float, 2, 3>& box, const Vectors& colors, const Vectors& by_colors,
                          const Array<float, -1, 3>& by_positions, const Array<float, -1, 3>& by_directions,
                          const Array<float, -1, -1>& by_xy, const Array<float, -1, -1>& by_xz,
                          const Array<float, -1, -1>& by_yz, const Array<float, -1, -1>& by_first,
                          const Array<float, -1, -1>& by_last, int threads) {
        pass.backward({positions, directions, xy, xz, yz, first, last, box}, colors, by_colors, by_positions, by_directions,
                      by_xy, by_xz, by_yz, by_first, by_last, std::max(threads, 1));
      });
  m.def("color_training", [](const Vectors& positions, const Vectors& directions, const Plane& xy, const Plane& xz,
                             const Plane& yz, const Values& first, const Values& last, const Array<const float, 2, 3>& box,
                             const Array<float, -1, 3>& colors, const std::string& instruction_set, int threads) {
    return std::make_unique<ColorPass>(ColorInputs{positions, directions, xy, xz, yz, first, last, box}, colors,
                                       kernels_of(instruction_set), std::max(threads, 1));
  }, "Write the colours.");
  nb::class_<LinePass>(m, "LinePass", "Offsets of the feature lines in training, kept for their gradients.")
      .def("backward", [](const LinePass& pass, const Values& table, const Vector& bias_0, const Values& weight_1,
                          const Vector& bias_1, const Values& weight_2, const Vector& bias_2, const Values& by_offsets,
                          const Array<float, -1, -1>& by_table, const Array<float, -1>& by_bias_0,
                          const Array<float, -1, -1>& by_weight_1, const Array<float, -1>& by_bias_1,
                          const Array<float, -1, -1>& by_weight_2, const Array<float, -1>& by_bias_2, int threads) {
        pass.backward({table, bias_0, weight_1, bias_1, weight_2, bias_2}, by_offsets, by_table, by_bias_0, by_weight_1,
                      by_bias_1, by_weight_2, by_bias_2, std::max(threads, 1));
      });
  m.def("line_training", [](const Values& table, const Vector& bias_0, const Values& weight_1, const Vector& bias_1,
                            const Values& weight_2, const Vector& bias_2, const Vectors& positions,
                            const Array<const float, 2, 3>& box, const Array<float, -1, -1>& offsets,
                            const std::string& instruction_set, int threads) {
    return std::make_unique<LinePass>(LineWeights{table, bias_0, weight_1, bias_1, weight_2, bias_2}, positions, box, offsets,
                                      kernels_of(instruction_set), std::max(threads, 1));
  }, "Write the offsets of the splats in the box, those of no others.");
}

}  // namespace headbench

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

#include "calls.h"

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

Grid grid_of(const float* box, std::int64_t samples) {
  require(samples >= 2 && samples < std::int64_t{1} << 15);
  Grid grid{};
  for (int axis = 0; axis < 3; ++axis) {
    grid.low[axis] = box[axis];
    grid.extent[axis] = box[3 + axis] - box[axis];
  }
  grid.samples = static_cast<int>(samples);
  return grid;
}

const NetworkKernels& network_kernels_of(const std::string& instruction_set) {
  return variant_of(runnable_network_kernels(), instruction_set);
}

// What both passes over the colours are given, with `first` and `last` as they are before zeros are added.
struct ColorInputs {
  Size count, rows, channels[kPlanes], hidden, inputs;
  ColorTraining net{};
  const float *first, *last;

  explicit ColorInputs(Arguments& from) {
    net.positions = from(count, 3);
    net.directions = from(count, 3);
    for (int plane = 0; plane < kPlanes; ++plane) {
      net.planes[plane] = from(rows, channels[plane]);
      net.channels[plane] = static_cast<int>(channels[plane]);
      net.features += net.channels[plane];
    }
    first = from(hidden, inputs);
    last = from(3, hidden);
    const float* box = from(2, 3);
    net.colors = from(count, 3);
    std::int64_t samples = 2;
    while (samples * samples < rows) ++samples;
    require(samples * samples == rows && inputs == net.features + kEncoding);
    net.grid = grid_of(box, samples);
    net.units = static_cast<int>(rounded_up(hidden, kUnitsStep));
    net.inputs = static_cast<int>(rounded_up(inputs, kUnitsStep));
    net.units_stride = odd_stride(net.units);
    net.inputs_stride = odd_stride(net.inputs);
    net.count = count;
  }
};

class ColorPass {
 public:
  ColorPass(const nb::tuple& arrays, const std::string& instruction_set, int threads)
      : kernels_(network_kernels_of(instruction_set)) {
    Arguments from(arrays);
    const ColorInputs in(from);
    ColorTraining net = in.net;
    net.kept_hidden = hidden_.resize(rounded_up(net.count, kGroupRows) * net.units);
    net.lower = lower_.resize(3 * net.count);
    net.fractions = fractions_.resize(3 * net.count);
    done_ = net;
    Buffer<float> first, last;
    net.first = pad_transposed(first, in.first, in.hidden, in.inputs, net.inputs, net.units_stride).data();
    net.last = pad(last, in.last, 3, in.hidden, 3, net.units).data();
    const nb::gil_scoped_release unlocked;
    const Scratch scratch(kernels_.color_forward_scratch(net), threads);
    parallel_for(net.count, kChunkMin, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
      kernels_.color_forward(net, begin, end, scratch.of(worker));
    });
  }

  void backward(const nb::tuple& arrays, int threads) const {
    Arguments from(arrays);
    ColorInputs in(from);
    ColorTraining net = in.net;
    require(net.count == done_.count && net.units == done_.units && net.grid.samples == done_.grid.samples);
    net.by_colors = from(in.count, 3);
    net.by_positions = from.optional(in.count, 3);
    net.by_directions = from.optional(in.count, 3);
    require(!net.by_positions == !net.by_directions);
    for (int plane = 0; plane < kPlanes; ++plane) net.by_planes[plane] = from(in.rows, in.channels[plane]);
    float *by_first = from(in.hidden, in.inputs), *by_last = from(3, in.hidden);
    net.kept_hidden = hidden_.data();
    net.lower = lower_.data();
    net.fractions = fractions_.data();
    Buffer<float> first, last, sums;
    const Buffer<float> by_inputs(rounded_up(net.count, kGroupRows) * net.inputs);
    net.first = pad(first, in.first, in.hidden, in.inputs, net.units, net.inputs_stride).data();
    net.last = pad(last, in.last, 3, in.hidden, 3, net.units).data();
    net.by_inputs = by_inputs.data();
    const std::size_t of_first = static_cast<std::size_t>(net.units) * net.inputs;
    const ColorSums at{0, of_first, of_first + std::size_t{3} * net.units};
    const nb::gil_scoped_release unlocked;
    const Scratch scratch(kernels_.color_backward_scratch(net), threads);
    parallel_sum(net.count, summed_chunk(net.count), at.end, threads, sums,
                 [&](std::int64_t begin, std::int64_t end, float* part, int worker) {
                   kernels_.color_backward(net, at, begin, end, part, scratch.of(worker));
                 });
    unpad(sums.data() + at.first, in.hidden, in.inputs, net.inputs, by_first);
    unpad(sums.data() + at.last, 3, in.hidden, net.units, by_last);
    scatter(net, threads);
  }

 private:
  static std::int32_t row_of(const ColorTraining& net, std::int64_t splat, int axis) {
    const std::int32_t lower = net.lower[3 * splat + axis];
    return lower < 0 ? ~lower : lower;
  }

  // Gradients by the planes: splats in the order of their lower row of samples, rows dealt out in bands.
  void scatter(const ColorTraining& net, int threads) const {
    const int samples = net.grid.samples;
    Groups splats[2];  // of the second and the third axis
    parallel_for(2, 1, threads, [&](std::int64_t k, std::int64_t) {
      splats[k] = group_by_key(net.count, samples, [&](std::int64_t i) { return row_of(net, i, static_cast<int>(k) + 1); });
    });
    const std::int64_t bands = divided_up(samples, kBandRows);
    parallel_for(kPlanes * bands, 1, threads, [&](std::int64_t task, std::int64_t) {
      const int plane = static_cast<int>(task / bands);
      const auto& [starts, order] = splats[kPlaneAxes[plane][1] - 1];
      const int first = static_cast<int>(task % bands) * kBandRows, last = std::min(first + kBandRows, samples) - 1;
      const std::size_t row_floats = static_cast<std::size_t>(samples) * net.channels[plane];
      std::fill_n(net.by_planes[plane] + first * row_floats, (last - first + 1) * row_floats, 0.0f);
      for (int row = std::max(first - 1, 0); row <= last; ++row)
        kernels_.scatter_plane(net, plane, row, order.data() + starts[row], starts[row + 1] - starts[row], first, last);
    });
  }

  const NetworkKernels& kernels_;
  ColorTraining done_{};  // the forward pass, of which only the sizes are still valid
  Buffer<float> hidden_, fractions_;
  Buffer<std::int32_t> lower_;
};

// The weights that both passes over the lines are given; backward also their gradients.
template <class T>
struct LineWeights {
  T *table, *bias_0, *weight_1, *bias_1, *weight_2, *bias_2;

  LineWeights(Arguments& from, Size& rows, Size& hidden, Size& outputs)
      : table(from(rows, hidden)), bias_0(from(hidden)), weight_1(from(hidden, hidden)), bias_1(from(hidden)),
        weight_2(from(outputs, hidden)), bias_2(from(outputs)) {}
};

class LinePass {
 public:
  LinePass(const nb::tuple& arrays, const std::string& instruction_set, int threads)
      : kernels_(network_kernels_of(instruction_set)) {
    Arguments from(arrays);
    const LineWeights<const float> in(from, table_rows_, hidden_, outputs_);
    const float *positions = from(all_, 3), *box = from(2, 3);
    float* offsets = from(all_, outputs_);
    require(table_rows_ % 3 == 0);
    find_places(grid_of(box, table_rows_ / 3), box, positions);
    Padded weights(*this, in, true);
    OffsetNetwork net = describe(weights);
    net.kept = kept_.resize(rounded_up(count_, kGroupRows) * net.units);
    net.offsets = offsets;
    const nb::gil_scoped_release unlocked;
    const Scratch scratch(kernels_.offset_scratch(net), threads);
    parallel_for(count_, kChunkMin, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
      kernels_.offset_network(net, begin, end, scratch.of(worker));
    });
  }

  void backward(const nb::tuple& arrays, int threads) {
    Arguments from(arrays);
    const LineWeights<const float> in(from, table_rows_, hidden_, outputs_);
    const float* by_offsets = from(all_, outputs_);
    const LineWeights<float> by(from, table_rows_, hidden_, outputs_);
    Padded weights(*this, in, false);
    LineTraining net{describe(weights), weights.weight_1.data(), odd_stride(weights.units), 0, nullptr, by_offsets};
    net.net.kept = kept_.data();
    const Buffer<std::int64_t> entries(count_);
    for (std::int64_t entry = 0, found = 0; entry < count_; ++entry) {
      const float* gradient = by_offsets + splats_.data()[entry] * outputs_;
      bool any = false;
      for (std::int64_t output = 0; output < outputs_; ++output) any |= gradient[output] != 0.0f;
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
    const nb::gil_scoped_release unlocked;
    Buffer<float> sums;
    const Scratch scratch(kernels_.line_backward_scratch(net), threads);
    parallel_sum(net.count, summed_chunk(net.count), at.end, threads, sums,
                 [&](std::int64_t begin, std::int64_t end, float* part, int worker) {
                   kernels_.line_backward(net, at, begin, end, part, scratch.of(worker));
                 });
    const float* summed = sums.data();
    unpad(summed + at.table, table_rows_, hidden_, units, by.table);
    // An entry's two weights on an axis add up to 1: what the first axis' rows were given is what the bias gets.
    std::fill_n(by.bias_0, hidden_, 0.0f);
    for (std::int64_t row = 0; row < table_rows_ / 3; ++row)
      for (std::int64_t unit = 0; unit < hidden_; ++unit) by.bias_0[unit] += summed[at.table + row * units + unit];
    unpad(summed + at.weight_1, hidden_, hidden_, units, by.weight_1);
    unpad(summed + at.bias_1, 1, hidden_, units, by.bias_1);
    unpad(summed + at.weight_2, outputs_, hidden_, units, by.weight_2);
    unpad(summed + at.bias_2, 1, outputs_, outputs_, by.bias_2);
  }

 private:
  // Weights with zeros added; those of the second layer transposed for the forward pass.
  struct Padded {
    Buffer<float> table, bias_0, weight_1, bias_1, weight_2;
    const float* bias_2;
    int units;
    Padded(const LinePass& pass, const LineWeights<const float>& in, bool transposed)
        : bias_2(in.bias_2), units(static_cast<int>(rounded_up(pass.hidden_, kUnitsStep))) {
      const std::int64_t rows = pass.table_rows_, hidden = pass.hidden_, outputs = pass.outputs_;
      pad(table, in.table, rows, hidden, rows, units);
      pad(bias_0, in.bias_0, 1, hidden, 1, units);
      (transposed ? pad_transposed : pad)(weight_1, in.weight_1, hidden, hidden, units, odd_stride(units));
      pad(bias_1, in.bias_1, 1, hidden, 1, units);
      pad(weight_2, in.weight_2, outputs, hidden, outputs, units);
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
  void find_places(const Grid& grid, const float* box, const float* positions) {
    const float last = static_cast<float>(grid.samples - 1);
    const Buffer<std::int64_t> found(all_);
    const Buffer<std::int32_t> lower(3 * all_);
    const Buffer<float> rest(3 * all_);
    std::int64_t count = 0;
    for (std::int64_t splat = 0; splat < all_; ++splat) {
      const float* position = positions + 3 * splat;
      bool inside = true;
      for (int axis = 0; axis < 3; ++axis) inside &= position[axis] >= box[axis] && position[axis] <= box[3 + axis];
      if (!inside) continue;
      for (int axis = 0; axis < 3; ++axis) {
        const float along = (position[axis] - grid.low[axis]) / grid.extent[axis] * last;
        const float clamped = along > 0.0f ? std::min(along, last) : 0.0f;  // also of NaN, in a box without extent
        const int row = std::min(static_cast<int>(clamped), grid.samples - 2);
        lower.data()[3 * count + axis] = row;
        rest.data()[3 * count + axis] = clamped - static_cast<float>(row);
      }
      found.data()[count++] = splat;
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
  Size all_, hidden_, outputs_, table_rows_;
  std::int64_t count_ = 0;
  Buffer<std::int64_t> splats_;
  Buffer<std::int32_t> rows_;
  Buffer<float> fractions_, kept_;
};

void positions(const nb::tuple& arguments, const std::string& instruction_set, int threads) {
  Arguments from(arguments);
  Size count, triangles;
  const PositionTraining in{from(count), from(triangles, 9), from(triangles, 3), from(count, 3), from(count, 3)};
  require(below(in.binding, count, triangles));
  const NetworkKernels& kernels = network_kernels_of(instruction_set);
  run(from.number<bool>() ? kernels.positions_backward : kernels.positions, in, count, threads);
}

void directions(const nb::tuple& arrays, const std::string& instruction_set, int threads) {
  Arguments from(arrays);
  Size count, triangles;
  const DirectionTraining in{from(count), from(triangles, 3, 3), from(3, 3), from(3), from(count, 3), from.optional(count, 3),
                             from(count, 3)};
  require(below(in.binding, count, triangles));
  const NetworkKernels& kernels = network_kernels_of(instruction_set);
  run(in.by_directions ? kernels.directions_backward : kernels.directions, in, count, threads);
}

template <class Pass>
std::unique_ptr<Pass> make(const nb::tuple& arrays, const std::string& instruction_set, int threads) {
  return std::make_unique<Pass>(arrays, instruction_set, threads);
}

}  // namespace

void bind_network_training(nb::module_& m) {
  const auto define = [&](const char* name, auto function, const char* help) {
    m.def(name, function, "arguments"_a, "instruction_set"_a, "threads"_a, help);
  };
  define("position_training", &positions,
         "Write canonical positions of local means; backward, the gradients by the means of those by the positions.");
  define("direction_training", &directions,
         "Write canonical directions; or, where gradients by them are given, the gradients by the means.");
  nb::class_<ColorPass>(m, "ColorPass", "Colours of the colour network in training, kept for their gradients.")
      .def("backward", &ColorPass::backward, "arrays"_a, "threads"_a);
  define("color_training", &make<ColorPass>, "Write the colours.");
  nb::class_<LinePass>(m, "LinePass", "Offsets of the feature lines in training, kept for their gradients.")
      .def("backward", &LinePass::backward, "arrays"_a, "threads"_a);
  define("line_training", &make<LinePass>, "Write the offsets of the splats in the box, those of no others.");
}

}  // namespace headbench

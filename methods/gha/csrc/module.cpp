// GHA's networks as a Python module. Arrays are typed and contiguous; outputs are allocated by the caller. Work is dealt out
// to threads in tiles and strips that do not depend on their number, and what chunks of it add up to is added in order:
// results are equal bit for bit for any number of threads.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <new>
#include <string>
#include <utility>
#include <vector>

#include <nanobind/stl/pair.h>

#include "bench/native/module.h"
#include "bench/native/thread_pool.h"
#include "motion.h"
#include "passes.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench::gha {
namespace {

using Rows = Array<const float, -1, -1>;
using Vector = Array<const float, -1>;
using RowsOut = Array<float, -1, -1>;
using VectorOut = Array<float, -1>;
using Image = Array<const float, -1, -1, -1>;
using ImageOut = Array<float, -1, -1, -1>;

constexpr std::int64_t kChunksMax = 16;       // accumulators of a gradient by weights
constexpr std::size_t kSumsPerTask = 8192;    // floats
constexpr int kStripRows = 8;                 // rows of an image that one task convolves, at most
constexpr std::size_t kStripFloats = 1 << 16;  // of its input; more only for a single row
constexpr std::int64_t kPointsPerTask = 512;
constexpr double kVarianceFloor = 1e-5;       // VARIANCE_FLOOR of gaussian_head.py

std::int64_t divided_up(std::int64_t value, std::int64_t by) { return (value + by - 1) / by; }
int whole_units(std::size_t count) { return static_cast<int>(divided_up(static_cast<std::int64_t>(count), kUnitsStep)) * kUnitsStep; }

// Uninitialised floats on a cache-line boundary.
class Floats {
 public:
  explicit Floats(std::size_t count) : data_(static_cast<float*>(::operator new(std::max<std::size_t>(count, 1) * sizeof(float), std::align_val_t{64}))) {}
  float* data() const { return data_.get(); }

 private:
  struct Free {
    void operator()(float* data) const { ::operator delete(data, std::align_val_t{64}); }
  };
  std::unique_ptr<float, Free> data_;
};

const Kernels& kernels_of(const std::string& name) {
  static const std::vector<const Kernels*> runnable = runnable_gha_kernels();
  return name.empty() ? *runnable.front() : variant_of(runnable, name);
}

// Call body(task, worker's scratch).
template <class Body>
void share_out(std::int64_t tasks, std::size_t scratch_floats, int threads, const Body& body) {
  const std::size_t stride = (scratch_floats + 15) / 16 * 16;
  const Floats scratch(stride * static_cast<std::size_t>(threads));
  ThreadPool::instance().run(tasks, threads, [&](std::int64_t task, int worker) {
    body(task, scratch.data() + stride * static_cast<std::size_t>(worker));
  });
}

// Call body(task, accumulator, scratch) for all tasks, those of a chunk one after the other with an accumulator of `floats`
// zeros; the sums over all of them.
template <class Body>
Floats sum_chunks(const Kernels& kernels, std::int64_t tasks, std::size_t floats, std::size_t scratch_floats, int threads,
                  const Body& body) {
  const std::int64_t per_chunk = std::max<std::int64_t>(divided_up(tasks, kChunksMax), 1);
  const std::int64_t chunks = std::max<std::int64_t>(divided_up(tasks, per_chunk), 1);
  const std::size_t stride = (floats + 15) / 16 * 16;
  Floats sums(stride * static_cast<std::size_t>(chunks));
  share_out(chunks, scratch_floats, threads, [&](std::int64_t chunk, float* scratch) {
    float* own = sums.data() + chunk * stride;
    std::fill_n(own, floats, 0.0f);
    for (std::int64_t task = chunk * per_chunk; task < std::min((chunk + 1) * per_chunk, tasks); ++task)
      body(task, own, scratch);
  });
  ThreadPool::instance().run(divided_up(static_cast<std::int64_t>(floats), kSumsPerTask), threads, [&](std::int64_t task, int) {
    const std::size_t begin = static_cast<std::size_t>(task) * kSumsPerTask, count = std::min(kSumsPerTask, floats - begin);
    for (std::int64_t chunk = 1; chunk < chunks; ++chunk)
      kernels.add(sums.data() + begin, sums.data() + chunk * stride + begin, count);
  });
  return sums;
}

bool within(const Array<const std::int64_t, -1>& rows, std::size_t limit) {
  bool all = true;
  for (std::size_t i = 0; i < rows.shape(0); ++i) all &= rows.data()[i] >= 0 && static_cast<std::size_t>(rows.data()[i]) < limit;
  return all;
}

// ---- Perceptrons ----

// What both passes are given.
struct Inputs {
  Rows points;
  Array<const std::int64_t, -1> rows;
  Vector influence;  // empty for none
  Rows condition;    // (conditions, C), C may be 0
  std::vector<Rows> weights;
  std::vector<Vector> biases;
  int again;  // the layer that points and condition come into once more; 0 for none
  int outputs;
  bool squashed;
  float slope;
};

// A `Perceptron` with padded copies of the weights it works on.
class Padded {
 public:
  Padded(const Inputs& in, bool forward, float* kept) : in_(in) {
    const std::size_t layers = in.weights.size();
    require(layers >= 1 && layers <= kLayersMax && in.biases.size() == layers);
    require(within(in.rows, in.points.shape(0)));
    require(in.influence.shape(0) == 0 || in.influence.shape(0) == in.rows.shape(0));
    require(in.condition.shape(0) >= 1 && (in.influence.shape(0) == 0 || in.condition.shape(0) == 1));
    const std::size_t conditions = in.condition.shape(0), condition_size = in.condition.shape(1);
    const std::size_t last = in.weights.back().shape(0);
    require(in.outputs >= 1 && static_cast<std::size_t>(in.outputs) <= last);
    net.layers = static_cast<int>(layers);
    net.point_inputs = static_cast<int>(in.points.shape(1));
    net.point_stride = whole_units(in.points.shape(1));
    net.outputs = in.outputs;
    net.squashed = in.squashed;
    net.slope = in.slope;
    net.count = static_cast<std::int64_t>(in.rows.shape(0));
    net.tiles = divided_up(net.count, kTileRows);
    net.points = in.points.data();
    net.rows = in.rows.data();
    net.influence = in.influence.shape(0) ? in.influence.data() : nullptr;
    std::size_t before = 0, kept_floats = 0;
    for (std::size_t l = 0; l < layers; ++l) {
      const Rows& weight = in.weights[l];
      Layer& layer = net.layer[l];
      const bool is_last = l + 1 == layers;
      const std::size_t outputs = is_last ? in.outputs : weight.shape(0), all = weight.shape(1);
      layer.takes_points = l == 0 || static_cast<int>(l) == in.again;
      require(in.biases[l].shape(0) == weight.shape(0));
      require(all == before + (layer.takes_points ? in.points.shape(1) + condition_size : 0));
      layer.inputs = whole_units(before);
      layer.outputs = whole_units(outputs);
      layer.hidden_sums = sum_floats;
      sum_floats += static_cast<std::size_t>(layer.inputs) * layer.outputs;
      layer.point_sums = sum_floats;
      if (layer.takes_points) sum_floats += static_cast<std::size_t>(net.point_stride) * layer.outputs;
      layer.bias_sums = net.bias_floats;
      net.bias_floats += layer.outputs;
      layer.kept = kept ? kept + kept_floats * conditions * net.tiles * kTileRows : nullptr;
      if (!is_last) kept_floats += layer.outputs;
      layer.of_hidden = part(weight, 0, before, outputs, layer.inputs, layer.outputs, forward);
      if (layer.takes_points)
        layer.of_points = part(weight, before, in.points.shape(1), outputs, net.point_stride, layer.outputs, forward);
      if (forward) layer.bias = biases(l, before + in.points.shape(1), outputs);
      before = outputs;
    }
  }

  // The columns of a layer's weights that belong to the condition.
  std::size_t condition_column(std::size_t layer) const {
    return (layer ? in_.weights[layer - 1].shape(0) : 0) + in_.points.shape(1);
  }

  Perceptron net{};
  std::size_t sum_floats = 0;

 private:
  // Some columns of the weights, padded with zeros: transposed, (columns, outputs), for the forward pass.
  const float* part(const Rows& weight, std::size_t first, std::size_t columns, std::size_t outputs, int column_stride,
                    int output_stride, bool transposed) {
    owned_.emplace_back(static_cast<std::size_t>(column_stride) * output_stride);
    float* to = owned_.back().data();
    std::fill_n(to, static_cast<std::size_t>(column_stride) * output_stride, 0.0f);
    for (std::size_t o = 0; o < outputs; ++o) {
      const float* from = weight.data() + o * weight.shape(1) + first;
      for (std::size_t k = 0; k < columns; ++k)
        to[transposed ? k * output_stride + o : o * column_stride + k] = from[k];
    }
    return to;
  }

  const float* biases(std::size_t l, std::size_t column, std::size_t outputs) {
    const Layer& layer = net.layer[l];
    const std::size_t conditions = in_.condition.shape(0), size = in_.condition.shape(1);
    owned_.emplace_back(conditions * layer.outputs);
    float* to = owned_.back().data();
    std::fill_n(to, conditions * layer.outputs, 0.0f);
    for (std::size_t b = 0; b < conditions; ++b)
      for (std::size_t o = 0; o < outputs; ++o) {
        float sum = in_.biases[l].data()[o];
        if (layer.takes_points) {
          const float* weight = in_.weights[l].data() + o * in_.weights[l].shape(1) + column;
          for (std::size_t k = 0; k < size; ++k) sum += weight[k] * in_.condition.data()[b * size + k];
        }
        to[b * layer.outputs + o] = sum;
      }
    return to;
  }

  const Inputs& in_;
  std::vector<Floats> owned_;
};

std::size_t kept_floats(std::int64_t conditions, std::int64_t count, const std::vector<std::int64_t>& hidden) {
  std::size_t units = 0;
  for (const std::int64_t width : hidden) units += whole_units(static_cast<std::size_t>(width));
  return units * conditions * divided_up(count, kTileRows) * kTileRows;
}

void check_kept(const Inputs& in, std::size_t floats) {
  std::vector<std::int64_t> hidden;
  for (std::size_t l = 0; l + 1 < in.weights.size(); ++l) hidden.push_back(static_cast<std::int64_t>(in.weights[l].shape(0)));
  require(floats == kept_floats(in.condition.shape(0), in.rows.shape(0), hidden));
}

void forward(const Rows& points, const Array<const std::int64_t, -1>& rows, const Vector& influence, const Rows& condition,
             const std::vector<Rows>& weights, const std::vector<Vector>& biases, int again, bool squashed, float slope,
             const VectorOut& kept, const RowsOut& values, const RowsOut& total, const std::string& isa, int threads) {
  const Inputs in{points, rows, influence, condition, weights, biases, again, static_cast<int>(values.shape(1)), squashed, slope};
  if (kept.shape(0)) check_kept(in, kept.shape(0));
  Padded padded(in, true, kept.shape(0) ? kept.data() : nullptr);
  require(values.shape(0) == condition.shape(0) * rows.shape(0) && threads >= 1);
  if (padded.net.influence) require(total.shape(0) == points.shape(0) && total.shape(1) == values.shape(1));
  padded.net.values = values.data();
  padded.net.total = total.data();
  const Kernels& kernels = kernels_of(isa);
  const std::int64_t tiles = static_cast<std::int64_t>(condition.shape(0)) * padded.net.tiles;
  nb::gil_scoped_release unlocked;
  share_out(tiles, kernels.forward_scratch(padded.net), threads,
            [&](std::int64_t tile, float* scratch) { kernels.forward_tile(padded.net, tile, scratch); });
}

void backward(const Rows& points, const Array<const std::int64_t, -1>& rows, const Vector& influence, const Rows& condition,
              const std::vector<Rows>& weights, const std::vector<Vector>& biases, int again, bool squashed, float slope,
              const VectorOut& kept, const RowsOut& values, const Rows& by_values, const RowsOut& by_points,
              const VectorOut& by_influence, const RowsOut& by_condition, const std::vector<RowsOut>& by_weights,
              const std::vector<VectorOut>& by_biases, const std::string& isa, int threads) {
  const Inputs in{points, rows, influence, condition, weights, biases, again, static_cast<int>(values.shape(1)), squashed, slope};
  check_kept(in, kept.shape(0));
  Padded padded(in, false, kept.data());
  Perceptron& net = padded.net;
  const std::size_t conditions = condition.shape(0), size = condition.shape(1);
  require(values.shape(0) == conditions * rows.shape(0) && by_values.shape(1) == values.shape(1) && threads >= 1);
  require(by_values.shape(0) == (net.influence ? points.shape(0) : values.shape(0)));
  require(by_influence.shape(0) == influence.shape(0));
  require(by_points.shape(0) == 0 ||
          (by_points.shape(0) == points.shape(0) && by_points.shape(1) == points.shape(1) && conditions == 1));
  require(by_condition.shape(0) == conditions && by_condition.shape(1) == size);
  require(by_weights.size() == weights.size() && by_biases.size() == weights.size());
  for (std::size_t l = 0; l < weights.size(); ++l)
    require(by_weights[l].shape(0) == weights[l].shape(0) && by_weights[l].shape(1) == weights[l].shape(1) &&
            by_biases[l].shape(0) == weights[l].shape(0));
  net.values = values.data();
  net.by_values = by_values.data();
  net.by_influence = by_influence.data();
  net.by_points = by_points.shape(0) ? by_points.data() : nullptr;
  const std::int64_t tiles = static_cast<std::int64_t>(conditions) * net.tiles;
  const Floats of_tiles(static_cast<std::size_t>(tiles) * net.bias_floats);
  net.by_biases = of_tiles.data();
  const Kernels& kernels = kernels_of(isa);
  nb::gil_scoped_release unlocked;
  const Floats sums = sum_chunks(kernels, tiles, padded.sum_floats, kernels.backward_scratch(net), threads,
                                 [&](std::int64_t tile, float* own, float* scratch) {
                                   kernels.backward_tile(net, tile, own, scratch);
                                 });
  // Gradients by biases, of each condition, then what they say of the condition and of its weights.
  const Floats of_conditions(conditions * net.bias_floats);
  std::fill_n(of_conditions.data(), conditions * net.bias_floats, 0.0f);
  for (std::int64_t tile = 0; tile < tiles; ++tile)
    kernels.add(of_conditions.data() + static_cast<std::size_t>(tile / net.tiles) * net.bias_floats,
                of_tiles.data() + static_cast<std::size_t>(tile) * net.bias_floats, net.bias_floats);
  std::fill_n(by_condition.data(), conditions * size, 0.0f);
  for (std::size_t l = 0; l < weights.size(); ++l) {
    const Layer& layer = net.layer[l];
    const std::size_t all = weights[l].shape(1), outputs = weights[l].shape(0), before = l ? weights[l - 1].shape(0) : 0;
    const std::size_t used = l + 1 == weights.size() ? static_cast<std::size_t>(net.outputs) : outputs;
    for (std::size_t o = 0; o < outputs; ++o) {
      float *to = by_weights[l].data() + o * all, *bias = by_biases[l].data() + o;
      *bias = 0.0f;
      if (o >= used) {
        std::fill_n(to, all, 0.0f);
        continue;
      }
      for (std::size_t b = 0; b < conditions; ++b) *bias += of_conditions.data()[b * net.bias_floats + layer.bias_sums + o];
      std::copy_n(sums.data() + layer.hidden_sums + o * layer.inputs, before, to);
      if (!layer.takes_points) continue;
      std::copy_n(sums.data() + layer.point_sums + o * net.point_stride, points.shape(1), to + before);
      const std::size_t column = padded.condition_column(l);
      std::fill_n(to + column, size, 0.0f);
      for (std::size_t b = 0; b < conditions; ++b) {
        const float gradient = of_conditions.data()[b * net.bias_floats + layer.bias_sums + o];
        const float* weight = weights[l].data() + o * all + column;
        for (std::size_t k = 0; k < size; ++k) {
          to[column + k] += gradient * condition.data()[b * size + k];
          by_condition.data()[b * size + k] += gradient * weight[k];
        }
      }
    }
  }
}

// ---- Convolutions ----

struct Strips {
  int rows;  // of a strip, but for the last
  std::int64_t count;
};

Strips strips_of(const Convolution& c) {
  const std::size_t row = static_cast<std::size_t>(c.width_stride) * std::max(c.input_stride, c.output_stride);
  const int rows = static_cast<int>(std::clamp<std::size_t>(kStripFloats / row, 1, kStripRows));
  return {rows, divided_up(c.height, rows)};
}

Convolution described(const Image& values, const Array<const float, -1, -1, 3, 3>& weight, const ImageOut& raw,
                      const Array<float, 2, -1>& moments) {
  Convolution c{};
  require(values.shape(0) >= 1 && values.shape(1) >= 1 && values.shape(0) < (1u << 20) && values.shape(1) < (1u << 20));
  require(weight.shape(1) == values.shape(2) && raw.shape(2) == weight.shape(0));
  require(raw.shape(0) == values.shape(0) && raw.shape(1) == values.shape(1));
  c.height = static_cast<int>(values.shape(0));
  c.width = static_cast<int>(values.shape(1));
  c.inputs = static_cast<int>(values.shape(2));
  c.outputs = static_cast<int>(weight.shape(0));
  c.width_stride = whole_units(values.shape(1));
  c.input_stride = whole_units(values.shape(2));
  c.output_stride = whole_units(weight.shape(0));
  require(static_cast<int>(moments.shape(1)) == c.output_stride);
  c.values = values.data();
  c.raw = raw.data();
  c.mean = moments.data();
  c.scale = moments.data() + c.output_stride;
  return c;
}

// Weights by rows of the window, then columns and channels, padded; turned by half a turn and transposed if asked for.
Floats window(const Convolution& c, const Array<const float, -1, -1, 3, 3>& weight, bool turned) {
  const std::size_t from = turned ? c.output_stride : c.input_stride, to = turned ? c.input_stride : c.output_stride;
  Floats padded(9 * from * to);
  std::fill_n(padded.data(), 9 * from * to, 0.0f);
  for (int o = 0; o < c.outputs; ++o)
    for (int i = 0; i < c.inputs; ++i)
      for (int tap = 0; tap < 9; ++tap) {
        const float value = weight.data()[(static_cast<std::size_t>(o) * c.inputs + i) * 9 + tap];
        const std::size_t left = turned ? o : i, right = turned ? i : o;
        padded.data()[((turned ? 8 - tap : tap) * from + left) * to + right] = value;
      }
  return padded;
}

void convolve(const Image& values, const Array<const float, -1, -1, 3, 3>& weight, const ImageOut& raw,
              const Array<float, 2, -1>& moments, const ImageOut& out, const std::string& isa, int threads) {
  Convolution c = described(values, weight, raw, moments);
  require(out.shape(0) == raw.shape(0) && out.shape(1) == raw.shape(1) && out.shape(2) == raw.shape(2) && threads >= 1);
  c.out = out.data();
  const Kernels& kernels = kernels_of(isa);
  nb::gil_scoped_release unlocked;
  const Floats padded = window(c, weight, false);
  const std::size_t stride = c.output_stride;
  const Floats of_rows(static_cast<std::size_t>(c.height) * 2 * stride);
  c.weight = padded.data();
  c.row_sums = of_rows.data();
  const Strips strips = strips_of(c);
  share_out(strips.count, kernels.convolve_scratch(c, strips.rows), threads, [&](std::int64_t strip, float* scratch) {
    const int begin = static_cast<int>(strip) * strips.rows;
    kernels.convolve(c, begin, std::min(begin + strips.rows, c.height), scratch);
  });
  for (std::size_t k = 0; k < stride; ++k) {
    double mean = 0, squares = 0;
    for (int y = 0; y < c.height; ++y) mean += c.row_sums[2 * y * stride + k];
    mean /= c.height;
    for (int y = 0; y < c.height; ++y) {
      const double away = c.row_sums[2 * y * stride + k] - mean;
      squares += c.row_sums[(2 * y + 1) * stride + k] + away * away * c.width;
    }
    c.mean[k] = static_cast<float>(mean);
    c.scale[k] = static_cast<float>(1 / std::sqrt(squares / (static_cast<double>(c.height) * c.width) + kVarianceFloor));
  }
  ThreadPool::instance().run(strips.count, threads, [&](std::int64_t strip, int) {
    const int begin = static_cast<int>(strip) * strips.rows;
    kernels.normalise(c, begin, std::min(begin + strips.rows, c.height));
  });
}

void convolve_backward(const Image& values, const Array<const float, -1, -1, 3, 3>& weight, const ImageOut& raw,
                       const Array<float, 2, -1>& moments, const Image& by_out, const ImageOut& by_values,
                       const Array<float, -1, -1, 3, 3>& by_weight, const std::string& isa, int threads) {
  Convolution c = described(values, weight, raw, moments);
  require(by_out.shape(0) == raw.shape(0) && by_out.shape(1) == raw.shape(1) && by_out.shape(2) == raw.shape(2) && threads >= 1);
  require(by_values.shape(0) == 0 || (by_values.shape(0) == values.shape(0) && by_values.shape(1) == values.shape(1) &&
                                      by_values.shape(2) == values.shape(2)));
  require(by_weight.shape(0) == weight.shape(0) && by_weight.shape(1) == weight.shape(1));
  c.by_out = by_out.data();
  c.by_values = by_values.shape(0) ? by_values.data() : nullptr;
  const Kernels& kernels = kernels_of(isa);
  nb::gil_scoped_release unlocked;
  const Floats turned = window(c, weight, true);
  const std::size_t stride = c.output_stride;
  const Floats of_rows(static_cast<std::size_t>(c.height) * 2 * stride), means(2 * stride);
  c.turned = turned.data();
  c.row_sums = of_rows.data();
  c.mean_by = means.data();
  const Strips strips = strips_of(c);
  ThreadPool::instance().run(strips.count, threads, [&](std::int64_t strip, int) {
    const int begin = static_cast<int>(strip) * strips.rows;
    kernels.sum_gradients(c, begin, std::min(begin + strips.rows, c.height));
  });
  for (std::size_t k = 0; k < 2 * stride; ++k) {
    double sum = 0;
    for (int y = 0; y < c.height; ++y) sum += c.row_sums[2 * y * stride + k];
    means.data()[k] = static_cast<float>(sum / (static_cast<double>(c.height) * c.width));
  }
  const Floats sums = sum_chunks(kernels, strips.count, std::size_t{9} * c.input_stride * c.output_stride,
                                 kernels.convolve_backward_scratch(c, strips.rows), threads,
                                 [&](std::int64_t strip, float* own, float* scratch) {
                                   const int begin = static_cast<int>(strip) * strips.rows;
                                   kernels.convolve_backward(c, begin, std::min(begin + strips.rows, c.height), own, scratch);
                                 });
  for (int o = 0; o < c.outputs; ++o)
    for (int i = 0; i < c.inputs; ++i)
      for (int tap = 0; tap < 9; ++tap)
        by_weight.data()[(static_cast<std::size_t>(o) * c.inputs + i) * 9 + tap] =
            sums.data()[(static_cast<std::size_t>(tap) * c.input_stride + i) * c.output_stride + o];
}

// ---- Influence ----

// `influences` of driving.py: how many points are near, and how many far.
std::pair<std::int64_t, std::int64_t> influences(
    const Array<const float, -1, 3>& points, const Array<const float, -1, 3>& landmarks, float near_squared, float far_squared,
    const Array<std::int32_t, -1>& nearest, const Array<std::int64_t, 2, -1>& rows, const Array<float, 2, -1>& weights,
    const std::string& isa, int threads) {
  const auto count = static_cast<std::int64_t>(points.shape(0)), of = static_cast<std::int64_t>(landmarks.shape(0));
  require(nearest.shape(0) == points.shape(0) && rows.shape(1) == points.shape(0) && weights.shape(1) == points.shape(0));
  require(of >= 1 && of < (1 << 24) && threads >= 1);
  const Kernels& kernels = kernels_of(isa);
  nb::gil_scoped_release unlocked;
  const Floats squared(count);
  ThreadPool::instance().run(divided_up(count, kPointsPerTask), threads, [&](std::int64_t task, int) {
    const std::int64_t begin = task * kPointsPerTask, end = std::min(begin + kPointsPerTask, count);
    kernels.nearest(points.data(), landmarks.data(), of, begin, end, nearest.data(), squared.data());
  });
  std::int64_t near = 0, far = 0;
  for (std::int64_t i = 0; i < count; ++i) {
    const float weight = std::clamp((far_squared - squared.data()[i]) / (far_squared - near_squared), 0.0f, 1.0f);
    if (weight > 0) {
      rows.data()[near] = i;
      weights.data()[near++] = weight;
    }
    if (weight < 1) {
      rows.data()[count + far] = i;
      weights.data()[count + far++] = 1 - weight;
    }
  }
  return {near, far};
}

// Gradients by points and, if asked for, landmarks, of those by the near and the far points' weights.
void influences_backward(const Array<const float, -1, 3>& points, const Array<const float, -1, 3>& landmarks,
                         float near_squared, float far_squared, const Array<const std::int32_t, -1>& nearest,
                         const Array<const std::int64_t, -1>& near, const Array<const float, -1>& near_weights,
                         const Array<const float, -1>& by_near, const Array<const std::int64_t, -1>& far,
                         const Array<const float, -1>& far_weights, const Array<const float, -1>& by_far,
                         const Array<float, -1, 3>& by_points, const Array<float, -1, 3>& by_landmarks) {
  require(nearest.shape(0) == points.shape(0) && by_points.shape(0) == points.shape(0));
  require(near.shape(0) == by_near.shape(0) && far.shape(0) == by_far.shape(0));
  require(near.shape(0) == near_weights.shape(0) && far.shape(0) == far_weights.shape(0));
  require(by_landmarks.shape(0) == 0 || by_landmarks.shape(0) == landmarks.shape(0));
  require(within(near, points.shape(0)) && within(far, points.shape(0)));
  const float slope = -2 / (far_squared - near_squared);
  std::fill_n(by_points.data(), 3 * points.shape(0), 0.0f);
  std::fill_n(by_landmarks.data(), 3 * by_landmarks.shape(0), 0.0f);
  const auto add = [&](std::int64_t i, float weight, float gradient) {
    if (!(weight > 0 && weight < 1)) return;
    const std::int64_t landmark = nearest.data()[i];
    for (int k = 0; k < 3; ++k) {
      const float by = gradient * slope * (points.data()[3 * i + k] - landmarks.data()[3 * landmark + k]);
      by_points.data()[3 * i + k] += by;
      if (by_landmarks.shape(0)) by_landmarks.data()[3 * landmark + k] -= by;
    }
  };
  for (std::size_t i = 0; i < near.shape(0); ++i) add(near.data()[i], near_weights.data()[i], by_near.data()[i]);
  for (std::size_t i = 0; i < far.shape(0); ++i) add(far.data()[i], far_weights.data()[i], -by_far.data()[i]);
}

// ---- Encoding ----

void encode(const Array<const float, -1, 3>& points, const Array<float, -1, kEncoding>& encoded, const std::string& isa,
            int threads) {
  const auto count = static_cast<std::int64_t>(points.shape(0));
  require(encoded.shape(0) == points.shape(0) && threads >= 1);
  const Kernels& kernels = kernels_of(isa);
  nb::gil_scoped_release unlocked;
  ThreadPool::instance().run(divided_up(count, kPointsPerTask), threads, [&](std::int64_t task, int) {
    const std::int64_t begin = task * kPointsPerTask;
    kernels.encode(points.data(), begin, std::min(begin + kPointsPerTask, count), encoded.data());
  });
}

void encode_backward(const Array<const float, -1, kEncoding>& encoded, const Array<const float, -1, kEncoding>& by_encoded,
                     const Array<float, -1, 3>& by_points, const std::string& isa, int threads) {
  const auto count = static_cast<std::int64_t>(encoded.shape(0));
  require(by_encoded.shape(0) == encoded.shape(0) && by_points.shape(0) == encoded.shape(0) && threads >= 1);
  const Kernels& kernels = kernels_of(isa);
  nb::gil_scoped_release unlocked;
  ThreadPool::instance().run(divided_up(count, kPointsPerTask), threads, [&](std::int64_t task, int) {
    const std::int64_t begin = task * kPointsPerTask;
    kernels.encode_backward(encoded.data(), by_encoded.data(), begin, std::min(begin + kPointsPerTask, count), by_points.data());
  });
}

// ---- Features ----

constexpr std::int64_t kNumbersPerTask = 1 << 14;

void tanh_of(const Vector& values, const VectorOut& out, const std::string& isa, int threads) {
  const auto count = static_cast<std::int64_t>(values.shape(0));
  require(out.shape(0) == values.shape(0) && threads >= 1);
  const Kernels& kernels = kernels_of(isa);
  nb::gil_scoped_release unlocked;
  ThreadPool::instance().run(divided_up(count, kNumbersPerTask), threads, [&](std::int64_t task, int) {
    const std::int64_t begin = task * kNumbersPerTask;
    kernels.tanh(values.data(), begin, std::min(begin + kNumbersPerTask, count), out.data());
  });
}

void tanh_backward(const Vector& out, const Vector& by_out, const VectorOut& by_values, const std::string& isa, int threads) {
  const auto count = static_cast<std::int64_t>(out.shape(0));
  require(by_out.shape(0) == out.shape(0) && by_values.shape(0) == out.shape(0) && threads >= 1);
  const Kernels& kernels = kernels_of(isa);
  nb::gil_scoped_release unlocked;
  ThreadPool::instance().run(divided_up(count, kNumbersPerTask), threads, [&](std::int64_t task, int) {
    const std::int64_t begin = task * kNumbersPerTask;
    kernels.tanh_backward(out.data(), by_out.data(), begin, std::min(begin + kNumbersPerTask, count), by_values.data());
  });
}

// ---- Colours of a residual image ----

// Whether any alpha within `reach` pixels is above `covered`.
void near_drawn(const Rows& alpha, int reach, float covered, const Array<std::uint8_t, -1, -1>& near) {
  const auto height = static_cast<int>(alpha.shape(0)), width = static_cast<int>(alpha.shape(1));
  require(near.shape(0) == alpha.shape(0) && near.shape(1) == alpha.shape(1) && reach >= 0);
  std::vector<std::uint8_t> across(static_cast<std::size_t>(height) * width);
  for (int y = 0; y < height; ++y) {
    int last = -reach - 1;  // drawn pixel seen last, from the left
    const float* row = alpha.data() + static_cast<std::ptrdiff_t>(y) * width;
    std::uint8_t* to = across.data() + static_cast<std::ptrdiff_t>(y) * width;
    for (int x = 0; x < std::min(reach, width); ++x)
      if (row[x] > covered) last = x;
    for (int x = 0; x < width; ++x) {
      if (x + reach < width && row[x + reach] > covered) last = x + reach;
      to[x] = last >= x - reach;
    }
  }
  for (int y = 0; y < height; ++y) {
    std::uint8_t* to = near.data() + static_cast<std::ptrdiff_t>(y) * width;
    std::fill_n(to, width, std::uint8_t{0});
    for (int other = std::max(y - reach, 0); other <= std::min(y + reach, height - 1); ++other) {
      const std::uint8_t* from = across.data() + static_cast<std::ptrdiff_t>(other) * width;
      for (int x = 0; x < width; ++x) to[x] |= from[x];
    }
  }
}

// What both passes are given.
struct ColorInputs {
  Image values;
  Array<const float, 3, -1> weight;
  Array<const float, 3> bias;
  Array<const float, -1, -1, 3> plain;
  Rows alpha;
  Array<const std::uint8_t, -1, -1> near;
};

class PaddedColors {
 public:
  explicit PaddedColors(const ColorInputs& in)
      : weight_(static_cast<std::size_t>(whole_units(in.values.shape(2))) * kUnitsStep),
        rows_(std::size_t{3} * whole_units(in.values.shape(2))), bias_(kUnitsStep) {
    const std::size_t channels = in.values.shape(2);
    for (const auto shape : {in.plain.shape(0), in.alpha.shape(0), in.near.shape(0)}) require(shape == in.values.shape(0));
    for (const auto shape : {in.plain.shape(1), in.alpha.shape(1), in.near.shape(1)}) require(shape == in.values.shape(1));
    require(in.weight.shape(1) == channels && in.values.shape(0) < (1u << 20) && in.values.shape(1) < (1u << 20));
    net.height = static_cast<int>(in.values.shape(0));
    net.width = static_cast<int>(in.values.shape(1));
    net.channels = static_cast<int>(channels);
    net.stride = whole_units(channels);
    std::fill_n(weight_.data(), static_cast<std::size_t>(net.stride) * kUnitsStep, 0.0f);
    std::fill_n(rows_.data(), std::size_t{3} * net.stride, 0.0f);
    std::fill_n(bias_.data(), kUnitsStep, 0.0f);
    for (int color = 0; color < 3; ++color) {
      bias_.data()[color] = in.bias.data()[color];
      for (std::size_t k = 0; k < channels; ++k)
        weight_.data()[k * kUnitsStep + color] = rows_.data()[color * net.stride + k] = in.weight.data()[color * channels + k];
    }
    net.values = in.values.data();
    net.weight = weight_.data();
    net.rows = rows_.data();
    net.bias = bias_.data();
    net.plain = in.plain.data();
    net.alpha = in.alpha.data();
    net.near = in.near.data();
  }

  Colors net{};

 private:
  const Floats weight_, rows_, bias_;
};

template <class Body>
void share_strips(int height, std::size_t scratch_floats, int threads, const Body& body) {
  share_out(divided_up(height, kStripRows), scratch_floats, threads, [&](std::int64_t strip, float* scratch) {
    const int begin = static_cast<int>(strip) * kStripRows;
    body(begin, std::min(begin + kStripRows, height), scratch);
  });
}

void colors(const Image& values, const Array<const float, 3, -1>& weight, const Array<const float, 3>& bias,
            const Array<const float, -1, -1, 3>& plain, const Rows& alpha, const Array<const std::uint8_t, -1, -1>& near,
            const Array<const float, 3>& background, const Array<float, -1, -1, 3>& image, const std::string& isa, int threads) {
  const ColorInputs in{values, weight, bias, plain, alpha, near};
  PaddedColors padded(in);
  require(image.shape(0) == values.shape(0) && image.shape(1) == values.shape(1) && threads >= 1);
  padded.net.background = background.data();
  padded.net.image = image.data();
  const Kernels& kernels = kernels_of(isa);
  nb::gil_scoped_release unlocked;
  share_strips(padded.net.height, kernels.colors_scratch(padded.net), threads,
               [&](int begin, int end, float* scratch) { kernels.colors(padded.net, begin, end, scratch); });
}

void colors_backward(const Image& values, const Array<const float, 3, -1>& weight, const Array<const float, 3>& bias,
                     const Array<const float, -1, -1, 3>& plain, const Rows& alpha,
                     const Array<const std::uint8_t, -1, -1>& near, const Array<const float, -1, -1, 3>& by_image,
                     const ImageOut& by_values, const Array<float, 3, -1>& by_weight, const Array<float, 3>& by_bias,
                     const Array<float, -1, -1, 3>& by_plain, const RowsOut& by_alpha, const std::string& isa, int threads) {
  const ColorInputs in{values, weight, bias, plain, alpha, near};
  PaddedColors padded(in);
  Colors& net = padded.net;
  for (const auto shape : {by_image.shape(0), by_values.shape(0), by_plain.shape(0), by_alpha.shape(0)})
    require(shape == values.shape(0));
  for (const auto shape : {by_image.shape(1), by_values.shape(1), by_plain.shape(1), by_alpha.shape(1)})
    require(shape == values.shape(1));
  require(by_values.shape(2) == values.shape(2) && by_weight.shape(1) == values.shape(2) && threads >= 1);
  const std::size_t stride = net.stride + 1;
  const Floats of_rows(3 * stride * net.height);
  net.by_image = by_image.data();
  net.by_values = by_values.data();
  net.by_plain = by_plain.data();
  net.by_alpha = by_alpha.data();
  net.row_sums = of_rows.data();
  const Kernels& kernels = kernels_of(isa);
  nb::gil_scoped_release unlocked;
  share_strips(net.height, kernels.colors_scratch(net), threads,
               [&](int begin, int end, float* scratch) { kernels.colors_backward(net, begin, end, scratch); });
  const std::size_t last = net.stride, channels = net.channels;
  for (int color = 0; color < 3; ++color)
    for (std::size_t k = 0; k < stride; ++k) {
      if (k >= channels && k < last) continue;
      double sum = 0;
      for (int y = 0; y < net.height; ++y) sum += of_rows.data()[(3 * y + color) * stride + k];
      (k == last ? by_bias.data()[color] : by_weight.data()[color * channels + k]) = static_cast<float>(sum);
    }
}

// ---- Splats of a pose ----

using Triples = Array<const float, -1, 3>;
using Quads = Array<const float, -1, 4>;

Posing posing_of(float unit, float displacement_scale, float attribute_scale, float largest,
                 const Array<const float, 3, 3>& rotation, const Array<const float, 3>& translation,
                 const Array<const float, 4, 4>& turn, const Triples& points, const Triples& moves, const Triples& log_scales,
                 const Quads& quats, const Vector& opacities, const Array<const float, -1, 8>& changes) {
  for (const auto shape : {moves.shape(0), log_scales.shape(0), quats.shape(0), opacities.shape(0), changes.shape(0)})
    require(shape == points.shape(0));
  Posing in{};
  in.unit = unit;
  in.displacement_scale = displacement_scale;
  in.attribute_scale = attribute_scale;
  in.largest = largest;
  std::copy_n(rotation.data(), 9, in.rotation);
  std::copy_n(translation.data(), 3, in.translation);
  std::copy_n(turn.data(), 16, in.turn);
  in.points = points.data();
  in.moves = moves.data();
  in.log_scales = log_scales.data();
  in.quats = quats.data();
  in.opacities = opacities.data();
  in.changes = changes.data();
  return in;
}

void pose(float unit, float displacement_scale, float attribute_scale, float largest,
          const Array<const float, 3, 3>& rotation, const Array<const float, 3>& translation,
          const Array<const float, 4, 4>& turn, const Triples& points, const Triples& moves, const Triples& log_scales,
          const Quads& quats, const Vector& opacities, const Array<const float, -1, 8>& changes,
          const Array<float, -1, 3>& means, const Array<float, -1, 4>& world_quats, const Array<float, -1, 3>& scales,
          const VectorOut& seen, const std::string& isa, int threads) {
  Posing in = posing_of(unit, displacement_scale, attribute_scale, largest, rotation, translation, turn, points, moves,
                        log_scales, quats, opacities, changes);
  for (const auto shape : {means.shape(0), world_quats.shape(0), scales.shape(0), seen.shape(0)})
    require(shape == points.shape(0));
  require(threads >= 1);
  in.means = means.data();
  in.world_quats = world_quats.data();
  in.scales = scales.data();
  in.seen = seen.data();
  const Kernels& kernels = kernels_of(isa);
  const auto count = static_cast<std::int64_t>(points.shape(0));
  nb::gil_scoped_release unlocked;
  ThreadPool::instance().run(divided_up(count, kPointsPerTask), threads, [&](std::int64_t task, int) {
    kernels.pose(in, task * kPointsPerTask, std::min((task + 1) * kPointsPerTask, count));
  });
}

void pose_backward(float unit, float displacement_scale, float attribute_scale, float largest,
                   const Array<const float, 3, 3>& rotation, const Array<const float, 3>& translation,
                   const Array<const float, 4, 4>& turn, const Triples& points, const Triples& moves,
                   const Triples& log_scales, const Quads& quats, const Vector& opacities,
                   const Array<const float, -1, 8>& changes, const Triples& scales, const Vector& seen,
                   const Triples& by_means, const Quads& by_world_quats, const Triples& by_scales, const Vector& by_seen,
                   const Array<float, 3, 3>& by_rotation, const Array<float, 3>& by_translation,
                   const Array<float, 4, 4>& by_turn, const Array<float, -1, 3>& by_points,
                   const Array<float, -1, 3>& by_moves, const Array<float, -1, 3>& by_log_scales,
                   const Array<float, -1, 4>& by_quats, const VectorOut& by_opacities, const Array<float, -1, 8>& by_changes,
                   const std::string& isa, int threads) {
  Posing in = posing_of(unit, displacement_scale, attribute_scale, largest, rotation, translation, turn, points, moves,
                        log_scales, quats, opacities, changes);
  for (const auto shape : {scales.shape(0), seen.shape(0), by_means.shape(0), by_world_quats.shape(0), by_scales.shape(0),
                           by_seen.shape(0), by_points.shape(0), by_moves.shape(0), by_log_scales.shape(0),
                           by_quats.shape(0), by_opacities.shape(0), by_changes.shape(0)})
    require(shape == points.shape(0));
  require(threads >= 1);
  in.scales = const_cast<float*>(scales.data());
  in.seen = const_cast<float*>(seen.data());
  in.by_means = by_means.data();
  in.by_world_quats = by_world_quats.data();
  in.by_scales = by_scales.data();
  in.by_seen = by_seen.data();
  in.by_points = by_points.data();
  in.by_moves = by_moves.data();
  in.by_log_scales = by_log_scales.data();
  in.by_quats = by_quats.data();
  in.by_opacities = by_opacities.data();
  in.by_changes = by_changes.data();
  const Kernels& kernels = kernels_of(isa);
  const auto count = static_cast<std::int64_t>(points.shape(0));
  const std::int64_t tasks = divided_up(count, kPointsPerTask);
  nb::gil_scoped_release unlocked;
  const Floats sums(static_cast<std::size_t>(tasks) * kPosingSums);
  ThreadPool::instance().run(tasks, threads, [&](std::int64_t task, int) {
    kernels.pose_backward(in, task * kPointsPerTask, std::min((task + 1) * kPointsPerTask, count),
                          sums.data() + task * kPosingSums);
  });
  for (int k = 0; k < kPosingSums; ++k) {
    double sum = 0;
    for (std::int64_t task = 0; task < tasks; ++task) sum += sums.data()[task * kPosingSums + k];
    float* to = k < 9 ? by_rotation.data() + k : k < 12 ? by_translation.data() + (k - 9) : by_turn.data() + (k - 12);
    *to = static_cast<float>(sum);
  }
}

void motion(const Array<const float, 18>& tracked, const Array<const float, kCorrection>& correction,
            const Array<float, kMotion>& out, const Array<float, kMotion, kCorrection>& derivatives) {
  double fixed[18], moved[kCorrection];
  std::copy_n(tracked.data(), 18, fixed);
  std::copy_n(correction.data(), kCorrection, moved);
  Dual found[kMotion];
  head_motion(fixed, moved, found);
  for (int i = 0; i < kMotion; ++i) {
    out.data()[i] = static_cast<float>(found[i].value);
    for (int k = 0; k < kCorrection; ++k) derivatives.data()[kCorrection * i + k] = static_cast<float>(found[i].by[k]);
  }
}

}  // namespace
}  // namespace headbench::gha

NB_MODULE(_kernel, m) {
  using namespace headbench;
  using namespace headbench::gha;
  m.doc() = "Perceptrons and convolutions of GHA, forward and backward";
  m.def("kept_floats", &kept_floats, "conditions"_a, "count"_a, "hidden"_a,
        "Numbers that the backward pass of a perceptron needs of the forward one.");
  m.def("forward", &forward, "points"_a, "rows"_a, "influence"_a, "condition"_a, "weights"_a, "biases"_a, "again"_a,
        "squashed"_a, "slope"_a, "kept"_a, "values"_a, "total"_a, "instruction_set"_a, "threads"_a,
        "Values of a perceptron; with influences, times these, they are added to the total. An empty kept keeps nothing.");
  m.def("backward", &backward, "points"_a, "rows"_a, "influence"_a, "condition"_a, "weights"_a, "biases"_a, "again"_a,
        "squashed"_a, "slope"_a, "kept"_a, "values"_a, "by_values"_a, "by_points"_a, "by_influence"_a, "by_condition"_a,
        "by_weights"_a, "by_biases"_a, "instruction_set"_a, "threads"_a,
        "Write all gradients but those by points, which are added. An empty by_points asks for none.");
  m.def("convolve", &convolve, "values"_a, "weight"_a, "raw"_a, "moments"_a, "out"_a, "instruction_set"_a, "threads"_a,
        "A convolution, raw, then normalised over the image and rectified.");
  m.def("convolve_backward", &convolve_backward, "values"_a, "weight"_a, "raw"_a, "moments"_a, "by_out"_a, "by_values"_a,
        "by_weight"_a, "instruction_set"_a, "threads"_a, "Its gradients. An empty by_values asks for none.");
  m.def("influences", &influences, "points"_a, "landmarks"_a, "near_squared"_a, "far_squared"_a, "nearest"_a, "rows"_a,
        "weights"_a, "instruction_set"_a, "threads"_a,
        "Rows and weights of the near and of the far points, and their numbers; the nearest landmark of each point.");
  m.def("influences_backward", &influences_backward, "points"_a, "landmarks"_a, "near_squared"_a, "far_squared"_a,
        "nearest"_a, "near"_a, "near_weights"_a, "by_near"_a, "far"_a, "far_weights"_a, "by_far"_a, "by_points"_a,
        "by_landmarks"_a, "Gradients of the weights. An empty by_landmarks asks for none.");
  m.def("encode", &encode, "points"_a, "encoded"_a, "instruction_set"_a, "threads"_a, "Positional encoding of points.");
  m.def("encode_backward", &encode_backward, "encoded"_a, "by_encoded"_a, "by_points"_a, "instruction_set"_a, "threads"_a,
        "Its gradient by the points.");
  m.def("tanh", &tanh_of, "values"_a, "out"_a, "instruction_set"_a, "threads"_a);
  m.def("tanh_backward", &tanh_backward, "out"_a, "by_out"_a, "by_values"_a, "instruction_set"_a, "threads"_a);
  m.def("near_drawn", &near_drawn, "alpha"_a, "reach"_a, "covered"_a, "near"_a, "Where something is drawn near.");
  m.def("colors", &colors, "values"_a, "weight"_a, "bias"_a, "plain"_a, "alpha"_a, "near"_a, "background"_a, "image"_a,
        "instruction_set"_a, "threads"_a, "Colours of a residual image.");
  m.def("colors_backward", &colors_backward, "values"_a, "weight"_a, "bias"_a, "plain"_a, "alpha"_a, "near"_a, "by_image"_a,
        "by_values"_a, "by_weight"_a, "by_bias"_a, "by_plain"_a, "by_alpha"_a, "instruction_set"_a, "threads"_a,
        "Their gradients.");
  m.def("pose", &pose, "unit"_a, "displacement_scale"_a, "attribute_scale"_a, "largest"_a, "rotation"_a, "translation"_a,
        "turn"_a, "points"_a, "moves"_a, "log_scales"_a, "quats"_a, "opacities"_a, "changes"_a, "means"_a, "world_quats"_a,
        "scales"_a, "seen"_a, "instruction_set"_a, "threads"_a, "Splats of a pose.");
  m.def("pose_backward", &pose_backward, "unit"_a, "displacement_scale"_a, "attribute_scale"_a, "largest"_a, "rotation"_a,
        "translation"_a, "turn"_a, "points"_a, "moves"_a, "log_scales"_a, "quats"_a, "opacities"_a, "changes"_a, "scales"_a,
        "seen"_a, "by_means"_a, "by_world_quats"_a, "by_scales"_a, "by_seen"_a, "by_rotation"_a, "by_translation"_a,
        "by_turn"_a, "by_points"_a, "by_moves"_a, "by_log_scales"_a, "by_quats"_a, "by_opacities"_a, "by_changes"_a,
        "instruction_set"_a, "threads"_a, "Their gradients.");
  m.def("motion", &motion, "tracked"_a, "correction"_a, "out"_a, "derivatives"_a,
        "Rigid motion of a head, and its derivatives by the correction.");
  m.def("instruction_sets", [] { return names_of(runnable_gha_kernels()); },
        "Variants this machine can run, the fastest first.");
}

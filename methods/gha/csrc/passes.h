// What the networks of GHA compute, forward and backward: plain data, shared by all instruction sets.
//
// Layers are padded with zeros to multiples of kUnitsStep units. Gradients by weights are sums over chunks of the work, each
// in an accumulator of its own; accumulators are added in order, and chunks do not depend on the number of threads.
#pragma once

#include <cstddef>
#include <cstdint>

#include "bench/native/instruction_sets.h"

namespace headbench::gha {

constexpr int kUnitsStep = 16;
constexpr int kTileRows = 64;  // rows of a perceptron's tile, whose activations stay in the first caches
constexpr int kLayersMax = 16;
constexpr int kFrequencies = 4;  // FREQUENCIES of methods/shared/networks.py: 1, 2, 4, 8
constexpr int kEncoding = 3 + 6 * kFrequencies;

// One layer of a perceptron. In the forward pass weights are (inputs, outputs), in the backward pass (outputs, inputs).
struct Layer {
  int inputs, outputs;     // padded; no inputs where there is no layer before
  bool takes_points;       // the inputs at points come in (once more)
  const float* of_hidden;  // weights of what the layer before gave
  const float* of_points;  // weights of the points' inputs, in rows of `outputs` or of `point_stride`
  const float* bias;       // (conditions, outputs), with the condition's part
  float* kept;             // (tiles kTileRows, outputs) after activation; none of the last layer, or where no gradient is wanted
  std::size_t hidden_sums, point_sums;  // where its weights' gradients begin in an accumulator
  std::size_t bias_sums;                // where its biases' gradients begin in those of a tile
};

// A perceptron at n points of a table under one or several conditions; see `Mlp` in networks.py.
struct Perceptron {
  int layers;
  Layer layer[kLayersMax];
  int point_inputs, point_stride;  // as they are, and padded
  int outputs;                     // as they are
  bool squashed;                   // tanh after the last layer
  float slope;                     // of the leaky ReLU between layers
  std::int64_t count;              // n
  std::int64_t tiles;              // of one condition
  const float* points;             // (N, point_inputs)
  const std::int64_t* rows;        // (n,) which points; each once
  const float* influence;          // (n,) or none
  float* values;                   // (conditions n, outputs)
  float* total;                    // (N, outputs) that values times influence are added to, with influence
  // Backward.
  const float* by_values;  // (conditions n, outputs), or (N, outputs) by the total
  float* by_influence;     // (n,)
  float* by_points;        // (N, point_inputs) that is added to, or none; of one condition alone
  float* by_biases;        // (conditions tiles, bias_floats)
  std::size_t bias_floats;
};

// A 3x3 convolution of an (H, W, C) image, padded with zeros, normalised over the image and rectified.
struct Convolution {
  int height, width, inputs, outputs;  // as they are
  int width_stride, input_stride, output_stride;  // padded
  const float* values;  // (height, width, inputs)
  const float* weight;  // (3, 3 input_stride, output_stride): by rows of the window, then columns and inputs
  float* raw;           // (height, width, outputs) of the convolution alone
  float* mean;          // (output_stride,) of the raw values
  float* scale;         // (output_stride,) one over their standard deviation
  float* out;           // (height, width, outputs)
  float* row_sums;      // (height, 2, output_stride) of each row: mean and sum of squared differences from it
  // Backward.
  const float* by_out;   // (height, width, outputs)
  const float* turned;   // (3, 3 output_stride, input_stride): the weights of the gradient by values
  const float* mean_by;  // (2, output_stride) means of the gradient by the normalised values, and of its product with them
  float* by_values;      // (height, width, inputs), or none
};

// Colours of a residual image: plain + alpha (weight values + bias) where something is near, else the background.
struct Colors {
  int height, width, channels, stride;  // channels as they are, and padded
  const float* values;      // (height, width, channels)
  const float* weight;      // (stride, kUnitsStep), colours side by side
  const float* bias;        // (kUnitsStep,)
  const float* plain;       // (height, width, 3)
  const float* alpha;       // (height, width)
  const std::uint8_t* near;  // (height, width)
  const float* background;  // (3,)
  float* image;             // (height, width, 3)
  // Backward.
  const float* rows;      // (3, stride) of the weights
  const float* by_image;  // (height, width, 3)
  float* by_values;       // (height, width, channels)
  float* by_plain;        // (height, width, 3)
  float* by_alpha;        // (height, width)
  float* row_sums;        // (height, 3, stride + 1) gradients by weights and bias of each row
};

// Splats of a pose from canonical points: `posed` of gaussian_head.py.
struct Posing {
  float unit, displacement_scale, attribute_scale, largest;  // the last of log-scales
  float rotation[9], translation[3], turn[16];  // by rows; the last multiplies quaternions
  const float *points, *moves, *log_scales, *quats, *opacities;  // (N, 3), (N, 3), (N, 3), (N, 4), (N,)
  const float* changes;  // (N, 8) of log-scales, quaternions and opacities
  float *means, *world_quats, *scales, *seen;  // (N, 3), (N, 4), (N, 3), (N,)
  // Backward: gradients by what was written.
  const float *by_means, *by_world_quats, *by_scales, *by_seen;
  float *by_points, *by_moves, *by_log_scales, *by_quats, *by_opacities, *by_changes;
};
constexpr int kPosingSums = 28;  // rotation, translation, turn

struct Kernels {
  const char* name;
  std::size_t (*forward_scratch)(const Perceptron&);
  void (*forward_tile)(const Perceptron&, std::int64_t tile, float* scratch);
  std::size_t (*backward_scratch)(const Perceptron&);
  // Adds to an accumulator of the weights' gradients.
  void (*backward_tile)(const Perceptron&, std::int64_t tile, float* sums, float* scratch);
  // Of rows [begin, end), as are those that follow.
  std::size_t (*convolve_scratch)(const Convolution&, int rows);
  void (*convolve)(const Convolution&, int begin, int end, float* scratch);
  void (*normalise)(const Convolution&, int begin, int end);
  void (*sum_gradients)(const Convolution&, int begin, int end);  // into row_sums
  std::size_t (*convolve_backward_scratch)(const Convolution&, int rows);
  // Adds to an accumulator shaped like `weight`.
  void (*convolve_backward)(const Convolution&, int begin, int end, float* sums, float* scratch);
  void (*add)(float* to, const float* from, std::size_t count);  // element by element
  // For points [begin, end): the nearest of the landmarks, and the squared distance from it.
  void (*nearest)(const float* points, const float* landmarks, std::int64_t landmark_count, std::int64_t begin,
                  std::int64_t end, std::int32_t* found, float* squared);
  // Positional encoding of (N, 3) points, (N, kEncoding), and the gradient by points.
  void (*encode)(const float* points, std::int64_t begin, std::int64_t end, float* encoded);
  void (*encode_backward)(const float* encoded, const float* by_encoded, std::int64_t begin, std::int64_t end,
                          float* by_points);
  void (*tanh)(const float* values, std::int64_t begin, std::int64_t end, float* out);
  void (*tanh_backward)(const float* out, const float* by_out, std::int64_t begin, std::int64_t end, float* by_values);
  std::size_t (*colors_scratch)(const Colors&);
  void (*colors)(const Colors&, int begin, int end, float* scratch);
  void (*colors_backward)(const Colors&, int begin, int end, float* scratch);
  void (*pose)(const Posing&, std::int64_t begin, std::int64_t end);
  // Writes the sums of splats [begin, end).
  void (*pose_backward)(const Posing&, std::int64_t begin, std::int64_t end, float* sums);
};

}  // namespace headbench::gha

namespace headbench {
using GhaKernels = gha::Kernels;
HEADBENCH_VARIANTS(GhaKernels, gha_kernels)
}  // namespace headbench

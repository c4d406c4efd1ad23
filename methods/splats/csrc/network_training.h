// Training passes of the two networks of "ours", forward and backward: plain data, shared by all instruction sets.
//
// The offsets are those of a list of M splats, whose values are kept in rows of their own. Layers are padded with zeros to `units`
// and `inputs`, multiples of kUnitsStep, lists to whole groups of kGroupRows rows. Gradients by weights are sums over
// chunks of the list, each in an accumulator of its own (see network_training.cpp).
#pragma once

#include "bench/native/instruction_sets.h"
#include "scene.h"

namespace headbench {

constexpr int kGroupRows = 16;  // rows per allocated group
constexpr int kEncoding = 27;   // of a direction
constexpr int kPlanes = 3;
constexpr int kPlaneAxes[kPlanes][2] = {{0, 1}, {0, 2}, {1, 2}};  // PAIRS of methods/ops/planes.py

// Box and samples of planes or lines: sample (p - low) / extent (samples - 1), clamped.
struct Grid {
  float low[3], extent[3];
  int samples;
};

// Positions of splats in canonical space: `points_on` of methods/ops/splats.py.
struct PositionTraining {
  const std::int64_t* binding;  // (N,) triangles
  const float* linear;          // (F, 3, 3)
  const float* centers;         // (F, 3)
  const float* values;          // (N, 3) local means; backward: gradients by the positions
  float* out;                   // (N, 3) positions; backward: gradients by the local means
};

// Directions to the camera in canonical space: `directions_to` of methods/ops/splats.py.
struct DirectionTraining {
  const std::int64_t* binding;  // (N,) triangles
  const float* turns;           // (F, 3, 3) applied to the directions
  const float* last;            // (3, 3) rotation applied to all of them after that
  const float* center;          // (3,) of the camera
  const float* means;           // (N, 3) in the world
  const float* by_directions;   // (N, 3) backward; null for the forward pass
  float* out;                   // (N, 3) directions; backward: gradients by the means
};

// Colours of splats by the planes: `plane_colors` of methods/ops/planes.py.
struct ColorTraining {
  Grid grid;
  int channels[kPlanes];
  int features;                // channels of all planes
  int units, inputs;           // padded; inputs are features, then the encoded direction
  int units_stride, inputs_stride;
  std::int64_t count;          // N
  const float* positions;      // (N, 3)
  const float* directions;     // (N, 3) unit vectors
  const float* planes[kPlanes];  // (samples^2, channels)
  const float* last;             // (3, units)
  float* kept_hidden;            // (N padded, units) after the ReLU
  std::int32_t* lower;           // (N, 3) the lower of two neighbouring samples, all bits inverted where clamped
  float* fractions;              // (N, 3) from the lower to the upper
  float* colors;                 // (N, 3)
  // Forward: (inputs, units_stride); backward: (units, inputs_stride).
  const float* first;
  // Backward.
  const float* by_colors;  // (N, 3)
  float* by_inputs;        // (N padded, inputs)
  float* by_positions;     // (N, 3), or null if no gradients by positions and directions are needed
  float* by_directions;    // (N, 3), or null with it
  float* by_planes[kPlanes];
};

// Backward pass of the offsets by the lines, `line_offsets` of methods/ops/planes.py; the forward pass is `offset_network`.
struct LineTraining {
  OffsetNetwork net;              // units and hidden are the same, `kept` is that of the forward pass
  const float* second_by_output;  // (hidden, units_stride), the weights of the second layer
  int units_stride;
  std::int64_t count;
  const std::int64_t* entries;  // of the list, those with a gradient
  const float* by_offsets;      // (N, outputs)
};

// Where the parts of an accumulator begin, floats.
struct ColorSums {
  std::size_t first, last, end;
};
struct LineSums {
  std::size_t table, weight_1, bias_1, weight_2, bias_2, end;
};

struct NetworkKernels {
  const char* name;
  // Of splats [begin, end).
  void (*positions)(const PositionTraining&, std::int64_t begin, std::int64_t end);
  void (*positions_backward)(const PositionTraining&, std::int64_t begin, std::int64_t end);
  void (*directions)(const DirectionTraining&, std::int64_t begin, std::int64_t end);
  void (*directions_backward)(const DirectionTraining&, std::int64_t begin, std::int64_t end);
  std::size_t (*color_forward_scratch)(const ColorTraining&);
  // Of entries [begin, end), begin a multiple of kGroupRows.
  void (*color_forward)(const ColorTraining&, std::int64_t begin, std::int64_t end, float* scratch);
  std::size_t (*color_backward_scratch)(const ColorTraining&);
  void (*color_backward)(const ColorTraining&, const ColorSums&, std::int64_t begin, std::int64_t end, float* sums,
                         float* scratch);
  // Add the gradients of entries order[begin .. end), whose lower row of samples is the same, to that row and the next;
  // only to those from `first` to `last`.
  void (*scatter_plane)(const ColorTraining&, int plane, int row, const std::uint32_t* order, std::int64_t count, int first,
                        int last);
  std::size_t (*offset_scratch)(const OffsetNetwork&);
  void (*offset_network)(const OffsetNetwork&, std::int64_t begin, std::int64_t end, float* scratch);
  std::size_t (*line_backward_scratch)(const LineTraining&);
  void (*line_backward)(const LineTraining&, const LineSums&, std::int64_t begin, std::int64_t end, float* sums,
                        float* scratch);
};

HEADBENCH_VARIANTS(NetworkKernels, network_kernels)

}  // namespace headbench

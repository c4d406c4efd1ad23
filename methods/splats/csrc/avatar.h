// What an avatar computes of a pose before its splats are drawn: plain data, shared by all instruction sets.
//
// N splats, F triangles. As in scene.h, there is no inline code here.
#pragma once

#include <cstddef>
#include <cstdint>

namespace headbench {

// Frames of the triangles of a mesh of V vertices.
struct Triangles {
  const float* vertices;      // (V, 3)
  const std::int64_t* faces;  // (F, 3)
  float* rotations;           // (F, 3, 3)
  float* centers;             // (F, 3)
  float* sizes;               // (F,)
  float* quaternions;         // (F, 4)
};

// Splats from their triangles' frames to the world; the formulas of binding.py, `to_world`.
struct Carry {
  const std::int64_t* binding;  // (N,) triangles
  const float* rotations;       // (F, 3, 3)
  const float* centers;         // (F, 3)
  const float* sizes;           // (F,)
  const float* quaternions;     // (F, 4)
  const float* means;           // (N, 3)
  const float* quats;           // (N, 4) unit
  const float* scales;          // (N, 3)
  float* world_means;           // (N, 3)
  float* world_quats;           // (N, 4)
  float* world_scales;          // (N, 3)
};

// Coefficients lie in blocks of so many splats, those of one block and one coefficient side by side.
constexpr int kHarmonicsBlock = 16;
constexpr int kDegreeMax = 3;

// Colours of spherical harmonics along the ways from the camera to the splats; the formulas of sh.py, `sh_to_rgb`.
struct Harmonics {
  int degree;
  const float* coefficients;    // (ceil(N / 16), 3, (degree + 1)^2, 16)
  const float* means;           // (N, 3) in the world
  const float* turns;           // (F, 3, 3) applied to the directions, or null
  const std::int64_t* binding;  // (N,) triangles; null without turns
  float center[3];              // of the camera
  float* colors;                // (N, 3)
};

// Both networks' layers are this wide, or multiples of it.
constexpr int kUnitsStep = 16;

// The colour network of ours_field.py, `shade_directions`: what is known of the position, plus the encoded direction from
// the splat to the camera by its weights, ReLU, a layer.
constexpr int kEncoding = 27;

struct ColorNetwork {
  int hidden;
  const float* positions;       // (N, hidden)
  const float* second;          // (27, hidden)
  const float* last;            // (3, hidden)
  const float* means;           // (N, 3) in the world
  const float* turns;           // (F, 3, 3) applied to the directions
  const std::int64_t* binding;  // (N,) triangles
  float center[3];              // of the camera
  float* colors;                // (N, 3)
};

// The offset network of feature_lines.py for M splats: rows of a table interpolated on three axes and added, ReLU, a
// layer, ReLU, a layer.
struct OffsetNetwork {
  int units, hidden, outputs;
  const float* table;         // (T, units), T > rows + 1
  const std::int32_t* rows;   // (M, 3) the lower of two neighbours
  const float* fractions;     // (M, 3) from the lower to the upper
  const float* second;        // (units, hidden)
  const float* second_bias;   // (hidden,)
  const float* last;          // (outputs, hidden)
  const float* last_bias;     // (outputs,)
  const std::int64_t* splats; // (M,) which splat each is
  float* offsets;             // (N, outputs)
};

}  // namespace headbench

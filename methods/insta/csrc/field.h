// The field as plain arrays, samples of it, and the functions of them that are compiled once per instruction set.
#pragma once

#include <cstddef>
#include <cstdint>

#include "search.h"

namespace headbench::insta {

struct Level {
  float scale;                // cells per unit length
  std::int32_t resolution;    // samples per side
  std::int64_t first, count;  // rows of the table
};

constexpr int kDirections = 16;  // spherical harmonics up to degree 3

// One layer's weights, (outputs, inputs).
struct Layer {
  int inputs, outputs;
  const float* weights;
};

struct Network {
  int count;
  const Layer* layers;
};

// Plain arrays: code compiled for one instruction set must not share the standard library's templates with the rest.
struct Field {
  int level_count;
  const Level* levels;
  int features;        // of a level
  const float* table;  // (rows, features)
  float low[3], side;  // cube that the encoding covers, metres
  float bias, depth, scale;  // the prior of field.py
  Network density, color;
};

// Lanes are worked on in groups of up to this many; arrays of samples are padded to multiples of it.
constexpr std::int64_t kGroupMax = 32;

// Samples coordinate by coordinate. What lies between their number and the next multiple of kGroupMax is finite.
struct Points {
  const float *position[3], *direction[3];  // canonical
  const float* away;                        // metres from the mesh
  const float* mouth;                       // 1 at the mouth, else 0
};

struct Values {
  float* left;      // what a step leaves of the light
  float* color[3];  // in (0, 1)
};

// What is compiled once per instruction set.
struct Kernels {
  const char* name;
  Nearest nearest;
  // (N, levels features) values at (N, 3) positions in [0, 1]; `buffer` has as many floats for kGroupMax of them.
  void (*encode)(const Field& field, const float* positions, std::int64_t count, float* out, float* buffer);
  std::size_t (*scratch)(const Field& field);  // floats
  // Values of `count` samples at steps of `step` metres. `starts` is (2, outputs of the first layer): what the
  // conditions add to that layer's sums outside the mouth and at it.
  void (*evaluate)(const Field& field, const float* starts, float step, const Points& points, std::int64_t count,
                   const Values& values, float* scratch);
};

}  // namespace headbench::insta

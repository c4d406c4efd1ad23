// Triangles, their light and a tree of boxes over them, as plain arrays that every instruction set's code reads.
#pragma once

#include <cstdint>

#include "bench/native/instruction_sets.h"
#include "bench/native/vector3.h"

namespace headbench::light {

constexpr int kWide = 8;    // children of a node, triangles of a leaf
constexpr int kPanels = 8;  // one to a lane; those that a scene lacks have no area

// Boxes of up to eight children. One that is missing has a box that no ray meets.
struct alignas(32) Node {
  float bounds[6][kWide];     // low x, y, z, high x, y, z
  std::int32_t child[kWide];  // a node, or ~leaf
};

// Up to eight triangles. One that is missing has no area, and nothing meets it.
struct alignas(32) Leaf {
  float corner[3][kWide], edge1[3][kWide], edge2[3][kWide];
  std::int32_t triangle[kWide];
};

struct Material {
  float specular;   // reflectance at normal incidence
  float roughness;  // the GGX distribution's alpha; 0 for a mirror
};

// Rectangles that emit on one side. A point on one is center + s half_u + t half_v, -1 <= s, t <= 1.
struct Panels {
  float center[3][kPanels], half_u[3][kPanels], half_v[3][kPanels];
  float normal[3][kPanels];  // unit, towards what is lit
  float radiance[3][kPanels];
  float area[kPanels], inverse_u2[kPanels], inverse_v2[kPanels];  // 1 / |half_u|^2, 1 / |half_v|^2
  float squared_u[kPanels], squared_v[kPanels];
};

// What reaches one side of a vertex. Irradiance is divided by pi: the radiance of a white diffuse surface there.
struct Reached {
  float visible[kPanels];  // share of each panel's light that is not blocked
  float direct[3];         // from the panels
  float all[3];            // with the surroundings and one bounce
};

// How a side of a vertex is lit.
enum State : std::uint8_t { kDark = 0, kDirect = 1, kFull = 2 };

struct Scene {
  const Node* nodes;
  const Leaf* leaves;
  const std::int32_t* faces;  // (triangles, 3)
  const std::uint8_t* material_of;  // by triangle
  const Material* materials;
  const float *vertices, *normals, *albedo;  // (vertices, 3)
  const float* gloss;  // (vertices,), factors on the panels' reflections
  Panels panels;
  float surroundings[3];  // radiance
  Reached* reached;       // 2 by vertex: front, where the normal points, and back
  const float* hemisphere;  // (patterns, rays, 3): directions about +z, dense by cosine
  std::int32_t patterns, rays;
  std::uint32_t seed;
};

// One sample of the image: where its ray ends, and what a mirror there shows.
struct Sample {
  std::int32_t triangle;  // -1 for none
  float u, v;             // barycentric weights of the second and third corner
  Vec3 towards;           // unit direction from there to the camera
  std::int32_t mirrored;  // side of a vertex, or kNothing or kNoMirror
  std::uint8_t back;      // whether the back of the triangle is seen
};
constexpr std::int32_t kNothing = -1, kNoMirror = -2;

struct Lens {
  double origin[3];
  double columns[3][3];  // direction of pixel position (x, y) = columns[0] x + columns[1] y + columns[2]
  double start;          // distance at which rays begin, before all of the scene
  double left, top;      // pixel position of the first sample's cell
  std::int32_t grid;     // cells a pixel and axis
  std::uint32_t seed;
};

// Which cells a triangle may be seen in: [left, right), [top, bottom).
struct Extent {
  std::int32_t left, right, top, bottom;
};

// Some rows of samples, the triangles that may be seen there by number, ascending, and memory for `kStripFloats` floats and
// one number a sample.
struct Strip {
  std::int64_t first, rows, columns;
  const std::int32_t* triangles;
  std::int64_t count;
  const Extent* extents;  // by triangle
  float* memory;
  std::int32_t* met;
};
constexpr int kStripFloats = 9;
// Samples of a row in memory: eight more, so that eight may be taken from anywhere.
inline std::int64_t stride_of(std::int64_t columns) { return columns + kWide; }

// The functions of one instruction set. All give the same numbers: none forms sums in an order of its own.
struct Kernels {
  const char* name;
  // Fill rows of samples from `strip.first` on, trying the triangles that may be seen there.
  void (*see)(const Scene&, const Lens&, const Strip& strip, Sample* samples);
  // Light of the panels on one side of a vertex: 2 vertex + back.
  void (*direct)(const Scene&, std::int64_t side);
  // Sides of vertices that `rays` directions from a side meet; kNothing for the surroundings.
  void (*bounce)(const Scene&, std::int64_t side, std::int32_t* met);
  // Linear radiance and coverage, (count, 4).
  void (*shade)(const Scene&, const Sample* samples, std::int64_t count, float* pixels);
};

}  // namespace headbench::light

namespace headbench {
using LightKernels = light::Kernels;
HEADBENCH_VARIANTS(LightKernels, light_kernels)
}  // namespace headbench

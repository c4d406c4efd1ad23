// Samples of rays near a posed mesh, warped to canonical space by their nearest triangle.
#pragma once

#include <cstdint>
#include <vector>

#include "mesh_search.h"

namespace headbench::insta {

struct Warp {
  const float* matrices;           // (F, 3, 4) canonical from posed
  const float* centroids;          // (F, 3) posed
  const std::int32_t* neighbours;  // (F, 3) across the edges, -1 at a border
  const float* own_falloff;        // (F,) per metre; negative: the triangle's own matrix alone
  const float* neighbour_falloff;  // (F,)
};

struct Grid {
  Vec3 low;
  float cells_per_metre;
  std::int32_t size[3];
  const std::uint8_t* free;  // cells, along the axis where it is most, to the nearest occupied one; 0: occupied
};

struct Rays {
  std::int64_t count;
  const float *origins, *directions;  // (R, 3), directions of unit length
  const std::int32_t* first;          // (R,) lattice index to start at
  const float* jitter;                // (R,) in [0, 1)
  float step;                         // metres
  std::int32_t samples_max;
};

struct Samples {
  std::vector<float> positions, directions;  // (N, 3) canonical; directions of unit length
  std::vector<float> distances;                // (N,) metres from the surface, posed
  std::vector<std::int32_t> rays, indices, triangles;
  std::vector<std::int32_t> next;  // (R,) lattice index to continue at; -1 where nothing is left
};

// Emit, in order along each ray, the lattice points t = (index + jitter) step whose nearest triangle is at most
// its `reach` away and whose canonical position lies in an occupied cell. Where the cells around are free, lattice
// points are passed over: as many as kCaution of the way to the nearest occupied cell holds. Only a fold of the warp
// could bring one of them to an occupied cell after all.
Samples march(const Posed& mesh, const Rays& rays, const float* reach, const Warp& warp, const Grid& grid,
              int threads);

}  // namespace headbench::insta

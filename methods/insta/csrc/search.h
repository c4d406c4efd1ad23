// A posed mesh as plain arrays to be searched, many boxes or triangles side by side.
#pragma once

#include <cstdint>
#include <limits>

#include "bench/native/simd.h"
#include "bench/native/vector3.h"

namespace headbench::insta {

struct Triangle {
  Vec3 a, b, c;
};

struct Hit {
  std::int32_t triangle = -1;
  float value = std::numeric_limits<float>::infinity();  // squared distance, or distance along the ray
};

constexpr int kLanes = 16;
constexpr int kDepthMax = 40;  // halving 2^28 triangles takes 28

// Up to kLanes nodes of the tree side by side. A child is a wide node, or the leaf ~child. Unused lanes have the node -1.
struct WideNode {
  std::int32_t child[kLanes];
  std::int32_t node[kLanes];
};

// Boxes and triangles of as many lanes, coordinate by coordinate. Unused lanes are infinitely far away.
struct alignas(64) WideBox {
  float low[3][kLanes], high[3][kLanes];
};

struct alignas(64) WideTriangles {
  float a[3][kLanes], ab[3][kLanes], ac[3][kLanes], normal[3][kLanes];
  float ab2[kLanes], ac2[kLanes], abac[kLanes];       // dot products of the edges
  float by_ab[kLanes], by_ac[kLanes], by_bc[kLanes];  // one over squared lengths of the edges, 0 for none
  float by_area[kLanes];                              // one over the normal's square, 0 for none
  std::int32_t index[kLanes];
};

// A tree fitted to one pose.
struct Search {
  const WideNode* nodes;
  const WideBox* boxes;
  const WideTriangles* leaves;
  const std::int32_t* leaf_of;  // by triangle
  float together;               // maximum distance from their middle, metres, of points that are searched together
};

// Up to kLanes points, the triangle nearest to each and its squared distance; -1 and infinity for one that is not finite. Of
// equally near triangles (a shared edge or corner) that whose plane is farthest is found, so that the space around a convex
// edge is parted along the bisector and not by rounding; of those the first. What is found for a point depends neither on the
// others nor on hints. Points that lie together are found the fastest.
struct alignas(64) Queries {
  int count = 0;
  float point[3][kLanes];
  std::int32_t hint[kLanes];  // a triangle that is near, or -1
  std::int32_t triangle[kLanes];
  float squared[kLanes];

  void add(Vec3 p, std::int32_t near) {
    point[0][count] = p.x, point[1][count] = p.y, point[2][count] = p.z;
    hint[count++] = near;
  }
};

using Nearest = void (*)(const Search& search, Queries& queries);

}  // namespace headbench::insta

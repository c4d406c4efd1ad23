// The search for the nearest triangle.
#pragma once

#include <math.h>

#include "bench/native/simd.h"
#include "search.h"

namespace headbench::HEADBENCH_ISA {

using insta::Hit;
using insta::kLanes;
using insta::Search;
using insta::Triangle;
using insta::Vec3;
using insta::WideBox;
using insta::WideTriangles;

// Distances that differ by no more than rounding count as equal.
constexpr float kTie = 2e-6f;
constexpr float kTieFloor = 1e-16f;
static_assert(kLanes % W == 0);

// A point in every lane.
struct Wide3 {
  Real x[3];
};

// Squared distances to boxes; a bit for each at most `limit` away.
HEADBENCH_INLINE std::uint32_t squared_distances(const WideBox& boxes, const Wide3& p, float limit, float* out) {
  std::uint32_t close = 0;
  for (int lane = 0; lane < kLanes; lane += W) {
    Real sum = 0.0f;
    for (int i = 0; i < 3; ++i) {
      const Real below = load(boxes.low[i] + lane) - p.x[i], above = p.x[i] - load(boxes.high[i] + lane);
      const Real out_of = max(max(below, above), 0.0f);
      sum = fma(out_of, out_of, sum);
    }
    store(out + lane, sum);
    close |= bits(Real(limit) >= sum) << lane;
  }
  return close;
}

// Squared distances to triangles: the nearest of three edges, or the plane where the foot lies inside all of them.
HEADBENCH_INLINE std::uint32_t squared_distances(const WideTriangles& t, const Wide3& p, float limit, float* out) {
  std::uint32_t close = 0;
  const Real zero = 0.0f, one = 1.0f;
  for (int lane = 0; lane < kLanes; lane += W) {
    Real ap[3], ab[3], ac[3], d1 = 0.0f, d2 = 0.0f, height = 0.0f;
    for (int i = 0; i < 3; ++i) {
      ap[i] = p.x[i] - load(t.a[i] + lane);
      ab[i] = load(t.ab[i] + lane);
      ac[i] = load(t.ac[i] + lane);
      d1 = fma(ab[i], ap[i], d1);
      d2 = fma(ac[i], ap[i], d2);
      height = fma(load(t.normal[i] + lane), ap[i], height);
    }
    const Real ab2 = load(t.ab2 + lane), ac2 = load(t.ac2 + lane), abac = load(t.abac + lane);
    const auto clamped = [&](Real value) { return min(max(value, zero), one); };
    const Real on_ab = clamped(d1 * load(t.by_ab + lane)), on_ac = clamped(d2 * load(t.by_ac + lane));
    // (p - b) . (c - b) = (ap - ab) . (ac - ab)
    const Real on_bc = clamped((d2 - d1 - abac + ab2) * load(t.by_bc + lane));
    Real to_ab = 0.0f, to_ac = 0.0f, to_bc = 0.0f;
    for (int i = 0; i < 3; ++i) {
      const Real way_ab = fnma(on_ab, ab[i], ap[i]), way_ac = fnma(on_ac, ac[i], ap[i]);
      const Real way_bc = fnma(on_bc, ac[i] - ab[i], ap[i] - ab[i]);
      to_ab = fma(way_ab, way_ab, to_ab);
      to_ac = fma(way_ac, way_ac, to_ac);
      to_bc = fma(way_bc, way_bc, to_bc);
    }
    // Barycentric coordinates of the foot times the determinant (Ericson, "Real-Time Collision Detection", 3.4).
    const Real v = fnma(abac, d2, ac2 * d1), w = fnma(abac, d1, ab2 * d2), whole = fnma(abac, abac, ab2 * ac2);
    const Real edges = min(min(to_ab, to_ac), to_bc), by_area = load(t.by_area + lane);
    const Real plane = height * height * by_area;
    const Mask inside = (v >= zero) & (w >= zero) & (whole >= v + w) & (by_area > zero) & (edges > plane);
    const Real squared = select(inside, plane, edges);
    store(out + lane, squared);
    close |= bits(Real(limit) >= squared) << lane;
  }
  return close;
}

inline float plane_distance(const Triangle& t, Vec3 p) {
  const Vec3 normal = cross(t.b - t.a, t.c - t.a);
  const float length = sqrtf(dot(normal, normal));
  return length > 0 ? fabsf(dot(normal, p - t.a)) / length : 0.0f;
}

struct Best {
  Hit hit;
  float reach;  // what is farther cannot be chosen
  const Triangle* triangle = nullptr;

  void offer(const Triangle& candidate, std::int32_t index, float squared, Vec3 p) {
    if (!(squared <= reach)) return;
    const float slack = kTie * hit.value + kTieFloor, least = squared < hit.value ? squared : hit.value;
    const bool nearer = triangle == nullptr || squared < hit.value - slack;
    if (!nearer) {
      const float own = plane_distance(candidate, p), other = plane_distance(*triangle, p);
      if (own < other || (own == other && index > hit.triangle)) {
        hit.value = least;
        return;
      }
    }
    hit.value = nearer ? squared : least;
    hit.triangle = index;
    triangle = &candidate;
    reach = hit.value * (1 + kTie) + kTieFloor;
  }
};

HEADBENCH_INLINE void offer_leaf(const Search& search, std::int32_t leaf, Vec3 point, const Wide3& wide, Best& best) {
  const WideTriangles& triangles = search.leaves[leaf];
  alignas(64) float squared[kLanes];
  for (std::uint32_t close = squared_distances(triangles, wide, best.reach, squared); close; close &= close - 1) {
    const int lane = lowest_bit(close);
    const std::int32_t index = triangles.index[lane];
    if (index >= 0) best.offer(search.triangles[index], index, squared[lane], point);
  }
}

inline Hit nearest(const Search& search, Vec3 point, float limit, std::int32_t hint) {
  Best best;
  best.reach = limit;
  const Wide3 wide{{Real(point.x), Real(point.y), Real(point.z)}};
  const std::int32_t tried = hint < 0 ? -1 : search.leaf_of[hint];
  if (tried >= 0) offer_leaf(search, tried, point, wide, best);
  struct Waiting {
    std::int32_t child;
    float distance;
  } stack[kLanes * insta::kDepthMax];
  int top = 0;
  stack[top++] = {0, 0};
  while (top > 0) {
    const Waiting next = stack[--top];
    if (!(next.distance <= best.reach)) continue;
    if (next.child < 0) {
      if (~next.child != tried) offer_leaf(search, ~next.child, point, wide, best);
      continue;
    }
    alignas(64) float squared[kLanes];
    const insta::WideNode& node = search.nodes[next.child];
    // The nearest on top.
    const int floor = top;
    for (std::uint32_t close = squared_distances(search.boxes[next.child], wide, best.reach, squared); close;
         close &= close - 1) {
      const int lane = lowest_bit(close);
      if (node.node[lane] < 0) continue;
      int place = top++;
      for (; place > floor && stack[place - 1].distance < squared[lane]; --place) stack[place] = stack[place - 1];
      stack[place] = {node.child[lane], squared[lane]};
    }
  }
  return best.hit;
}

}  // namespace headbench::HEADBENCH_ISA

// Rays: the nearest triangle, or whether there is any.
#pragma once

#include "lanes.h"
#include "scene.h"

namespace headbench::HEADBENCH_ISA {

using namespace light;

HEADBENCH_INLINE Vec3 unit(Vec3 a) {
  const float squared = dot(a, a);
  return squared > 0.0f ? a * (1.0f / sqrtf(squared)) : a;
}
struct Hit {
  float distance;
  std::int32_t triangle = -1;
  float u, v;
};

constexpr float kFar = 1e30f;
constexpr int kDeep = 512;          // nodes that may wait: seven a level
constexpr float kOverlap = 2e-5f;   // triangles reach over their edges by this share: no ray slips between two

struct Ray {
  Vec3 from, along;
  Vec3 inverse;
  int near[3];  // rows of a node's bounds that the ray meets first

  HEADBENCH_INLINE Ray(Vec3 origin, Vec3 direction) : from(origin), along(direction) {
    const float d[3] = {direction.x, direction.y, direction.z};
    float inverted[3];
    for (int axis = 0; axis < 3; ++axis) {
      const float kept = d[axis] >= 0.0f ? (d[axis] < 1e-12f ? 1e-12f : d[axis]) : (d[axis] > -1e-12f ? -1e-12f : d[axis]);
      inverted[axis] = 1.0f / kept;
      near[axis] = d[axis] >= 0.0f ? axis : axis + 3;
    }
    inverse = {inverted[0], inverted[1], inverted[2]};
  }
};

// Children whose boxes the ray meets before `limit`, and where it enters them.
HEADBENCH_INLINE unsigned children(const Node& node, const Ray& ray, float limit, Float8& enter) {
  const Float8 ox = all(ray.from.x), oy = all(ray.from.y), oz = all(ray.from.z);
  const Float8 ix = all(ray.inverse.x), iy = all(ray.inverse.y), iz = all(ray.inverse.z);
  enter = max(max((load(node.bounds[ray.near[0]]) - ox) * ix, (load(node.bounds[ray.near[1]]) - oy) * iy),
              max((load(node.bounds[ray.near[2]]) - oz) * iz, all(0.0f)));
  const Float8 leave = min(min((load(node.bounds[(ray.near[0] + 3) % 6]) - ox) * ix,
                               (load(node.bounds[(ray.near[1] + 3) % 6]) - oy) * iy),
                           min((load(node.bounds[(ray.near[2] + 3) % 6]) - oz) * iz, all(limit)));
  return bits(enter <= leave);
}

// Triangles of a leaf that the ray meets, up to and with `limit` (Moeller and Trumbore 1997).
HEADBENCH_INLINE unsigned meets(const Leaf& leaf, const Ray& ray, float limit, Float8& distance, Float8& u, Float8& v) {
  const Float8 dx = all(ray.along.x), dy = all(ray.along.y), dz = all(ray.along.z);
  const Float8 ax = load(leaf.edge1[0]), ay = load(leaf.edge1[1]), az = load(leaf.edge1[2]);
  const Float8 bx = load(leaf.edge2[0]), by = load(leaf.edge2[1]), bz = load(leaf.edge2[2]);
  const Float8 px = dy * bz - dz * by, py = dz * bx - dx * bz, pz = dx * by - dy * bx;
  const Float8 inverse = all(1.0f) / (ax * px + ay * py + az * pz);
  const Float8 tx = all(ray.from.x) - load(leaf.corner[0]), ty = all(ray.from.y) - load(leaf.corner[1]),
               tz = all(ray.from.z) - load(leaf.corner[2]);
  u = (tx * px + ty * py + tz * pz) * inverse;
  const Float8 qx = ty * az - tz * ay, qy = tz * ax - tx * az, qz = tx * ay - ty * ax;
  v = (dx * qx + dy * qy + dz * qz) * inverse;
  distance = (bx * qx + by * qy + bz * qz) * inverse;
  return bits((u >= all(-kOverlap)) & (v >= all(-kOverlap)) & (u + v <= all(1.0f + kOverlap)) &
              (distance > all(0.0f)) & (distance <= all(limit)));
}

HEADBENCH_INLINE bool improve(Hit& best, const Leaf& leaf, const Ray& ray) {
  Float8 distance, u, v;
  bool better = false;
  for (unsigned found = meets(leaf, ray, best.distance, distance, u, v); found; found &= found - 1) {
    const int lane = __builtin_ctz(found);
    const bool first = distance[lane] == best.distance && leaf.triangle[lane] < best.triangle;
    if (distance[lane] < best.distance || first) {
      best = {distance[lane], leaf.triangle[lane], u[lane], v[lane]};
      better = true;
    }
  }
  return better;
}

// The nearest triangle; of equally near ones the first by number, in whatever order the tree has them. `likely` is a leaf to
// try first, and then the one that was met, where any was.
inline Hit nearest(const Scene& scene, const Ray& ray, std::int32_t& likely) {
  Hit best;
  best.distance = kFar;
  improve(best, scene.leaves[likely], ray);
  struct Waiting {
    std::int32_t child;
    float enter;
  } stack[kDeep];
  int waiting = 0;
  stack[waiting++] = {0, 0.0f};
  while (waiting > 0) {
    const Waiting next = stack[--waiting];
    if (next.enter > best.distance) continue;
    if (next.child < 0) {
      if (improve(best, scene.leaves[~next.child], ray)) likely = ~next.child;
      continue;
    }
    const Node& node = scene.nodes[next.child];
    Float8 enter;
    const int base = waiting;
    for (unsigned found = children(node, ray, best.distance, enter); found; found &= found - 1) {
      const int lane = __builtin_ctz(found);
      const Waiting child = {node.child[lane], enter[lane]};
      int place = waiting++;  // the nearest comes to lie on top
      for (; place > base && stack[place - 1].enter < child.enter; --place) stack[place] = stack[place - 1];
      stack[place] = child;
    }
  }
  return best;
}

// Whether there is any triangle before `limit`. `likely` as above.
inline bool blocked(const Scene& scene, const Ray& ray, float limit, std::int32_t& likely) {
  Float8 a, b, c;
  if (meets(scene.leaves[likely], ray, limit, a, b, c)) return true;
  std::int32_t stack[kDeep];
  int waiting = 0;
  stack[waiting++] = 0;
  while (waiting > 0) {
    const std::int32_t next = stack[--waiting];
    if (next < 0) {
      if (meets(scene.leaves[~next], ray, limit, a, b, c)) {
        likely = ~next;
        return true;
      }
      continue;
    }
    const Node& node = scene.nodes[next];
    for (unsigned found = children(node, ray, limit, a); found; found &= found - 1)
      stack[waiting++] = node.child[__builtin_ctz(found)];
  }
  return false;
}

}  // namespace headbench::HEADBENCH_ISA

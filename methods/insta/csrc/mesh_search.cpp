#include "mesh_search.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <stdexcept>

namespace headbench::insta {

namespace {

constexpr std::int32_t kLeafSize = kLanes;
constexpr int kDepthMax = 40;  // halving 2^28 triangles takes 28
// Distances that differ by no more than rounding count as equal.
constexpr float kTie = 2e-6f;
constexpr float kTieFloor = 1e-16f;

// Squared distances of a point to four boxes.
void squared_distances(const WideBox& boxes, Vec3 p, float* out) {
  const float at[3] = {p.x, p.y, p.z};
  for (int lane = 0; lane < kLanes; ++lane) out[lane] = 0;
  for (int i = 0; i < 3; ++i)
    for (int lane = 0; lane < kLanes; ++lane) {
      const float below = boxes.low[i][lane] - at[i], above = at[i] - boxes.high[i][lane];
      float out_of = below > above ? below : above;
      out_of = out_of > 0 ? out_of : 0;
      out[lane] += out_of * out_of;
    }
}

// Squared distances of a point to four triangles: the nearest of three edges, or the plane where the foot lies
// inside all of them. Without branches, so that the lanes run side by side.
void squared_distances(const WideTriangles& t, Vec3 p, float* out) {
  const float at[3] = {p.x, p.y, p.z};
  float ap[3][kLanes];
  float d1[kLanes] = {}, d2[kLanes] = {}, ab2[kLanes] = {}, ac2[kLanes] = {}, abac[kLanes] = {}, height[kLanes] = {};
  for (int i = 0; i < 3; ++i)
    for (int lane = 0; lane < kLanes; ++lane) {
      ap[i][lane] = at[i] - t.a[i][lane];
      d1[lane] += t.ab[i][lane] * ap[i][lane];
      d2[lane] += t.ac[i][lane] * ap[i][lane];
      ab2[lane] += t.ab[i][lane] * t.ab[i][lane];
      ac2[lane] += t.ac[i][lane] * t.ac[i][lane];
      abac[lane] += t.ab[i][lane] * t.ac[i][lane];
      height[lane] += t.normal[i][lane] * ap[i][lane];
    }
  float on_ab[kLanes], on_ac[kLanes], on_bc[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const auto clamped = [](float value) { return value < 0 ? 0.0f : value > 1 ? 1.0f : value; };
    on_ab[lane] = clamped(d1[lane] * t.by_ab[lane]);
    on_ac[lane] = clamped(d2[lane] * t.by_ac[lane]);
    // (p - b) . (c - b) = (ap - ab) . (ac - ab)
    on_bc[lane] = clamped((d2[lane] - d1[lane] - abac[lane] + ab2[lane]) * t.by_bc[lane]);
  }
  float to_ab[kLanes] = {}, to_ac[kLanes] = {}, to_bc[kLanes] = {};
  for (int i = 0; i < 3; ++i)
    for (int lane = 0; lane < kLanes; ++lane) {
      const float x = ap[i][lane], ab = t.ab[i][lane], ac = t.ac[i][lane];
      const float way_ab = x - on_ab[lane] * ab, way_ac = x - on_ac[lane] * ac;
      const float way_bc = x - ab - on_bc[lane] * (ac - ab);
      to_ab[lane] += way_ab * way_ab;
      to_ac[lane] += way_ac * way_ac;
      to_bc[lane] += way_bc * way_bc;
    }
  for (int lane = 0; lane < kLanes; ++lane) {
    // Barycentric coordinates of the foot times the determinant (Ericson, "Real-Time Collision Detection", 3.4).
    const float v = ac2[lane] * d1[lane] - abac[lane] * d2[lane];
    const float w = ab2[lane] * d2[lane] - abac[lane] * d1[lane];
    const float whole = ab2[lane] * ac2[lane] - abac[lane] * abac[lane];
    const float edge = to_ab[lane] < to_ac[lane] ? to_ab[lane] : to_ac[lane];
    const float edges = edge < to_bc[lane] ? edge : to_bc[lane];
    const float plane = height[lane] * height[lane] * t.by_area[lane];
    const bool inside = (v >= 0) & (w >= 0) & (v + w <= whole) & (t.by_area[lane] > 0) & (plane < edges);
    out[lane] = inside ? plane : edges;
  }
}

float inverse(float value) { return value > 0 && std::isfinite(1 / value) ? 1 / value : 0.0f; }

void set_lane(WideTriangles& t, int lane, const Triangle& triangle, std::int32_t index) {
  const Vec3 ab = triangle.b - triangle.a, ac = triangle.c - triangle.a, bc = triangle.c - triangle.b;
  const Vec3 normal = cross(ab, ac);
  const auto put = [lane](float (*to)[kLanes], Vec3 v) { to[0][lane] = v.x, to[1][lane] = v.y, to[2][lane] = v.z; };
  put(t.a, triangle.a);
  put(t.ab, ab);
  put(t.ac, ac);
  put(t.normal, normal);
  t.by_ab[lane] = inverse(dot(ab, ab));
  t.by_ac[lane] = inverse(dot(ac, ac));
  t.by_bc[lane] = inverse(dot(bc, bc));
  t.by_area[lane] = inverse(dot(normal, normal));
  t.index[lane] = index;
}

float plane_distance(const Triangle& t, Vec3 p) {
  const Vec3 normal = cross(t.b - t.a, t.c - t.a);
  const float length = std::sqrt(dot(normal, normal));
  return length > 0 ? std::fabs(dot(normal, p - t.a)) / length : 0.0f;
}

struct Best {
  Hit hit;
  float reach;  // what is farther cannot be chosen
  const Triangle* triangle = nullptr;

  void offer(const Triangle& candidate, std::int32_t index, float squared, Vec3 p) {
    if (!(squared <= reach)) return;
    const float slack = kTie * hit.value + kTieFloor;
    const bool nearer = triangle == nullptr || squared < hit.value - slack;
    if (!nearer) {
      const float own = plane_distance(candidate, p), other = plane_distance(*triangle, p);
      if (own < other || (own == other && index > hit.triangle)) {
        hit.value = std::min(hit.value, squared);
        return;
      }
    }
    hit.value = nearer ? squared : std::min(hit.value, squared);
    hit.triangle = index;
    triangle = &candidate;
    reach = hit.value * (1 + kTie) + kTieFloor;
  }
};

// Distance along a ray at which it enters a box, or infinity.
float entry(const Box& box, Vec3 origin, Vec3 inverse, float limit) {
  float from = 0, to = limit;
  const float lows[3] = {(box.low.x - origin.x) * inverse.x, (box.low.y - origin.y) * inverse.y,
                         (box.low.z - origin.z) * inverse.z};
  const float highs[3] = {(box.high.x - origin.x) * inverse.x, (box.high.y - origin.y) * inverse.y,
                          (box.high.z - origin.z) * inverse.z};
  for (int i = 0; i < 3; ++i) {
    from = std::max(from, std::min(lows[i], highs[i]));
    to = std::min(to, std::max(lows[i], highs[i]));
  }
  // Rounding must not lose a triangle in a box of no thickness.
  return from <= to * (1 + 1e-6f) + 1e-7f ? from : std::numeric_limits<float>::infinity();
}

}  // namespace

void Box::add(Vec3 p) {
  low = {std::min(low.x, p.x), std::min(low.y, p.y), std::min(low.z, p.z)};
  high = {std::max(high.x, p.x), std::max(high.y, p.y), std::max(high.z, p.z)};
}

void Box::add(const Box& other) {
  add(other.low);
  add(other.high);
}

Tree::Tree(const std::int32_t* faces, std::int64_t face_count, const float* vertices, std::int64_t vertex_count)
    : faces_(faces, faces + 3 * face_count), order_(face_count), vertex_count_(vertex_count) {
  if (face_count < 1 || face_count > (std::int64_t{1} << 28))
    throw std::invalid_argument("a mesh has from 1 to 2^28 triangles");
  for (const std::int32_t index : faces_)
    if (index < 0 || index >= vertex_count) throw std::invalid_argument("a triangle names a vertex that is not there");
  std::iota(order_.begin(), order_.end(), 0);
  std::vector<Vec3> centroids(face_count);
  for (std::int64_t face = 0; face < face_count; ++face) {
    Vec3 sum{0, 0, 0};
    for (int corner = 0; corner < 3; ++corner) {
      const float* p = vertices + 3 * faces_[3 * face + corner];
      sum = sum + Vec3{p[0], p[1], p[2]};
    }
    centroids[face] = (1.0f / 3) * sum;
    if (!std::isfinite(dot(sum, sum))) throw std::invalid_argument("a vertex is not finite");
  }
  nodes_.reserve(face_count);
  build(centroids, 0, static_cast<std::int32_t>(face_count));
  widen(0);
}

// Takes a node apart into up to four below it, the largest first, and puts them side by side.
std::int32_t Tree::widen(std::int32_t node) {
  const auto self = static_cast<std::int32_t>(wide_.size());
  wide_.push_back({{0, 0, 0, 0}, {-1, -1, -1, -1}});
  std::int32_t below[kLanes] = {node, -1, -1, -1};
  int used = 1;
  while (used < kLanes) {
    int inner = -1;  // of the inner nodes, the one that was put in first
    for (int i = 0; i < used && inner < 0; ++i)
      if (nodes_[below[i]].count == 0) inner = i;
    if (inner < 0) break;
    const std::int32_t taken = below[inner];
    for (int i = inner; i + 1 < used; ++i) below[i] = below[i + 1];
    below[used - 1] = taken + 1;
    below[used++] = nodes_[taken].right;
  }
  for (int lane = 0; lane < used; ++lane) {
    std::int32_t child;
    if (nodes_[below[lane]].count > 0) {
      child = ~static_cast<std::int32_t>(leaves_.size());
      leaves_.push_back(below[lane]);
    } else {
      child = widen(below[lane]);
    }
    wide_[self].child[lane] = child;
    wide_[self].node[lane] = below[lane];
  }
  return self;
}

void Tree::build(std::vector<Vec3>& centroids, std::int32_t first, std::int32_t count) {
  const std::size_t self = nodes_.size();
  nodes_.push_back({0, first, count});
  if (count <= kLeafSize) return;
  Box box;
  for (std::int32_t i = first; i < first + count; ++i) box.add(centroids[order_[i]]);
  const Vec3 size = box.high - box.low;
  const int axis = size.x >= size.y && size.x >= size.z ? 0 : size.y >= size.z ? 1 : 2;
  const auto key = [&](std::int32_t face) {
    const Vec3& c = centroids[face];
    return axis == 0 ? c.x : axis == 1 ? c.y : c.z;
  };
  const std::int32_t half = count / 2;
  std::nth_element(order_.begin() + first, order_.begin() + first + half, order_.begin() + first + count,
                   [&](std::int32_t a, std::int32_t b) { return key(a) < key(b) || (key(a) == key(b) && a < b); });
  build(centroids, first, half);
  nodes_[self].right = static_cast<std::int32_t>(nodes_.size());
  nodes_[self].count = 0;
  build(centroids, first + half, count - half);
}

Posed::Posed(std::shared_ptr<const Tree> tree, const float* vertices) : tree_(std::move(tree)) {
  const std::int64_t count = tree_->face_count();
  by_face_.resize(count);
  by_order_.resize(count);
  const auto& faces = tree_->faces();
  for (std::int64_t face = 0; face < count; ++face) {
    Vec3 corners[3];
    for (int corner = 0; corner < 3; ++corner) {
      const float* p = vertices + 3 * faces[3 * face + corner];
      corners[corner] = {p[0], p[1], p[2]};
    }
    by_face_[face] = {corners[0], corners[1], corners[2]};
  }
  const auto& nodes = tree_->nodes();
  boxes_.resize(nodes.size());
  for (std::size_t i = nodes.size(); i-- > 0;) {
    const Node& node = nodes[i];
    if (node.count == 0) {
      boxes_[i].add(boxes_[i + 1]);
      boxes_[i].add(boxes_[node.right]);
      continue;
    }
    for (std::int32_t k = node.first; k < node.first + node.count; ++k) {
      const Triangle& triangle = by_order_[k] = by_face_[tree_->order()[k]];
      boxes_[i].add(triangle.a);
      boxes_[i].add(triangle.b);
      boxes_[i].add(triangle.c);
    }
  }
  const auto& wide = tree_->wide();
  wide_.resize(wide.size());
  for (std::size_t i = 0; i < wide.size(); ++i)
    for (int lane = 0; lane < kLanes; ++lane) {
      const Box box = wide[i].node[lane] < 0 ? Box() : boxes_[wide[i].node[lane]];
      const float low[3] = {box.low.x, box.low.y, box.low.z}, high[3] = {box.high.x, box.high.y, box.high.z};
      for (int axis = 0; axis < 3; ++axis) wide_[i].low[axis][lane] = low[axis], wide_[i].high[axis][lane] = high[axis];
    }
  leaves_.resize(tree_->leaves().size());
  for (std::size_t i = 0; i < leaves_.size(); ++i) {
    const Node& node = nodes[tree_->leaves()[i]];
    leaves_[i] = WideTriangles{};
    for (int lane = 0; lane < kLanes; ++lane) {
      leaves_[i].index[lane] = -1;
      if (lane < node.count) set_lane(leaves_[i], lane, by_order_[node.first + lane], tree_->order()[node.first + lane]);
    }
  }
}

Hit Posed::nearest(Vec3 point, float limit, std::int32_t hint) const {
  Best best;
  best.reach = limit;
  if (hint >= 0) {
    WideTriangles alone{};
    float squared[kLanes];
    set_lane(alone, 0, by_face_[hint], hint);
    squared_distances(alone, point, squared);
    best.offer(by_face_[hint], hint, squared[0], point);
  }
  struct Waiting {
    std::int32_t child;
    float distance;
  } stack[kLanes * kDepthMax];
  int top = 0;
  stack[top++] = {0, 0};
  const auto& wide = tree_->wide();
  while (top > 0) {
    const Waiting next = stack[--top];
    if (!(next.distance <= best.reach)) continue;
    float squared[kLanes];
    if (next.child < 0) {
      const WideTriangles& leaf = leaves_[~next.child];
      squared_distances(leaf, point, squared);
      for (int lane = 0; lane < kLanes; ++lane)
        if (squared[lane] <= best.reach && leaf.index[lane] >= 0 && leaf.index[lane] != hint)
          best.offer(by_face_[leaf.index[lane]], leaf.index[lane], squared[lane], point);
      continue;
    }
    squared_distances(wide_[next.child], point, squared);
    // The nearest on top.
    const int floor = top;
    for (int lane = 0; lane < kLanes; ++lane) {
      if (!(squared[lane] <= best.reach) || wide[next.child].node[lane] < 0) continue;
      int place = top++;
      for (; place > floor && stack[place - 1].distance < squared[lane]; --place) stack[place] = stack[place - 1];
      stack[place] = {wide[next.child].child[lane], squared[lane]};
    }
  }
  return best.hit;
}

Hit Posed::first_hit(Vec3 origin, Vec3 direction) const {
  Hit hit;
  const Vec3 inverse{1 / direction.x, 1 / direction.y, 1 / direction.z};
  std::int32_t stack[kDepthMax];
  int top = 0;
  stack[top++] = 0;
  const auto& nodes = tree_->nodes();
  while (top > 0) {
    const std::int32_t at = stack[--top];
    if (!(entry(boxes_[at], origin, inverse, hit.value) < std::numeric_limits<float>::infinity())) continue;
    const Node& node = nodes[at];
    if (node.count == 0) {
      const float left = entry(boxes_[at + 1], origin, inverse, hit.value);
      const float right = entry(boxes_[node.right], origin, inverse, hit.value);
      stack[top++] = left <= right ? node.right : at + 1;
      stack[top++] = left <= right ? at + 1 : node.right;
      continue;
    }
    for (std::int32_t k = node.first; k < node.first + node.count; ++k) {
      // Moeller and Trumbore, 1997.
      const Triangle& t = by_order_[k];
      const Vec3 ab = t.b - t.a, ac = t.c - t.a;
      const Vec3 p = cross(direction, ac);
      const float determinant = dot(ab, p);
      if (determinant == 0) continue;
      const Vec3 from = origin - t.a;
      const float u = dot(from, p) / determinant;
      const Vec3 q = cross(from, ab);
      const float v = dot(direction, q) / determinant, distance = dot(ac, q) / determinant;
      const float slack = 1e-6f;  // a ray along an edge must not slip between its triangles
      if (!(u >= -slack && v >= -slack && u + v <= 1 + slack && distance > 0)) continue;
      const std::int32_t index = tree_->order()[k];
      if (distance < hit.value || (distance == hit.value && index < hit.triangle)) hit = {index, distance};
    }
  }
  return hit;
}

}  // namespace headbench::insta

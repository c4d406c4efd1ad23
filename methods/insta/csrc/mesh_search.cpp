#include "mesh_search.h"

#include <algorithm>
#include <numeric>
#include <stdexcept>

namespace headbench::insta {

namespace {

constexpr std::int32_t kLeafSize = kLanes;
constexpr float kFar = 1e30f;  // its square is infinite

float inverse(float value) { return value > 0 && std::isfinite(1 / value) ? 1 / value : 0.0f; }

void set_lane(WideTriangles& t, int lane, const Triangle& triangle, std::int32_t index) {
  const Vec3 ab = triangle.b - triangle.a, ac = triangle.c - triangle.a, bc = triangle.c - triangle.b;
  const Vec3 normal = cross(ab, ac);
  const auto put = [lane](float (*to)[kLanes], Vec3 v) { to[0][lane] = v.x, to[1][lane] = v.y, to[2][lane] = v.z; };
  put(t.a, triangle.a);
  put(t.ab, ab);
  put(t.ac, ac);
  put(t.normal, normal);
  t.ab2[lane] = dot(ab, ab);
  t.ac2[lane] = dot(ac, ac);
  t.abac[lane] = dot(ab, ac);
  t.by_ab[lane] = inverse(dot(ab, ab));
  t.by_ac[lane] = inverse(dot(ac, ac));
  t.by_bc[lane] = inverse(dot(bc, bc));
  t.by_area[lane] = inverse(dot(normal, normal));
  t.index[lane] = index;
}

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
    : faces_(faces, faces + 3 * face_count), order_(face_count), leaf_of_(face_count), vertex_count_(vertex_count) {
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

// Takes a node apart into up to kLanes below it, the one put in first at first, and puts them side by side.
std::int32_t Tree::widen(std::int32_t node) {
  const auto self = static_cast<std::int32_t>(wide_.size());
  wide_.emplace_back();
  for (int lane = 0; lane < kLanes; ++lane) wide_[self].child[lane] = wide_[self].node[lane] = -1;
  std::int32_t below[kLanes] = {node};
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
      const Node& leaf = nodes_[below[lane]];
      for (std::int32_t k = leaf.first; k < leaf.first + leaf.count; ++k)
        leaf_of_[order_[k]] = static_cast<std::int32_t>(leaves_.size());
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

Posed::Posed(std::shared_ptr<const Tree> tree, const float* vertices, Nearest nearest)
    : tree_(std::move(tree)), nearest_(nearest) {
  triangles_.resize(tree_->face_count());
  const auto corner = [&](std::int32_t face, int number) { return row(vertices, tree_->faces()[3 * face + number]); };
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
      const std::int32_t face = tree_->order()[k];
      const Triangle& triangle = triangles_[k] = {corner(face, 0), corner(face, 1), corner(face, 2)};
      boxes_[i].add(triangle.a);
      boxes_[i].add(triangle.b);
      boxes_[i].add(triangle.c);
    }
  }
  const auto& wide = tree_->wide();
  wide_.resize(wide.size());
  for (std::size_t i = 0; i < wide.size(); ++i)
    for (int lane = 0; lane < kLanes; ++lane) {
      const bool used = wide[i].node[lane] >= 0;
      const Box box = used ? boxes_[wide[i].node[lane]] : Box();
      const float low[3] = {box.low.x, box.low.y, box.low.z}, high[3] = {box.high.x, box.high.y, box.high.z};
      for (int axis = 0; axis < 3; ++axis) {
        wide_[i].low[axis][lane] = used ? low[axis] : kFar;
        wide_[i].high[axis][lane] = used ? high[axis] : kFar;
      }
    }
  leaves_.resize(tree_->leaves().size());
  double diagonals = 0;
  for (std::size_t i = 0; i < leaves_.size(); ++i) {
    const Node& node = nodes[tree_->leaves()[i]];
    const Box& box = boxes_[tree_->leaves()[i]];
    diagonals += length(box.high - box.low);
    const Triangle none{{kFar, kFar, kFar}, {kFar, kFar, kFar}, {kFar, kFar, kFar}};
    for (int lane = 0; lane < kLanes; ++lane) {
      const bool used = lane < node.count;
      set_lane(leaves_[i], lane, used ? triangles_[node.first + lane] : none, used ? tree_->order()[node.first + lane] : -1);
    }
  }
  // Half of a leaf's diagonal, on average.
  together_ = static_cast<float>(0.5 * diagonals / static_cast<double>(leaves_.size()));
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
      const Triangle& t = triangles_[k];
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

// Nearest triangle and first hit on a posed mesh, exact, by a tree of boxes that is built once and refitted.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <vector>

#include "search.h"

namespace headbench::insta {

inline float length(Vec3 v) { return std::sqrt(dot(v, v)); }

struct Box {
  Vec3 low{std::numeric_limits<float>::infinity(), std::numeric_limits<float>::infinity(),
           std::numeric_limits<float>::infinity()};
  Vec3 high{-std::numeric_limits<float>::infinity(), -std::numeric_limits<float>::infinity(),
            -std::numeric_limits<float>::infinity()};
  void add(Vec3 p);
  void add(const Box& other);
};

// The left child of an inner node follows it; a leaf has triangles [first, first + count) of the tree's order.
struct Node {
  std::int32_t right;
  std::int32_t first;
  std::int32_t count;  // 0 for an inner node
};

// Which triangles lie together. Made from one pose of the mesh; poses that differ moderately keep it tight.
class Tree {
 public:
  Tree(const std::int32_t* faces, std::int64_t face_count, const float* vertices, std::int64_t vertex_count);

  std::int64_t face_count() const { return static_cast<std::int64_t>(order_.size()); }
  std::int64_t vertex_count() const { return vertex_count_; }
  const std::vector<Node>& nodes() const { return nodes_; }
  const std::vector<std::int32_t>& order() const { return order_; }
  const std::vector<std::int32_t>& faces() const { return faces_; }
  const std::vector<WideNode>& wide() const { return wide_; }
  const std::vector<std::int32_t>& leaves() const { return leaves_; }    // nodes
  const std::vector<std::int32_t>& leaf_of() const { return leaf_of_; }  // by triangle

 private:
  void build(std::vector<Vec3>& centroids, std::int32_t first, std::int32_t count);
  std::int32_t widen(std::int32_t node);

  std::vector<std::int32_t> faces_, order_, leaves_, leaf_of_;
  std::vector<Node> nodes_;
  std::vector<WideNode> wide_;
  std::int64_t vertex_count_;
};

// The tree fitted to one pose.
class Posed {
 public:
  Posed(std::shared_ptr<const Tree> tree, const float* vertices, Nearest nearest);

  const Tree& tree() const { return *tree_; }
  const std::vector<Box>& boxes() const { return boxes_; }
  float together() const { return together_; }  // maximum distance from their middle, metres, of points that are searched together

  // Writes the triangles and the squared distances of queries.
  void nearest(Queries& queries) const {
    nearest_({tree_->wide().data(), wide_.data(), leaves_.data(), tree_->leaf_of().data(), together_}, queries);
  }

  // First triangle hit at a distance above 0, from either side. `direction` need not have unit length.
  Hit first_hit(Vec3 origin, Vec3 direction) const;

 private:
  std::shared_ptr<const Tree> tree_;
  std::vector<Triangle> triangles_;  // in the tree's order
  std::vector<Box> boxes_;
  std::vector<WideBox> wide_;
  std::vector<WideTriangles> leaves_;
  float together_;
  Nearest nearest_;
};

}  // namespace headbench::insta

// A tree of boxes over triangles: built once, fitted to every pose.
#pragma once

#include <vector>

#include "scene.h"

namespace headbench::light {

class Tree {
 public:
  // Boxes that keep together what lies together, by the surface area heuristic in 16 bins an axis.
  Tree(const float* vertices, const std::int32_t* faces, std::int64_t triangles);

  // Move the triangles to other vertices. What rays meet does not depend on the pose that the tree was built for.
  void fit(const float* vertices, const std::int32_t* faces);

  const std::vector<Node>& nodes() const { return nodes_; }
  const std::vector<Leaf>& leaves() const { return leaves_; }

 private:
  struct Part;
  std::int32_t add(Part* parts, std::int32_t part);
  std::vector<Node> nodes_;  // children after their parents
  std::vector<Leaf> leaves_;
};

}  // namespace headbench::light

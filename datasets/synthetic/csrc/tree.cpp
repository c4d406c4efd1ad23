#include "tree.h"

#include <algorithm>
#include <numeric>

namespace headbench::light {
namespace {

constexpr int kBins = 16;
constexpr float kFar = 1e30f;
constexpr float kMargin = 1e-6f;  // metres around each leaf: boxes must lose no hit to rounding

struct Box {
  float low[3] = {kFar, kFar, kFar}, high[3] = {-kFar, -kFar, -kFar};
  void add(const float* point) {
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = std::min(low[axis], point[axis]);
      high[axis] = std::max(high[axis], point[axis]);
    }
  }
  void add(const Box& other) {
    add(other.low);
    add(other.high);
  }
  float area() const {
    const float x = high[0] - low[0], y = high[1] - low[1], z = high[2] - low[2];
    return x < 0.0f ? 0.0f : x * y + y * z + z * x;
  }
};

}  // namespace

// A binary tree on the way: triangles [first, last) of the order, or two parts.
struct Tree::Part {
  Box box;
  std::int32_t first, last;
  std::int32_t left = -1, right = -1;
};

Tree::Tree(const float* vertices, const std::int32_t* faces, std::int64_t triangles) {
  std::vector<Box> boxes(triangles);
  std::vector<std::int32_t> order(triangles);
  std::iota(order.begin(), order.end(), 0);
  for (std::int64_t i = 0; i < triangles; ++i)
    for (int corner = 0; corner < 3; ++corner) boxes[i].add(vertices + 3 * faces[3 * i + corner]);
  const auto middle = [&](std::int32_t i, int axis) { return boxes[i].low[axis] + boxes[i].high[axis]; };

  std::vector<Part> parts(1);
  parts[0].first = 0;
  parts[0].last = static_cast<std::int32_t>(triangles);
  for (const Box& box : boxes) parts[0].box.add(box);
  for (std::size_t at = 0; at < parts.size(); ++at) {
    const std::int32_t first = parts[at].first, last = parts[at].last;
    if (last - first < 2) continue;
    Box middles;
    for (std::int32_t i = first; i < last; ++i) {
      const float point[3] = {middle(order[i], 0), middle(order[i], 1), middle(order[i], 2)};
      middles.add(point);
    }
    // A leaf costs one test of eight triangles however many it has.
    float best = last - first <= kWide ? parts[at].box.area() : kFar;
    int best_axis = -1, best_bin = 0;
    for (int axis = 0; axis < 3; ++axis) {
      const float low = middles.low[axis], width = middles.high[axis] - low;
      if (!(width > 0.0f)) continue;
      Box bins[kBins];
      std::int32_t counts[kBins] = {};
      for (std::int32_t i = first; i < last; ++i) {
        const int bin = std::min(kBins - 1, static_cast<int>((middle(order[i], axis) - low) / width * kBins));
        bins[bin].add(boxes[order[i]]);
        ++counts[bin];
      }
      float right_cost[kBins] = {};
      Box sum;
      std::int32_t count = 0;
      for (int bin = kBins - 1; bin > 0; --bin) {
        sum.add(bins[bin]);
        count += counts[bin];
        right_cost[bin] = sum.area() * static_cast<float>((count + kWide - 1) / kWide);
      }
      sum = Box();
      count = 0;
      for (int bin = 1; bin < kBins; ++bin) {
        sum.add(bins[bin - 1]);
        count += counts[bin - 1];
        const float cost = sum.area() * static_cast<float>((count + kWide - 1) / kWide) + right_cost[bin];
        if (count > 0 && count < last - first && cost < best) {
          best = cost;
          best_axis = axis;
          best_bin = bin;
        }
      }
    }
    std::int32_t split = (first + last) / 2;
    if (best_axis >= 0) {
      const float low = middles.low[best_axis], width = middles.high[best_axis] - low;
      split = static_cast<std::int32_t>(
          std::partition(order.begin() + first, order.begin() + last,
                         [&](std::int32_t i) {
                           const float place = (middle(i, best_axis) - low) / width * kBins;
                           return std::min(kBins - 1, static_cast<int>(place)) < best_bin;
                         }) -
          order.begin());
    } else if (last - first <= kWide) {
      continue;
    }
    for (int side = 0; side < 2; ++side) {
      Part half;
      half.first = side ? split : first;
      half.last = side ? last : split;
      for (std::int32_t i = half.first; i < half.last; ++i) half.box.add(boxes[order[i]]);
      (side ? parts[at].right : parts[at].left) = static_cast<std::int32_t>(parts.size());
      parts.push_back(half);
    }
  }

  // Leaves in the order of their triangles; a part's leaf is found by its first triangle.
  std::vector<std::int32_t> leaf_at(triangles, -1);
  for (const Part& part : parts) {
    if (part.left >= 0 || part.first == part.last) continue;
    leaf_at[part.first] = static_cast<std::int32_t>(leaves_.size());
    Leaf leaf{};
    for (int lane = 0; lane < kWide; ++lane)
      leaf.triangle[lane] = part.first + lane < part.last ? order[part.first + lane] : -1;
    leaves_.push_back(leaf);
  }
  for (Part& part : parts)
    if (part.left < 0) part.right = part.first == part.last ? -1 : leaf_at[part.first];
  add(parts.data(), 0);
  fit(vertices, faces);
}

// Add a node with up to eight parts below `part`: the largest are opened first.
std::int32_t Tree::add(Part* parts, std::int32_t part) {
  const std::int32_t index = static_cast<std::int32_t>(nodes_.size());
  nodes_.emplace_back();
  std::int32_t open[kWide] = {part};
  int count = 1;
  while (count < kWide) {
    int largest = -1;
    for (int i = 0; i < count; ++i) {
      if (parts[open[i]].left < 0) continue;
      if (largest < 0 || parts[open[i]].box.area() > parts[open[largest]].box.area()) largest = i;
    }
    if (largest < 0) break;
    const Part& opened = parts[open[largest]];
    open[largest] = opened.left;
    open[count++] = opened.right;
  }
  for (int lane = 0; lane < kWide; ++lane) {
    std::int32_t child = 0;  // the root is not a child, so 0 marks an empty lane
    if (lane < count) {
      const Part& below = parts[open[lane]];
      if (below.left >= 0)
        child = add(parts, open[lane]);
      else if (below.right >= 0)
        child = ~below.right;
    }
    nodes_[index].child[lane] = child;
  }
  return index;
}

void Tree::fit(const float* vertices, const std::int32_t* faces) {
  for (Leaf& leaf : leaves_) {
    for (int lane = 0; lane < kWide; ++lane) {
      if (leaf.triangle[lane] < 0) continue;
      const std::int32_t* face = faces + 3 * static_cast<std::int64_t>(leaf.triangle[lane]);
      for (int axis = 0; axis < 3; ++axis) {
        const float a = vertices[3 * face[0] + axis];
        leaf.corner[axis][lane] = a;
        leaf.edge1[axis][lane] = vertices[3 * face[1] + axis] - a;
        leaf.edge2[axis][lane] = vertices[3 * face[2] + axis] - a;
      }
    }
  }
  for (std::size_t at = nodes_.size(); at-- > 0;) {
    Node& node = nodes_[at];
    for (int lane = 0; lane < kWide; ++lane) {
      Box box;
      const std::int32_t child = node.child[lane];
      if (child < 0) {
        for (const std::int32_t triangle : leaves_[~child].triangle)
          for (int corner = 0; triangle >= 0 && corner < 3; ++corner)
            box.add(vertices + 3 * faces[3 * static_cast<std::int64_t>(triangle) + corner]);
        for (int axis = 0; axis < 3; ++axis) {
          box.low[axis] -= kMargin;
          box.high[axis] += kMargin;
        }
      } else if (child > 0) {
        const Node& below = nodes_[child];
        for (int axis = 0; axis < 3; ++axis) {
          box.low[axis] = *std::min_element(below.bounds[axis], below.bounds[axis] + kWide);
          box.high[axis] = *std::max_element(below.bounds[axis + 3], below.bounds[axis + 3] + kWide);
        }
      }
      for (int axis = 0; axis < 3; ++axis) {
        node.bounds[axis][lane] = box.low[axis];
        node.bounds[axis + 3][lane] = box.high[axis];
      }
    }
  }
}

}  // namespace headbench::light

#include "marcher.h"

#include <algorithm>
#include <cmath>

namespace headbench::insta {

namespace {

constexpr float kBend = 0.5f;  // of a way through free cells: by so much the warp may lead elsewhere than straight on
constexpr float kLatticeMax = 1e9f;  // from farther away a float does not tell lattice points apart

// Largest reach below every node: by so much its box grows.
std::vector<float> paddings(const Tree& tree, const float* reach) {
  const auto& nodes = tree.nodes();
  std::vector<float> padding(nodes.size());
  for (std::size_t i = nodes.size(); i-- > 0;) {
    const Node& node = nodes[i];
    if (node.count == 0) {
      padding[i] = std::max(padding[i + 1], padding[node.right]);
      continue;
    }
    padding[i] = -1;
    for (std::int32_t k = node.first; k < node.first + node.count; ++k)
      padding[i] = std::max(padding[i], reach[tree.order()[k]]);
  }
  return padding;
}

// Whether what a box grows by outweighs its own size, so that taking it apart would tell a ray little.
bool is_cluster(const Node& node, const Box& box, float padding) {
  const Vec3 size = box.high - box.low;
  return node.count > 0 || std::max({size.x, size.y, size.z}) <= 2 * padding;
}

bool crossing(const Box& box, float padding, Vec3 origin, Vec3 inverse, float limit, Interval& interval) {
  const float lows[3] = {(box.low.x - padding - origin.x) * inverse.x, (box.low.y - padding - origin.y) * inverse.y,
                         (box.low.z - padding - origin.z) * inverse.z};
  const float highs[3] = {(box.high.x + padding - origin.x) * inverse.x,
                          (box.high.y + padding - origin.y) * inverse.y,
                          (box.high.z + padding - origin.z) * inverse.z};
  // A ray within a face of the box gives 0 * infinity; the comparisons below then keep what they have.
  float from = 0, to = limit;
  for (int i = 0; i < 3; ++i) {
    const float near = lows[i] < highs[i] ? lows[i] : highs[i], far = lows[i] < highs[i] ? highs[i] : lows[i];
    if (near > from) from = near;
    if (far < to) to = far;
  }
  interval = {from, to, padding};
  return from <= to;
}

}  // namespace

Marcher::Marcher(const Posed& mesh, const Warp& warp, const float* reach, const Grid& grid, float step)
    : mesh_(mesh), warp_(warp), reach_(reach), grid_(grid), step_(step), padding_(paddings(mesh.tree(), reach)) {}

Progress Marcher::start(Vec3 origin, Vec3 direction, float jitter, std::int32_t first,
                        std::vector<Interval>& intervals) const {
  Progress progress{origin, direction, jitter, first, -1, intervals.size(), intervals.size(), -1};
  if (first < 0 || padding_[0] < 0) return progress;
  near_intervals(origin, direction, intervals);
  progress.last = intervals.size();
  if (progress.interval < progress.last) enter(progress, intervals);
  return progress;
}

// One lattice point more at both ends: nothing depends on how an interval's end was rounded.
void Marcher::enter(Progress& progress, const std::vector<Interval>& intervals) const {
  const Interval& interval = intervals[progress.interval];
  const auto before = static_cast<std::int32_t>(std::floor(interval.from / step_ - progress.jitter)) - 1;
  progress.index = std::max(progress.index, before);
  progress.until = interval.to / step_ - progress.jitter + 1;
}

// Whether there are lattice points left in intervals.
bool Marcher::more(Progress& progress, const std::vector<Interval>& intervals) const {
  while (progress.interval < progress.last) {
    if (static_cast<float>(progress.index) <= progress.until) return true;
    if (++progress.interval < progress.last) enter(progress, intervals);
  }
  return false;
}

// Goes on from a lattice point whose nearest triangle is known; whether there is a sample at that point.
bool Marcher::look(Progress& progress, const std::vector<Interval>& intervals, std::int32_t triangle, float squared,
                   Sample& sample) const {
  const Vec3 at = point(progress);
  const std::int32_t index = progress.index++;
  const float away = std::sqrt(squared), farthest = intervals[progress.interval].reach;
  if (!std::isfinite(away)) return false;
  if (triangle < 0 || away > farthest) {
    // Nor is any triangle in reach before the ray has covered the difference.
    progress.index += static_cast<std::int32_t>((away - farthest) / step_);
    return false;
  }
  const CanonicalPoint placed = place(at, progress.direction, triangle);
  progress.index += passed(placed, progress.until - static_cast<float>(index));
  const float reach = reach_[triangle];
  if (free_at(placed.cells) != 0 || reach < 0 || away > reach) return false;
  const float length = std::max(std::sqrt(dot(placed.way, placed.way)), 1e-12f);
  sample = {placed.position, (1 / length) * placed.way, away, index, triangle};
  return true;
}

void Marcher::near_intervals(Vec3 origin, Vec3 direction, std::vector<Interval>& intervals) const {
  const std::size_t begin = intervals.size();
  const Vec3 inverse{1 / direction.x, 1 / direction.y, 1 / direction.z};
  const Box& whole = mesh_.boxes()[0];
  const Vec3 way = 0.5f * (whole.low + whole.high) - origin, half = 0.5f * (whole.high - whole.low);
  const float farthest = std::sqrt(dot(way, way)) + std::sqrt(dot(half, half)) + 2 * padding_[0];
  if (!(farthest / step_ < kLatticeMax)) return;
  const auto& nodes = mesh_.tree().nodes();
  std::int32_t stack[64];
  int top = 0;
  stack[top++] = 0;
  while (top > 0) {
    const std::int32_t at = stack[--top];
    Interval interval;
    if (padding_[at] < 0 || !crossing(mesh_.boxes()[at], padding_[at], origin, inverse, farthest, interval))
      continue;
    if (is_cluster(nodes[at], mesh_.boxes()[at], padding_[at])) {
      intervals.push_back(interval);
      continue;
    }
    stack[top++] = nodes[at].right;
    stack[top++] = at + 1;
  }
  std::sort(intervals.begin() + begin, intervals.end(),
            [](const Interval& a, const Interval& b) { return a.from < b.from; });
  std::size_t kept = begin;
  for (std::size_t i = begin; i < intervals.size(); ++i) {
    const Interval interval = intervals[i];
    if (kept == begin || interval.from > intervals[kept - 1].to) {
      intervals[kept++] = interval;
      continue;
    }
    intervals[kept - 1].to = std::max(intervals[kept - 1].to, interval.to);
    intervals[kept - 1].reach = std::max(intervals[kept - 1].reach, interval.reach);
  }
  intervals.resize(kept);
}

Marcher::CanonicalPoint Marcher::place(Vec3 point, Vec3 direction, std::int32_t triangle) const {
  float m[12];
  matrix(point, triangle, m);
  CanonicalPoint placed;
  const Vec3 p = placed.position = {m[0] * point.x + m[1] * point.y + m[2] * point.z + m[3],
                                    m[4] * point.x + m[5] * point.y + m[6] * point.z + m[7],
                                    m[8] * point.x + m[9] * point.y + m[10] * point.z + m[11]};
  placed.way = {m[0] * direction.x + m[1] * direction.y + m[2] * direction.z,
                m[4] * direction.x + m[5] * direction.y + m[6] * direction.z,
                m[8] * direction.x + m[9] * direction.y + m[10] * direction.z};
  placed.cells = grid_.cells_per_metre * (p - grid_.low);
  return placed;
}

// How many lattice points in a row, up to `most`, follow a point into free cells.
std::int32_t Marcher::passed(const CanonicalPoint& placed, float most) const {
  const Vec3 step = (step_ * grid_.cells_per_metre) * placed.way;
  const float length = std::sqrt(dot(step, step)), bend = kBend * length;
  if (!(length > 0)) return 0;  // a triangle without area leads nowhere
  std::int32_t clear = 0;
  while (static_cast<float>(clear) < most) {
    const float steps = static_cast<float>(clear + 1), slack = steps * bend;
    const Vec3 at = placed.cells + steps * step;
    const float room = static_cast<float>(free_at(at)) - 1;
    if (room >= slack)
      clear += 1 + static_cast<std::int32_t>(std::min((room - slack) / (length + bend), most));
    else if (slack <= 0.5f && clear_around(at, slack))
      ++clear;
    else
      break;
  }
  return clear;
}

// Cells to the nearest occupied one, 0 in one; what is known of places off the grid is that they are free.
int Marcher::free_at(Vec3 cells) const {
  const float at[3] = {cells.x, cells.y, cells.z};
  std::int64_t cell = 0;
  for (int i = 0; i < 3; ++i) {
    if (!(at[i] >= 0 && at[i] < static_cast<float>(grid_.size[i]))) return 1;
    cell = cell * grid_.size[i] + static_cast<std::int32_t>(at[i]);
  }
  return grid_.free[cell];
}

// Whether a cube about a place, of twice `half` <= 1 cells, touches no occupied cell.
bool Marcher::clear_around(Vec3 cells, float half) const {
  for (int corner = 0; corner < 8; ++corner) {
    const auto side = [&](int axis) { return corner >> axis & 1 ? half : -half; };
    if (free_at(cells + Vec3{side(0), side(1), side(2)}) == 0) return false;
  }
  return true;
}

void Marcher::matrix(Vec3 point, std::int32_t triangle, float* m) const {
  const float* own = warp_.matrices + 12 * triangle;
  const float own_falloff = warp_.own_falloff[triangle];
  if (own_falloff < 0) {
    std::copy(own, own + 12, m);
    return;
  }
  const auto weight = [&](std::int32_t face, float falloff) {
    const float* c = warp_.centroids + 3 * face;
    const Vec3 way = point - Vec3{c[0], c[1], c[2]};
    return std::exp(-falloff * std::sqrt(dot(way, way)));
  };
  float total = weight(triangle, own_falloff);
  for (int i = 0; i < 12; ++i) m[i] = total * own[i];
  for (int side = 0; side < 3; ++side) {
    const std::int32_t other = warp_.neighbours[3 * triangle + side];
    if (other < 0) continue;
    const float w = weight(other, warp_.neighbour_falloff[triangle]);
    for (int i = 0; i < 12; ++i) m[i] += w * warp_.matrices[12 * other + i];
    total += w;
  }
  for (int i = 0; i < 12; ++i) m[i] /= total;
}

}  // namespace headbench::insta

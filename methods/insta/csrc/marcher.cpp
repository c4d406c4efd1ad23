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
  interval.from = from;
  interval.to = to;
  return from <= to;
}

}  // namespace

Marcher::Marcher(const Posed& mesh, const Warp& warp, const float* reach, const Grid& grid, float step)
    : mesh_(mesh), warp_(warp), reach_(reach), grid_(grid), step_(step), padding_(paddings(mesh.tree(), reach)) {}

// Rays that stay together share the intervals of one between them, to boxes that are larger by as much as they part.
void Marcher::start(Progress* rays, int count, std::vector<Interval>& intervals) const {
  const auto set_out = [&](int begin, int end, Vec3 origin, Vec3 direction, float spread, float farthest) {
    const std::size_t first = intervals.size();
    if (padding_[0] >= 0) near_intervals(origin, direction, spread, farthest, intervals);
    for (int i = begin; i < end; ++i) {
      Progress& ray = rays[i];
      ray.interval = ray.last = intervals.size();
      if (ray.index < 0 || first == ray.last) continue;
      ray.interval = first;
      enter(ray, intervals);
    }
  };
  Box origins, directions;
  for (int i = 0; i < count; ++i) {
    origins.add(rays[i].origin);
    directions.add(rays[i].direction);
  }
  const Vec3 origin = 0.5f * (origins.low + origins.high), direction = 0.5f * (directions.low + directions.high);
  const float farthest = farthest_from(origin);
  const float spread = length(origins.high - origin) + farthest * length(directions.high - direction);
  if (spread <= mesh_.together()) return set_out(0, count, origin, direction, spread, farthest);
  for (int i = 0; i < count; ++i)
    set_out(i, i + 1, rays[i].origin, rays[i].direction, 0, farthest_from(rays[i].origin));
}

// Where a ray from a place has left the mesh behind.
float Marcher::farthest_from(Vec3 origin) const {
  const Box& whole = mesh_.boxes()[0];
  return length(0.5f * (whole.low + whole.high) - origin) + length(0.5f * (whole.high - whole.low)) + 2 * padding_[0];
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

// Goes on from the next lattice points of rays where one between them tells that there are no samples at any of them; whether
// it does.
bool Marcher::pass(Progress* rays, const Together& together, const std::vector<Interval>& intervals) const {
  if (together.count == 1) return false;
  Box box;
  float farthest = 0, most = 0;
  for (int k = 0; k < together.count; ++k) {
    const Progress& ray = rays[together.rays[k]];
    box.add(point(ray));
    farthest = std::max(farthest, intervals[ray.interval].reach);
    most = std::max(most, ray.until - static_cast<float>(ray.index));
  }
  const Vec3 half = 0.5f * (box.high - box.low), middle = box.low + half;
  const float spread = length(half);
  if (!(spread <= mesh_.together())) return false;
  Queries query;
  query.add(middle, rays[together.rays[0]].hint);
  mesh_.nearest(query);
  const std::int32_t triangle = query.triangle[0];
  if (triangle < 0) return false;
  for (int k = 0; k < together.count; ++k) rays[together.rays[k]].hint = triangle;
  const float away = std::sqrt(query.squared[0]) - spread;
  std::int32_t clear = 0;
  if (away > farthest) {
    clear = static_cast<std::int32_t>((away - farthest) / step_);
  } else {
    const CanonicalPoint placed = place(middle, rays[together.rays[0]].direction, triangle);
    const float about = (1 + kBend) * spread * grid_.cells_per_metre * length(placed.way);
    if (static_cast<float>(free_at(placed.cells)) - 1 < about) return false;
    clear = passed(placed, about, most);
  }
  for (int k = 0; k < together.count; ++k) {
    Progress& ray = rays[together.rays[k]];
    ray.index += 1 + std::min(clear, static_cast<std::int32_t>(std::max(ray.until - static_cast<float>(ray.index), 0.0f)));
  }
  return true;
}

// Goes on from a lattice point whose nearest triangle is known; whether there is a sample at that point.
bool Marcher::look(Progress& progress, const std::vector<Interval>& intervals, std::int32_t triangle, float squared,
                   Sample& sample) const {
  const Vec3 at = point(progress);
  const std::int32_t index = progress.index++;
  if (triangle < 0) return false;
  progress.hint = triangle;
  const float away = std::sqrt(squared), farthest = intervals[progress.interval].reach;
  if (away > farthest) {
    // Nor is any triangle in reach before the ray has covered the difference.
    progress.index += static_cast<std::int32_t>((away - farthest) / step_);
    return false;
  }
  const CanonicalPoint placed = place(at, progress.direction, triangle);
  if (free_at(placed.cells) != 0) {
    progress.index += passed(placed, 0, progress.until - static_cast<float>(index));
    return false;
  }
  const float reach = reach_[triangle];
  if (reach < 0 || away > reach) return false;
  const float scale = std::max(length(placed.way), 1e-12f);
  sample = {placed.position, (1 / scale) * placed.way, away, index, triangle};
  return true;
}

void Marcher::near_intervals(Vec3 origin, Vec3 direction, float spread, float farthest,
                             std::vector<Interval>& intervals) const {
  const std::size_t begin = intervals.size();
  const Vec3 inverse{1 / direction.x, 1 / direction.y, 1 / direction.z};
  if (!(farthest / step_ < kLatticeMax)) return;
  const auto& nodes = mesh_.tree().nodes();
  std::int32_t stack[64];
  int top = 0;
  stack[top++] = 0;
  while (top > 0) {
    const std::int32_t at = stack[--top];
    Interval interval;
    if (padding_[at] < 0 || !crossing(mesh_.boxes()[at], padding_[at] + spread, origin, inverse, farthest, interval))
      continue;
    interval.reach = padding_[at];
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

// How many lattice points in a row, up to `most`, follow a point, and those `about` cells from it, into free cells.
std::int32_t Marcher::passed(const CanonicalPoint& placed, float about, float most) const {
  const Vec3 step = (step_ * grid_.cells_per_metre) * placed.way;
  const float stride = length(step), bend = kBend * stride;
  if (!(stride > 0)) return 0;  // a triangle without area leads nowhere
  std::int32_t clear = 0;
  while (static_cast<float>(clear) < most) {
    const float steps = static_cast<float>(clear + 1), slack = about + steps * bend;
    const Vec3 at = placed.cells + steps * step;
    const float room = static_cast<float>(free_at(at)) - 1;
    if (room >= slack)
      clear += 1 + static_cast<std::int32_t>(std::min((room - slack) / (stride + bend), most));
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
    return std::exp(-falloff * length(point - Vec3{c[0], c[1], c[2]}));
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

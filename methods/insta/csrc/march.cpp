#include "march.h"

#include <algorithm>
#include <cmath>

#include "../../splats/csrc/thread_pool.h"

namespace headbench::insta {

namespace {

constexpr std::int64_t kRaysPerTask = 128;
constexpr float kCaution = 0.75f;

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

// A part of a ray near some triangles, and the largest reach among them.
struct Interval {
  float from, to, reach;
};

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

class Marcher {
 public:
  Marcher(const Posed& mesh, const Rays& rays, const float* reach, const Warp& warp, const Grid& grid)
      : mesh_(mesh), rays_(rays), reach_(reach), warp_(warp), grid_(grid), padding_(paddings(mesh.tree(), reach)) {}

  void ray(std::int64_t number, std::vector<Interval>& intervals, Samples& out) const {
    const float* o = rays_.origins + 3 * number;
    const float* d = rays_.directions + 3 * number;
    const Vec3 origin{o[0], o[1], o[2]}, direction{d[0], d[1], d[2]};
    std::int32_t index = rays_.first[number];
    out.next.push_back(-1);
    if (index < 0 || padding_[0] < 0) return;
    near_intervals(origin, direction, intervals);
    const float jitter = rays_.jitter[number];
    std::int32_t emitted = 0, hint = -1;
    for (const Interval& interval : intervals) {
      // One lattice point more at both ends: nothing depends on how an interval's end was rounded.
      index = std::max(index, static_cast<std::int32_t>(std::floor(interval.from / rays_.step - jitter)) - 1);
      const float last = interval.to / rays_.step - jitter + 1;
      for (std::int32_t stride = 1; static_cast<float>(index) <= last; index += stride) {
        stride = 1;
        const Vec3 point = origin + ((static_cast<float>(index) + jitter) * rays_.step) * direction;
        // A triangle farther than every reach here is not wanted, so it need not be found.
        const Hit hit = mesh_.nearest(point, interval.reach * interval.reach, hint);
        if (hit.triangle < 0) continue;
        hint = hit.triangle;
        const Placed placed = place(point, direction, hit.triangle);
        stride = std::max(1, static_cast<std::int32_t>(kCaution * placed.room / rays_.step));
        const float reach = reach_[hit.triangle];
        if (!placed.occupied || reach < 0 || hit.value > reach * reach) continue;
        if (emitted == rays_.samples_max) {
          out.next.back() = index;
          return;
        }
        out.positions.insert(out.positions.end(), {placed.position.x, placed.position.y, placed.position.z});
        out.directions.insert(out.directions.end(), {placed.direction.x, placed.direction.y, placed.direction.z});
        out.rays.push_back(static_cast<std::int32_t>(number));
        out.indices.push_back(index);
        out.triangles.push_back(hit.triangle);
        out.distances.push_back(std::sqrt(hit.value));
        ++emitted;
      }
    }
  }

 private:
  void near_intervals(Vec3 origin, Vec3 direction, std::vector<Interval>& intervals) const {
    intervals.clear();
    const Vec3 inverse{1 / direction.x, 1 / direction.y, 1 / direction.z};
    const Box& whole = mesh_.boxes()[0];
    const Vec3 way = 0.5f * (whole.low + whole.high) - origin, half = 0.5f * (whole.high - whole.low);
    const float farthest = std::sqrt(dot(way, way)) + std::sqrt(dot(half, half)) + 2 * padding_[0];
    if (!std::isfinite(farthest / rays_.step)) return;
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
    std::sort(intervals.begin(), intervals.end(),
              [](const Interval& a, const Interval& b) { return a.from < b.from; });
    std::size_t kept = 0;
    for (const Interval& interval : intervals) {
      if (kept == 0 || interval.from > intervals[kept - 1].to) {
        intervals[kept++] = interval;
        continue;
      }
      intervals[kept - 1].to = std::max(intervals[kept - 1].to, interval.to);
      intervals[kept - 1].reach = std::max(intervals[kept - 1].reach, interval.reach);
    }
    intervals.resize(kept);
  }

  // A point in canonical space.
  struct Placed {
    Vec3 position, direction;
    bool occupied = false;
    float room = 0;  // metres along the posed ray that are free
  };

  Placed place(Vec3 point, Vec3 direction, std::int32_t triangle) const {
    float m[12];
    matrix(point, triangle, m);
    Placed placed;
    const Vec3 p = placed.position = {m[0] * point.x + m[1] * point.y + m[2] * point.z + m[3],
                                      m[4] * point.x + m[5] * point.y + m[6] * point.z + m[7],
                                      m[8] * point.x + m[9] * point.y + m[10] * point.z + m[11]};
    const float scale = grid_.cells_per_metre;
    const float cells[3] = {(p.x - grid_.low.x) * scale, (p.y - grid_.low.y) * scale, (p.z - grid_.low.z) * scale};
    std::int64_t cell = 0;
    for (int i = 0; i < 3; ++i) {
      if (!(cells[i] >= 0 && cells[i] < static_cast<float>(grid_.size[i]))) return placed;
      cell = cell * grid_.size[i] + static_cast<std::int32_t>(cells[i]);
    }
    const Vec3 way{m[0] * direction.x + m[1] * direction.y + m[2] * direction.z,
                   m[4] * direction.x + m[5] * direction.y + m[6] * direction.z,
                   m[8] * direction.x + m[9] * direction.y + m[10] * direction.z};
    const float length = std::max(std::sqrt(dot(way, way)), 1e-12f);
    placed.direction = (1 / length) * way;
    placed.occupied = grid_.free[cell] == 0;
    if (grid_.free[cell] > 1) placed.room = static_cast<float>(grid_.free[cell] - 1) / (scale * std::max(length, 0.1f));
    return placed;
  }

  void matrix(Vec3 point, std::int32_t triangle, float* m) const {
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

  const Posed& mesh_;
  const Rays& rays_;
  const float* reach_;
  const Warp& warp_;
  const Grid& grid_;
  const std::vector<float> padding_;
};

template <class T>
void append(std::vector<T>& whole, const std::vector<T>& part) {
  whole.insert(whole.end(), part.begin(), part.end());
}

}  // namespace

Samples march(const Posed& mesh, const Rays& rays, const float* reach, const Warp& warp, const Grid& grid,
              int threads) {
  const Marcher marcher(mesh, rays, reach, warp, grid);
  const std::int64_t tasks = (rays.count + kRaysPerTask - 1) / kRaysPerTask;
  std::vector<Samples> parts(tasks);
  ThreadPool::instance().run(tasks, threads, [&](std::int64_t task, int) {
    std::vector<Interval> intervals;
    const std::int64_t end = std::min(rays.count, (task + 1) * kRaysPerTask);
    for (std::int64_t number = task * kRaysPerTask; number < end; ++number)
      marcher.ray(number, intervals, parts[task]);
  });
  Samples whole;
  for (const Samples& part : parts) {
    append(whole.positions, part.positions);
    append(whole.directions, part.directions);
    append(whole.distances, part.distances);
    append(whole.rays, part.rays);
    append(whole.indices, part.indices);
    append(whole.triangles, part.triangles);
    append(whole.next, part.next);
  }
  return whole;
}

}  // namespace headbench::insta

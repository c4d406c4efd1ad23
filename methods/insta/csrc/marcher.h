// A ray's way past a posed mesh: its samples near it, warped to canonical space by their nearest triangle.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

#include "mesh_search.h"

namespace headbench::insta {

struct Warp {
  const float* matrices;           // (F, 3, 4) canonical from posed
  const float* centroids;          // (F, 3) posed
  const std::int32_t* neighbours;  // (F, 3) across the edges, -1 at a border
  const float* own_falloff;        // (F,) per metre; negative: the triangle's own matrix alone
  const float* neighbour_falloff;  // (F,)
};

struct Grid {
  Vec3 low;
  float cells_per_metre;
  std::int32_t size[3];
  const std::uint8_t* free;  // cells, along the axis where it is most, to the nearest occupied one; 0: occupied
};

// A part of a ray near some triangles, and the largest reach among them.
struct Interval {
  float from, to, reach;
};

// How far a ray has come.
struct Progress {
  Vec3 origin, direction;
  float jitter;
  std::int32_t index, hint = -1;       // the lattice point to look at next, the triangle found last
  std::size_t interval = 0, last = 0;  // where it is, and the end of its intervals
  float until = 0;                     // last lattice point of the interval
};

struct Sample {
  Vec3 position, direction;  // canonical; the direction of unit length
  float away;                // metres from the surface, posed
  std::int32_t index, triangle;
};

// Finds, in order along a ray, the lattice points t = (index + jitter) step whose nearest triangle is at most its `reach`
// away and whose canonical position lies in an occupied cell. Two kinds of points are passed over: those too near to one
// whose nearest triangle is beyond every reach, which loses nothing; and those that lead on through free cells, where half
// of the way is allowed for what the warp bends a ray. Only a fold of the warp could bring one of them to an
// occupied cell after all. Both kinds are told for rays that lie together by one point between them.
class Marcher {
 public:
  Marcher(const Posed& mesh, const Warp& warp, const float* reach, const Grid& grid, float step);

  // Sets out with up to kLanes rays, each at the lattice point `index`, or done where that is negative. Appends their intervals,
  // which `march` wants again.
  void start(Progress* rays, int count, std::vector<Interval>& intervals) const;

  // Hands the next samples of up to kLanes rays to `take(ray, sample)`, each ray's in order, until that says false or there
  // are none left. Rays that lie together are marched the fastest.
  template <class Take>
  void march(Progress* rays, int count, const std::vector<Interval>& intervals, const Take& take) const {
    bool open[kLanes], found = false;
    for (int i = 0; i < count; ++i) open[i] = more(rays[i], intervals);
    for (;;) {
      std::int32_t first = std::numeric_limits<std::int32_t>::max();
      for (int i = 0; i < count; ++i)
        if (open[i]) first = std::min(first, rays[i].index);
      Together together;
      for (int i = 0; i < count; ++i)
        if (open[i] && rays[i].index - first <= kBeside) together.rays[together.count++] = i;
      if (together.count == 0) return;
      // Samples are seldom alone.
      if (found || !pass(rays, together, intervals)) {
        Queries queries;
        for (int k = 0; k < together.count; ++k) queries.add(point(rays[together.rays[k]]), rays[together.rays[k]].hint);
        mesh_.nearest(queries);
        found = false;
        Sample sample;
        for (int k = 0; k < together.count; ++k) {
          const int ray = together.rays[k];
          if (!look(rays[ray], intervals, queries.triangle[k], queries.squared[k], sample)) continue;
          found = true;
          open[ray] = take(ray, sample);
        }
      }
      for (int k = 0; k < together.count; ++k) {
        const int ray = together.rays[k];
        open[ray] = open[ray] && more(rays[ray], intervals);
      }
    }
  }

 private:
  // A point of a ray in canonical space.
  struct CanonicalPoint {
    Vec3 position, way;  // metres; the ray's direction there, not of unit length
    Vec3 cells;          // the position in cells of the grid
  };

  // Maximum distance of lattice points that are evaluated together.
  static constexpr std::int32_t kBeside = 1;

  struct Together {
    int count = 0;
    int rays[kLanes];
  };

  Vec3 point(const Progress& ray) const {
    return ray.origin + ((static_cast<float>(ray.index) + ray.jitter) * step_) * ray.direction;
  }
  bool pass(Progress* rays, const Together& together, const std::vector<Interval>& intervals) const;
  bool more(Progress& progress, const std::vector<Interval>& intervals) const;
  bool look(Progress& progress, const std::vector<Interval>& intervals, std::int32_t triangle, float squared,
            Sample& sample) const;
  void near_intervals(Vec3 origin, Vec3 direction, float spread, float farthest, std::vector<Interval>& intervals) const;
  float farthest_from(Vec3 origin) const;
  void enter(Progress& progress, const std::vector<Interval>& intervals) const;
  CanonicalPoint place(Vec3 point, Vec3 direction, std::int32_t triangle) const;
  std::int32_t passed(const CanonicalPoint& placed, float about, float most) const;
  int free_at(Vec3 cells) const;
  bool clear_around(Vec3 cells, float half) const;
  void matrix(Vec3 point, std::int32_t triangle, float* m) const;

  const Posed& mesh_;
  const Warp warp_;
  const float* reach_;
  const Grid grid_;
  const float step_;
  const std::vector<float> padding_;
};

}  // namespace headbench::insta

// A ray's way past a posed mesh: its samples near it, warped to canonical space by their nearest triangle.
#pragma once

#include <cstddef>
#include <cstdint>
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
  std::int32_t index, hint;    // the lattice point to look at next, the triangle found last
  std::size_t interval, last;  // where it is, and the end of its intervals
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
// occupied cell after all.
class Marcher {
 public:
  Marcher(const Posed& mesh, const Warp& warp, const float* reach, const Grid& grid, float step);

  // A ray at the lattice point `first`, or done where that is negative. Appends its intervals, which `next` wants again.
  Progress start(Vec3 origin, Vec3 direction, float jitter, std::int32_t first, std::vector<Interval>& intervals) const;

  // The next sample; false where there is none left.
  bool next(Progress& progress, const std::vector<Interval>& intervals, Sample& sample) const;

 private:
  // A point of a ray in canonical space.
  struct CanonicalPoint {
    Vec3 position, way;  // metres; the ray's direction there, not of unit length
    Vec3 cells;          // the position in cells of the grid
  };

  void near_intervals(Vec3 origin, Vec3 direction, std::vector<Interval>& intervals) const;
  void enter(Progress& progress, const std::vector<Interval>& intervals) const;
  CanonicalPoint place(Vec3 point, Vec3 direction, std::int32_t triangle) const;
  std::int32_t passed(const CanonicalPoint& placed, float most) const;
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

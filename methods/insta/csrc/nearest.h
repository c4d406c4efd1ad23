// The search for the nearest triangle.
#pragma once

#include <float.h>
#include <math.h>

#include "bench/native/simd.h"
#include "search.h"

namespace headbench::HEADBENCH_ISA {

using insta::kLanes;
using insta::Queries;
using insta::Search;
using insta::WideBox;
using insta::WideTriangles;

// Distances that differ by no more than rounding count as equal: squared ones, and plain ones near 0.
constexpr float kTie = 2e-6f, kTieFloor = 1e-16f, kTieFloorPlain = 1e-8f;
constexpr int kFoundMax = 128;
static_assert(kLanes % W == 0);

struct Wide3 {
  Real x[3];
};

// Squared distances to boxes; a bit for each at most `limit` away.
HEADBENCH_INLINE std::uint32_t squared_distances(const WideBox& boxes, const Wide3& p, float limit, float* out) {
  std::uint32_t close = 0;
  for (int lane = 0; lane < kLanes; lane += W) {
    Real sum = 0.0f;
    for (int i = 0; i < 3; ++i) {
      const Real below = load(boxes.low[i] + lane) - p.x[i], above = p.x[i] - load(boxes.high[i] + lane);
      const Real out_of = max(max(below, above), 0.0f);
      sum = fma(out_of, out_of, sum);
    }
    store(out + lane, sum);
    close |= bits(Real(limit) >= sum) << lane;
  }
  return close;
}

// Rows of triangles as vectors: W triangles, each to a lane, or one of them in every lane.
struct SideBySide {
  int lane;
  HEADBENCH_INLINE Real operator()(const float* row) const { return load(row + lane); }
};
struct Everywhere {
  int lane;
  HEADBENCH_INLINE Real operator()(const float* row) const { return row[lane]; }
};

// Squared distance to the triangle's plane; 0 for one without area.
template <class Get>
HEADBENCH_INLINE Real squared_plane_distance(const WideTriangles& t, const Get& get, const Wide3& p) {
  Real height = 0.0f;
  for (int i = 0; i < 3; ++i) height = fma(get(t.normal[i]), p.x[i] - get(t.a[i]), height);
  return height * height * get(t.by_area);
}

// Squared distance to the triangle: the nearest of three edges, or the plane where the foot lies inside all of them. `way`,
// unless null, is the way from the foot.
template <class Get>
HEADBENCH_INLINE Real squared_distance(const WideTriangles& t, const Get& get, const Wide3& p, Wide3* way = nullptr) {
  const Real zero = 0.0f, one = 1.0f;
  Real ap[3], ab[3], ac[3], d1 = 0.0f, d2 = 0.0f;
  for (int i = 0; i < 3; ++i) {
    ap[i] = p.x[i] - get(t.a[i]);
    ab[i] = get(t.ab[i]);
    ac[i] = get(t.ac[i]);
    d1 = fma(ab[i], ap[i], d1);
    d2 = fma(ac[i], ap[i], d2);
  }
  const Real ab2 = get(t.ab2), ac2 = get(t.ac2), abac = get(t.abac);
  const auto clamped = [&](Real value) { return min(max(value, zero), one); };
  const Real on_ab = clamped(d1 * get(t.by_ab)), on_ac = clamped(d2 * get(t.by_ac));
  // (p - b) . (c - b) = (ap - ab) . (ac - ab)
  const Real on_bc = clamped((d2 - d1 - abac + ab2) * get(t.by_bc));
  Real to_ab = 0.0f, to_ac = 0.0f, to_bc = 0.0f, way_ab[3], way_ac[3], way_bc[3];
  for (int i = 0; i < 3; ++i) {
    way_ab[i] = fnma(on_ab, ab[i], ap[i]);
    way_ac[i] = fnma(on_ac, ac[i], ap[i]);
    way_bc[i] = fnma(on_bc, ac[i] - ab[i], ap[i] - ab[i]);
    to_ab = fma(way_ab[i], way_ab[i], to_ab);
    to_ac = fma(way_ac[i], way_ac[i], to_ac);
    to_bc = fma(way_bc[i], way_bc[i], to_bc);
  }
  // Barycentric coordinates of the foot times the determinant (Ericson, "Real-Time Collision Detection", 3.4).
  const Real v = fnma(abac, d2, ac2 * d1), w = fnma(abac, d1, ab2 * d2), whole = fnma(abac, abac, ab2 * ac2);
  const Real edges = min(min(to_ab, to_ac), to_bc);
  Real height = 0.0f;
  for (int i = 0; i < 3; ++i) height = fma(get(t.normal[i]), ap[i], height);
  const Real plane = height * height * get(t.by_area);
  const Mask inside = (v >= zero) & (w >= zero) & (whole >= v + w) & (get(t.by_area) > zero) & (edges > plane);
  if (way) {
    for (int i = 0; i < 3; ++i) {
      const Real edge = select(to_bc > min(to_ab, to_ac), select(to_ac > to_ab, way_ab[i], way_ac[i]), way_bc[i]);
      way->x[i] = select(inside, height * get(t.by_area) * get(t.normal[i]), edge);
    }
  }
  return select(inside, plane, edges);
}

// The triangles near a centre: those nearest to it, or those that may be nearest to a point about it.
class Nearby {
 public:
  struct Found {
    const WideTriangles* leaf;
    int lane;
    float squared;  // distance of the centre
  };
  Found found[kFoundMax];
  int count = 0;

  Nearby(const Search& search, const Wide3& centre) : search_(search), centre_(centre) {}

  // Finds the triangles nearest to the centre, kFoundMax of them at most.
  void nearest(std::int32_t hint) {
    const std::int32_t tried = hint < 0 ? -1 : search_.leaf_of[hint];
    if (tried >= 0) add_nearest(tried);
    struct Waiting {
      std::int32_t child;
      float distance;
    } stack[kLanes * insta::kDepthMax];
    int top = 0;
    stack[top++] = {0, 0};
    while (top > 0) {
      const Waiting next = stack[--top];
      if (!(next.distance <= limit_)) continue;
      if (next.child < 0) {
        if (~next.child != tried) add_nearest(~next.child);
        continue;
      }
      alignas(64) float squared[kLanes];
      const insta::WideNode& node = search_.nodes[next.child];
      // The nearest on top.
      const int floor = top;
      for (std::uint32_t close = squared_distances(search_.boxes[next.child], centre_, limit_, squared); close;
           close &= close - 1) {
        const int lane = lowest_bit(close);
        if (node.node[lane] < 0) continue;
        int place = top++;
        for (; place > floor && stack[place - 1].distance < squared[lane]; --place) stack[place] = stack[place - 1];
        stack[place] = {node.child[lane], squared[lane]};
      }
    }
    drop_farther();
  }

  // Finds those that may be nearest to points within `spread` metres of the centre, given a triangle that should be near it;
  // false where there are more than kFoundMax.
  //
  // Let d be the distance of the centre c from a triangle, n the unit way from its foot; d' and n' those of the one given. A
  // point c + e is d + n e or more from the one, distances being convex, and from the other's foot, and so from the other,
  // no more than d' + n' e + e^2 / 2 d', nor than d' + |e|. So the one is nowhere nearest where
  // d - d' > min(2 |e|, |n - n'| |e| + e^2 / 2 d'). The same holds for boxes.
  bool about(float spread, std::int32_t given) {
    const WideTriangles& leaf = search_.leaves[search_.leaf_of[given]];
    int place = 0;
    while (leaf.index[place] != given) ++place;
    Wide3 way;
    alignas(64) float squared[W];
    store(squared, squared_distance(leaf, Everywhere{place}, centre_, &way));
    const float least = sqrtf(squared[0]), tiny = 1e-12f, by_least = 1 / (least > tiny ? least : tiny);
    for (int i = 0; i < 3; ++i) towards_.x[i] = way.x[i] * by_least;
    spread_ = spread * 1.001f;
    bent_ = 0.5f * spread_ * spread_ * by_least;
    reach_ = least * (1 + kTie) + kTieFloorPlain;
    count = 0;
    std::int32_t stack[kLanes * insta::kDepthMax];
    int top = 0;
    stack[top++] = 0;
    while (top > 0) {
      const std::int32_t next = stack[--top];
      if (next < 0) {
        if (!add_near(search_.leaves[~next])) return false;
        continue;
      }
      const insta::WideNode& node = search_.nodes[next];
      for (std::uint32_t close = near(search_.boxes[next]); close; close &= close - 1) {
        const int lane = lowest_bit(close);
        if (node.node[lane] >= 0) stack[top++] = node.child[lane];
      }
    }
    return true;
  }

 private:
  void add_nearest(std::int32_t number) {
    const WideTriangles& leaf = search_.leaves[number];
    alignas(64) float squared[kLanes];
    std::uint32_t close = 0;
    for (int lane = 0; lane < kLanes; lane += W) {
      const Real to = squared_distance(leaf, SideBySide{lane}, centre_);
      store(squared + lane, to);
      close |= bits(Real(limit_) >= to) << lane;
    }
    for (; close; close &= close - 1) {
      const int lane = lowest_bit(close);
      if (leaf.index[lane] < 0 || !(squared[lane] <= limit_)) continue;
      if (squared[lane] < best_) {
        best_ = squared[lane];
        const float reach = sqrtf(best_) * (1 + kTie) + kTieFloorPlain;
        limit_ = reach * reach;
      }
      if (count == kFoundMax) drop_farther();
      if (count < kFoundMax) found[count++] = {&leaf, lane, squared[lane]};
    }
  }

  void drop_farther() {
    int kept = 0;
    for (int i = 0; i < count; ++i)
      if (found[i].squared <= limit_) found[kept++] = found[i];
    count = kept;
  }

  // Of what has these squared distances, which may be nearest to a point; `along` is the way to the centre along the nearest's.
  HEADBENCH_INLINE std::uint32_t near(Real squared, Real along) const {
    const Real distance = sqrt(squared), cosine = along / max(distance, 1e-20f);
    const Real turned = sqrt(max(Real(2.0f) - Real(2.0f) * cosine, 0.0f));
    const Real more = min(Real(2 * spread_), fma(spread_, turned, bent_));
    return bits(Real(reach_) + more >= distance);
  }

  std::uint32_t near(const WideBox& boxes) const {
    std::uint32_t close = 0;
    for (int lane = 0; lane < kLanes; lane += W) {
      Real squared = 0.0f, along = 0.0f;
      for (int i = 0; i < 3; ++i) {
        const Real below = max(load(boxes.low[i] + lane) - centre_.x[i], 0.0f);
        const Real above = max(centre_.x[i] - load(boxes.high[i] + lane), 0.0f);
        const Real way = above - below;
        squared = fma(way, way, squared);
        along = fma(way, towards_.x[i], along);
      }
      close |= near(squared, along) << lane;
    }
    return close;
  }

  bool add_near(const WideTriangles& leaf) {
    std::uint32_t close = 0;
    for (int lane = 0; lane < kLanes; lane += W) {
      Wide3 way;
      const Real squared = squared_distance(leaf, SideBySide{lane}, centre_, &way);
      Real along = 0.0f;
      for (int i = 0; i < 3; ++i) along = fma(way.x[i], towards_.x[i], along);
      close |= near(squared, along) << lane;
    }
    for (; close; close &= close - 1) {
      const int lane = lowest_bit(close);
      if (leaf.index[lane] < 0) continue;
      if (count == kFoundMax) return false;
      found[count++] = {&leaf, lane, 0};
    }
    return true;
  }

  const Search& search_;
  const Wide3 centre_;
  float best_ = HUGE_VALF, limit_ = FLT_MAX;
  // Of `widen`:
  Wide3 towards_;
  float spread_, bent_, reach_;
};

// For queries from `first` to `last`, the nearest of the triangles found.
inline void choose(const Nearby& nearby, Queries& queries, int first, int last) {
  alignas(64) float squared[kFoundMax][W], slots[W], values[W];
  for (int begin = first / W * W; begin < last; begin += W) {
    const Wide3 p{{load(queries.point[0] + begin), load(queries.point[1] + begin), load(queries.point[2] + begin)}};
    Real least = HUGE_VALF;
    for (int i = 0; i < nearby.count; ++i) {
      const Real to = squared_distance(*nearby.found[i].leaf, Everywhere{nearby.found[i].lane}, p);
      store(squared[i], to);
      least = min(to, least);
    }
    const Real bound = least * Real(1 + kTie) + Real(kTieFloor);
    Real farthest = -1.0f, slot = -1.0f, order = 0.0f;
    for (int i = 0; i < nearby.count; ++i) {
      const Mask tied = bound >= load(squared[i]);
      if (!any(tied)) continue;
      const auto [leaf, lane, unused] = nearby.found[i];
      const Real plane = squared_plane_distance(*leaf, Everywhere{lane}, p), index = static_cast<float>(leaf->index[lane]);
      const auto take = [&](Mask better) {
        slot = select(better, static_cast<float>(i), slot);
        order = select(better, index, order);
        farthest = select(better, plane, farthest);
      };
      take(tied & (plane >= farthest) & (order > index));
      take(tied & (plane > farthest));
    }
    store(slots, slot);
    store(values, least);
    for (int lane = begin < first ? first : begin; lane < last && lane < begin + W; ++lane) {
      const int chosen = static_cast<int>(slots[lane - begin]);
      queries.triangle[lane] = chosen < 0 ? -1 : nearby.found[chosen].leaf->index[nearby.found[chosen].lane];
      queries.squared[lane] = values[lane - begin];
    }
  }
}

// Queries from `first` to `last`, together or in halves.
inline void nearest(const Search& search, Queries& queries, int first, int last) {
  Wide3 centre;
  float spread = 0;
  for (int i = 0; i < 3; ++i) {
    float low = queries.point[i][first], high = low;
    for (int lane = first + 1; lane < last; ++lane) {
      const float at = queries.point[i][lane];
      low = at < low ? at : low;
      high = at > high ? at : high;
    }
    const float middle = 0.5f * (low + high), half = high - middle > middle - low ? high - middle : middle - low;
    centre.x[i] = middle;
    spread += half * half;
  }
  spread = sqrtf(spread);
  const bool alone = last - first == 1;
  if (alone || spread <= search.together) {
    Nearby nearby(search, centre);
    std::int32_t near = queries.hint[first];
    if (alone || near < 0) {
      nearby.nearest(near);
      near = nearby.count > 0 ? nearby.found[0].leaf->index[nearby.found[0].lane] : -1;
    }
    if (alone || near < 0 || nearby.about(spread, near)) return choose(nearby, queries, first, last);
  }
  nearest(search, queries, first, (first + last) / 2);
  nearest(search, queries, (first + last) / 2, last);
}

inline void nearest(const Search& search, Queries& queries) {
  if (queries.count > 0) nearest(search, queries, 0, queries.count);
}

}  // namespace headbench::HEADBENCH_ISA

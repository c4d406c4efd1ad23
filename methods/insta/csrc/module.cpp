// INSTA's kernel as a Python module. Arrays are typed and contiguous.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <vector>

#include "../../splats/csrc/thread_pool.h"
#include "hash_grid.h"
#include "march.h"
#include "mesh_search.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench::insta {
namespace {

template <class T, nb::ssize_t... Shape>
using Array = nb::ndarray<T, nb::shape<Shape...>, nb::c_contig, nb::device::cpu>;

constexpr std::int64_t kPointsPerTask = 256;

void require(bool fits) {
  if (!fits) throw std::invalid_argument("arrays do not fit together");
}

// Hands a vector's memory to numpy.
template <class T>
nb::ndarray<nb::numpy, T> given(std::vector<T>&& values, std::size_t columns) {
  auto* owned = new std::vector<T>(std::move(values));
  nb::capsule owner(owned, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  const std::size_t rows = owned->size() / columns;
  if (columns == 1) return nb::ndarray<nb::numpy, T>(owned->data(), {rows}, owner);
  return nb::ndarray<nb::numpy, T>(owned->data(), {rows, columns}, owner);
}

std::shared_ptr<Tree> make_tree(const Array<const std::int32_t, -1, 3>& faces, const Array<const float, -1, 3>& vertices) {
  return std::make_shared<Tree>(faces.data(), faces.shape(0), vertices.data(), vertices.shape(0));
}

std::shared_ptr<Posed> make_posed(std::shared_ptr<Tree> tree, const Array<const float, -1, 3>& vertices) {
  require(static_cast<std::int64_t>(vertices.shape(0)) == tree->vertex_count());
  return std::make_shared<Posed>(std::move(tree), vertices.data());
}

Vec3 row(const float* values, std::int64_t number) {
  return {values[3 * number], values[3 * number + 1], values[3 * number + 2]};
}

template <class Query>
void each(std::int64_t count, int threads, Query query) {
  ThreadPool::instance().run((count + kPointsPerTask - 1) / kPointsPerTask, threads, [&](std::int64_t task, int) {
    const std::int64_t end = std::min(count, (task + 1) * kPointsPerTask);
    for (std::int64_t i = task * kPointsPerTask; i < end; ++i) query(i);
  });
}

void nearest(const Posed& mesh, const Array<const float, -1, 3>& points, const Array<std::int32_t, -1>& triangles,
             const Array<float, -1>& squared, int threads) {
  const auto count = static_cast<std::int64_t>(points.shape(0));
  require(triangles.shape(0) == points.shape(0) && squared.shape(0) == points.shape(0) && threads >= 1);
  nb::gil_scoped_release unlocked;
  each(count, threads, [&](std::int64_t i) {
    const Hit hit = mesh.nearest(row(points.data(), i), std::numeric_limits<float>::infinity(), -1);
    triangles.data()[i] = hit.triangle;
    squared.data()[i] = hit.value;
  });
}

void first_hit(const Posed& mesh, const Array<const float, -1, 3>& origins, const Array<const float, -1, 3>& directions,
               const Array<std::int32_t, -1>& triangles, const Array<float, -1>& distances, int threads) {
  const auto count = static_cast<std::int64_t>(origins.shape(0));
  require(directions.shape(0) == origins.shape(0) && triangles.shape(0) == origins.shape(0) &&
          distances.shape(0) == origins.shape(0) && threads >= 1);
  nb::gil_scoped_release unlocked;
  each(count, threads, [&](std::int64_t i) {
    const Hit hit = mesh.first_hit(row(origins.data(), i), row(directions.data(), i));
    triangles.data()[i] = hit.triangle;
    distances.data()[i] = hit.value;
  });
}

nb::tuple march_rays(const Posed& mesh, const Array<const float, -1, 3>& origins,
                     const Array<const float, -1, 3>& directions, const Array<const std::int32_t, -1>& first,
                     const Array<const float, -1>& jitter, float step, int samples_max,
                     const Array<const float, -1>& reach, const Array<const float, -1, 3, 4>& matrices,
                     const Array<const float, -1, 3>& centroids, const Array<const std::int32_t, -1, 3>& neighbours,
                     const Array<const float, -1>& own_falloff, const Array<const float, -1>& neighbour_falloff,
                     const Array<const float, 3>& low, float cells_per_metre,
                     const Array<const std::uint8_t, -1, -1, -1>& free, int threads) {
  const auto faces = static_cast<std::size_t>(mesh.tree().face_count());
  require(directions.shape(0) == origins.shape(0) && first.shape(0) == origins.shape(0) &&
          jitter.shape(0) == origins.shape(0) && step > 0 && samples_max >= 1 && reach.shape(0) == faces &&
          matrices.shape(0) == faces && centroids.shape(0) == faces && neighbours.shape(0) == faces &&
          own_falloff.shape(0) == faces && neighbour_falloff.shape(0) == faces && threads >= 1);
  for (std::size_t i = 0; i < 3 * faces; ++i)
    require(neighbours.data()[i] < static_cast<std::int64_t>(faces));
  const Warp warp{matrices.data(), centroids.data(), neighbours.data(), own_falloff.data(), neighbour_falloff.data()};
  const Grid grid{row(low.data(), 0), cells_per_metre,
                  {static_cast<std::int32_t>(free.shape(0)), static_cast<std::int32_t>(free.shape(1)),
                   static_cast<std::int32_t>(free.shape(2))},
                  free.data()};
  const Rays rays{static_cast<std::int64_t>(origins.shape(0)), origins.data(), directions.data(), first.data(),
                  jitter.data(), step, samples_max};
  Samples samples;
  {
    nb::gil_scoped_release unlocked;
    samples = march(mesh, rays, reach.data(), warp, grid, threads);
  }
  return nb::make_tuple(given(std::move(samples.positions), 3), given(std::move(samples.directions), 3),
                        given(std::move(samples.distances), 1),
                        given(std::move(samples.rays), 1), given(std::move(samples.indices), 1),
                        given(std::move(samples.triangles), 1), given(std::move(samples.next), 1));
}

using LevelTuple = std::tuple<float, std::int32_t, std::int64_t, std::int64_t>;

std::vector<Level> levels_of(const std::vector<LevelTuple>& given, std::size_t rows) {
  std::vector<Level> levels;
  for (const auto& [scale, resolution, first, count] : given) {
    const bool hashed = static_cast<double>(resolution) * resolution * resolution > static_cast<double>(count);
    require(resolution >= 1 && first >= 0 && count >= 1 && first + count <= static_cast<std::int64_t>(rows) &&
            (!hashed || (count & (count - 1)) == 0));
    levels.push_back({scale, resolution, first, count});
  }
  return levels;
}

void encode_points(const Array<const float, -1, 3>& positions, const Array<const float, -1, -1>& table,
                   const std::vector<LevelTuple>& levels, const Array<float, -1, -1>& out, int threads) {
  const auto parsed = levels_of(levels, table.shape(0));
  require(out.shape(0) == positions.shape(0) && out.shape(1) == parsed.size() * table.shape(1) && threads >= 1);
  nb::gil_scoped_release unlocked;
  encode(positions.data(), positions.shape(0), table.data(), parsed, static_cast<int>(table.shape(1)), out.data(),
         threads);
}

void encode_points_backward(const Array<const float, -1, 3>& positions, const Array<const float, -1, -1>& gradient,
                            const std::vector<LevelTuple>& levels, const Array<float, -1, -1>& table_gradient,
                            int threads) {
  const auto parsed = levels_of(levels, table_gradient.shape(0));
  require(gradient.shape(0) == positions.shape(0) &&
          gradient.shape(1) == parsed.size() * table_gradient.shape(1) && threads >= 1);
  nb::gil_scoped_release unlocked;
  encode_backward(positions.data(), positions.shape(0), gradient.data(), parsed,
                  static_cast<int>(table_gradient.shape(1)), table_gradient.data(), threads);
}

}  // namespace
}  // namespace headbench::insta

NB_MODULE(_kernel, m) {
  using namespace headbench::insta;
  // A mesh that is alive when the interpreter ends keeps its tree; that is no leak.
  nb::set_leak_warnings(false);
  m.doc() = "Nearest triangles, ray marching and hash encoding";
  nb::class_<Tree>(m, "Tree", "Boxes around the triangles of a mesh.");
  nb::class_<Posed>(m, "Posed", "A tree fitted to one pose.");
  m.def("tree", &make_tree, "faces"_a, "vertices"_a);
  m.def("posed", &make_posed, "tree"_a, "vertices"_a);
  m.def("nearest", &nearest, "mesh"_a, "points"_a, "triangles"_a, "squared"_a, "threads"_a,
        "Write the nearest triangle of each point and its squared distance.");
  m.def("first_hit", &first_hit, "mesh"_a, "origins"_a, "directions"_a, "triangles"_a, "distances"_a, "threads"_a,
        "Write the first triangle each ray hits, or -1, and its distance.");
  m.def("march", &march_rays, "mesh"_a, "origins"_a, "directions"_a, "first"_a, "jitter"_a, "step"_a, "samples_max"_a,
        "reach"_a, "matrices"_a, "centroids"_a, "neighbours"_a, "own_falloff"_a, "neighbour_falloff"_a, "low"_a,
        "cells_per_metre"_a, "free"_a, "threads"_a,
        "Canonical positions and directions, distances from the surface, rays, lattice indices and triangles of samples; where each ray goes on.");
  m.def("encode", &encode_points, "positions"_a, "table"_a, "levels"_a, "out"_a, "threads"_a);
  m.def("encode_backward", &encode_points_backward, "positions"_a, "gradient"_a, "levels"_a, "table_gradient"_a,
        "threads"_a);
}

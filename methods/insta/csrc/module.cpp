// INSTA's kernel as a Python module. Arrays are typed and contiguous.
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <memory>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "bench/native/arguments.h"
#include "bench/native/parallel.h"
#include "hash_grid.h"
#include "mesh_search.h"
#include "rays.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench::insta {
namespace {

constexpr std::int64_t kPointsPerTask = 256;

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

// The kernels of an instruction set; of no name, the fastest.
const Kernels& kernels_of(const std::string& name) {
  static const std::vector<const Kernels*> runnable = runnable_kernels();
  return name.empty() ? *runnable.front() : variant_of(runnable, name);
}

std::shared_ptr<Posed> make_posed(std::shared_ptr<Tree> tree, const Array<const float, -1, 3>& vertices,
                                  const std::string& isa) {
  require(static_cast<std::int64_t>(vertices.shape(0)) == tree->vertex_count());
  return std::make_shared<Posed>(std::move(tree), vertices.data(), kernels_of(isa).nearest);
}

void nearest(const Posed& mesh, const Array<const float, -1, 3>& points, const Array<std::int32_t, -1>& triangles,
             const Array<float, -1>& squared, int threads) {
  const auto count = static_cast<std::int64_t>(points.shape(0));
  require(triangles.shape(0) == points.shape(0) && squared.shape(0) == points.shape(0) && threads >= 1);
  nb::gil_scoped_release unlocked;
  parallel_for(count, kPointsPerTask, threads, [&](std::int64_t begin, std::int64_t end) {
    for (; begin < end; begin += kLanes) {
      Queries queries;
      for (std::int64_t i = begin; i < std::min(end, begin + kLanes); ++i) queries.add(row(points.data(), i), -1);
      mesh.nearest(queries);
      std::copy_n(queries.triangle, queries.count, triangles.data() + begin);
      std::copy_n(queries.squared, queries.count, squared.data() + begin);
    }
  });
}

void first_hit(const Posed& mesh, const Array<const float, -1, 3>& origins, const Array<const float, -1, 3>& directions,
               const Array<std::int32_t, -1>& triangles, const Array<float, -1>& distances, int threads) {
  const auto count = static_cast<std::int64_t>(origins.shape(0));
  require(directions.shape(0) == origins.shape(0) && triangles.shape(0) == origins.shape(0) &&
          distances.shape(0) == origins.shape(0) && threads >= 1);
  nb::gil_scoped_release unlocked;
  parallel_for(count, kPointsPerTask, threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const Hit hit = mesh.first_hit(row(origins.data(), i), row(directions.data(), i));
      triangles.data()[i] = hit.triangle;
      distances.data()[i] = hit.value;
    }
  });
}

// Where rays through one pose may meet density. Keeps the arrays it was made of.
class Guide {
 public:
  Guide(std::shared_ptr<Posed> mesh, nb::tuple arguments) : mesh_(std::move(mesh)), arguments_(std::move(arguments)) {
    Arguments from(arguments_);
    const std::int64_t faces = face_count();
    Size x, y, z;
    reach_ = from(faces);
    warp_ = {from(faces, 3, 4), from(faces, 3), from(faces, 3), from(faces), from(faces)};
    const float* low = from(3);
    grid_ = {row(low, 0), from.number<float>(), {}, from(x, y, z)};
    for (int axis = 0; axis < 3; ++axis) grid_.size[axis] = static_cast<std::int32_t>(axis == 0 ? x : axis == 1 ? y : z);
    for (std::int64_t i = 0; i < 3 * faces; ++i) require(warp_.neighbours[i] < faces);
  }

  std::int64_t face_count() const { return mesh_->tree().face_count(); }

  Marcher marcher(float step) const {
    require(step > 0);
    return Marcher(*mesh_, warp_, reach_, grid_, step);
  }

 private:
  std::shared_ptr<Posed> mesh_;
  nb::tuple arguments_;
  const float* reach_;
  Warp warp_;
  Grid grid_;
};

Rays read_rays(const nb::tuple& arrays) {
  Arguments from(arrays);
  Size count;
  Rays rays{0, from(count, 3), from(count, 3), from(count)};
  rays.count = count;
  return rays;
}

nb::tuple march_rays(const Guide& guide, const nb::tuple& arrays, const Array<const std::int32_t, -1>& first, float step,
                     int samples_max, int threads) {
  const Rays rays = read_rays(arrays);
  require(static_cast<std::int64_t>(first.shape(0)) == rays.count && samples_max >= 1 && threads >= 1);
  const Marcher marcher = guide.marcher(step);
  Samples samples;
  {
    nb::gil_scoped_release unlocked;
    samples = march(marcher, rays, first.data(), samples_max, threads);
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
    require(resolution >= 2 && scale > 0 && scale <= static_cast<float>(resolution) - 0.999f && first >= 0 && count >= 1 && first + count <= static_cast<std::int64_t>(rows) &&
            (!hashed || (count & (count - 1)) == 0));
    levels.push_back({scale, resolution, first, count});
  }
  return levels;
}

void encode_points(const Array<const float, -1, 3>& positions, const Array<const float, -1, -1>& table,
                   const std::vector<LevelTuple>& levels, const Array<float, -1, -1>& out, int threads,
                   const std::string& isa) {
  const auto parsed = levels_of(levels, table.shape(0));
  const std::size_t features = table.shape(1);
  require((features == 1 || features == 2 || features == 4 || features == 8) && out.shape(0) == positions.shape(0) &&
          out.shape(1) == parsed.size() * features && threads >= 1);
  const Kernels& kernels = kernels_of(isa);
  nb::gil_scoped_release unlocked;
  encode(kernels, positions.data(), positions.shape(0), table.data(), parsed, static_cast<int>(table.shape(1)),
         out.data(), threads);
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

using Weights = std::vector<Array<const float, -1, -1>>;

// The field's parameters. Keeps the arrays it was made of.
class Trained {
 public:
  Trained(const std::vector<LevelTuple>& levels, Array<const float, -1, -1> table, const Array<const float, 3>& low,
          float side, float bias, float depth, float scale, Weights density, Weights color)
      : levels_(levels_of(levels, table.shape(0))), table_(std::move(table)), density_(std::move(density)),
        color_(std::move(color)), density_layers_(layers(density_)), color_layers_(layers(color_)) {
    const int features = static_cast<int>(table_.shape(1)), encoded = features * static_cast<int>(levels_.size());
    require((features == 1 || features == 2 || features == 4 || features == 8) && side > 0 && scale > 0);
    require(density_layers_[0].inputs >= encoded && color_layers_.back().outputs == 3 &&
            color_layers_[0].inputs == density_layers_.back().outputs + kDirections);
    field_ = {static_cast<int>(levels_.size()), levels_.data(), features, table_.data(),
              {low.data()[0], low.data()[1], low.data()[2]}, side, bias, depth, scale,
              {static_cast<int>(density_layers_.size()), density_layers_.data()},
              {static_cast<int>(color_layers_.size()), color_layers_.data()}};
  }
  Trained(const Trained&) = delete;

  const Field& field() const { return field_; }

 private:
  static std::vector<Layer> layers(const Weights& weights) {
    std::vector<Layer> found;
    for (const auto& each : weights) {
      found.push_back({static_cast<int>(each.shape(1)), static_cast<int>(each.shape(0)), each.data()});
      require(found.back().outputs >= 1 && (found.size() == 1 || found[found.size() - 2].outputs == found.back().inputs));
    }
    require(!found.empty());
    return found;
  }

  std::vector<Level> levels_;
  Array<const float, -1, -1> table_;
  Weights density_, color_;
  std::vector<Layer> density_layers_, color_layers_;
  Field field_;
};

// `conditions` are those of `Kernels::evaluate` and where the second counts, `marching` and `seen` as in Python.
std::int64_t render_rays(const Guide& guide, const Trained& trained, const nb::tuple& conditions, const nb::tuple& arrays,
                         const nb::tuple& marching, const nb::tuple& seen, const std::string& isa, int threads) {
  const Rays rays = read_rays(arrays);
  Arguments given(conditions), how(marching), to(seen);
  const float* starts = given(2, trained.field().density.layers[0].outputs);
  const std::uint8_t* mouth = given(guide.face_count());
  const float step = how.number<float>();
  const Rounds rounds{how.number<std::int32_t>(), how.number<float>()};
  const Seen out{to(rays.count, 3), to(rays.count)};
  require(rounds.samples >= 1 && threads >= 1);
  const Kernels& kernels = kernels_of(isa);
  const Marcher marcher = guide.marcher(step);
  nb::gil_scoped_release unlocked;
  return render(marcher, kernels, trained.field(), starts, mouth, step, rays, rounds, out, threads);
}

}  // namespace
}  // namespace headbench::insta

NB_MODULE(_kernel, m) {
  using namespace headbench;
  using namespace headbench::insta;
  // A mesh that is alive when the interpreter ends keeps its tree; that is no leak.
  nb::set_leak_warnings(false);
  m.doc() = "Nearest triangles, ray marching and hash encoding";
  nb::class_<Tree>(m, "Tree", "Boxes around the triangles of a mesh.");
  nb::class_<Posed>(m, "Posed", "A tree fitted to one pose.");
  m.def("tree", &make_tree, "faces"_a, "vertices"_a);
  m.def("posed", &make_posed, "tree"_a, "vertices"_a, "isa"_a = "");
  m.def("nearest", &nearest, "mesh"_a, "points"_a, "triangles"_a, "squared"_a, "threads"_a,
        "Write the nearest triangle of each point and its squared distance.");
  m.def("first_hit", &first_hit, "mesh"_a, "origins"_a, "directions"_a, "triangles"_a, "distances"_a, "threads"_a,
        "Write the first triangle each ray hits, or -1, and its distance.");
  nb::class_<Guide>(m, "Guide", "Where rays through one pose may meet density.")
      .def(nb::init<std::shared_ptr<Posed>, nb::tuple>(), "mesh"_a, "arguments"_a);
  m.def("march", &march_rays, "guide"_a, "rays"_a, "first"_a, "step"_a, "samples_max"_a, "threads"_a,
        "Canonical positions and directions, distances from the surface, rays, lattice indices and triangles of samples; where each ray goes on.");
  nb::class_<Trained>(m, "Trained", "The field's parameters.")
      .def(nb::init<const std::vector<LevelTuple>&, Array<const float, -1, -1>, const Array<const float, 3>&, float,
                    float, float, float, Weights, Weights>(),
           "levels"_a, "table"_a, "low"_a, "side"_a, "bias"_a, "depth"_a, "scale"_a, "density"_a, "color"_a);
  m.def("instruction_sets", [] { return names_of(runnable_kernels()); },
        "Variants this machine can run, the fastest first.");
  m.def("render", &render_rays, "guide"_a, "trained"_a, "conditions"_a, "rays"_a, "marching"_a, "seen"_a, "isa"_a,
        "threads"_a,
        "Write what rays see and what they leave; return the number of samples.");
  m.def("encode", &encode_points, "positions"_a, "table"_a, "levels"_a, "out"_a, "threads"_a, "isa"_a = "");
  m.def("encode_backward", &encode_points_backward, "positions"_a, "gradient"_a, "levels"_a, "table_gradient"_a,
        "threads"_a);
}

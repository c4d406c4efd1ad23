// The light of area panels on meshes, as a Python module. Arrays are typed and contiguous.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <memory>
#include <string>
#include <vector>

#include "bench/native/module.h"
#include "bench/native/parallel.h"
#include "bench/native/workspace.h"
#include "tree.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench::light {
namespace {

constexpr std::int64_t kSidesPerTask = 64;
constexpr double kRoom = 0.01;          // cells
constexpr std::int64_t kStripRows = 4;  // of pixels, that a thread draws at a time
constexpr std::int64_t kBand = 32;  // rows of pixels between one search for what is seen and the next

using Floats = std::vector<float>;
template <class T, class A>
std::vector<T> kept(const A& array) {
  return std::vector<T>(array.data(), array.data() + array.size());
}

// Numbers of sides in ascending order, gathered from several threads.
class Sides {
 public:
  explicit Sides(std::int64_t count) : words_((count + 63) / 64) {}
  void add(std::int64_t side) {
    std::atomic<std::uint64_t>& word = words_[side >> 6];
    const std::uint64_t bit = std::uint64_t{1} << (side & 63);
    if (!(word.load(std::memory_order_relaxed) & bit)) word.fetch_or(bit, std::memory_order_relaxed);
  }
  // Hand them out, of those in a lower state than `wanted`, and forget them all.
  std::vector<std::int64_t> take(const std::vector<std::uint8_t>& states, State wanted) {
    std::vector<std::int64_t> found;
    for (std::size_t i = 0; i < words_.size(); ++i) {
      for (std::uint64_t word = words_[i].exchange(0); word; word &= word - 1) {
        const std::int64_t side = static_cast<std::int64_t>(64 * i) + __builtin_ctzll(word);
        if (states[side] < wanted) found.push_back(side);
      }
    }
    return found;
  }

 private:
  std::vector<std::atomic<std::uint64_t>> words_;
};

// Triangles of vertices below `count`.
std::vector<std::int32_t> checked(const Array<const std::int32_t, -1, 3>& faces, std::size_t count) {
  require(below(faces.data(), faces.size(), count));
  return kept<std::int32_t>(faces);
}

class World {
 public:
  World(const Array<const float, -1, 3>& vertices, const Array<const std::int32_t, -1, 3>& faces,
        const Array<const std::uint8_t, -1>& material_of, const Array<const float, -1, 2>& materials,
        const Array<const float, kPanels, 5, 3>& panels, const Array<const float, 3>& surroundings,
        const Array<const float, -1, -1, 3>& hemisphere, std::uint32_t seed, const std::string& isa)
      : kernels_(variant_of(runnable_light_kernels(), isa)),
        vertices_(kept<float>(vertices)),
        faces_(checked(faces, vertices.shape(0))),
        material_of_(kept<std::uint8_t>(material_of)),
        hemisphere_(kept<float>(hemisphere)),
        count_(static_cast<std::int64_t>(vertices.shape(0))),
        tree_(vertices_.data(), faces_.data(), static_cast<std::int64_t>(faces.shape(0))),
        normals_(vertices_.size()),
        albedo_(vertices_.size(), 0.5f),
        gloss_(count_, 1.0f),
        reached_(2 * count_),
        states_(2 * count_),
        wanted_(2 * count_),
        mirrored_(2 * count_) {
    require(material_of.shape(0) == faces.shape(0));
    for (const std::uint8_t index : material_of_) require(index < materials.shape(0));
    for (std::size_t i = 0; i < materials.shape(0); ++i)
      materials_.push_back({materials.data()[2 * i], materials.data()[2 * i + 1]});
    for (int p = 0; p < kPanels; ++p) place(p, panels.data() + 15 * p);
    std::copy_n(surroundings.data(), 3, scene_.surroundings);
    scene_.patterns = static_cast<std::int32_t>(hemisphere.shape(0));
    scene_.rays = static_cast<std::int32_t>(hemisphere.shape(1));
    scene_.seed = seed;
    move(vertices);
  }
  World(const World&) = delete;

  void move(const Array<const float, -1, 3>& vertices) {
    require(static_cast<std::int64_t>(vertices.shape(0)) == count_);
    std::copy_n(vertices.data(), 3 * count_, vertices_.data());
    tree_.fit(vertices_.data(), faces_.data());
    find_normals();
    darken();
  }

  void paint(const Array<const float, -1, 3>& albedo, const Array<const float, -1>& gloss) {
    require(static_cast<std::int64_t>(albedo.shape(0)) == count_ && static_cast<std::int64_t>(gloss.shape(0)) == count_);
    std::copy_n(albedo.data(), 3 * count_, albedo_.data());
    std::copy_n(gloss.data(), count_, gloss_.data());
    darken();
  }

  // (n, 14) of sides 2 vertex + back: light of the panels, all light, visible shares of the panels.
  void light(const Array<const std::int64_t, -1>& sides, const Array<float, -1, 14>& out, int threads) {
    require(sides.shape(0) == out.shape(0));
    for (std::size_t i = 0; i < sides.shape(0); ++i) {
      require(sides.data()[i] >= 0 && sides.data()[i] < 2 * count_);
      wanted_.add(sides.data()[i]);
    }
    const nb::gil_scoped_release release;
    gather(threads);
    for (std::size_t i = 0; i < sides.shape(0); ++i) {
      const Reached& reached = reached_[sides.data()[i]];
      float* row = out.data() + 14 * i;
      std::copy_n(reached.direct, 3, row);
      std::copy_n(reached.all, 3, row + 3);
      std::copy_n(reached.visible, kPanels, row + 6);
    }
  }

  // `image` (height, width, 4): linear light times coverage, and coverage. Pixel (0, 0) begins at (left, top). `matrix` are
  // the camera's place and the directions that pixel positions (x, y, 1) are multiplied by; `taps` weigh `grid` samples a
  // pixel over an odd number of pixels.
  void render(const Array<const double, 4, 3>& matrix, std::int64_t left, std::int64_t top, int grid,
              const Array<const float, -1>& taps, std::uint32_t seed, const Array<float, -1, -1, 4>& image, int threads) {
    require(grid >= 1 && taps.shape(0) % grid == 0 && taps.shape(0) / grid % 2 == 1);
    const std::int64_t height = image.shape(0), width = image.shape(1);
    const std::int64_t reach = static_cast<std::int64_t>(taps.shape(0)) / grid / 2, count = taps.shape(0);
    const std::int64_t columns = (width + 2 * reach) * grid, rows = (height + 2 * reach) * grid;
    const nb::gil_scoped_release release;
    Lens lens;
    std::copy_n(matrix.data(), 3, lens.origin);
    std::copy_n(matrix.data() + 3, 9, lens.columns[0]);
    lens.start = distance(lens.origin);
    lens.left = static_cast<double>(left - reach);
    lens.top = static_cast<double>(top - reach);
    lens.grid = grid;
    lens.seed = seed;
    const std::int64_t band = kBand * grid, strip_rows = kStripRows * grid;
    const std::vector<Extent> extents = extents_in(lens, rows, columns);
    std::vector<std::vector<std::int32_t>> seen(divided_up(rows, strip_rows));
    for (std::size_t i = 0; i < extents.size(); ++i)
      for (std::int64_t strip = extents[i].top / strip_rows; strip * strip_rows < extents[i].bottom; ++strip)
        seen[strip].push_back(static_cast<std::int32_t>(i));
    const Buffer<Sample> samples(band * columns);
    const Buffer<float> narrow(rows * width * 4);
    const Scene scene = current();
    for (std::int64_t begin = 0; begin < rows; begin += band) {
      const std::int64_t taken = std::min(band, rows - begin);
      parallel_for(taken, strip_rows, threads, [&](std::int64_t first, std::int64_t last) {
        const std::int64_t count_rows = last - first;
        const Buffer<float> memory(kStripFloats * count_rows * stride_of(columns));
        const Buffer<std::int32_t> met(count_rows * stride_of(columns));
        const std::vector<std::int32_t>& triangles = seen[(begin + first) / strip_rows];
        Sample* row = samples.data() + first * columns;
        kernels_.see(scene, lens,
                     {begin + first, count_rows, columns, triangles.data(), static_cast<std::int64_t>(triangles.size()),
                      extents.data(), memory.data(), met.data()},
                     row);
        for (std::int64_t i = 0; i < count_rows * columns; ++i) {
          if (row[i].triangle < 0) continue;
          for (int corner = 0; corner < 3; ++corner)
            wanted_.add(2 * static_cast<std::int64_t>(faces_[3 * static_cast<std::int64_t>(row[i].triangle) + corner]) + row[i].back);
          if (row[i].mirrored >= 0) mirrored_.add(row[i].mirrored);
        }
      });
      gather(threads);
      parallel_for(taken, 1, threads, [&](std::int64_t row, std::int64_t) {
        const Buffer<float> wide(columns * 4);
        kernels_.shade(scene, samples.data() + row * columns, columns, wide.data());
        float* out = narrow.data() + (begin + row) * width * 4;
        for (std::int64_t x = 0; x < width; ++x) {
          float sums[4] = {};
          for (std::int64_t tap = 0; tap < count; ++tap)
            for (int c = 0; c < 4; ++c) sums[c] += taps.data()[tap] * wide.data()[4 * (x * grid + tap) + c];
          std::copy_n(sums, 4, out + 4 * x);
        }
      });
    }
    parallel_for(height, 1, threads, [&](std::int64_t y, std::int64_t) {
      float* out = image.data() + y * width * 4;
      std::fill_n(out, width * 4, 0.0f);
      for (std::int64_t tap = 0; tap < count; ++tap) {
        const float* row = narrow.data() + (y * grid + tap) * width * 4;
        for (std::int64_t i = 0; i < width * 4; ++i) out[i] += taps.data()[tap] * row[i];
      }
    });
  }

 private:
  Scene current() {
    scene_.nodes = tree_.nodes().data();
    scene_.leaves = tree_.leaves().data();
    scene_.faces = faces_.data();
    scene_.material_of = material_of_.data();
    scene_.materials = materials_.data();
    scene_.vertices = vertices_.data();
    scene_.normals = normals_.data();
    scene_.albedo = albedo_.data();
    scene_.gloss = gloss_.data();
    scene_.hemisphere = hemisphere_.data();
    scene_.reached = reached_.data();
    return scene_;
  }

  // Center, half_u, half_v, normal, radiance of a panel; without area it gives no light.
  void place(int p, const float* rows) {
    Panels& panels = scene_.panels;
    float u2 = 0.0f, v2 = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
      panels.center[axis][p] = rows[axis];
      panels.half_u[axis][p] = rows[3 + axis];
      panels.half_v[axis][p] = rows[6 + axis];
      panels.normal[axis][p] = rows[9 + axis];
      panels.radiance[axis][p] = rows[12 + axis];
      u2 += rows[3 + axis] * rows[3 + axis];
      v2 += rows[6 + axis] * rows[6 + axis];
    }
    panels.area[p] = 4.0f * std::sqrt(u2) * std::sqrt(v2);
    panels.inverse_u2[p] = u2 > 0.0f ? 1.0f / u2 : 0.0f;
    panels.inverse_v2[p] = v2 > 0.0f ? 1.0f / v2 : 0.0f;
    panels.squared_u[p] = u2 * 0.318309886f;
    panels.squared_v[p] = v2 * 0.318309886f;
  }

  void darken() { std::fill(states_.begin(), states_.end(), std::uint8_t{kDark}); }

  // Means of the triangles' normals, by area.
  void find_normals() {
    std::vector<double> sums(3 * count_);
    for (std::size_t i = 0; i < faces_.size(); i += 3) {
      double a[3], b[3];
      for (int axis = 0; axis < 3; ++axis) {
        const double corner = vertices_[3 * faces_[i] + axis];
        a[axis] = vertices_[3 * faces_[i + 1] + axis] - corner;
        b[axis] = vertices_[3 * faces_[i + 2] + axis] - corner;
      }
      for (int axis = 0; axis < 3; ++axis) {
        const int j = (axis + 1) % 3, k = (axis + 2) % 3;
        const double part = a[j] * b[k] - a[k] * b[j];
        for (int corner = 0; corner < 3; ++corner) sums[3 * faces_[i + corner] + axis] += part;
      }
    }
    for (std::int64_t i = 0; i < count_; ++i) {
      const double* n = sums.data() + 3 * i;
      const double squared = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
      const double inverse = squared > 0.0 ? 1.0 / std::sqrt(squared) : 0.0;
      for (int axis = 0; axis < 3; ++axis) normals_[3 * i + axis] = static_cast<float>(n[axis] * inverse);
      if (squared <= 0.0) normals_[3 * i + 2] = 1.0f;
    }
  }

  // Cells that each triangle may be seen in, with some room for rounding; all of them where one reaches beside the camera.
  std::vector<Extent> extents_in(const Lens& lens, std::int64_t rows, std::int64_t columns) const {
    const double* c[3] = {lens.columns[0], lens.columns[1], lens.columns[2]};
    double inverse[3][3];  // pixel position times depth, of a direction
    for (int i = 0; i < 3; ++i) {
      const double *a = c[(i + 1) % 3], *b = c[(i + 2) % 3];
      for (int axis = 0; axis < 3; ++axis)
        inverse[i][axis] = a[(axis + 1) % 3] * b[(axis + 2) % 3] - a[(axis + 2) % 3] * b[(axis + 1) % 3];
    }
    const double volume = c[0][0] * inverse[0][0] + c[0][1] * inverse[0][1] + c[0][2] * inverse[0][2];
    std::vector<double> cells(2 * count_);
    std::vector<std::uint8_t> before(count_);
    for (std::int64_t i = 0; i < count_; ++i) {
      double p[3] = {};
      for (int part = 0; part < 3; ++part)
        for (int axis = 0; axis < 3; ++axis)
          p[part] += inverse[part][axis] * (vertices_[3 * i + axis] - lens.origin[axis]) / volume;
      before[i] = p[2] > 1e-3;
      cells[2 * i] = (p[0] / p[2] - lens.left) * lens.grid;
      cells[2 * i + 1] = (p[1] / p[2] - lens.top) * lens.grid;
    }
    const auto cell = [](double place, std::int64_t most) {
      return static_cast<std::int32_t>(std::floor(std::min(std::max(place, 0.0), static_cast<double>(most))));
    };
    std::vector<Extent> extents(faces_.size() / 3);
    for (std::size_t i = 0; i < extents.size(); ++i) {
      const std::int32_t* face = faces_.data() + 3 * i;
      const double* at[3] = {&cells[2 * face[0]], &cells[2 * face[1]], &cells[2 * face[2]]};
      if (!before[face[0]] || !before[face[1]] || !before[face[2]]) {
        extents[i] = {0, static_cast<std::int32_t>(columns), 0, static_cast<std::int32_t>(rows)};
        continue;
      }
      extents[i] = {cell(std::min({at[0][0], at[1][0], at[2][0]}) - kRoom, columns),
                    cell(std::max({at[0][0], at[1][0], at[2][0]}) + kRoom + 1.0, columns),
                    cell(std::min({at[0][1], at[1][1], at[2][1]}) - kRoom, rows),
                    cell(std::max({at[0][1], at[1][1], at[2][1]}) + kRoom + 1.0, rows)};
    }
    return extents;
  }

  // From a place to the box around all vertices, or 0 inside of it.
  double distance(const double* from) const {
    double squared = 0.0;
    for (int axis = 0; axis < 3; ++axis) {
      double low = 1e30, high = -1e30;
      for (std::int64_t i = 0; i < count_; ++i) {
        low = std::min<double>(low, vertices_[3 * i + axis]);
        high = std::max<double>(high, vertices_[3 * i + axis]);
      }
      const double outside = std::max({low - from[axis], from[axis] - high, 0.0});
      squared += outside * outside;
    }
    return 0.999 * std::sqrt(squared);
  }

  void direct(const std::vector<std::int64_t>& sides, const Scene& scene, int threads) {
    parallel_for(sides.size(), kSidesPerTask, threads, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t i = begin; i < end; ++i) kernels_.direct(scene, sides[i]);
    });
    for (const std::int64_t side : sides) states_[side] = kDirect;
  }

  // Light all sides that were asked for.
  void gather(int threads) {
    const Scene scene = current();
    const std::vector<std::int64_t> sides = wanted_.take(states_, kFull);
    const std::int64_t count = static_cast<std::int64_t>(sides.size()), rays = scene.rays;
    std::vector<std::int32_t> met(count * rays);
    parallel_for(count, kSidesPerTask, threads, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t i = begin; i < end; ++i) {
        kernels_.bounce(scene, sides[i], met.data() + i * rays);
        for (std::int64_t ray = 0; ray < rays; ++ray)
          if (met[i * rays + ray] >= 0) mirrored_.add(met[i * rays + ray]);
        mirrored_.add(sides[i]);
      }
    });
    direct(mirrored_.take(states_, kDirect), scene, threads);
    for (std::int64_t i = 0; i < count; ++i) {
      float sums[3] = {};
      for (std::int64_t ray = 0; ray < rays; ++ray) {
        const std::int32_t side = met[i * rays + ray];
        for (int c = 0; c < 3; ++c)
          sums[c] += side < 0 ? scene.surroundings[c] : albedo_[3 * (side >> 1) + c] * reached_[side].direct[c];
      }
      Reached& reached = reached_[sides[i]];
      for (int c = 0; c < 3; ++c) reached.all[c] = reached.direct[c] + sums[c] / static_cast<float>(rays);
      states_[sides[i]] = kFull;
    }
  }

  const Kernels& kernels_;
  Floats vertices_;
  std::vector<std::int32_t> faces_;
  std::vector<std::uint8_t> material_of_;
  Floats hemisphere_;
  std::int64_t count_;
  Tree tree_;
  Floats normals_, albedo_, gloss_;
  std::vector<Reached> reached_;
  std::vector<std::uint8_t> states_;
  Sides wanted_, mirrored_;
  std::vector<Material> materials_;
  Scene scene_{};
};

}  // namespace
}  // namespace headbench::light

NB_MODULE(_light, m) {
  using namespace headbench;
  using namespace headbench::light;
  nb::set_leak_warnings(false);  // the renderer of a process lives until it exits
  m.def("instruction_sets", [] { return names_of(runnable_light_kernels()); });
  nb::class_<World>(m, "World")
      .def(nb::init<const Array<const float, -1, 3>&, const Array<const std::int32_t, -1, 3>&, const Array<const std::uint8_t, -1>&,
                    const Array<const float, -1, 2>&, const Array<const float, kPanels, 5, 3>&, const Array<const float, 3>&,
                    const Array<const float, -1, -1, 3>&, std::uint32_t, const std::string&>(),
           "vertices"_a, "faces"_a, "material_of"_a, "materials"_a, "panels"_a, "surroundings"_a, "hemisphere"_a, "seed"_a,
           "instruction_set"_a)
      .def("move", &World::move, "vertices"_a)
      .def("paint", &World::paint, "albedo"_a, "gloss"_a)
      .def("light", &World::light, "sides"_a, "out"_a, "threads"_a)
      .def("render", &World::render, "matrix"_a, "left"_a, "top"_a, "grid"_a, "taps"_a, "seed"_a, "image"_a, "threads"_a);
}

// The operations of methods/ops on meshes and splats, as functions of the Python module: arrays in the order of the structs'
// members, the inputs first. Work is divided alike for any number of threads, and sums are taken in one order, so that
// results are equal bit for bit.
#include <string>
#include <vector>

#include "calls.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench {
namespace {

static_assert(kPerTask % kHarmonicsBlock == 0);

void triangles(const nb::tuple& arrays, const std::string& instruction_set, int threads) {
  Arguments from(arrays);
  Size vertices, count;
  const Triangles in{from(vertices, 3), from(count, 3), from(count, 3, 3), from(count, 3), from(count), from(count, 4)};
  require(below(in.faces, 3 * count, vertices));
  run(kernels_of(instruction_set).triangles, in, count, threads);
}

void triangles_backward(const nb::tuple& arrays, const std::string& instruction_set, int threads) {
  Arguments from(arrays);
  Size vertices, count;
  TrianglesBackward in{from(vertices, 3), from(count, 3), from(count, 3, 3), from(count, 3), from(count),
                       from(count, 4),    nullptr};
  float* by_vertices = from(vertices, 3);
  require(below(in.faces, 3 * count, vertices));
  const Buffer<float> by_corners(9 * count);
  in.by_corners = by_corners.data();
  run(kernels_of(instruction_set).triangles_backward, in, count, threads);
  const nb::gil_scoped_release unlocked;
  std::fill_n(by_vertices, 3 * vertices, 0.0f);
  for (std::int64_t corner = 0; corner < 3 * count; ++corner)
    for (int k = 0; k < 3; ++k) by_vertices[3 * in.faces[corner] + k] += in.by_corners[3 * corner + k];
}

void turns(const nb::tuple& arrays, const std::string& instruction_set, int threads) {
  Arguments from(arrays);
  Size count;
  const Turns in{from(count, 3, 3), from(count, 3, 3), from(count, 3, 3)};
  run(kernels_of(instruction_set).turns, in, count, threads);
}

void activate(const nb::tuple& arrays, const std::string& instruction_set, int threads) {
  Arguments from(arrays);
  Size count;
  const Activation in{from(count, 3), from(count, 4), from(count, 3), from(count, 4)};
  run(kernels_of(instruction_set).activate, in, count, threads);
}

ToWorld bound_splats(Arguments& from, Size& count, Size& triangles) {
  const ToWorld in{from(count),    from(triangles, 3, 3), from(triangles, 3), from(triangles), from(triangles, 4),
                   from(count, 3), from(count, 4),        from(count, 3),     nullptr,         nullptr,
                   nullptr};
  require(count < std::int64_t{1} << 32 && below(in.binding, count, triangles));
  return in;
}

void to_world(const nb::tuple& arrays, const std::string& instruction_set, int threads) {
  Arguments from(arrays);
  Size count, triangles;
  ToWorld in = bound_splats(from, count, triangles);
  in.world_means = from(count, 3);
  in.world_quats = from(count, 4);
  in.world_scales = from(count, 3);
  run(kernels_of(instruction_set).to_world, in, count, threads);
}

// Sum what splats add to the frames of their triangles, each triangle's splats in ascending order.
void sum_by_triangle(const std::int64_t* binding, std::int64_t count, const float* parts, std::int64_t triangles, int threads,
                     float* rotations, float* centers, float* sizes, float* quaternions) {
  const Groups splats = group_by_key(count, triangles, [&](std::int64_t splat) { return binding[splat]; });
  parallel_for(triangles, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t triangle = begin; triangle < end; ++triangle) {
      float sums[kFrameNumbers] = {};
      for (std::uint32_t i = splats.starts[triangle]; i < splats.starts[triangle + 1]; ++i)
        for (int k = 0; k < kFrameNumbers; ++k) sums[k] += parts[std::size_t{kFrameNumbers} * splats.order[i] + k];
      std::copy(sums, sums + 9, rotations + 9 * triangle);
      std::copy(sums + 9, sums + 12, centers + 3 * triangle);
      sizes[triangle] = sums[12];
      std::copy(sums + 13, sums + 17, quaternions + 4 * triangle);
    }
  });
}

void to_world_backward(const nb::tuple& arrays, const std::string& instruction_set, int threads) {
  Arguments from(arrays);
  Size count, triangles;
  ToWorldBackward in{bound_splats(from, count, triangles), from(count, 3), from(count, 4), from(count, 3),
                     from(count, 3), from(count, 4), from(count, 3), nullptr};
  float *by_rotations = from.optional(triangles, 3, 3), *by_centers = from.optional(triangles, 3);
  float *by_sizes = from.optional(triangles), *by_quaternions = from.optional(triangles, 4);
  require(!by_sizes || (by_rotations && by_centers && by_quaternions));
  Buffer<float> parts;
  if (by_sizes) in.by_frames = parts.resize(kFrameNumbers * count);
  run(kernels_of(instruction_set).to_world_backward, in, count, threads);
  const nb::gil_scoped_release unlocked;
  if (by_sizes)
    sum_by_triangle(in.splats.binding, count, in.by_frames, triangles, threads, by_rotations, by_centers, by_sizes,
                    by_quaternions);
}

template <bool backward>
void harmonics(const nb::tuple& arguments, const std::string& instruction_set, int threads) {
  Arguments from(arguments);
  Size count, stride;
  TrainedHarmonics in{};
  in.degree = from.number<int>();
  in.dc = from(count, 3);
  in.rest = from(count, 3, stride);
  in.vectors = from(count, 3);
  in.colors = from(count, 3);
  if (backward) {
    in.by_colors = from(count, 3);
    in.by_dc = from(count, 3);
    in.by_rest = from(count, 3, stride);
    in.by_vectors = from(count, 3);
  }
  in.stride = stride;
  require(in.degree >= 0 && in.degree <= kDegreeMax && (in.degree + 1) * (in.degree + 1) - 1 <= stride);
  const Kernels& kernels = kernels_of(instruction_set);
  run(backward ? kernels.harmonics_backward : kernels.harmonics, in, count, threads);
}

void shade(const nb::tuple& arrays, const std::string& instruction_set, int threads) {
  Arguments from(arrays);
  Size blocks, coefficients, count, triangles;
  Harmonics in{0,
               from(blocks, 3, coefficients, kHarmonicsBlock),
               from(count, 3),
               from.optional(triangles, 3, 3),
               from.optional(count),
               from(3),
               from(count, 3)};
  while (in.degree < kDegreeMax && (in.degree + 1) * (in.degree + 1) < coefficients) ++in.degree;
  require((in.degree + 1) * (in.degree + 1) == coefficients && blocks * kHarmonicsBlock >= count);
  require(!in.rotations || (in.binding && below(in.binding, count, triangles)));
  run(kernels_of(instruction_set).shade, in, count, threads);
}

void color_network(const nb::tuple& arrays, const std::string& instruction_set, int threads) {
  Arguments from(arrays);
  Size count, hidden, rows, triangles;
  ColorNetwork net{0, 0, from(count, hidden), from(hidden), from(rows, hidden), from(3, hidden), from(count, 3),
                   from(triangles, 3, 3), from(count), from(3), from(count, 3)};
  require(hidden % kUnitsStep == 0 && rows % 3 == 0 && rows >= 6 && rows < 3 << 20);
  require(below(net.binding, count, triangles));
  net.hidden = static_cast<int>(hidden);
  net.samples = static_cast<int>(rows / 3);
  run(kernels_of(instruction_set).color_network, net, count, threads);
}

void offset_network(const nb::tuple& arrays, const std::string& instruction_set, int threads) {
  Arguments from(arrays);
  Size rows, units, count, hidden, outputs, splats;
  OffsetNetwork net{0, 0, 0, 0, from(rows, units), from(units), from(count, 3), from(count, 3), from(units, hidden),
                    from(hidden), from(outputs, hidden), from(outputs), from(count), from(splats, outputs), nullptr};
  require(units % kUnitsStep == 0 && hidden % kUnitsStep == 0 && (count == 0 || rows > 1));
  require(below(net.rows, 3 * count, rows - 1) && below(net.splats, count, splats));
  net.units = static_cast<int>(units);
  net.hidden = net.second_stride = static_cast<int>(hidden);
  net.outputs = static_cast<int>(outputs);
  const Kernels& kernels = kernels_of(instruction_set);
  const nb::gil_scoped_release unlocked;
  const Scratch scratch(kernels.offset_scratch(net), threads);
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
    kernels.offset_network(net, begin, end, scratch.of(worker));
  });
}

double photometric(const nb::tuple& arguments, const std::string& instruction_set, int threads) {
  constexpr std::int64_t kRowsPerTask = 48;
  Arguments from(arguments);
  Size height, width;
  Photometric in{0, 0, from(height, width, 3), from(height, width, 3), from(11), from.number<float>(),
                 from(height, width, 3), nullptr, nullptr};
  require(height >= 1 && width >= 1 && height * width < std::int64_t{1} << 28);
  std::vector<double> l1(height), ssim(height);
  in.height = static_cast<int>(height);
  in.width = static_cast<int>(width);
  in.row_l1 = l1.data();
  in.row_ssim = ssim.data();
  const Kernels& kernels = kernels_of(instruction_set);
  const nb::gil_scoped_release unlocked;
  const Scratch scratch(kernels.photometric_scratch(in.width), threads);
  parallel_for(height, kRowsPerTask, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
    kernels.photometric(in, static_cast<int>(begin), static_cast<int>(end), scratch.of(worker));
  });
  double l1_sum = 0.0, ssim_sum = 0.0;
  for (std::int64_t row = 0; row < height; ++row) {
    l1_sum += l1[row];
    ssim_sum += ssim[row];
  }
  const double numbers = 3.0 * static_cast<double>(height) * static_cast<double>(width), weight = in.ssim_weight;
  return (1.0 - weight) * l1_sum / numbers + weight * (1.0 - ssim_sum / numbers);
}

}  // namespace

void bind_operations(nb::module_& m) {
  const auto define = [&](const char* name, auto function, const char* help) {
    m.def(name, function, "arguments"_a, "instruction_set"_a, "threads"_a, help);
  };
  define("triangles", &triangles, "Write the frames of a mesh's triangles.");
  define("triangles_backward", &triangles_backward, "Write the gradient by a mesh's vertices.");
  define("turns", &turns, "Write the rotations that take directions on triangles to those on others.");
  define("activate", &activate, "Write scales and unit quaternions of local splats.");
  define("to_world", &to_world, "Write the splats' means, quaternions and scales in the world.");
  define("to_world_backward", &to_world_backward,
         "Write gradients by local splats and, unless they are None, by triangle frames.");
  define("harmonics", &harmonics<false>, "Write the colours of spherical harmonics.");
  define("harmonics_backward", &harmonics<true>, "Write the gradients by coefficients and vectors.");
  define("shade", &shade, "Write the colours of spherical harmonics; rotations may be None.");
  define("color_network", &color_network, "Write the colours of the colour network.");
  define("offset_network", &offset_network, "Write the offsets of the splats named, those of no others.");
  define("photometric", &photometric, "The photometric loss of two images; writes its gradient by the first.");
}

}  // namespace headbench

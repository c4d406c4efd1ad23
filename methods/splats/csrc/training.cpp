// What training computes of splats beside the rasteriser, as functions of the Python module. Work is divided alike for any
// number of threads, and sums are taken in one order, so that results are equal bit for bit.
#include <string>
#include <vector>

#include "bench/native/module.h"
#include "frame.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench {
namespace {

void triangles_backward(const Array<const float, -1, 3>& vertices, const Array<const std::int64_t, -1, 3>& faces,
                        const Array<const float, -1, 3, 3>& by_rotations, const Array<const float, -1, 3>& by_centers,
                        const Array<const float, -1>& by_sizes, const Array<const float, -1, 4>& by_quaternions,
                        const Array<float, -1, 3>& by_vertices, const std::string& instruction_set, int threads) {
  const std::size_t count = faces.shape(0);
  require(by_rotations.shape(0) == count && by_centers.shape(0) == count && by_sizes.shape(0) == count);
  require(by_quaternions.shape(0) == count && by_vertices.shape(0) == vertices.shape(0));
  require(below(faces.data(), 3 * count, vertices.shape(0)));
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  const Buffer<float> by_corners(9 * count);
  const TrianglesBackward in{vertices.data(), faces.data(),          by_rotations.data(), by_centers.data(),
                             by_sizes.data(), by_quaternions.data(), by_corners.data()};
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernels.triangles_backward(in, begin, end); });
  float* out = by_vertices.data();
  std::fill(out, out + 3 * by_vertices.shape(0), 0.0f);
  for (std::size_t corner = 0; corner < 3 * count; ++corner)
    for (int k = 0; k < 3; ++k) out[3 * faces.data()[corner] + k] += by_corners.data()[3 * corner + k];
}

void activate(const Array<const float, -1, 3>& log_scales, const Array<const float, -1, 4>& quats,
              const Array<float, -1, 3>& scales, const Array<float, -1, 4>& unit_quats,
              const std::string& instruction_set, int threads) {
  const std::size_t count = log_scales.shape(0);
  require(quats.shape(0) == count && scales.shape(0) == count && unit_quats.shape(0) == count);
  const Activation in{log_scales.data(), quats.data(), scales.data(), unit_quats.data()};
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernels.activate(in, begin, end); });
}

// Sum what splats add to the frames of their triangles, each triangle's splats in ascending order.
void sum_by_triangle(const std::int64_t* binding, std::size_t count, const float* parts, std::size_t triangles, int threads,
                     const Array<float, -1, 3, 3>& rotations, const Array<float, -1, 3>& centers,
                     const Array<float, -1>& sizes, const Array<float, -1, 4>& quaternions) {
  std::vector<std::int64_t> starts(triangles + 1, 0), order(count);
  for (std::size_t splat = 0; splat < count; ++splat) ++starts[binding[splat] + 1];
  for (std::size_t triangle = 0; triangle < triangles; ++triangle) starts[triangle + 1] += starts[triangle];
  std::vector<std::int64_t> next(starts.begin(), starts.end() - 1);
  for (std::size_t splat = 0; splat < count; ++splat) order[next[binding[splat]]++] = static_cast<std::int64_t>(splat);
  parallel_for(triangles, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t triangle = begin; triangle < end; ++triangle) {
      float sums[kFrameNumbers] = {};
      for (std::int64_t i = starts[triangle]; i < starts[triangle + 1]; ++i)
        for (int k = 0; k < kFrameNumbers; ++k) sums[k] += parts[kFrameNumbers * order[i] + k];
      std::copy(sums, sums + 9, rotations.data() + 9 * triangle);
      std::copy(sums + 9, sums + 12, centers.data() + 3 * triangle);
      sizes.data()[triangle] = sums[12];
      std::copy(sums + 13, sums + 17, quaternions.data() + 4 * triangle);
    }
  });
}

void to_world_backward(const Array<const std::int64_t, -1>& binding, const Array<const float, -1, 3, 3>& rotations,
                       const Array<const float, -1, 3>& centers, const Array<const float, -1>& sizes,
                       const Array<const float, -1, 4>& quaternions, const Array<const float, -1, 3>& means,
                       const Array<const float, -1, 4>& quats, const Array<const float, -1, 3>& scales,
                       const Array<const float, -1, 3>& by_means, const Array<const float, -1, 4>& by_quats,
                       const Array<const float, -1, 3>& by_scales, const Array<float, -1, 3>& by_local_means,
                       const Array<float, -1, 4>& by_raw_quats, const Array<float, -1, 3>& by_log_scales,
                       const Array<float, -1, 3, 3>& by_rotations, const Array<float, -1, 3>& by_centers,
                       const Array<float, -1>& by_sizes, const Array<float, -1, 4>& by_quaternions,
                       const std::string& instruction_set, int threads) {
  const std::size_t count = binding.shape(0), triangles = sizes.shape(0), wanted = by_sizes.shape(0);
  require(rotations.shape(0) == triangles && centers.shape(0) == triangles && quaternions.shape(0) == triangles);
  require(means.shape(0) == count && quats.shape(0) == count && scales.shape(0) == count);
  require(by_means.shape(0) == count && by_quats.shape(0) == count && by_scales.shape(0) == count);
  require(by_local_means.shape(0) == count && by_raw_quats.shape(0) == count && by_log_scales.shape(0) == count);
  require((wanted == triangles || wanted == 0) && by_rotations.shape(0) == wanted && by_centers.shape(0) == wanted);
  require(by_quaternions.shape(0) == wanted && below(binding.data(), count, triangles));
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  Buffer<float> parts;
  if (wanted) parts.resize(kFrameNumbers * count);
  const ToWorldBackward in{{binding.data(), rotations.data(), centers.data(), sizes.data(), quaternions.data(), means.data(),
                            nullptr, scales.data(), nullptr, nullptr, nullptr},
                           quats.data(),
                           by_means.data(),
                           by_quats.data(),
                           by_scales.data(),
                           by_local_means.data(),
                           by_raw_quats.data(),
                           by_log_scales.data(),
                           wanted ? parts.data() : nullptr};
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernels.to_world_backward(in, begin, end); });
  if (wanted)
    sum_by_triangle(binding.data(), count, parts.data(), triangles, threads, by_rotations, by_centers, by_sizes,
                    by_quaternions);
}

TrainedHarmonics harmonics_of(int degree, const Array<const float, -1, 3>& dc, const Array<const float, -1, 3, -1>& rest,
                              const Array<const float, -1, 3>& vectors) {
  require(rest.shape(0) == dc.shape(0) && vectors.shape(0) == dc.shape(0) && degree >= 0 && degree <= kDegreeMax);
  require(static_cast<std::size_t>((degree + 1) * (degree + 1) - 1) <= rest.shape(2));
  TrainedHarmonics in{};
  in.degree = degree;
  in.stride = static_cast<std::int64_t>(rest.shape(2));
  in.dc = dc.data();
  in.rest = rest.data();
  in.vectors = vectors.data();
  return in;
}

void harmonics(int degree, const Array<const float, -1, 3>& dc, const Array<const float, -1, 3, -1>& rest,
               const Array<const float, -1, 3>& vectors,
               const Array<float, -1, 3>& colors, const std::string& instruction_set, int threads) {
  TrainedHarmonics in = harmonics_of(degree, dc, rest, vectors);
  require(colors.shape(0) == dc.shape(0));
  in.colors = colors.data();
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  parallel_for(dc.shape(0), kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernels.harmonics(in, begin, end); });
}

void harmonics_backward(int degree, const Array<const float, -1, 3>& dc, const Array<const float, -1, 3, -1>& rest,
                        const Array<const float, -1, 3>& vectors,
                        const Array<float, -1, 3>& colors, const Array<const float, -1, 3>& by_colors,
                        const Array<float, -1, 3>& by_dc, const Array<float, -1, 3, -1>& by_rest,
                        const Array<float, -1, 3>& by_vectors, const std::string& instruction_set, int threads) {
  TrainedHarmonics in = harmonics_of(degree, dc, rest, vectors);
  const std::size_t count = dc.shape(0);
  require(colors.shape(0) == count && by_colors.shape(0) == count && by_dc.shape(0) == count);
  require(by_rest.shape(0) == count && by_rest.shape(2) == rest.shape(2) && by_vectors.shape(0) == count);
  in.colors = colors.data();
  in.by_colors = by_colors.data();
  in.by_dc = by_dc.data();
  in.by_rest = by_rest.data();
  in.by_vectors = by_vectors.data();
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernels.harmonics_backward(in, begin, end); });
}

constexpr int kRowsPerTask = 48;

double photometric(const Array<const float, -1, -1, 3>& image, const Array<const float, -1, -1, 3>& truth,
                   const Array<const float, 11>& window, float ssim_weight, const Array<float, -1, -1, 3>& gradient,
                   const std::string& instruction_set, int threads) {
  const std::size_t height = image.shape(0), width = image.shape(1);
  require(truth.shape(0) == height && truth.shape(1) == width && gradient.shape(0) == height);
  require(gradient.shape(1) == width && height >= 1 && width >= 1 && height * width < (std::size_t{1} << 28));
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  std::vector<double> l1(height), ssim(height);
  const Photometric in{static_cast<int>(height), static_cast<int>(width), image.data(), truth.data(), window.data(),
                       ssim_weight,              gradient.data(),         l1.data(),    ssim.data()};
  const Scratch scratch(kernels.photometric_scratch(in.width), threads);
  parallel_for(in.height, kRowsPerTask, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
    kernels.photometric(in, static_cast<int>(begin), static_cast<int>(end), scratch.of(worker));
  });
  double l1_sum = 0.0, ssim_sum = 0.0;
  for (std::size_t row = 0; row < height; ++row) {
    l1_sum += l1[row];
    ssim_sum += ssim[row];
  }
  const double numbers = 3.0 * static_cast<double>(height) * static_cast<double>(width), weight = ssim_weight;
  return (1.0 - weight) * l1_sum / numbers + weight * (1.0 - ssim_sum / numbers);
}

}  // namespace

void bind_training(nb::module_& m) {
  m.def("triangles_backward", &triangles_backward, "vertices"_a, "faces"_a, "by_rotations"_a, "by_centers"_a, "by_sizes"_a,
        "by_quaternions"_a, "by_vertices"_a, "instruction_set"_a, "threads"_a, "Write the gradient by a mesh's vertices.");
  m.def("activate", &activate, "log_scales"_a, "quats"_a, "scales"_a, "unit_quats"_a, "instruction_set"_a, "threads"_a,
        "Write scales and unit quaternions of local splats.");
  m.def("to_world_backward", &to_world_backward, "binding"_a, "rotations"_a, "centers"_a, "sizes"_a, "quaternions"_a,
        "means"_a, "quats"_a, "scales"_a, "by_means"_a, "by_quats"_a, "by_scales"_a, "by_local_means"_a, "by_raw_quats"_a,
        "by_log_scales"_a, "by_rotations"_a, "by_centers"_a, "by_sizes"_a, "by_quaternions"_a, "instruction_set"_a,
        "threads"_a, "Write gradients by local splats and, where their arrays are not empty, by triangle frames.");
  m.def("harmonics", &harmonics, "degree"_a, "dc"_a, "rest"_a, "vectors"_a, "colors"_a, "instruction_set"_a,
        "threads"_a, "Write the colours of spherical harmonics.");
  m.def("harmonics_backward", &harmonics_backward, "degree"_a, "dc"_a, "rest"_a, "vectors"_a, "colors"_a,
        "by_colors"_a, "by_dc"_a, "by_rest"_a, "by_vectors"_a, "instruction_set"_a, "threads"_a,
        "Write the gradients by coefficients and vectors.");
  m.def("photometric", &photometric, "image"_a, "truth"_a, "window"_a, "ssim_weight"_a, "gradient"_a, "instruction_set"_a,
        "threads"_a, "The photometric loss of two images; writes its gradient by the first.");
}

}  // namespace headbench

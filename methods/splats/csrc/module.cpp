// The kernel as a Python module. Arrays are typed and contiguous; outputs are allocated by the caller.
#include <nanobind/stl/map.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/unique_ptr.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <memory>
#include <string>
#include <utility>

#include "bench/native/module.h"
#include "frame.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench {

void bind_avatar(nb::module_& m);            // avatar.cpp
void bind_training(nb::module_& m);          // training.cpp
void bind_network_training(nb::module_& m);  // network_training.cpp

namespace {

// The inputs in the order of `rasterize`; `offset` is empty (0, 2) where there is none.
struct Inputs {
  Array<const float, -1, 3> means;
  Array<const float, -1, 4> quats;
  Array<const float, -1, 3> scales;
  Array<const float, -1> opacities;
  Array<const float, -1, -1> colors;
  Array<const float, -1, 2> offset;
  Array<const float, -1> background;

  // Shapes were checked in Python with clear messages; this only keeps memory safe.
  Splats splats() const {
    const std::size_t count = means.shape(0);
    const bool fit = quats.shape(0) == count && scales.shape(0) == count && opacities.shape(0) == count &&
                     colors.shape(0) == count && (offset.shape(0) == count || offset.shape(0) == 0) &&
                     background.shape(0) == colors.shape(1) && colors.shape(1) >= 1 &&
                     colors.shape(1) <= static_cast<std::size_t>(kChannelsMax) && count < (std::size_t{1} << 32);
    require(fit);
    return {static_cast<std::int64_t>(count), static_cast<int>(colors.shape(1)), means.data(), quats.data(),
            scales.data(), opacities.data(), colors.data(), offset.shape(0) ? offset.data() : nullptr,
            background.data()};
  }
};

Camera make_view(const Array<const float, 4, 4>& viewmat, const Array<const float, 3, 3>& K, double near, double far,
               float eps2d, bool antialiased, double alpha_min, double transmittance_min, std::size_t width, std::size_t height) {
  Camera view{};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) view.rotation[3 * i + j] = viewmat(i, j);
    view.translation[i] = viewmat(i, 3);
  }
  view.fx = K(0, 0);
  view.fy = K(1, 1);
  view.cx = K(0, 2);
  view.cy = K(1, 2);
  view.near = near;
  view.far = far;
  view.eps2d = eps2d;
  view.antialiased = antialiased;
  view.alpha_min = static_cast<float>(alpha_min);
  view.log2_alpha_min = static_cast<float>(std::log2(alpha_min));
  view.transmittance_min = static_cast<float>(transmittance_min);
  constexpr std::size_t kSizeMax = std::size_t{1} << 19;  // tile indices have 16 bits
  if (width < 1 || height < 1 || width > kSizeMax || height > kSizeMax)
    throw std::invalid_argument("image sides must be from 1 to 2^19 pixels");
  view.width = static_cast<int>(width);
  view.height = static_cast<int>(height);
  view.tiles_x = (view.width + kTile - 1) / kTile;
  view.tiles_y = (view.height + kTile - 1) / kTile;
  return view;
}

std::unique_ptr<Frame> forward(const Array<const float, -1, 3>& means, const Array<const float, -1, 4>& quats,
                               const Array<const float, -1, 3>& scales, const Array<const float, -1>& opacities,
                               const Array<const float, -1, -1>& colors, const Array<const float, -1, 2>& offset,
                               const Array<const float, -1>& background, const Array<const float, 4, 4>& viewmat,
                               const Array<const float, 3, 3>& K, double near, double far, float eps2d,
                               bool antialiased, double alpha_min, double transmittance_min,
                               const Array<float, -1, -1, -1>& image, const Array<float, -1, -1>& alpha,
                               const Array<std::int32_t, -1>& radii, const std::string& instruction_set,
                               int threads) {
  const Splats splats = Inputs{means, quats, scales, opacities, colors, offset, background}.splats();
  const Camera view = make_view(viewmat, K, near, far, eps2d, antialiased, alpha_min, transmittance_min, image.shape(1),
                              image.shape(0));
  if (image.shape(2) != colors.shape(1) || alpha.shape(0) != image.shape(0) || alpha.shape(1) != image.shape(1) ||
      radii.shape(0) != means.shape(0) || threads < 1)
    throw std::invalid_argument("outputs do not fit the inputs");
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  return std::make_unique<Frame>(view, splats, ImageOut{image.data(), alpha.data()}, radii.data(), kernels, threads);
}

void backward(Frame& frame, const Array<const float, -1, 3>& means, const Array<const float, -1, 4>& quats,
              const Array<const float, -1, 3>& scales, const Array<const float, -1>& opacities,
              const Array<const float, -1, -1>& colors, const Array<const float, -1, 2>& offset,
              const Array<const float, -1>& background, const Array<const float, -1, -1, -1>& grad_image,
              const Array<const float, -1, -1>& grad_alpha, const Array<float, -1, 3>& grad_means,
              const Array<float, -1, 4>& grad_quats, const Array<float, -1, 3>& grad_scales,
              const Array<float, -1>& grad_opacities, const Array<float, -1, -1>& grad_colors,
              const Array<float, -1, 2>& grad_offset, const Array<float, -1>& grad_background,
              const Array<float, 4, 4>& grad_viewmat, const Array<float, 3, 3>& grad_K,
              const Array<float, -1, 2>& grad_absolute, int threads) {
  const Splats splats = Inputs{means, quats, scales, opacities, colors, offset, background}.splats();
  const auto same = [](const auto& a, const auto& b) {
    for (std::size_t i = 0; i < a.ndim(); ++i)
      if (a.shape(i) != b.shape(i)) return false;
    return true;
  };
  if (!frame.fits(splats) || !frame.fits(grad_image.shape(1), grad_image.shape(0)) || !same(grad_means, means) ||
      !same(grad_quats, quats) || !same(grad_scales, scales) || !same(grad_opacities, opacities) ||
      !same(grad_colors, colors) || !same(grad_offset, offset) || !same(grad_background, background) ||
      (grad_absolute.shape(0) != 0 && grad_absolute.shape(0) != means.shape(0)) ||
      grad_image.shape(2) != colors.shape(1) || grad_alpha.shape(0) != grad_image.shape(0) ||
      grad_alpha.shape(1) != grad_image.shape(1) || threads < 1)
    throw std::invalid_argument("gradients do not fit the inputs");
  Gradients grads{};
  grads.image = grad_image.data();
  grads.alpha = grad_alpha.data();
  grads.means = grad_means.data();
  grads.quats = grad_quats.data();
  grads.scales = grad_scales.data();
  grads.opacities = grad_opacities.data();
  grads.colors = grad_colors.data();
  grads.means2d = grad_offset.shape(0) ? grad_offset.data() : nullptr;
  grads.means2d_abs = grad_absolute.shape(0) ? grad_absolute.data() : nullptr;
  float view_gradient[kViewGradient];
  {
    nb::gil_scoped_release unlocked;
    frame.backward(splats, grads, grad_background.data(), view_gradient, threads);
  }
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) grad_viewmat(i, j) = view_gradient[3 * i + j];
    grad_viewmat(i, 3) = view_gradient[9 + i];
  }
  for (int i = 0; i < 2; ++i) {
    grad_K(i, i) = view_gradient[12 + i];
    grad_K(i, 2) = view_gradient[14 + i];
  }
}

std::map<std::string, double> stage_seconds(const Frame& frame) {
  std::map<std::string, double> named;
  for (int stage = 0; stage < kStageCount; ++stage) named[kStageNames[stage]] = frame.stage_seconds()[stage];
  return named;
}

std::pair<std::uint64_t, std::uint64_t> work(const Frame& frame, const Array<const float, -1, 3>& means,
                                             const Array<const float, -1, 4>& quats,
                                             const Array<const float, -1, 3>& scales,
                                             const Array<const float, -1>& opacities,
                                             const Array<const float, -1, -1>& colors,
                                             const Array<const float, -1, 2>& offset,
                                             const Array<const float, -1>& background) {
  const Splats splats = Inputs{means, quats, scales, opacities, colors, offset, background}.splats();
  if (!frame.fits(splats)) throw std::invalid_argument("inputs do not fit the frame");
  const Work work = frame.work(splats);
  return {work.tested, work.drawn};
}

// Fastest of several short runs, in floating-point operations per second of one thread.
double peak_flops(const std::string& instruction_set) {
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  constexpr std::int64_t kRounds = 1 << 17;
  constexpr int kRuns = 20;
  double best = std::numeric_limits<double>::infinity();
  volatile float keep;
  for (int run = 0; run < kRuns; ++run) {
    const double start = thread_seconds();
    keep = kernels.multiply_add(kRounds);
    best = std::min(best, thread_seconds() - start);
  }
  static_cast<void>(keep);
  return 2.0 * kRounds * kernels.chains * kernels.lanes / best;
}

}  // namespace
}  // namespace headbench

NB_MODULE(_kernel, m) {
  using namespace headbench;
  // A tensor that is alive when the interpreter ends keeps its frame; that is no leak.
  nb::set_leak_warnings(false);
  m.doc() = "Gaussian splat rasteriser, and what avatars compute before it";
  nb::class_<Frame>(m, "Frame", "A drawn frame: what its backward pass needs.")
      .def_prop_ro("stage_seconds", &stage_seconds, "Processor time of the calling thread by stage.")
      .def("work", &work, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "colors"_a, "offset"_a, "background"_a,
           "Pairs of splat and pixel tested, and those drawn.");
  m.def("peak_flops", &peak_flops, "instruction_set"_a, "Measured multiply-add rate of one thread, flops per second.");
  m.def("forward", &forward, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "colors"_a, "offset"_a, "background"_a,
        "viewmat"_a, "K"_a, "near"_a, "far"_a, "eps2d"_a, "antialiased"_a, "alpha_min"_a,
        "transmittance_min"_a, "image"_a, "alpha"_a, "radii"_a, "instruction_set"_a,
        "threads"_a, "Draw into image, alpha and radii.");
  m.def("backward", &backward, "frame"_a, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "colors"_a, "offset"_a,
        "background"_a, "grad_image"_a, "grad_alpha"_a, "grad_means"_a, "grad_quats"_a, "grad_scales"_a,
        "grad_opacities"_a, "grad_colors"_a, "grad_offset"_a, "grad_background"_a, "grad_viewmat"_a, "grad_K"_a,
        "grad_absolute"_a, "threads"_a,
        "Add the gradients of drawn splats; write those of background and camera. An empty grad_absolute asks for none.");
  bind_avatar(m);
  bind_training(m);
  bind_network_training(m);
  m.def("instruction_sets", [] { return names_of(runnable_kernels()); }, "Variants this machine can run, the fastest first.");
}

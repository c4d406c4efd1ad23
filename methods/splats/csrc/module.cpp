// The kernel as a Python module. Outputs are allocated by the caller.
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

#include "calls.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench {

void bind_operations(nb::module_& m);        // operations.cpp
void bind_network_training(nb::module_& m);  // network_training.cpp

namespace {

// Inputs of `rasterize`; the offset may be None.
Splats read_splats(const nb::tuple& arrays, Size& count, Size& channels) {
  Arguments from(arrays);
  Splats splats{0, 0, from(count, 3), from(count, 4), from(count, 3), from(count), from(count, channels), from.optional(count, 2),
                from(channels)};
  require(channels >= 1 && channels <= kChannelsMax && count < std::int64_t{1} << 32);
  splats.count = count;
  splats.channels = static_cast<int>(channels);
  return splats;
}

// World to camera and intrinsics, then the settings in the order of `rasterize`.
Camera read_camera(const nb::tuple& arguments, std::int64_t width, std::int64_t height) {
  Arguments from(arguments);
  const float *viewmat = from(4, 4), *K = from(3, 3);
  Camera view{};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) view.rotation[3 * i + j] = viewmat[4 * i + j];
    view.translation[i] = viewmat[4 * i + 3];
  }
  view.fx = K[0];
  view.fy = K[4];
  view.cx = K[2];
  view.cy = K[5];
  view.near = from.number<double>();
  view.far = from.number<double>();
  view.eps2d = from.number<float>();
  view.antialiased = from.number<bool>();
  const double alpha_min = from.number<double>();
  view.alpha_min = static_cast<float>(alpha_min);
  view.log2_alpha_min = static_cast<float>(std::log2(alpha_min));
  view.transmittance_min = static_cast<float>(from.number<double>());
  constexpr std::int64_t kSizeMax = std::int64_t{1} << 19;  // tile indices have 16 bits
  if (width < 1 || height < 1 || width > kSizeMax || height > kSizeMax)
    throw std::invalid_argument("image sides must be from 1 to 2^19 pixels");
  view.width = static_cast<int>(width);
  view.height = static_cast<int>(height);
  view.tiles_x = (view.width + kTile - 1) / kTile;
  view.tiles_y = (view.height + kTile - 1) / kTile;
  return view;
}

std::unique_ptr<Frame> forward(const nb::tuple& inputs, const nb::tuple& camera, const nb::tuple& outputs,
                               const std::string& instruction_set, int threads) {
  Size count, channels, height, width;
  const Splats splats = read_splats(inputs, count, channels);
  Arguments to(outputs);
  const ImageOut out{to(height, width, channels), to(height, width)};
  std::int32_t* radii = to(count);
  const Camera view = read_camera(camera, width, height);
  const Kernels& kernels = kernels_of(instruction_set);
  require(threads >= 1);
  nb::gil_scoped_release unlocked;
  return std::make_unique<Frame>(view, splats, out, radii, kernels, threads);
}

void backward(Frame& frame, const nb::tuple& inputs, const nb::tuple& by_image, const nb::tuple& by_inputs,
              const nb::tuple& by_camera, int threads) {
  Size count, channels, height, width;
  const Splats splats = read_splats(inputs, count, channels);
  Gradients grads{};
  Arguments given(by_image), to(by_inputs), to_camera(by_camera);
  grads.image = given(height, width, channels);
  grads.alpha = given(height, width);
  grads.means = to(count, 3);
  grads.quats = to(count, 4);
  grads.scales = to(count, 3);
  grads.opacities = to(count);
  grads.colors = to(count, channels);
  grads.means2d = to.optional(count, 2);
  float *background = to(channels), *by_viewmat = to_camera(4, 4), *by_K = to_camera(3, 3);
  require(frame.fits(splats) && frame.fits(width, height) && !grads.means2d == !splats.offset && threads >= 1);
  float view_gradient[kViewGradient];
  {
    nb::gil_scoped_release unlocked;
    frame.backward(splats, grads, background, view_gradient, threads);
  }
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) by_viewmat[4 * i + j] = view_gradient[3 * i + j];
    by_viewmat[4 * i + 3] = view_gradient[9 + i];
  }
  for (int i = 0; i < 2; ++i) {
    by_K[4 * i] = view_gradient[12 + i];
    by_K[3 * i + 2] = view_gradient[14 + i];
  }
}

std::map<std::string, double> stage_seconds(const Frame& frame) {
  std::map<std::string, double> named;
  for (int stage = 0; stage < kStageCount; ++stage) named[kStageNames[stage]] = frame.stage_seconds()[stage];
  return named;
}

std::pair<std::uint64_t, std::uint64_t> work(const Frame& frame, const nb::tuple& inputs) {
  Size count, channels;
  const Splats splats = read_splats(inputs, count, channels);
  require(frame.fits(splats));
  const Work work = frame.work(splats);
  return {work.tested, work.drawn};
}

// Fastest of several short runs, in floating-point operations per second of one thread.
double peak_flops(const std::string& instruction_set) {
  const Kernels& kernels = kernels_of(instruction_set);
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
      .def("work", &work, "inputs"_a, "Pairs of splat and pixel tested, and those drawn.");
  m.def("peak_flops", &peak_flops, "instruction_set"_a, "Measured multiply-add rate of one thread, flops per second.");
  m.def("forward", &forward, "inputs"_a, "camera"_a, "outputs"_a, "instruction_set"_a, "threads"_a,
        "Draw into image, alpha and radii.");
  m.def("backward", &backward, "frame"_a, "inputs"_a, "by_image"_a, "by_inputs"_a, "by_camera"_a, "threads"_a,
        "Add the gradients of drawn splats; write those of background and camera.");
  bind_operations(m);
  bind_network_training(m);
  m.def("instruction_sets", [] { return names_of(runnable_kernels()); }, "Variants this machine can run, the fastest first.");
}

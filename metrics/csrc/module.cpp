// The kernels as a Python module. Shapes are checked in Python with clear messages; here memory is kept safe.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <new>
#include <stdexcept>
#include <string>
#include <vector>

#include "kernels.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench::metrics {
namespace {

template <class T, nb::ssize_t... Shape>
using Array = nb::ndarray<T, nb::shape<Shape...>, nb::c_contig, nb::device::cpu>;
using Image = Array<const std::uint8_t, -1, -1, kChannels>;
using Masks = Array<const std::uint8_t, -1, -1, -1>;

const Kernels& kernels_by_name(const std::string& name) {
  for (const Kernels* kernels : runnable_kernels())
    if (name == kernels->name) return *kernels;
  throw std::invalid_argument("instruction set " + name + " is not available here");
}

Pair make_pair(const Image& image, const Image& truth, const Masks& masks) {
  const std::size_t height = image.shape(0), width = image.shape(1);
  if (truth.shape(0) != height || truth.shape(1) != width ||
      (masks.shape(0) != 0 && (masks.shape(1) != height || masks.shape(2) != width)))
    throw std::invalid_argument("arrays do not fit together");
  return {image.data(), truth.data(), masks.data(), static_cast<std::int64_t>(height),
          static_cast<std::int64_t>(width), static_cast<std::int64_t>(masks.shape(0))};
}

std::vector<double> similarity(const Image& image, const Image& truth, const Masks& masks,
                               const Array<const double, -1>& taps, int border, double covariance_scale, double c1,
                               double c2, const std::string& instruction_set) {
  const Pair pair = make_pair(image, truth, masks);
  const Kernels& kernels = kernels_by_name(instruction_set);
  const int radius = static_cast<int>(taps.shape(0)) - 1;
  if ((radius != 3 && radius != 5 && radius != kRadiusMax) || border < 0 || border > 2)
    throw std::invalid_argument("no such window");
  const std::int64_t side = border == 0 ? 2 * radius + 1 : border == 1 ? radius + 1 : 1;
  if (pair.height < side || pair.width < side) throw std::invalid_argument("image smaller than the window");
  Form form{{}, radius, static_cast<Border>(border), covariance_scale, c1, c2};
  for (int i = 0; i <= radius; ++i) form.taps[i] = taps(i);
  std::vector<double> sums(pair.regions + 1);
  bool done;
  {
    nb::gil_scoped_release unlocked;
    done = kernels.similarity(pair, form, sums.data());
  }
  if (!done) throw std::bad_alloc();
  return sums;
}

std::vector<std::uint64_t> squared_error(const Image& image, const Image& truth, const Masks& masks,
                                         const std::string& instruction_set) {
  const Pair pair = make_pair(image, truth, masks);
  const Kernels& kernels = kernels_by_name(instruction_set);
  std::vector<std::uint64_t> sums(kChannels * (pair.regions + 1));
  nb::gil_scoped_release unlocked;
  kernels.squared_error(pair, sums.data());
  return sums;
}

std::vector<std::string> instruction_sets() {
  std::vector<std::string> names;
  for (const Kernels* kernels : runnable_kernels()) names.emplace_back(kernels->name);
  return names;
}

}  // namespace
}  // namespace headbench::metrics

NB_MODULE(_structural, m) {
  using namespace headbench::metrics;
  m.doc() = "Structural similarity and squared error of 8-bit images";
  m.def("similarity", &similarity, "image"_a, "truth"_a, "masks"_a, "taps"_a, "border"_a, "covariance_scale"_a,
        "c1"_a, "c2"_a, "instruction_set"_a,
        "Sums of the local similarities over windows and channels: of the image, then of each mask.");
  m.def("squared_error", &squared_error, "image"_a, "truth"_a, "masks"_a, "instruction_set"_a,
        "Sums of the squared differences, three channels: of the image, then of each mask.");
  m.def("instruction_sets", &instruction_sets, "Variants this machine can run, the fastest first.");
}

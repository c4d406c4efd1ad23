// The kernels as a Python module. Shapes are checked in Python with clear messages; here memory is kept safe.
#include <new>
#include <string>
#include <vector>

#include "bench/native/instruction_sets.h"
#include "bench/native/module.h"
#include "kernels.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench {

HEADBENCH_VARIANTS(metrics::Kernels, kernels)

namespace metrics {
namespace {

using Image = Array<const std::uint8_t, -1, -1, kChannels>;
using Masks = Array<const std::uint8_t, -1, -1, -1>;

Pair make_pair(const Image& image, const Image& reference, const Masks& masks) {
  const std::size_t height = image.shape(0), width = image.shape(1);
  require(reference.shape(0) == height && reference.shape(1) == width &&
          (masks.shape(0) == 0 || (masks.shape(1) == height && masks.shape(2) == width)));
  return {image.data(), reference.data(), masks.data(), static_cast<std::int64_t>(height),
          static_cast<std::int64_t>(width), static_cast<std::int64_t>(masks.shape(0))};
}

std::vector<double> similarity(const Image& image, const Image& reference, const Masks& masks,
                               const Array<const double, -1>& taps, int border, double covariance_scale, double c1,
                               double c2, const std::string& instruction_set) {
  const Pair pair = make_pair(image, reference, masks);
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
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

std::vector<std::uint64_t> squared_error(const Image& image, const Image& reference, const Masks& masks,
                                         const std::string& instruction_set) {
  const Pair pair = make_pair(image, reference, masks);
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  std::vector<std::uint64_t> sums(kChannels * (pair.regions + 1));
  nb::gil_scoped_release unlocked;
  kernels.squared_error(pair, sums.data());
  return sums;
}

}  // namespace
}  // namespace metrics
}  // namespace headbench

NB_MODULE(_structural, m) {
  using namespace headbench;
  using namespace headbench::metrics;
  m.doc() = "Structural similarity and squared error of 8-bit images";
  m.def("similarity", &similarity, "image"_a, "reference"_a, "masks"_a, "taps"_a, "border"_a, "covariance_scale"_a,
        "c1"_a, "c2"_a, "instruction_set"_a,
        "Sums of the local similarities over windows and channels: of the image, then of each mask.");
  m.def("squared_error", &squared_error, "image"_a, "reference"_a, "masks"_a, "instruction_set"_a,
        "Sums of the squared differences, three channels: of the image, then of each mask.");
  m.def("instruction_sets", [] { return names_of(runnable_kernels()); },
        "Variants this machine can run, the fastest first.");
}

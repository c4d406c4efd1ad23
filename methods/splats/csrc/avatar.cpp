// What avatars compute of a pose, as functions of the Python module: triangles and splats are dealt out to threads, no two of which
// write to one place, so that results are equal bit for bit for any number of them.
#include <string>

#include "bench/native/module.h"
#include "frame.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench {
namespace {

static_assert(kPerTask % kHarmonicsBlock == 0);

void triangles(const Array<const float, -1, 3>& vertices, const Array<const std::int64_t, -1, 3>& faces,
               const Array<float, -1, 3, 3>& rotations, const Array<float, -1, 3>& centers,
               const Array<float, -1>& sizes, const Array<float, -1, 4>& quaternions, const std::string& instruction_set,
               int threads) {
  const std::size_t count = faces.shape(0);
  require(rotations.shape(0) == count && centers.shape(0) == count && sizes.shape(0) == count);
  require(quaternions.shape(0) == count && below(faces.data(), 3 * count, vertices.shape(0)));
  const Triangles in{vertices.data(), faces.data(), rotations.data(), centers.data(), sizes.data(), quaternions.data()};
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernels.triangles(in, begin, end); });
}

void to_world(const Array<const std::int64_t, -1>& binding, const Array<const float, -1, 3, 3>& rotations,
           const Array<const float, -1, 3>& centers, const Array<const float, -1>& sizes,
           const Array<const float, -1, 4>& quaternions, const Array<const float, -1, 3>& means,
           const Array<const float, -1, 4>& quats, const Array<const float, -1, 3>& scales,
           const Array<float, -1, 3>& world_means, const Array<float, -1, 4>& world_quats,
           const Array<float, -1, 3>& world_scales, const std::string& instruction_set, int threads) {
  const std::size_t count = binding.shape(0), triangles = sizes.shape(0);
  require(rotations.shape(0) == triangles && centers.shape(0) == triangles && quaternions.shape(0) == triangles);
  require(means.shape(0) == count && quats.shape(0) == count && scales.shape(0) == count);
  require(world_means.shape(0) == count && world_quats.shape(0) == count && world_scales.shape(0) == count);
  require(below(binding.data(), count, triangles));
  const ToWorld in{binding.data(), rotations.data(), centers.data(),     sizes.data(),       quaternions.data(),  means.data(),
                 quats.data(),   scales.data(),    world_means.data(), world_quats.data(), world_scales.data()};
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernels.to_world(in, begin, end); });
}

void shade(const Array<const float, -1, 3, -1, kHarmonicsBlock>& coefficients, const Array<const float, -1, 3>& means,
           const Array<const float, -1, 3, 3>& rotations, const Array<const std::int64_t, -1>& binding,
           const Array<const float, 3>& center, const Array<float, -1, 3>& colors, const std::string& instruction_set,
           int threads) {
  const std::size_t count = means.shape(0);
  Harmonics in{0, coefficients.data(), means.data(), nullptr, nullptr, {}, colors.data()};
  while (in.degree < kDegreeMax && static_cast<std::size_t>((in.degree + 1) * (in.degree + 1)) < coefficients.shape(2))
    ++in.degree;
  require(static_cast<std::size_t>((in.degree + 1) * (in.degree + 1)) == coefficients.shape(2));
  require(coefficients.shape(0) * kHarmonicsBlock >= count && colors.shape(0) == count);
  if (rotations.shape(0)) {
    require(binding.shape(0) == count && below(binding.data(), count, rotations.shape(0)));
    in.rotations = rotations.data();
    in.binding = binding.data();
  }
  for (int k = 0; k < 3; ++k) in.center[k] = center(k);
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernels.shade(in, begin, end); });
}

void turns(const Array<const float, -1, 3, 3>& to, const Array<const float, -1, 3, 3>& from,
           const Array<float, -1, 3, 3>& out, const std::string& instruction_set, int threads) {
  const std::size_t count = out.shape(0);
  require(to.shape(0) == count && from.shape(0) == count);
  const Turns in{to.data(), from.data(), out.data()};
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernels.turns(in, begin, end); });
}

void color_network(const Array<const std::int16_t, -1, -1>& positions, const Array<const float, -1>& steps, const Array<const float, -1, -1>& table,
                   const Array<const float, 3, -1>& last, const Array<const float, -1, 3>& means,
                   const Array<const float, -1, 3, 3>& rotations, const Array<const std::int64_t, -1>& binding,
                   const Array<const float, 3>& center, const Array<float, -1, 3>& colors,
                   const std::string& instruction_set, int threads) {
  const std::size_t count = means.shape(0), hidden = positions.shape(1);
  require(hidden % kUnitsStep == 0 && table.shape(1) == hidden && last.shape(1) == hidden);
  require(table.shape(0) % 3 == 0 && table.shape(0) >= 6 && table.shape(0) < 3 << 20);
  require(positions.shape(0) == count && binding.shape(0) == count && colors.shape(0) == count && steps.shape(0) == hidden);
  require(below(binding.data(), count, rotations.shape(0)));
  ColorNetwork net{static_cast<int>(hidden), static_cast<int>(table.shape(0) / 3), positions.data(), steps.data(),
                   table.data(),                   last.data(), means.data(), rotations.data(), binding.data(), {}, colors.data()};
  for (int k = 0; k < 3; ++k) net.center[k] = center(k);
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end) { kernels.color_network(net, begin, end); });
}

void offset_network(const Array<const float, -1, -1>& table, const Array<const float, -1>& first_bias, const Array<const std::int32_t, -1, 3>& rows,
                    const Array<const float, -1, 3>& fractions, const Array<const float, -1, -1>& second,
                    const Array<const float, -1>& second_bias, const Array<const float, -1, -1>& last,
                    const Array<const float, -1>& last_bias, const Array<const std::int64_t, -1>& splats,
                    const Array<float, -1, -1>& offsets, const std::string& instruction_set, int threads) {
  const std::size_t count = splats.shape(0), units = table.shape(1), hidden = second.shape(1);
  require(units % kUnitsStep == 0 && hidden % kUnitsStep == 0 && second.shape(0) == units);
  require(first_bias.shape(0) == units && second_bias.shape(0) == hidden && last.shape(1) == hidden && last_bias.shape(0) == last.shape(0));
  require(rows.shape(0) == count && fractions.shape(0) == count && offsets.shape(1) == last.shape(0));
  require(count == 0 || table.shape(0) > 1);
  require(below(rows.data(), 3 * count, table.shape(0) - 1) && below(splats.data(), count, offsets.shape(0)));
  const OffsetNetwork net{static_cast<int>(units), static_cast<int>(hidden), static_cast<int>(last.shape(0)),
                          static_cast<int>(hidden), table.data(), first_bias.data(), rows.data(), fractions.data(),
                          second.data(), second_bias.data(), last.data(), last_bias.data(), splats.data(),
                          offsets.data(), nullptr};
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  const Scratch scratch(kernels.offset_scratch(net), threads);
  parallel_for(count, kPerTask, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
    kernels.offset_network(net, begin, end, scratch.of(worker));
  });
}

}  // namespace

void bind_avatar(nb::module_& m) {
  m.def("triangles", &triangles, "vertices"_a, "faces"_a, "rotations"_a, "centers"_a, "sizes"_a, "quaternions"_a,
        "instruction_set"_a, "threads"_a, "Write the frames of a mesh's triangles.");
  m.def("to_world", &to_world, "binding"_a, "rotations"_a, "centers"_a, "sizes"_a, "quaternions"_a, "means"_a, "quats"_a,
        "scales"_a, "world_means"_a, "world_quats"_a, "world_scales"_a, "instruction_set"_a, "threads"_a,
        "Write the splats' means, quaternions and scales in the world.");
  m.def("shade", &shade, "coefficients"_a, "means"_a, "rotations"_a, "binding"_a, "center"_a, "colors"_a,
        "instruction_set"_a, "threads"_a, "Write the colours of spherical harmonics; empty rotations rotate nothing.");
  m.def("turns", &turns, "to"_a, "from_"_a, "out"_a, "instruction_set"_a, "threads"_a,
        "Write the rotations that take directions on triangles to those on others.");
  m.def("color_network", &color_network, "positions"_a, "steps"_a, "table"_a, "last"_a, "means"_a, "rotations"_a, "binding"_a,
        "center"_a, "colors"_a, "instruction_set"_a, "threads"_a, "Write the colours of the colour network.");
  m.def("offset_network", &offset_network, "table"_a, "first_bias"_a, "rows"_a, "fractions"_a, "second"_a, "second_bias"_a, "last"_a,
        "last_bias"_a, "splats"_a, "offsets"_a, "instruction_set"_a, "threads"_a,
        "Write the offsets of the splats named, those of no others.");
}

}  // namespace headbench

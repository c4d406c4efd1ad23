// Draws one scene and differentiates it with every instruction set of the processor this is compiled for, so that a
// kernel for another processor can be tested in an emulator, where there is no Python.
//
//   driver IN OUT    numbers as they lie in memory; the order is that of test_emulated.py
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <vector>

#include "frame.h"

using namespace headbench;

namespace {

template <class T>
std::vector<T> take(std::FILE* file, std::size_t count) {
  std::vector<T> values(count);
  if (std::fread(values.data(), sizeof(T), count, file) != count) values.clear();
  return values;
}

}  // namespace

int main(int argc, char** argv) {
  std::FILE* in = argc == 3 ? std::fopen(argv[1], "rb") : nullptr;
  std::FILE* out = in ? std::fopen(argv[2], "wb") : nullptr;
  if (!out) return 2;
  const std::vector<std::int32_t> sizes = take<std::int32_t>(in, 4);
  const std::size_t count = sizes.at(0), channels = sizes.at(1), width = sizes.at(2), height = sizes.at(3);
  const std::vector<float> camera = take<float>(in, 16);  // as kViewGradient is ordered
  const std::size_t fields[] = {3, 4, 3, 1, channels};
  std::vector<float> inputs[5];
  for (int k = 0; k < 5; ++k) inputs[k] = take<float>(in, count * fields[k]);
  const std::vector<float> background = take<float>(in, channels);
  const std::vector<float> on_image = take<float>(in, width * height * channels);
  const std::vector<float> on_alpha = take<float>(in, width * height);
  if (on_alpha.size() != width * height) return 3;

  Camera view{};
  std::memcpy(view.rotation, camera.data(), sizeof view.rotation);
  std::memcpy(view.translation, camera.data() + 9, sizeof view.translation);
  view.fx = camera[12], view.fy = camera[13], view.cx = camera[14], view.cy = camera[15];
  view.near = 0.01, view.far = 1e10, view.eps2d = 0.3f;
  view.alpha_min = 1.0f / 255.0f, view.log2_alpha_min = std::log2(view.alpha_min), view.transmittance_min = 1e-4f;
  view.width = static_cast<int>(width), view.height = static_cast<int>(height);
  view.tiles_x = (view.width + kTile - 1) / kTile, view.tiles_y = (view.height + kTile - 1) / kTile;
  const Splats splats{static_cast<std::int64_t>(count), static_cast<int>(channels), inputs[0].data(), inputs[1].data(),
                      inputs[2].data(), inputs[3].data(), inputs[4].data(), nullptr, background.data()};

  for (const Kernels* kernels : runnable_kernels()) {
    char name[16] = {};
    std::strncpy(name, kernels->name, sizeof name - 1);
    std::fwrite(name, 1, sizeof name, out);
    std::vector<float> image(width * height * channels), alpha(width * height), gradients[5];
    std::vector<std::int32_t> radii(count);
    Frame frame(view, splats, {image.data(), alpha.data()}, radii.data(), *kernels, 2);
    for (int k = 0; k < 5; ++k) gradients[k].assign(count * fields[k], 0.0f);
    Gradients grads{};
    grads.image = on_image.data(), grads.alpha = on_alpha.data();
    grads.means = gradients[0].data(), grads.quats = gradients[1].data(), grads.scales = gradients[2].data();
    grads.opacities = gradients[3].data(), grads.colors = gradients[4].data();
    std::vector<float> background_gradient(channels);
    float view_gradient[kViewGradient];
    frame.backward(splats, grads, background_gradient.data(), view_gradient, 2);
    std::fwrite(image.data(), sizeof(float), image.size(), out);
    std::fwrite(alpha.data(), sizeof(float), alpha.size(), out);
    for (const std::vector<float>& gradient : gradients) std::fwrite(gradient.data(), sizeof(float), gradient.size(), out);
  }
  return std::fclose(out) ? 4 : 0;
}

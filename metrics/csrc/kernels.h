// What the kernels compute: plain data, shared by all instruction sets.
#pragma once

#include <cstdint>

namespace headbench::metrics {

constexpr int kChannels = 3;
constexpr int kRadiusMax = 7;

// What the window sees beyond the image.
enum class Border : int {
  kValid = 0,    // nothing: only windows that lie wholly inside count
  kReflect = 1,  // the image mirrored about its outermost pixels
  kZero = 2,     // black
};

// Two 8-bit images (height, width, 3) and any number of masks (height, width) that are not 0 inside.
struct Pair {
  const std::uint8_t* image;
  const std::uint8_t* reference;
  const std::uint8_t* masks;
  std::int64_t height, width, regions;
};

// A separable, symmetric window and the constants of the formula.
struct Form {
  double taps[kRadiusMax + 1];  // from the centre outwards
  int radius;
  Border border;
  double covariance_scale;  // what variances and covariance are multiplied by
  double c1, c2;
};

struct Kernels {
  const char* name;
  // Sum of the local similarities over windows and channels: first over the image, then over each region. False
  // where the memory for the working rows cannot be had.
  bool (*similarity)(const Pair&, const Form&, double* sums);
  // Sum of the squared differences of each channel (3,): first over the image, then over each region.
  void (*squared_error)(const Pair&, std::uint64_t* sums);
};

}  // namespace headbench::metrics

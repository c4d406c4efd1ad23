#include "hash_grid.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "bench/native/parallel.h"

namespace headbench::insta {

namespace {

struct Corners {
  std::int64_t row[8];
  float weight[8];
};

inline Corners corners(const float* position, const Level& level) {
  std::uint32_t cell[3];
  float part[3];
  for (int i = 0; i < 3; ++i) {
    const float scaled = position[i] * level.scale;
    const float below = std::floor(scaled);
    cell[i] = static_cast<std::uint32_t>(static_cast<std::int32_t>(below));
    part[i] = scaled - below;
  }
  const auto side = static_cast<std::uint64_t>(level.resolution);
  const auto rows = static_cast<std::uint64_t>(level.count);
  const bool dense = side * side * side <= rows;
  Corners found;
  for (int corner = 0; corner < 8; ++corner) {
    std::uint32_t at[3];
    float weight = 1;
    for (int i = 0; i < 3; ++i) {
      const bool upper = corner >> i & 1;
      at[i] = cell[i] + upper;
      weight *= upper ? part[i] : 1 - part[i];
    }
    std::uint64_t row;
    if (dense)
      row = (at[0] + side * (at[1] + side * at[2])) % rows;
    else
      row = (at[0] ^ at[1] * 2654435761u ^ at[2] * 805459861u) & (rows - 1);
    found.row[corner] = level.first + static_cast<std::int64_t>(row);
    found.weight[corner] = weight;
  }
  return found;
}

template <int Features>
void spread_level(const float* positions, std::int64_t count, const float* gradient, const Level& level,
                  std::int64_t stride, float* table_gradient) {
  for (std::int64_t point = 0; point < count; ++point) {
    const float* from = gradient + point * stride;
    const Corners found = corners(positions + 3 * point, level);
    for (int corner = 0; corner < 8; ++corner) {
      float* to = table_gradient + Features * found.row[corner];
      for (int f = 0; f < Features; ++f) to[f] += found.weight[corner] * from[f];
    }
  }
}

template <class Body>
void with_features(int features, Body body) {
  switch (features) {
    case 1: return body(std::integral_constant<int, 1>());
    case 2: return body(std::integral_constant<int, 2>());
    case 4: return body(std::integral_constant<int, 4>());
    case 8: return body(std::integral_constant<int, 8>());
    default: throw std::invalid_argument("a level has 1, 2, 4 or 8 features");
  }
}

}  // namespace

void encode(const Kernels& kernels, const float* positions, std::int64_t count, const float* table,
            const std::vector<Level>& levels, int features, float* out, int threads) {
  Field field{};
  field.level_count = static_cast<int>(levels.size());
  field.levels = levels.data();
  field.features = features;
  field.table = table;
  const std::int64_t width = features * static_cast<std::int64_t>(levels.size());
  const Scratch scratch(width * kGroupMax, threads);
  constexpr std::int64_t kPointsPerTask = 2048;
  parallel_for(count, kPointsPerTask, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
    kernels.encode(field, positions + 3 * begin, end - begin, out + begin * width, scratch.of(worker));
  });
}

void encode_backward(const float* positions, std::int64_t count, const float* gradient,
                     const std::vector<Level>& levels, int features, float* table_gradient, int threads) {
  const auto level_count = static_cast<std::int64_t>(levels.size());
  with_features(features, [&](auto size) {
    parallel_for(level_count, 1, threads, [&](std::int64_t task, std::int64_t) {
      // The finest levels, whose rows are the most scattered, take the longest: they go first.
      const std::int64_t number = level_count - 1 - task;
      constexpr int kFeatures = decltype(size)::value;
      spread_level<kFeatures>(positions, count, gradient + kFeatures * number, levels[number],
                              level_count * kFeatures, table_gradient);
    });
  });
}

}  // namespace headbench::insta

// The colour network: directions and their encoding one splat per lane, the layers a few splats at a time.
#pragma once

#include "avatar.h"
#include "directions.h"
#include "layers.h"

namespace headbench::HEADBENCH_ISA {

constexpr int kBatch = W > kSplatGroup ? W : kSplatGroup;

// Sine and cosine of numbers in [-1, 1]: Taylor series, whose next terms are below 2e-10.
HEADBENCH_INLINE void sine_cosine(Real x, Real& sine, Real& cosine) {
  const Real square = x * x;
  sine = fma(square, -1.0f / 39916800.0f, 1.0f / 362880.0f);
  sine = fma(square, sine, -1.0f / 5040.0f);
  sine = fma(square, sine, 1.0f / 120.0f);
  sine = fma(square, sine, -1.0f / 6.0f);
  sine = fma(square * sine, x, x);
  cosine = fma(square, 1.0f / 479001600.0f, -1.0f / 3628800.0f);
  cosine = fma(square, cosine, 1.0f / 40320.0f);
  cosine = fma(square, cosine, -1.0f / 720.0f);
  cosine = fma(square, cosine, 1.0f / 24.0f);
  cosine = fma(square, cosine, -0.5f);
  cosine = fma(square, cosine, 1.0f);
}

// The encoding of ours_inference.py, `encode_columns`, for the W splats in one column of `out`.
HEADBENCH_INLINE void encode(const Real* direction, float* out) {
  constexpr int kFrequencies = (kEncoding - 3) / 6;
  for (int k = 0; k < 3; ++k) {
    store(out + k * kBatch, direction[k]);
    Real sine, cosine;
    sine_cosine(direction[k], sine, cosine);
    for (int n = 0; n < kFrequencies; ++n) {
      store(out + (3 + 6 * n + k) * kBatch, sine);
      store(out + (6 + 6 * n + k) * kBatch, cosine);
      // sin 2a = 2 sin a cos a, cos 2a = 1 - 2 sin^2 a.
      const Real twice = sine + sine, next = twice * cosine;
      cosine = fnma(twice, sine, 1.0f);
      sine = next;
    }
  }
}

inline std::size_t color_scratch(int hidden) { return static_cast<std::size_t>(kSplatGroup) * hidden; }

// Colours of splats [begin, end); `scratch` has color_scratch floats.
inline void color_network(const ColorNetwork& net, std::int64_t begin, std::int64_t end, float* scratch) {
  alignas(64) float encoded[kEncoding * kBatch] = {};
  std::int32_t rows[kEncoding];
  for (int k = 0; k < kEncoding; ++k) rows[k] = k;
  for (std::int64_t first = begin; first < end; first += kBatch) {
    for (int offset = 0; offset < kBatch && first + offset < end; offset += W) {
      Real direction[3];
      directions_from(net.center, net.means, net.turns, net.binding, first + offset,
                      lanes_used(first + offset, end), direction);
      for (int k = 0; k < 3; ++k) direction[k] = Real(0.0f) - direction[k];
      encode(direction, encoded + offset);
    }
    for (int offset = 0; offset < kBatch && first + offset < end; offset += kSplatGroup) {
      const std::int64_t splat = first + offset;
      const int used = end - splat < kSplatGroup ? static_cast<int>(end - splat) : kSplatGroup;
      const float* starts[kSplatGroup];
      for (int s = 0; s < kSplatGroup; ++s) starts[s] = net.positions + (splat + (s < used ? s : 0)) * net.hidden;
      dense_layer(starts, net.second, net.hidden, encoded + offset, kBatch, rows, kEncoding, scratch);
      for (int channel = 0; channel < 3; ++channel) {
        float sums[kSplatGroup];
        dots(scratch, net.last + channel * net.hidden, net.hidden, sums);
        for (int s = 0; s < used; ++s) {
          const float color = 0.5f + 0.28209479177387814f * sums[s];
          net.colors[3 * (splat + s) + channel] = color > 0.0f ? color : 0.0f;
        }
      }
    }
  }
}

}  // namespace headbench::HEADBENCH_ISA

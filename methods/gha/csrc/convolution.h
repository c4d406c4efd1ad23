// 3x3 convolutions over strips of rows, with the normalisation over the image that follows them.
#pragma once

#include "products.h"

namespace headbench::HEADBENCH_ISA {

using gha::Convolution;

// Floats of a row in a strip: pixels padded to whole blocks, and one of zeros at either side.
HEADBENCH_INLINE std::ptrdiff_t row_floats(const Convolution& c, int channels) {
  return static_cast<std::ptrdiff_t>(c.width_stride + 2) * channels;
}

// A row of an image of (width, channels), `stride` apart, with zeros around it; all zeros for a row outside of the image.
inline void fill_row(const Convolution& c, const float* image, int y, int channels, int stride, float* out) {
  if (y < 0 || y >= c.height) {
    fill_zero(out, row_floats(c, stride));
    return;
  }
  fill_zero(out, stride);
  const float* from = image + static_cast<std::ptrdiff_t>(y) * c.width * channels;
  float* to = out + stride;
  if (channels == stride) {
    const std::ptrdiff_t all = static_cast<std::ptrdiff_t>(c.width) * channels;
    for (std::ptrdiff_t k = 0; k < all; k += W) store(to + k, load(from + k));
  } else {
    for (int x = 0; x < c.width; ++x) {
      for (int k = 0; k < channels; ++k) to[x * stride + k] = from[x * channels + k];
      for (int k = channels; k < stride; ++k) to[x * stride + k] = 0.0f;
    }
  }
  fill_zero(to + static_cast<std::ptrdiff_t>(c.width) * stride,
            static_cast<std::ptrdiff_t>(c.width_stride + 1 - c.width) * stride);
}

// Pixels of the row whose window's rows begin at `above`, `apart` floats from one to the next.
inline void convolve_row(const Convolution& c, const float* above, std::ptrdiff_t apart, int inputs, const float* weight,
                         int outputs, float* out) {
  Part parts[3];
  for (int dy = 0; dy < 3; ++dy)
    parts[dy] = {above + dy * apart, inputs, 1, weight + static_cast<std::ptrdiff_t>(dy) * 3 * inputs * outputs, outputs,
                 3 * inputs};
  product(parts, 3, c.width_stride, outputs, nullptr, 0, out, outputs);
}

inline void copy_row(const Convolution& c, const float* row, int stride, int channels, float* image, int y) {
  float* to = image + static_cast<std::ptrdiff_t>(y) * c.width * channels;
  if (channels == stride) {
    const std::ptrdiff_t all = static_cast<std::ptrdiff_t>(c.width) * channels;
    for (std::ptrdiff_t k = 0; k < all; k += W) store(to + k, load(row + k));
    return;
  }
  for (int x = 0; x < c.width; ++x)
    for (int k = 0; k < channels; ++k) to[x * channels + k] = row[x * stride + k];
}

inline std::size_t convolve_scratch(const Convolution& c, int rows) {
  return static_cast<std::size_t>(rows + 2) * row_floats(c, c.input_stride) +
         static_cast<std::size_t>(c.width_stride) * c.output_stride;
}

inline void convolve(const Convolution& c, int begin, int end, float* scratch) {
  const std::ptrdiff_t apart = row_floats(c, c.input_stride);
  float* out = scratch + (end - begin + 2) * apart;
  for (int y = begin - 1; y <= end; ++y)
    fill_row(c, c.values, y, c.inputs, c.input_stride, scratch + (y - begin + 1) * apart);
  const float share = 1.0f / static_cast<float>(c.width);
  for (int y = begin; y < end; ++y) {
    convolve_row(c, scratch + (y - begin) * apart, apart, c.input_stride, c.weight, c.output_stride, out);
    float* sums = c.row_sums + static_cast<std::ptrdiff_t>(y) * 2 * c.output_stride;
    for (int k = 0; k < c.output_stride; k += W) {
      Real sum = 0.0f, squares = 0.0f;
      for (int x = 0; x < c.width; ++x) sum = sum + load(out + x * c.output_stride + k);
      const Real mean = sum * Real(share);
      for (int x = 0; x < c.width; ++x) {
        const Real away = load(out + x * c.output_stride + k) - mean;
        squares = fma(away, away, squares);
      }
      store(sums + k, mean);
      store(sums + c.output_stride + k, squares);
    }
    copy_row(c, out, c.output_stride, c.outputs, c.raw, y);
  }
}

inline void normalise(const Convolution& c, int begin, int end) {
  const std::ptrdiff_t first = static_cast<std::ptrdiff_t>(begin) * c.width, last = static_cast<std::ptrdiff_t>(end) * c.width;
  for (std::ptrdiff_t pixel = first; pixel < last; ++pixel) {
    const float* from = c.raw + pixel * c.outputs;
    float* to = c.out + pixel * c.outputs;
    int k = 0;
    for (; k + W <= c.outputs; k += W)
      store(to + k, max((load(from + k) - load(c.mean + k)) * load(c.scale + k), 0.0f));
    for (; k < c.outputs; ++k) {
      const float value = (from[k] - c.mean[k]) * c.scale[k];
      to[k] = value > 0.0f ? value : 0.0f;
    }
  }
}

// A row of the normalised values, and of the gradient by them, zero where they are rectified; channels `output_stride` apart.
inline void gradient_row(const Convolution& c, int y, float* normalised, float* gradient) {
  const float* raw = c.raw + static_cast<std::ptrdiff_t>(y) * c.width * c.outputs;
  const float* by = c.by_out + static_cast<std::ptrdiff_t>(y) * c.width * c.outputs;
  for (int x = 0; x < c.width; ++x) {
    const std::ptrdiff_t from = static_cast<std::ptrdiff_t>(x) * c.outputs, to = static_cast<std::ptrdiff_t>(x) * c.output_stride;
    int k = 0;
    for (; k + W <= c.outputs; k += W) {
      const Real value = (load(raw + from + k) - load(c.mean + k)) * load(c.scale + k);
      store(normalised + to + k, value);
      store(gradient + to + k, zero_unless(value > Real(0.0f), load(by + from + k)));
    }
    for (; k < c.output_stride; ++k) {
      const bool known = k < c.outputs;
      const float value = known ? (raw[from + k] - c.mean[k]) * c.scale[k] : 0.0f;
      normalised[to + k] = value;
      gradient[to + k] = known && value > 0.0f ? by[from + k] : 0.0f;
    }
  }
}

inline void sum_gradients(const Convolution& c, int begin, int end) {
  for (int y = begin; y < end; ++y) {
    const float* raw = c.raw + static_cast<std::ptrdiff_t>(y) * c.width * c.outputs;
    const float* by = c.by_out + static_cast<std::ptrdiff_t>(y) * c.width * c.outputs;
    float* sums = c.row_sums + static_cast<std::ptrdiff_t>(y) * 2 * c.output_stride;
    int k = 0;
    for (; k + W <= c.outputs; k += W) {
      const Real mean = load(c.mean + k), scale = load(c.scale + k);
      Real sum = 0.0f, product = 0.0f;
      for (int x = 0; x < c.width; ++x) {
        const Real value = (load(raw + x * c.outputs + k) - mean) * scale;
        const Real gradient = zero_unless(value > Real(0.0f), load(by + x * c.outputs + k));
        sum = sum + gradient;
        product = fma(gradient, value, product);
      }
      store(sums + k, sum);
      store(sums + c.output_stride + k, product);
    }
    for (; k < c.output_stride; ++k) {
      float sum = 0.0f, product = 0.0f;
      if (k < c.outputs)
        for (int x = 0; x < c.width; ++x) {
          const float value = (raw[x * c.outputs + k] - c.mean[k]) * c.scale[k];
          const float gradient = value > 0.0f ? by[x * c.outputs + k] : 0.0f;
          sum += gradient;
          product += gradient * value;
        }
      sums[k] = sum;
      sums[c.output_stride + k] = product;
    }
  }
}

inline std::size_t convolve_backward_scratch(const Convolution& c, int rows) {
  const int wider = c.input_stride > c.output_stride ? c.input_stride : c.output_stride;
  return static_cast<std::size_t>(rows + 2) * (row_floats(c, c.input_stride) + row_floats(c, c.output_stride)) +
         static_cast<std::size_t>(c.width_stride) * wider;
}

inline void convolve_backward(const Convolution& c, int begin, int end, float* sums, float* scratch) {
  const int rows = end - begin + 2;
  const std::ptrdiff_t apart = row_floats(c, c.input_stride), by_apart = row_floats(c, c.output_stride);
  float *inputs = scratch, *by_raw = inputs + rows * apart, *out = by_raw + rows * by_apart;
  for (int y = begin - 1; y <= end; ++y) {
    fill_row(c, c.values, y, c.inputs, c.input_stride, inputs + (y - begin + 1) * apart);
    float* row = by_raw + (y - begin + 1) * by_apart;
    if (y < 0 || y >= c.height) {
      fill_zero(row, by_apart);
      continue;
    }
    fill_zero(row, c.output_stride);
    float* to = row + c.output_stride;
    gradient_row(c, y, out, to);
    for (int x = 0; x < c.width; ++x)
      for (int k = 0; k < c.output_stride; k += W) {
        const std::ptrdiff_t at = static_cast<std::ptrdiff_t>(x) * c.output_stride + k;
        const Real left = fnma(load(out + at), load(c.mean_by + c.output_stride + k), load(to + at) - load(c.mean_by + k));
        store(to + at, left * load(c.scale + k));
      }
    fill_zero(to + static_cast<std::ptrdiff_t>(c.width) * c.output_stride,
              static_cast<std::ptrdiff_t>(c.width_stride + 1 - c.width) * c.output_stride);
  }
  for (int y = begin; y < end; ++y) {
    const int at = y - begin;
    for (int dy = 0; dy < 3; ++dy) {
      float* to = sums + static_cast<std::ptrdiff_t>(dy) * 3 * c.input_stride * c.output_stride;
      const Part part = {inputs + (at + dy) * apart, 1, c.input_stride, by_raw + (at + 1) * by_apart + c.output_stride,
                         c.output_stride, c.width};
      product(&part, 1, 3 * c.input_stride, c.output_stride, to, c.output_stride, to, c.output_stride);
    }
    if (c.by_values) {
      convolve_row(c, by_raw + at * by_apart, by_apart, c.output_stride, c.turned, c.input_stride, out);
      copy_row(c, out, c.input_stride, c.inputs, c.by_values, y);
    }
  }
}

// ---- Colours of a residual image ----

using gha::Colors;
using gha::kUnitsStep;

inline std::size_t colors_scratch(const Colors& c) {
  return static_cast<std::size_t>(whole_units(c.width)) * (c.stride + kUnitsStep);
}

// A row's values, padded, and its last layer before alpha: (width, kUnitsStep), of which three count.
inline void last_layer(const Colors& c, int y, float* values, float* out) {
  const float* from = c.values + static_cast<std::ptrdiff_t>(y) * c.width * c.channels;
  const int padded = whole_units(c.width);
  for (int x = 0; x < c.width; ++x) {
    for (int k = 0; k < c.channels; ++k) values[x * c.stride + k] = from[x * c.channels + k];
    for (int k = c.channels; k < c.stride; ++k) values[x * c.stride + k] = 0.0f;
  }
  fill_zero(values + static_cast<std::ptrdiff_t>(c.width) * c.stride, static_cast<std::int64_t>(padded - c.width) * c.stride);
  const Part part = {values, c.stride, 1, c.weight, kUnitsStep, c.channels};
  product(&part, 1, padded, kUnitsStep, c.bias, 0, out, kUnitsStep);
}

inline void colors(const Colors& c, int begin, int end, float* scratch) {
  float *values = scratch, *last = scratch + static_cast<std::ptrdiff_t>(whole_units(c.width)) * c.stride;
  for (int y = begin; y < end; ++y) {
    last_layer(c, y, values, last);
    for (int x = 0; x < c.width; ++x) {
      const std::ptrdiff_t pixel = static_cast<std::ptrdiff_t>(y) * c.width + x;
      for (int k = 0; k < 3; ++k)
        c.image[3 * pixel + k] =
            c.near[pixel] ? c.plain[3 * pixel + k] + c.alpha[pixel] * last[x * kUnitsStep + k] : c.background[k];
    }
  }
}

inline void colors_backward(const Colors& c, int begin, int end, float* scratch) {
  float *values = scratch, *last = scratch + static_cast<std::ptrdiff_t>(whole_units(c.width)) * c.stride;
  for (int y = begin; y < end; ++y) {
    last_layer(c, y, values, last);
    float* sums = c.row_sums + static_cast<std::ptrdiff_t>(y) * 3 * (c.stride + 1);
    fill_zero(sums, 3 * (c.stride + 1));
    for (int x = 0; x < c.width; ++x) {
      const std::ptrdiff_t pixel = static_cast<std::ptrdiff_t>(y) * c.width + x;
      float by_last[3], by_alpha = 0.0f;
      for (int k = 0; k < 3; ++k) {
        const float by = c.near[pixel] ? c.by_image[3 * pixel + k] : 0.0f;
        c.by_plain[3 * pixel + k] = by;
        by_alpha += by * last[x * kUnitsStep + k];
        by_last[k] = c.alpha[pixel] * by;
        sums[k * (c.stride + 1) + c.stride] += by_last[k];
      }
      c.by_alpha[pixel] = by_alpha;
      float* by_values = c.by_values + pixel * c.channels;
      for (int channel = 0; channel < c.stride; channel += W) {
        Real by = 0.0f;
        const Real value = load(values + x * c.stride + channel);
        for (int k = 0; k < 3; ++k) {
          by = fma(load(c.rows + k * c.stride + channel), by_last[k], by);
          float* sum = sums + k * (c.stride + 1) + channel;
          store(sum, fma(value, by_last[k], load(sum)));
        }
        if (channel + W <= c.channels) {
          store(by_values + channel, by);
        } else {
          alignas(64) float lanes[W];
          store(lanes, by);
          for (int lane = 0; channel + lane < c.channels; ++lane) by_values[channel + lane] = lanes[lane];
        }
      }
    }
  }
}

}  // namespace headbench::HEADBENCH_ISA

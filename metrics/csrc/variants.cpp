// The loops for one instruction set; compiled once for each.
//
// The image is cut into strips of columns, so that the rows that a window needs stay in the first cache. A strip is
// processed from top to bottom: each row is filtered horizontally into a ring of rows, and as soon as the ring holds
// the height of the window, one row of local similarities follows from it. Samples of the three channels lie side
// by side; to the horizontal filter they are neighbours at a distance of three.
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>

#include "bench/native/simd_double.h"
#include "kernels.h"

namespace headbench::HEADBENCH_ISA {
namespace {

using namespace metrics;

constexpr int kStrip = 96;   // samples: a multiple of the channels and of the lanes
constexpr int kFields = 4;   // x, y, x^2 + y^2, x y: the two variances enter the formula by their sum alone

template <int Radius>
struct Strip {
  static constexpr int kMargin = kChannels * Radius;
  static constexpr int kRows = 2 * Radius + 1;

  alignas(64) double line[kFields][kStrip + 2 * kMargin + kDoubles];
  alignas(64) double ring[kRows][kFields][kStrip];
  alignas(64) double similarity[kStrip];

  // Samples [start, start + kStrip) of a row and the margins about them; zeros where there is nothing.
  void read(const Pair& pair, Border border, std::int64_t row, std::int64_t start) {
    const std::int64_t samples = pair.width * kChannels;
    const std::uint8_t* image = pair.image + row * samples;
    const std::uint8_t* reference = pair.reference + row * samples;
    alignas(64) std::uint8_t x[kStrip + 2 * kMargin + kDoubles] = {}, y[kStrip + 2 * kMargin + kDoubles] = {};
    const std::int64_t first = start - kMargin, last = start + kStrip + kMargin;
    const std::int64_t from = first < 0 ? 0 : first, to = last > samples ? samples : last;
    std::memcpy(x + (from - first), image + from, to - from);
    std::memcpy(y + (from - first), reference + from, to - from);
    if (border == Border::kReflect) {
      const auto mirror = [&](std::int64_t position) {
        std::int64_t pixel = (position + kMargin) / kChannels - Radius;  // rounds down for those left of the image
        const std::int64_t channel = position - pixel * kChannels;
        pixel = pixel < 0 ? -pixel : 2 * (pair.width - 1) - pixel;
        x[position - first] = image[pixel * kChannels + channel];
        y[position - first] = reference[pixel * kChannels + channel];
      };
      for (std::int64_t position = first; position < 0; ++position) mirror(position);
      const std::int64_t beyond = samples + kMargin;
      for (std::int64_t position = samples; position < beyond && position < last; ++position) mirror(position);
    }
    for (int i = 0; i < kStrip + 2 * kMargin; ++i) {
      const int a = x[i], b = y[i];
      line[0][i] = a;
      line[1][i] = b;
      line[2][i] = a * a + b * b;
      line[3][i] = a * b;
    }
  }

  void filter_line(const Form& form, double (*out)[kStrip]) const {
    Doubles taps[Radius + 1];
    for (int k = 0; k <= Radius; ++k) taps[k] = all(form.taps[k]);
    for (int field = 0; field < kFields; ++field) {
      const double* in = line[field] + kMargin;
      for (int i = 0; i < kStrip; i += kDoubles) {
        Doubles sum = taps[0] * load(in + i);
        for (int k = 1; k <= Radius; ++k)
          sum = sum + taps[k] * (load(in + i - kChannels * k) + load(in + i + kChannels * k));
        store(out[field] + i, sum);
      }
    }
  }

  // One row of similarities from the ring, whose oldest row is at `oldest`.
  void combine(const Form& form, int oldest) {
    const double(*rows[kRows])[kStrip];
    for (int k = 0; k < kRows; ++k) rows[k] = ring[(oldest + k) % kRows];
    Doubles taps[Radius + 1];
    for (int k = 0; k <= Radius; ++k) taps[k] = all(form.taps[k]);
    const Doubles c1 = all(form.c1), c2 = all(form.c2), scale = all(form.covariance_scale), two = all(2.0);
    for (int i = 0; i < kStrip; i += kDoubles) {
      Doubles mean[kFields];
      for (int field = 0; field < kFields; ++field) {
        mean[field] = taps[0] * load(rows[Radius][field] + i);
        for (int k = 1; k <= Radius; ++k)
          mean[field] = mean[field] +
                        taps[k] * (load(rows[Radius - k][field] + i) + load(rows[Radius + k][field] + i));
      }
      const Doubles product = mean[0] * mean[1];
      const Doubles squares = mean[0] * mean[0] + mean[1] * mean[1];
      const Doubles covariance = scale * (mean[3] - product);
      const Doubles variances = scale * (mean[2] - squares);
      store(similarity + i, ((two * product + c1) * (two * covariance + c2)) / ((squares + c1) * (variances + c2)));
    }
  }
};

template <int Radius>
bool similarity_of_radius(const Pair& pair, const Form& form, double* sums) {
  using Work = Strip<Radius>;
  const std::unique_ptr<Work> work(new (std::nothrow) Work);
  if (!work) return false;
  const bool valid = form.border == Border::kValid;
  const std::int64_t inset = valid ? Radius : 0;  // of the outermost window's centre
  const std::int64_t end = (pair.width - inset) * kChannels;
  for (std::int64_t region = 0; region <= pair.regions; ++region) sums[region] = 0.0;
  for (std::int64_t start = inset * kChannels; start < end; start += kStrip) {
    const int count = static_cast<int>(end - start < kStrip ? end - start : kStrip);
    Doubles total = all(0.0);
    for (std::int64_t row = inset - Radius; row < pair.height - inset + Radius; ++row) {
      const int slot = static_cast<int>((row + Radius) % Work::kRows);
      if (row >= 0 && row < pair.height) {
        work->read(pair, form.border, row, start);
        work->filter_line(form, work->ring[slot]);
      } else if (form.border == Border::kReflect) {
        work->read(pair, form.border, row < 0 ? -row : 2 * (pair.height - 1) - row, start);
        work->filter_line(form, work->ring[slot]);
      } else {
        std::memset(work->ring[slot], 0, sizeof work->ring[slot]);
      }
      const std::int64_t centre = row - Radius;
      if (centre < inset) continue;
      work->combine(form, (slot + 1) % Work::kRows);
      double* similarity = work->similarity;
      for (int i = count; i < kStrip; ++i) similarity[i] = 0.0;
      for (int i = 0; i < kStrip; i += kDoubles) total = total + load(similarity + i);
      for (std::int64_t region = 0; region < pair.regions; ++region) {
        const std::uint8_t* mask =
            pair.masks + (region * pair.height + centre) * pair.width + start / kChannels;
        double inside = 0.0;
        for (int pixel = 0; pixel < count / kChannels; ++pixel) {
          const double* of = similarity + kChannels * pixel;
          if (mask[pixel]) inside += of[0] + of[1] + of[2];
        }
        sums[region + 1] += inside;
      }
    }
    for (int lane = 0; lane < kDoubles; ++lane) sums[0] += total[lane];
  }
  return true;
}

bool similarity(const Pair& pair, const Form& form, double* sums) {
  switch (form.radius) {
    case 3:
      return similarity_of_radius<3>(pair, form, sums);
    case 5:
      return similarity_of_radius<5>(pair, form, sums);
    default:
      return similarity_of_radius<kRadiusMax>(pair, form, sums);
  }
}

void squared_error(const Pair& pair, std::uint64_t* sums) {
  constexpr int kBlock = 48;         // samples: a multiple of the channels and of 16 lanes
  constexpr int kBlocks = 1 << 16;   // as many squares of bytes as a 32-bit sum holds
  const std::int64_t samples = pair.height * pair.width * kChannels;
  for (std::int64_t i = 0; i < kChannels * (pair.regions + 1); ++i) sums[i] = 0;
  for (std::int64_t start = 0; start < samples;) {
    std::uint32_t lanes[kBlock] = {};
    for (int block = 0; block < kBlocks && start + kBlock <= samples; ++block, start += kBlock) {
      const std::uint8_t *image = pair.image + start, *reference = pair.reference + start;
      for (int i = 0; i < kBlock; ++i) {
        const int difference = static_cast<int>(image[i]) - static_cast<int>(reference[i]);
        lanes[i] += static_cast<std::uint32_t>(difference * difference);
      }
    }
    for (int i = 0; i < kBlock; ++i) sums[i % kChannels] += lanes[i];
    if (start + kBlock > samples)
      for (; start < samples; ++start) {
        const int difference = static_cast<int>(pair.image[start]) - static_cast<int>(pair.reference[start]);
        sums[start % kChannels] += static_cast<std::uint64_t>(difference * difference);
      }
  }
  for (std::int64_t region = 0; region < pair.regions; ++region) {
    const std::uint8_t* mask = pair.masks + region * pair.height * pair.width;
    std::uint64_t* inside = sums + kChannels * (region + 1);
    for (std::int64_t pixel = 0; pixel < pair.height * pair.width; ++pixel) {
      if (!mask[pixel]) continue;
      for (int channel = 0; channel < kChannels; ++channel) {
        const std::int64_t i = kChannels * pixel + channel;
        const int difference = static_cast<int>(pair.image[i]) - static_cast<int>(pair.reference[i]);
        inside[channel] += static_cast<std::uint64_t>(difference * difference);
      }
    }
  }
}

}  // namespace

extern const Kernels kernels;
const Kernels kernels{HEADBENCH_ISA_NAME, &similarity, &squared_error};

}  // namespace headbench::HEADBENCH_ISA

// Products of small matrices whose sums stay in registers.
#pragma once

#include "passes.h"

namespace headbench::HEADBENCH_ISA {

static_assert(gha::kUnitsStep % W == 0);

// A part of a sum of products: left[r row + k step] right[k stride + c], over k below `count`.
struct Part {
  const float* left;
  int row, step;
  const float* right;
  int stride, count;
};

// Rows r and vectors of columns c of out[r][c] = start[r][c] + the sums of all parts; no start counts as zero.
template <int rows, int vectors>
HEADBENCH_INLINE void block(const Part* parts, int part_count, int first_row, int first_column, const float* start,
                            int start_stride, float* out, int out_stride) {
  Real sums[rows][vectors];
  for (int r = 0; r < rows; ++r)
    for (int v = 0; v < vectors; ++v)
      sums[r][v] = start ? load(start + (first_row + r) * static_cast<std::ptrdiff_t>(start_stride) + first_column + v * W)
                         : Real(0.0f);
  for (int p = 0; p < part_count; ++p) {
    const Part& part = parts[p];
    const std::ptrdiff_t row = part.row, step = part.step, stride = part.stride;
    const float* right = part.right + first_column;
    const float* left[(rows + 3) / 4];
    for (int r = 0; r < rows; r += 4) left[r / 4] = part.left + (first_row + r) * row;
    for (int k = 0; k < part.count; ++k) {
      Real factors[vectors];
      for (int v = 0; v < vectors; ++v) factors[v] = load(right + v * W);
      for (int r = 0; r < rows; ++r) {
        const Real value = left[r / 4][(r % 4) * row];
        for (int v = 0; v < vectors; ++v) sums[r][v] = fma(value, factors[v], sums[r][v]);
      }
      right += stride;
      for (int r = 0; r < rows; r += 4) left[r / 4] += step;
    }
  }
  for (int r = 0; r < rows; ++r)
    for (int v = 0; v < vectors; ++v)
      store(out + (first_row + r) * static_cast<std::ptrdiff_t>(out_stride) + first_column + v * W, sums[r][v]);
}

template <int rows, int vectors>
inline void blocks(const Part* parts, int part_count, int all_rows, int first_column, const float* start,
                   int start_stride, float* out, int out_stride) {
  for (int row = 0; row < all_rows; row += rows)
    block<rows, vectors>(parts, part_count, row, first_column, start, start_stride, out, out_stride);
}

// All rows and columns of it, multiples of kUnitsStep.
inline void product(const Part* parts, int part_count, int rows, int columns, const float* start, int start_stride,
                    float* out, int out_stride) {
  int column = 0;
  if constexpr (W == 16) {
    for (; column + 4 * W <= columns; column += 4 * W)
      blocks<4, 4>(parts, part_count, rows, column, start, start_stride, out, out_stride);
    for (; column + 2 * W <= columns; column += 2 * W)
      blocks<8, 2>(parts, part_count, rows, column, start, start_stride, out, out_stride);
    for (; column < columns; column += W)
      blocks<16, 1>(parts, part_count, rows, column, start, start_stride, out, out_stride);
  } else {
    for (; column < columns; column += 2 * W)
      blocks<4, 2>(parts, part_count, rows, column, start, start_stride, out, out_stride);
  }
}

HEADBENCH_INLINE int whole_units(int count) { return (count + gha::kUnitsStep - 1) / gha::kUnitsStep * gha::kUnitsStep; }

inline void fill_zero(float* to, std::int64_t count) {
  for (std::int64_t k = 0; k < count; ++k) to[k] = 0.0f;
}

inline void add(float* to, const float* from, std::size_t count) {
  std::size_t k = 0;
  for (; k + W <= count; k += W) store(to + k, load(to + k) + load(from + k));
  for (; k < count; ++k) to[k] += from[k];
}

}  // namespace headbench::HEADBENCH_ISA

// Multi-resolution hash encoding, forward and backward.
#pragma once

#include <vector>

#include "field.h"

namespace headbench::insta {

// (N, levels features) values at (N, 3) positions in [0, 1].
void encode(const Kernels& kernels, const float* positions, std::int64_t count, const float* table,
            const std::vector<Level>& levels, int features, float* out, int threads);

// Add the gradient by the table. Every level belongs to one thread, so sums do not depend on their number.
void encode_backward(const float* positions, std::int64_t count, const float* gradient,
                     const std::vector<Level>& levels, int features, float* table_gradient, int threads);

}  // namespace headbench::insta

// Frames of triangles, one triangle per lane; the formulas of binding.py, `triangle_frames`, and of rotations.py,
// `matrix_to_quaternion`.
#pragma once

#include "avatar.h"
#include "gathered.h"

namespace headbench::HEADBENCH_ISA {

// Divides by the length, 1e-10 at least, and gives it.
HEADBENCH_INLINE Real normalise3(Real* a) {
  const Real length = sqrt(max(dot3(a, a), 1e-20f));
  for (int k = 0; k < 3; ++k) a[k] = a[k] / length;
  return length;
}

// (w, x, y, z), w >= 0, of a rotation by rows.
HEADBENCH_INLINE void quaternion_of(const Real* r, Real* out) {
  const Real one = 1.0f, zero = 0.0f;
  const Real x = r[7] - r[5], y = r[2] - r[6], z = r[3] - r[1], p = r[1] + r[3], q = r[2] + r[6], s = r[5] + r[7];
  const Real diagonal[4] = {one + r[0] + r[4] + r[8], one + r[0] - r[4] - r[8], one - r[0] + r[4] - r[8],
                            one - r[0] - r[4] + r[8]};
  const Real rows[4][4] = {{diagonal[0], x, y, z}, {x, diagonal[1], p, q}, {y, p, diagonal[2], s}, {z, q, s, diagonal[3]}};
  Real largest = diagonal[0], square = zero;
  for (int k = 0; k < 4; ++k) out[k] = rows[0][k];
  for (int row = 1; row < 4; ++row) {
    const Mask above = diagonal[row] > largest;
    for (int k = 0; k < 4; ++k) out[k] = select(above, rows[row][k], out[k]);
    largest = max(diagonal[row], largest);
  }
  for (int k = 0; k < 4; ++k) square = fma(out[k], out[k], square);
  const Real length = sqrt(square);
  const Mask negative = zero > out[0];
  for (int k = 0; k < 4; ++k) out[k] = select(negative, zero - out[k], out[k]) / length;
}

inline void triangles(const Triangles& in, std::int64_t begin, std::int64_t end) {
  Gathered<9> corners, rotation;
  Gathered<3> center;
  Gathered<4> quaternion;
  Gathered<1> size;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    for (int lane = 0; lane < W; ++lane) {
      const std::int64_t* face = in.faces + 3 * (first + (lane < used ? lane : 0));
      for (int corner = 0; corner < 3; ++corner)
        for (int k = 0; k < 3; ++k) corners.values[3 * corner + k][lane] = in.vertices[3 * face[corner] + k];
    }
    Real along[3], side[3], normal[3], across[3], matrix[9], turn[4];
    for (int k = 0; k < 3; ++k) {
      along[k] = corners[3 + k] - corners[k];
      side[k] = corners[6 + k] - corners[k];
      center.keep(k, (corners[k] + corners[3 + k] + corners[6 + k]) / Real(3.0f));
    }
    const Real base = normalise3(along);
    cross3(along, side, normal);
    normalise3(normal);
    cross3(along, normal, across);
    normalise3(across);
    const Real height = dot3(across, side);
    size.keep(0, Real(0.5f) * (base + max(height, Real(0.0f) - height)));
    for (int row = 0; row < 3; ++row) {
      matrix[3 * row] = along[row];
      matrix[3 * row + 1] = normal[row];
      matrix[3 * row + 2] = across[row];
    }
    quaternion_of(matrix, turn);
    for (int k = 0; k < 9; ++k) rotation.keep(k, matrix[k]);
    for (int k = 0; k < 4; ++k) quaternion.keep(k, turn[k]);
    for (int lane = 0; lane < used; ++lane) {
      rotation.put(in.rotations + 9 * (first + lane), lane);
      center.put(in.centers + 3 * (first + lane), lane);
      size.put(in.sizes + first + lane, lane);
      quaternion.put(in.quaternions + 4 * (first + lane), lane);
    }
  }
}

}  // namespace headbench::HEADBENCH_ISA

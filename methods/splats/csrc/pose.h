// Frames of triangles, splats in world space, and their colours by spherical harmonics: one triangle or splat per lane.
#pragma once

#include "bench/native/spherical_harmonics.h"
#include "projection.h"

namespace headbench::HEADBENCH_ISA {

// Numbers of W rows side by side, component by component. Lanes beyond the last row hold a copy of the first.
template <int components>
struct Gathered {
  alignas(64) float values[components][W];

  HEADBENCH_INLINE void set(const float* row, int lane) {
    for (int k = 0; k < components; ++k) values[k][lane] = row[k];
  }
  HEADBENCH_INLINE void put(float* row, int lane) const {
    for (int k = 0; k < components; ++k) row[k] = values[k][lane];
  }
  HEADBENCH_INLINE Real operator[](int k) const { return load(values[k]); }
  HEADBENCH_INLINE void keep(int k, Real value) { store(values[k], value); }
};

HEADBENCH_INLINE int lanes_used(std::int64_t first, std::int64_t end) {
  return end - first < W ? static_cast<int>(end - first) : W;
}

// Divides by the length, whose square is taken as `least` at least, and gives it.
HEADBENCH_INLINE Real normalise3(Real* a, float least = 1e-20f) {
  const Real length = sqrt(max(dot3(a, a), least));
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
    Real along[3], side[3], normal[3], across[3], matrix[9], whole[4];
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
    quaternion_of(matrix, whole);
    for (int k = 0; k < 9; ++k) rotation.keep(k, matrix[k]);
    for (int k = 0; k < 4; ++k) quaternion.keep(k, whole[k]);
    for (int lane = 0; lane < used; ++lane) {
      rotation.put(in.rotations + 9 * (first + lane), lane);
      center.put(in.centers + 3 * (first + lane), lane);
      size.put(in.sizes + first + lane, lane);
      quaternion.put(in.quaternions + 4 * (first + lane), lane);
    }
  }
}

inline void turns(const Turns& in, std::int64_t begin, std::int64_t end) {
  Gathered<9> to, from, result;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    for (int lane = 0; lane < W; ++lane) {
      const std::int64_t triangle = 9 * (first + (lane < used ? lane : 0));
      to.set(in.to + triangle, lane);
      from.set(in.from + triangle, lane);
    }
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        result.keep(3 * i + j, fma(to[3 * i], from[3 * j], fma(to[3 * i + 1], from[3 * j + 1], to[3 * i + 2] * from[3 * j + 2])));
    for (int lane = 0; lane < used; ++lane) result.put(in.turns + 9 * (first + lane), lane);
  }
}

inline void to_world(const ToWorld& in, std::int64_t begin, std::int64_t end) {
  Gathered<9> rotation;
  Gathered<4> outer, quat;
  Gathered<3> center, mean, scale;
  Gathered<1> size;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    for (int lane = 0; lane < W; ++lane) {
      const std::int64_t splat = first + (lane < used ? lane : 0), triangle = in.binding[splat];
      rotation.set(in.rotations + 9 * triangle, lane);
      center.set(in.centers + 3 * triangle, lane);
      size.set(in.sizes + triangle, lane);
      outer.set(in.quaternions + 4 * triangle, lane);
      mean.set(in.means + 3 * splat, lane);
      quat.set(in.quats + 4 * splat, lane);
      scale.set(in.scales + 3 * splat, lane);
    }
    const Real k = size[0], x = mean[0], y = mean[1], z = mean[2];
    for (int row = 0; row < 3; ++row) {
      const Real rotated = fma(rotation[3 * row], x, fma(rotation[3 * row + 1], y, rotation[3 * row + 2] * z));
      mean.keep(row, fma(k, rotated, center[row]));
      scale.keep(row, k * scale[row]);
    }
    const Real a = outer[0], b = outer[1], c = outer[2], d = outer[3];
    const Real w = quat[0], i = quat[1], j = quat[2], l = quat[3];
    quat.keep(0, a * w - b * i - c * j - d * l);
    quat.keep(1, b * w + a * i - d * j + c * l);
    quat.keep(2, c * w + d * i + a * j - b * l);
    quat.keep(3, d * w - c * i + b * j + a * l);
    for (int lane = 0; lane < used; ++lane) {
      mean.put(in.world_means + 3 * (first + lane), lane);
      quat.put(in.world_quats + 4 * (first + lane), lane);
      scale.put(in.world_scales + 3 * (first + lane), lane);
    }
  }
}

// Unit vectors from `center` to the means of `used` splats from `first` on, rotated by those of their triangles if any.
HEADBENCH_INLINE void directions_from(const float* center, const float* means, const float* rotations,
                                      const std::int64_t* binding, std::int64_t first, int used, Real* direction) {
  Gathered<3> mean;
  Gathered<9> rotation;
  for (int lane = 0; lane < W; ++lane) {
    const std::int64_t splat = first + (lane < used ? lane : 0);
    mean.set(means + 3 * splat, lane);
    if (rotations) rotation.set(rotations + 9 * binding[splat], lane);
  }
  Real d[3];
  for (int k = 0; k < 3; ++k) d[k] = mean[k] - Real(center[k]);
  const Real square = max(fma(d[0], d[0], fma(d[1], d[1], d[2] * d[2])), 1e-24f), scale = Real(1.0f) / sqrt(square);
  for (int k = 0; k < 3; ++k) d[k] = d[k] * scale;
  for (int row = 0; row < 3; ++row)
    direction[row] =
        rotations ? fma(rotation[3 * row], d[0], fma(rotation[3 * row + 1], d[1], rotation[3 * row + 2] * d[2])) : d[row];
}

template <int degree>
inline void shade_degree(const Harmonics& in, std::int64_t begin, std::int64_t end) {
  constexpr int kCount = (degree + 1) * (degree + 1);
  static_assert(kHarmonicsBlock % W == 0);
  Gathered<3> color;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    Real d[3];
    directions_from(in.center, in.means, in.rotations, in.binding, first, used, d);
    Real basis[kCount > 1 ? kCount - 1 : 1];
    harmonics_basis<degree>(d[0], d[1], d[2], basis);
    const float* block = in.coefficients + first / kHarmonicsBlock * (3 * kCount * kHarmonicsBlock) + first % kHarmonicsBlock;
    for (int channel = 0; channel < 3; ++channel, block += kCount * kHarmonicsBlock) {
      Real sum = fma(load(block), 0.28209479177387814f, 0.5f);
      for (int k = 1; k < kCount; ++k) sum = fma(load(block + k * kHarmonicsBlock), basis[k - 1], sum);
      color.keep(channel, max(sum, 0.0f));
    }
    for (int lane = 0; lane < used; ++lane) color.put(in.colors + 3 * (first + lane), lane);
  }
}

// `begin` is a multiple of kHarmonicsBlock.
inline void shade(const Harmonics& in, std::int64_t begin, std::int64_t end) {
  switch (in.degree) {
    case 0: return shade_degree<0>(in, begin, end);
    case 1: return shade_degree<1>(in, begin, end);
    case 2: return shade_degree<2>(in, begin, end);
    default: return shade_degree<3>(in, begin, end);
  }
}

}  // namespace headbench::HEADBENCH_ISA

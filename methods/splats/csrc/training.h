// What training computes of splats beside the rasteriser, forward and backward: one triangle, splat or pixel per lane.
#pragma once

#include "pose.h"

namespace headbench::HEADBENCH_ISA {

// Triangles and splats.

// Gradients of a unit vector u = a / |a| by a: `length` is |a|, 1e-10 at least; where it was less, it is a constant.
HEADBENCH_INLINE void unit_backward(const Real* unit, Real length, const Real* gradient, Real* out) {
  const Real along = zero_unless(length > Real(1.0001e-10f), dot3(unit, gradient));
  for (int k = 0; k < 3; ++k) out[k] = (gradient[k] - along * unit[k]) / length;
}

// Gradients of a rotation by rows from that of its quaternion, which `quaternion_of` made; adds to `out`.
HEADBENCH_INLINE void quaternion_backward(const Real* r, const Real* quaternion, const Real* gradient, Real* out) {
  const Real one = 1.0f, zero = 0.0f, two = 2.0f;
  const Real diagonal[4] = {one + r[0] + r[4] + r[8], one + r[0] - r[4] - r[8], one - r[0] + r[4] - r[8],
                            one - r[0] - r[4] + r[8]};
  // Four times the square of the largest component, whose row was normalised, is the diagonal's entry there: the row's
  // length is four times that component, whose sign the quaternion may have flipped.
  Real largest = diagonal[0];
  for (int row = 1; row < 4; ++row) largest = max(largest, diagonal[row]);
  const Real length = two * sqrt(largest);
  Real along = zero;
  for (int k = 0; k < 4; ++k) along = fma(quaternion[k], gradient[k], along);
  Real g[4];
  for (int k = 0; k < 4; ++k) g[k] = (gradient[k] - along * quaternion[k]) / length;
  Real chosen = diagonal[0];
  Real row[4] = {one, zero, zero, zero};  // 1 at the row that was normalised, the first of equals
  for (int k = 1; k < 4; ++k) {
    const Mask above = diagonal[k] > chosen;
    for (int j = 0; j < 4; ++j) row[j] = select(above, j == k ? one : zero, row[j]);
    chosen = max(diagonal[k], chosen);
  }
  // The component of that row is positive before the sign of the real part is made so.
  Real own = zero;
  for (int k = 0; k < 4; ++k) own = fma(row[k], quaternion[k], own);
  const Real sign = select(zero > own, Real(-1.0f), one);
  for (int k = 0; k < 4; ++k) g[k] = sign * g[k];
  // Entries of the rows: {w, x, y, z}, {x, 1, p, q}, {y, p, 2, s}, {z, q, s, 3}.
  const Real w = row[0] * g[0], i = row[1] * g[1], j = row[2] * g[2], l = row[3] * g[3];
  const Real x = row[0] * g[1] + row[1] * g[0], y = row[0] * g[2] + row[2] * g[0], z = row[0] * g[3] + row[3] * g[0];
  const Real p = row[1] * g[2] + row[2] * g[1], q = row[1] * g[3] + row[3] * g[1], s = row[2] * g[3] + row[3] * g[2];
  out[0] = out[0] + (w + i - j - l);
  out[4] = out[4] + (w - i + j - l);
  out[8] = out[8] + (w - i - j + l);
  out[7] = out[7] + (x + s);
  out[5] = out[5] + (s - x);
  out[2] = out[2] + (y + q);
  out[6] = out[6] + (q - y);
  out[3] = out[3] + (z + p);
  out[1] = out[1] + (p - z);
}

// Gradients of the corners of triangles [begin, end).
inline void triangles_backward(const TrianglesBackward& in, std::int64_t begin, std::int64_t end) {
  Gathered<9> corners, by_rotation, by_corners;
  Gathered<3> by_center;
  Gathered<1> by_size;
  Gathered<4> by_quaternion;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    for (int lane = 0; lane < W; ++lane) {
      const std::int64_t triangle = first + (lane < used ? lane : 0);
      const std::int64_t* face = in.faces + 3 * triangle;
      for (int corner = 0; corner < 3; ++corner)
        for (int k = 0; k < 3; ++k) corners.values[3 * corner + k][lane] = in.vertices[3 * face[corner] + k];
      by_rotation.set(in.by_rotations + 9 * triangle, lane);
      by_center.set(in.by_centers + 3 * triangle, lane);
      by_size.set(in.by_sizes + triangle, lane);
      by_quaternion.set(in.by_quaternions + 4 * triangle, lane);
    }
    Real along[3], side[3], normal[3], across[3];
    for (int k = 0; k < 3; ++k) {
      along[k] = corners[3 + k] - corners[k];
      side[k] = corners[6 + k] - corners[k];
    }
    const Real base = normalise3(along);
    cross3(along, side, normal);
    const Real normal_length = normalise3(normal);
    cross3(along, normal, across);
    const Real across_length = normalise3(across);
    Real rotation[9], quaternion[4], g_rotation[9], g_quaternion[4];
    for (int row = 0; row < 3; ++row) {
      rotation[3 * row] = along[row];
      rotation[3 * row + 1] = normal[row];
      rotation[3 * row + 2] = across[row];
    }
    quaternion_of(rotation, quaternion);
    for (int k = 0; k < 9; ++k) g_rotation[k] = by_rotation[k];
    for (int k = 0; k < 4; ++k) g_quaternion[k] = by_quaternion[k];
    quaternion_backward(rotation, quaternion, g_quaternion, g_rotation);

    const Real half_size = Real(0.5f) * by_size[0], height = dot3(across, side);
    const Real by_height = select(Real(0.0f) > height, Real(0.0f) - half_size, half_size);
    Real g_along[3], g_normal[3], g_across[3], g_side[3], g[3], product[3];
    for (int k = 0; k < 3; ++k) {
      g_along[k] = g_rotation[3 * k];
      g_normal[k] = g_rotation[3 * k + 1];
      g_across[k] = fma(by_height, side[k], g_rotation[3 * k + 2]);
      g_side[k] = by_height * across[k];
    }
    // The gradient of a x b by a is b x g, by b it is g x a.
    unit_backward(across, across_length, g_across, g);
    cross3(normal, g, product);
    for (int k = 0; k < 3; ++k) g_along[k] = g_along[k] + product[k];
    cross3(g, along, product);
    for (int k = 0; k < 3; ++k) g_normal[k] = g_normal[k] + product[k];
    unit_backward(normal, normal_length, g_normal, g);
    cross3(side, g, product);
    for (int k = 0; k < 3; ++k) g_along[k] = g_along[k] + product[k];
    cross3(g, along, product);
    for (int k = 0; k < 3; ++k) g_side[k] = g_side[k] + product[k];
    unit_backward(along, base, g_along, g);
    const Real by_base = zero_unless(base > Real(1.0001e-10f), half_size);
    for (int k = 0; k < 3; ++k) {
      const Real g_base = fma(by_base, along[k], g[k]), third = by_center[k] / Real(3.0f);
      by_corners.keep(k, third - g_base - g_side[k]);
      by_corners.keep(3 + k, third + g_base);
      by_corners.keep(6 + k, third + g_side[k]);
    }
    for (int lane = 0; lane < used; ++lane) by_corners.put(in.by_corners + 9 * (first + lane), lane);
  }
}

HEADBENCH_INLINE Real exponential(Real x) { return exp2(max(min(x * Real(kLog2e), Real(127.0f)), Real(-126.0f))); }

// Local splats [begin, end) as training holds them, prepared for `to_world`.
inline void activate(const Activation& in, std::int64_t begin, std::int64_t end) {
  Gathered<4> quat;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    for (int lane = 0; lane < W; ++lane) quat.set(in.quats + 4 * (first + (lane < used ? lane : 0)), lane);
    Real square = 0.0f;
    for (int k = 0; k < 4; ++k) square = fma(quat[k], quat[k], square);
    const Real length = sqrt(max(square, Real(1e-24f)));
    for (int k = 0; k < 4; ++k) quat.keep(k, quat[k] / length);
    for (int lane = 0; lane < used; ++lane) quat.put(in.unit_quats + 4 * (first + lane), lane);
  }
  alignas(64) float values[W];
  for (std::int64_t first = 3 * begin; first < 3 * end; first += W) {
    const int used = lanes_used(first, 3 * end);
    for (int lane = 0; lane < W; ++lane) values[lane] = in.log_scales[first + (lane < used ? lane : 0)];
    store(values, exponential(load(values)));
    for (int lane = 0; lane < used; ++lane) in.scales[first + lane] = values[lane];
  }
}

// Gradients of local splats [begin, end), and, where they are asked for, what each adds to those of its triangle.
inline void to_world_backward(const ToWorldBackward& in, std::int64_t begin, std::int64_t end) {
  Gathered<9> rotation;
  Gathered<4> outer, quat, by_quat;
  Gathered<3> mean, scale, by_mean, by_scale;
  Gathered<1> size;
  Gathered<kFrameNumbers> by_frame;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    for (int lane = 0; lane < W; ++lane) {
      const std::int64_t splat = first + (lane < used ? lane : 0), triangle = in.splats.binding[splat];
      rotation.set(in.splats.rotations + 9 * triangle, lane);
      size.set(in.splats.sizes + triangle, lane);
      outer.set(in.splats.quaternions + 4 * triangle, lane);
      mean.set(in.splats.means + 3 * splat, lane);
      quat.set(in.splats.quats + 4 * splat, lane);
      scale.set(in.splats.scales + 3 * splat, lane);
      by_mean.set(in.by_means + 3 * splat, lane);
      by_quat.set(in.by_quats + 4 * splat, lane);
      by_scale.set(in.by_scales + 3 * splat, lane);
    }
    const Real k = size[0];
    Real g[3], m[3], r[9], local[3], by_size = 0.0f;
    for (int i = 0; i < 9; ++i) r[i] = rotation[i];
    for (int i = 0; i < 3; ++i) {
      g[i] = by_mean[i];
      m[i] = mean[i];
    }
    for (int row = 0; row < 3; ++row) {
      const Real rotated = fma(r[3 * row], m[0], fma(r[3 * row + 1], m[1], r[3 * row + 2] * m[2]));
      by_size = fma(g[row], rotated, by_size);
      for (int column = 0; column < 3; ++column) by_frame.keep(3 * row + column, k * g[row] * m[column]);
      by_frame.keep(9 + row, g[row]);
    }
    for (int column = 0; column < 3; ++column)
      local[column] = k * fma(r[column], g[0], fma(r[3 + column], g[1], r[6 + column] * g[2]));
    for (int i = 0; i < 3; ++i) {
      mean.keep(i, local[i]);
      by_size = fma(by_scale[i], scale[i], by_size);
      scale.keep(i, by_scale[i] * k * scale[i]);
    }
    by_frame.keep(12, by_size);

    const Real a = outer[0], b = outer[1], c = outer[2], d = outer[3];
    const Real gw = by_quat[0], gi = by_quat[1], gj = by_quat[2], gl = by_quat[3];
    Real square = 0.0f;
    for (int i = 0; i < 4; ++i) square = fma(quat[i], quat[i], square);
    const Real length = sqrt(max(square, Real(1e-24f)));
    const Real w = quat[0] / length, i = quat[1] / length, j = quat[2] / length, l = quat[3] / length;
    // conj(outer) gradient, and gradient conj(unit).
    const Real by_unit[4] = {a * gw + b * gi + c * gj + d * gl, a * gi - b * gw + d * gj - c * gl,
                             a * gj - c * gw - d * gi + b * gl, a * gl - d * gw + c * gi - b * gj};
    by_frame.keep(13, gw * w + gi * i + gj * j + gl * l);
    by_frame.keep(14, gi * w - gw * i - gj * l + gl * j);
    by_frame.keep(15, gj * w - gw * j + gi * l - gl * i);
    by_frame.keep(16, gl * w - gw * l - gi * j + gj * i);
    const Real unit[4] = {w, i, j, l};
    Real along = 0.0f;
    for (int n = 0; n < 4; ++n) along = fma(unit[n], by_unit[n], along);
    along = zero_unless(square > Real(1e-24f), along);
    for (int n = 0; n < 4; ++n) quat.keep(n, (by_unit[n] - along * unit[n]) / length);
    for (int lane = 0; lane < used; ++lane) {
      mean.put(in.by_local_means + 3 * (first + lane), lane);
      scale.put(in.by_log_scales + 3 * (first + lane), lane);
      quat.put(in.by_raw_quats + 4 * (first + lane), lane);
      if (in.by_frames) by_frame.put(in.by_frames + kFrameNumbers * (first + lane), lane);
    }
  }
}

// Spherical harmonics.

// Gradients of a direction, from those of `harmonics_basis`.
template <int degree>
HEADBENCH_INLINE void harmonics_basis_backward(Real x, Real y, Real z, const Real* g, Real* out) {
  Real by_x = 0.0f, by_y = 0.0f, by_z = 0.0f;
  if constexpr (degree >= 1) {
    const Real c = 0.4886025119029199f;
    by_y = Real(0.0f) - c * g[0];
    by_z = c * g[1];
    by_x = Real(0.0f) - c * g[2];
  }
  if constexpr (degree >= 2) {
    const Real c = 1.0925484305920792f, two = 2.0f;
    const Real e = Real(0.31539156525252005f) * two * g[5], h = Real(0.5462742152960396f) * two * g[7];
    by_x = by_x + c * (y * g[3] - z * g[6]) + x * (h - e);
    by_y = by_y + c * (x * g[3] - z * g[4]) - y * (e + h);
    by_z = by_z - c * (y * g[4] + x * g[6]) + two * z * e;
    if constexpr (degree >= 3) {
      const Real c0 = -0.5900435899266435f, c2 = -0.4570457994644658f, c1 = 2.890611442640554f;
      const Real c3 = 0.3731763325901154f, c4 = 1.445305721320277f;
      const Real three = 3.0f, four = 4.0f, six = 6.0f, eight = 8.0f;
      const Real xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
      by_x = by_x + c0 * (six * xy * g[8] + three * (xx - yy) * g[14]) + c1 * yz * g[9] - c2 * two * xy * g[10] -
             c3 * six * xz * g[11] + c2 * (four * zz - three * xx - yy) * g[12] + c4 * two * xz * g[13];
      by_y = by_y + c0 * (three * (xx - yy) * g[8] - six * xy * g[14]) + c1 * xz * g[9] +
             c2 * (four * zz - xx - three * yy) * g[10] - c3 * six * yz * g[11] - c2 * two * xy * g[12] -
             c4 * two * yz * g[13];
      by_z = by_z + c1 * xy * g[9] + c2 * eight * (yz * g[10] + xz * g[12]) +
             c3 * three * (two * zz - xx - yy) * g[11] + c4 * (xx - yy) * g[13];
    }
  }
  out[0] = by_x;
  out[1] = by_y;
  out[2] = by_z;
}

// Unit vectors of W vectors, and their lengths.
HEADBENCH_INLINE Real direction_of(const Gathered<3>& vector, Real* direction) {
  for (int k = 0; k < 3; ++k) direction[k] = vector[k];
  return normalise3(direction, 1e-24f);
}

template <int degree>
inline void harmonics_degree(const TrainedHarmonics& in, std::int64_t begin, std::int64_t end) {
  constexpr int kUsed = (degree + 1) * (degree + 1) - 1;
  Gathered<3> vector, color;
  Gathered<kUsed ? kUsed : 1> rest;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    Real basis[kUsed ? kUsed : 1], direction[3];
    if constexpr (kUsed > 0) {
      for (int lane = 0; lane < W; ++lane) vector.set(in.vectors + 3 * (first + (lane < used ? lane : 0)), lane);
      direction_of(vector, direction);
      harmonics_basis<degree>(direction[0], direction[1], direction[2], basis);
    }
    for (int lane = 0; lane < W; ++lane) color.set(in.dc + 3 * (first + (lane < used ? lane : 0)), lane);
    for (int channel = 0; channel < 3; ++channel) {
      if constexpr (kUsed > 0)
        for (int lane = 0; lane < W; ++lane)
          rest.set(in.rest + (3 * (first + (lane < used ? lane : 0)) + channel) * in.stride, lane);
      Real sum = fma(color[channel], Real(0.28209479177387814f), Real(0.5f));
      for (int k = 0; k < kUsed; ++k) sum = fma(rest[k], basis[k], sum);
      color.keep(channel, max(sum, Real(0.0f)));
    }
    for (int lane = 0; lane < used; ++lane) color.put(in.colors + 3 * (first + lane), lane);
  }
}

template <int degree>
inline void harmonics_degree_backward(const TrainedHarmonics& in, std::int64_t begin, std::int64_t end) {
  constexpr int kUsed = (degree + 1) * (degree + 1) - 1;
  constexpr int kRoom = kUsed ? kUsed : 1;
  Gathered<3> vector, color, gradient, by_vector;
  Gathered<kRoom> rest, by_rest;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = lanes_used(first, end);
    float* by_dc = in.by_dc + 3 * first;
    float* by_rows = in.by_rest + 3 * first * in.stride;
    for (int lane = 0; lane < W; ++lane) {
      color.set(in.colors + 3 * (first + (lane < used ? lane : 0)), lane);
      gradient.set(in.by_colors + 3 * (first + (lane < used ? lane : 0)), lane);
    }
    const Real zero = 0.0f;
    Real g[3], largest = zero;
    for (int channel = 0; channel < 3; ++channel) {
      g[channel] = zero_unless(color[channel] > zero, gradient[channel]);
      largest = max(largest, max(g[channel], zero - g[channel]));
    }
    if (!any(largest > zero)) {  // hidden splats lie together
      for (int i = 0; i < 3 * used; ++i) by_dc[i] = in.by_vectors[3 * first + i] = 0.0f;
      for (std::int64_t i = 0; i < 3 * used * in.stride; ++i) by_rows[i] = 0.0f;
      continue;
    }
    Real basis[kRoom], by_basis[kRoom], direction[3], length = 1.0f;
    if constexpr (kUsed > 0) {
      for (int lane = 0; lane < W; ++lane) vector.set(in.vectors + 3 * (first + (lane < used ? lane : 0)), lane);
      length = direction_of(vector, direction);
      harmonics_basis<degree>(direction[0], direction[1], direction[2], basis);
      for (int k = 0; k < kUsed; ++k) by_basis[k] = 0.0f;
    }
    for (int channel = 0; channel < 3; ++channel) {
      by_vector.keep(channel, Real(0.28209479177387814f) * g[channel]);
      for (int lane = 0; lane < used; ++lane) by_dc[3 * lane + channel] = by_vector.values[channel][lane];
      if constexpr (kUsed > 0) {
        for (int lane = 0; lane < W; ++lane)
          rest.set(in.rest + (3 * (first + (lane < used ? lane : 0)) + channel) * in.stride, lane);
        for (int k = 0; k < kUsed; ++k) {
          by_basis[k] = fma(g[channel], rest[k], by_basis[k]);
          by_rest.keep(k, g[channel] * basis[k]);
        }
        for (int lane = 0; lane < used; ++lane) by_rest.put(by_rows + (3 * lane + channel) * in.stride, lane);
      }
      for (int lane = 0; lane < used; ++lane)
        for (std::int64_t k = kUsed; k < in.stride; ++k) by_rows[(3 * lane + channel) * in.stride + k] = 0.0f;
    }
    if constexpr (kUsed > 0) {
      Real by_direction[3];
      harmonics_basis_backward<degree>(direction[0], direction[1], direction[2], by_basis, by_direction);
      const Real along = dot3(direction, by_direction);
      for (int k = 0; k < 3; ++k) by_vector.keep(k, (by_direction[k] - along * direction[k]) / length);
    } else {
      for (int k = 0; k < 3; ++k) by_vector.keep(k, Real(0.0f));
    }
    for (int lane = 0; lane < used; ++lane) by_vector.put(in.by_vectors + 3 * (first + lane), lane);
  }
}

template <bool backward>
inline void harmonics(const TrainedHarmonics& in, std::int64_t begin, std::int64_t end) {
  switch (in.degree) {
    case 0: return backward ? harmonics_degree_backward<0>(in, begin, end) : harmonics_degree<0>(in, begin, end);
    case 1: return backward ? harmonics_degree_backward<1>(in, begin, end) : harmonics_degree<1>(in, begin, end);
    case 2: return backward ? harmonics_degree_backward<2>(in, begin, end) : harmonics_degree<2>(in, begin, end);
    default: return backward ? harmonics_degree_backward<3>(in, begin, end) : harmonics_degree<3>(in, begin, end);
  }
}

// L1 and SSIM.

constexpr int kWindow = 11, kHalf = kWindow / 2;  // rows, and columns of three channels each
constexpr int kProducts = 5;                      // x, y, xx, yy, xy; going back: by their means' x, xx, xy

// Floats of a row with the window's reach of zeros at both ends, and a vector more.
inline std::size_t padded_row(int width) { return static_cast<std::size_t>(3 * (width + 2 * kHalf) + W + 15) / 16 * 16; }

inline std::size_t photometric_scratch(int width) {
  return padded_row(width) * (kProducts + kWindow * kProducts + 3 + kWindow * 3);
}

// Window along a row of `count` numbers; `row` points at its first one, with zeros on both sides.
HEADBENCH_INLINE void blur_row(const float* row, const float* window, int count, float* out) {
  for (int i = 0; i < count; i += W) {
    Real sum = Real(window[kHalf]) * load(row + i);
    for (int k = 1; k <= kHalf; ++k)
      sum = fma(Real(window[kHalf + k]), load(row + i - 3 * k) + load(row + i + 3 * k), sum);
    store(out + i, sum);
  }
}

// Window across the rows of a ring, centred on row `y`, at column `i`.
HEADBENCH_INLINE Real blur_column(const float* const* rows, const float* window, int i) {
  Real sum = Real(window[kHalf]) * load(rows[kHalf] + i);
  for (int k = 1; k <= kHalf; ++k)
    sum = fma(Real(window[kHalf + k]), load(rows[kHalf - k] + i) + load(rows[kHalf + k] + i), sum);
  return sum;
}

HEADBENCH_INLINE float sum_of(const float* values, int count) {
  Real sum = 0.0f;
  int i = 0;
  for (; i + W <= count; i += W) sum = sum + load(values + i);
  alignas(64) float lanes[W];
  store(lanes, sum);
  float total = 0.0f;
  for (int lane = 0; lane < W; ++lane) total += lanes[lane];
  for (; i < count; ++i) total += values[i];
  return total;
}

// Rows [begin, end) of the gradient, and the sums of |x - y| and SSIM of each; in one sweep down the image.
inline void photometric(const Photometric& in, int begin, int end, float* scratch) {
  const int count = 3 * in.width, margin = 3 * kHalf;
  const std::size_t stride = padded_row(in.width);
  float* products = scratch;                                   // kProducts rows
  float* blurred = products + kProducts * stride;              // kWindow x kProducts rows
  float* factors = blurred + kWindow * kProducts * stride;     // 3 rows
  float* blurred_factors = factors + 3 * stride;               // kWindow x 3 rows
  const std::size_t floats = photometric_scratch(in.width);
  for (std::size_t i = 0; i < floats; i += W) store(scratch + i, Real(0.0f));
  const Real c1 = 1e-4f, c2 = 9e-4f, one = 1.0f, two = 2.0f;
  const float numbers = static_cast<float>(count) * static_cast<float>(in.height);
  const Real by_l1 = (1.0f - in.ssim_weight) / numbers, by_ssim = -in.ssim_weight / numbers;
  const float* rows[kWindow];
  for (int y = begin - 2 * kHalf; y < end + 2 * kHalf; ++y) {
    const int slot = (y + 4 * kWindow) % kWindow;  // y is above -2 kWindow
    if (y >= 0 && y < in.height) {
      const float* x_row = in.image + static_cast<std::size_t>(y) * count;
      const float* y_row = in.truth + static_cast<std::size_t>(y) * count;
      float* out[kProducts];
      for (int k = 0; k < kProducts; ++k) out[k] = products + k * stride + margin;
      int i = 0;
      for (; i + W <= count; i += W) {
        const Real a = load(x_row + i), b = load(y_row + i);
        store(out[0] + i, a);
        store(out[1] + i, b);
        store(out[2] + i, a * a);
        store(out[3] + i, b * b);
        store(out[4] + i, a * b);
      }
      for (; i < count; ++i) {
        const float a = x_row[i], b = y_row[i];
        out[0][i] = a;
        out[1][i] = b;
        out[2][i] = a * a;
        out[3][i] = b * b;
        out[4][i] = a * b;
      }
      for (int k = 0; k < kProducts; ++k) blur_row(out[k], in.window, count, blurred + (slot * kProducts + k) * stride);
    } else {
      for (std::size_t i = 0; i < kProducts * stride; i += W) store(blurred + slot * kProducts * stride + i, Real(0.0f));
    }

    const int center = y - kHalf;
    if (center < begin - kHalf) continue;
    const int factor_slot = (center + 4 * kWindow) % kWindow;
    if (center >= 0 && center < in.height) {
      for (int k = 0; k < kWindow; ++k)
        rows[k] = blurred + (center - kHalf + k + 4 * kWindow) % kWindow * kProducts * stride;
      float* ssim_row = blurred_factors + factor_slot * 3 * stride;  // overwritten below
      for (int i = 0; i < count; i += W) {
        Real value[kProducts];
        for (int k = 0; k < kProducts; ++k)
          value[k] = blur_column(rows, in.window, static_cast<int>(k * stride) + i);
        const Real product = value[0] * value[1], squares = value[0] * value[0] + value[1] * value[1];
        const Real luminance_top = two * product + c1, structure_top = two * (value[4] - product) + c2;
        const Real luminance_bottom = squares + c1, structure_bottom = (value[2] + value[3] - squares) + c2;
        const Real inverse = one / (luminance_bottom * structure_bottom);
        const Real ssim = luminance_top * structure_top * inverse;
        store(ssim_row + i, ssim);
        // Derivatives of SSIM by the three blurred planes that contain the image: E[x], E[x^2], E[xy].
        const Real relative = ssim / structure_bottom;
        store(factors + margin + i, two * value[1] * (structure_top - luminance_top) * inverse +
                                        two * value[0] * (relative - ssim / luminance_bottom));
        store(factors + stride + margin + i, Real(0.0f) - relative);
        store(factors + 2 * stride + margin + i, two * luminance_top * inverse);
      }
      if (center >= begin && center < end) in.row_ssim[center] = sum_of(ssim_row, count);
      for (int k = 0; k < 3; ++k) {
        float* row = factors + k * stride + margin;
        for (int i = count; i < count + margin; ++i) row[i] = 0.0f;  // a vector's rest lies beyond the image
        blur_row(row, in.window, count, blurred_factors + (factor_slot * 3 + k) * stride);
      }
    } else {
      for (std::size_t i = 0; i < 3 * stride; i += W) store(blurred_factors + factor_slot * 3 * stride + i, Real(0.0f));
    }

    const int row = center - kHalf;
    if (row < begin) continue;
    for (int k = 0; k < kWindow; ++k)
      rows[k] = blurred_factors + (row - kHalf + k + 4 * kWindow) % kWindow * 3 * stride;
    const float* x_row = in.image + static_cast<std::size_t>(row) * count;
    const float* y_row = in.truth + static_cast<std::size_t>(row) * count;
    float* out = in.gradient + static_cast<std::size_t>(row) * count;
    float* difference = products;
    alignas(64) float a[W], b[W], g[W];
    for (int i = 0; i < count; i += W) {
      const int used = count - i < W ? count - i : W;
      if (used < W)
        for (int lane = 0; lane < W; ++lane) {
          a[lane] = lane < used ? x_row[i + lane] : 0.0f;
          b[lane] = lane < used ? y_row[i + lane] : 0.0f;
        }
      const Real x = load(used < W ? a : x_row + i), t = load(used < W ? b : y_row + i), gap = x - t, size = max(gap, Real(0.0f) - gap);
      store(difference + i, size);
      const Real sign = zero_unless(size > Real(0.0f), select(gap > Real(0.0f), one, Real(-1.0f)));
      const Real back = blur_column(rows, in.window, i) + two * x * blur_column(rows, in.window, static_cast<int>(stride) + i) +
                        t * blur_column(rows, in.window, static_cast<int>(2 * stride) + i);
      store(used < W ? g : out + i, fma(by_ssim, back, by_l1 * sign));
      if (used < W)
        for (int lane = 0; lane < used; ++lane) out[i + lane] = g[lane];
    }
    in.row_l1[row] = sum_of(difference, count);
    for (std::size_t i = 0; i < stride; i += W) store(products + i, Real(0.0f));
  }
}

}  // namespace headbench::HEADBENCH_ISA

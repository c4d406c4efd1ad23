// Splats of a pose from canonical points, one to a lane.
#pragma once

#include "passes.h"
#include "perceptron.h"

namespace headbench::HEADBENCH_ISA {

using gha::Posing;

// Numbers of W rows side by side, component by component. Lanes beyond the last row hold copies of the first.
template <int components>
struct Columns {
  alignas(64) float values[components][W];

  HEADBENCH_INLINE void read(const float* table, std::int64_t first, int used) {
    for (int lane = 0; lane < W; ++lane) {
      const float* row = table + components * (first + (lane < used ? lane : 0));
      for (int k = 0; k < components; ++k) values[k][lane] = row[k];
    }
  }
  HEADBENCH_INLINE void write(float* table, std::int64_t first, int used) const {
    for (int lane = 0; lane < used; ++lane)
      for (int k = 0; k < components; ++k) table[components * (first + lane) + k] = values[k][lane];
  }
  HEADBENCH_INLINE Real operator[](int k) const { return load(values[k]); }
  HEADBENCH_INLINE void keep(int k, Real value) { store(values[k], value); }
};

HEADBENCH_INLINE Real exponential(Real x) { return exp2(min(max(x, -87.0f), 88.0f) * Real(kLog2e)); }

HEADBENCH_INLINE Real sigmoid(Real x) { return Real(1.0f) / (Real(1.0f) + exponential(Real(0.0f) - x)); }

inline void pose(const Posing& in, std::int64_t begin, std::int64_t end) {
  Columns<3> point, move, scale, mean;
  Columns<4> quat, turned;
  Columns<1> opacity;
  Columns<8> change;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = end - first < W ? static_cast<int>(end - first) : W;
    point.read(in.points, first, used);
    move.read(in.moves, first, used);
    scale.read(in.log_scales, first, used);
    quat.read(in.quats, first, used);
    opacity.read(in.opacities, first, used);
    change.read(in.changes, first, used);
    Real place[3], local[4];
    for (int k = 0; k < 3; ++k) place[k] = fma(move[k], in.displacement_scale, point[k]);
    for (int k = 0; k < 4; ++k) local[k] = fma(change[3 + k], in.attribute_scale, quat[k]);
    for (int k = 0; k < 3; ++k) {
      const float* row = in.rotation + 3 * k;
      const Real turned_place = fma(place[0], row[0], fma(place[1], row[1], place[2] * Real(row[2])));
      mean.keep(k, fma(turned_place, in.unit, in.translation[k]));
      scale.keep(k, Real(in.unit) * exponential(min(fma(change[k], in.attribute_scale, scale[k]), in.largest)));
    }
    for (int k = 0; k < 4; ++k) {
      const float* row = in.turn + 4 * k;
      turned.keep(k, fma(local[0], row[0], fma(local[1], row[1], fma(local[2], row[2], local[3] * Real(row[3])))));
    }
    opacity.keep(0, sigmoid(fma(change[7], in.attribute_scale, opacity[0])));
    mean.write(in.means, first, used);
    scale.write(in.scales, first, used);
    turned.write(in.world_quats, first, used);
    opacity.write(in.seen, first, used);
  }
}

HEADBENCH_INLINE float sum_of(Real value, int used) {
  alignas(64) float lanes[W];
  store(lanes, value);
  float sum = 0.0f;
  for (int lane = 0; lane < used; ++lane) sum += lanes[lane];
  return sum;
}

inline void pose_backward(const Posing& in, std::int64_t begin, std::int64_t end, float* sums) {
  Columns<3> point, move, scale, log_scale, by_mean, by_scale;
  Columns<4> quat, by_quat;
  Columns<1> seen, by_seen;
  Columns<8> change;
  Real totals[gha::kPosingSums];
  for (Real& total : totals) total = 0.0f;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = end - first < W ? static_cast<int>(end - first) : W;
    point.read(in.points, first, used);
    move.read(in.moves, first, used);
    log_scale.read(in.log_scales, first, used);
    quat.read(in.quats, first, used);
    change.read(in.changes, first, used);
    scale.read(in.scales, first, used);
    seen.read(in.seen, first, used);
    by_mean.read(in.by_means, first, used);
    by_scale.read(in.by_scales, first, used);
    by_quat.read(in.by_world_quats, first, used);
    by_seen.read(in.by_seen, first, used);
    if (used < W)  // copies of the first row must not count
      for (int lane = used; lane < W; ++lane) {
        for (int k = 0; k < 3; ++k) by_mean.values[k][lane] = 0.0f;
        for (int k = 0; k < 4; ++k) by_quat.values[k][lane] = 0.0f;
      }
    Real place[3], local[4];
    for (int k = 0; k < 3; ++k) place[k] = fma(move[k], in.displacement_scale, point[k]);
    for (int k = 0; k < 4; ++k) local[k] = fma(change[3 + k], in.attribute_scale, quat[k]);
    for (int i = 0; i < 3; ++i) {
      for (int k = 0; k < 3; ++k) totals[3 * i + k] = fma(by_mean[i] * Real(in.unit), place[k], totals[3 * i + k]);
      totals[9 + i] = totals[9 + i] + by_mean[i];
    }
    for (int i = 0; i < 4; ++i)
      for (int k = 0; k < 4; ++k) totals[12 + 4 * i + k] = fma(by_quat[i], local[k], totals[12 + 4 * i + k]);
    Real by_log_scale[3], by_local[4];
    for (int k = 0; k < 3; ++k) {
      const Real inside = fma(change[k], in.attribute_scale, log_scale[k]);
      by_log_scale[k] = select(inside > Real(in.largest), 0.0f, by_scale[k] * scale[k]);
      const Real by_place =
          Real(in.unit) * fma(by_mean[0], in.rotation[k], fma(by_mean[1], in.rotation[3 + k], by_mean[2] * Real(in.rotation[6 + k])));
      point.keep(k, by_place);
      move.keep(k, Real(in.displacement_scale) * by_place);
    }
    for (int k = 0; k < 4; ++k)
      by_local[k] = fma(by_quat[0], in.turn[k], fma(by_quat[1], in.turn[4 + k], fma(by_quat[2], in.turn[8 + k], by_quat[3] * Real(in.turn[12 + k]))));
    const Real by_opacity = by_seen[0] * seen[0] * (Real(1.0f) - seen[0]);
    for (int k = 0; k < 3; ++k) {
      log_scale.keep(k, by_log_scale[k]);
      change.keep(k, Real(in.attribute_scale) * by_log_scale[k]);
    }
    for (int k = 0; k < 4; ++k) {
      quat.keep(k, by_local[k]);
      change.keep(3 + k, Real(in.attribute_scale) * by_local[k]);
    }
    seen.keep(0, by_opacity);
    change.keep(7, Real(in.attribute_scale) * by_opacity);
    point.write(in.by_points, first, used);
    move.write(in.by_moves, first, used);
    log_scale.write(in.by_log_scales, first, used);
    quat.write(in.by_quats, first, used);
    seen.write(in.by_opacities, first, used);
    change.write(in.by_changes, first, used);
  }
  for (int k = 0; k < gha::kPosingSums; ++k) sums[k] = sum_of(totals[k], W);
}

inline void tanh_of(const float* values, std::int64_t begin, std::int64_t end, float* out) {
  std::int64_t k = begin;
  for (; k + W <= end; k += W) store(out + k, tanh(load(values + k)));
  if (k == end) return;
  alignas(64) float lanes[W] = {};
  for (std::int64_t i = k; i < end; ++i) lanes[i - k] = values[i];
  store(lanes, tanh(load(lanes)));
  for (std::int64_t i = k; i < end; ++i) out[i] = lanes[i - k];
}

inline void tanh_backward(const float* out, const float* by_out, std::int64_t begin, std::int64_t end, float* by_values) {
  for (std::int64_t k = begin; k < end; ++k) by_values[k] = by_out[k] * (1.0f - out[k] * out[k]);
}

}  // namespace headbench::HEADBENCH_ISA

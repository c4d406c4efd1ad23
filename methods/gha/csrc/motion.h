// The rigid motion of a head with its derivatives by a correction of rotation and translation: `Driver.motion` of driving.py.
#pragma once

#include <cmath>

namespace headbench::gha {

constexpr int kCorrection = 6;

// A number with its derivatives.
struct Dual {
  double value = 0, by[kCorrection] = {};
  Dual() = default;
  Dual(double constant) : value(constant) {}
};

// f(a) of value f and derivative f'; f(a, b) likewise.
inline Dual chained(double f, double by_a, const Dual& a, double by_b = 0, const Dual& b = {}) {
  Dual result = f;
  for (int k = 0; k < kCorrection; ++k) result.by[k] = by_a * a.by[k] + by_b * b.by[k];
  return result;
}
inline Dual operator+(const Dual& a, const Dual& b) { return chained(a.value + b.value, 1, a, 1, b); }
inline Dual operator-(const Dual& a, const Dual& b) { return chained(a.value - b.value, 1, a, -1, b); }
inline Dual operator*(const Dual& a, const Dual& b) { return chained(a.value * b.value, b.value, a, a.value, b); }
inline Dual operator/(const Dual& a, const Dual& b) {
  return chained(a.value / b.value, 1 / b.value, a, -a.value / (b.value * b.value), b);
}
inline Dual sqrt(const Dual& a) { return chained(std::sqrt(a.value), 0.5 / std::sqrt(a.value), a); }

// sin(t) / t of t^2.
inline Dual sinc(const Dual& squared) {
  const double s = squared.value;
  if (s < 0.04)  // the series of rotations.py, and its derivative
    return chained(1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72))),
                   -1.0 / 6 * (1 - s / 10 * (1 - s / 28 * (1 - s / 54))), squared);
  const double t = std::sqrt(s);
  return chained(std::sin(t) / t, 0.5 * (std::cos(t) - std::sin(t) / t) / s, squared);
}

// Rotation matrix of an axis-angle vector.
inline void rotation_of(const Dual* v, Dual* m) {
  const Dual squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], half = sinc(squared * 0.25);
  const Dual sine = sinc(squared), versine = half * half * 0.5;
  const Dual cross[9] = {0.0, Dual(0.0) - v[2], v[1], v[2], 0.0, Dual(0.0) - v[0], Dual(0.0) - v[1], v[0], 0.0};
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) {
      Dual square = 0.0;
      for (int j = 0; j < 3; ++j) square = square + cross[3 * i + j] * cross[3 * j + k];
      m[3 * i + k] = Dual(i == k) + sine * cross[3 * i + k] + versine * square;
    }
}

// (w, x, y, z), w >= 0: the longest row of 4 q q^T.
inline void quaternion_of(const Dual* r, Dual* out) {
  const Dual one = 1.0, x = r[7] - r[5], y = r[2] - r[6], z = r[3] - r[1];
  const Dual p = r[1] + r[3], q = r[2] + r[6], s = r[5] + r[7];
  const Dual diagonal[4] = {one + r[0] + r[4] + r[8], one + r[0] - r[4] - r[8], one - r[0] + r[4] - r[8],
                            one - r[0] - r[4] + r[8]};
  const Dual rows[4][4] = {{diagonal[0], x, y, z}, {x, diagonal[1], p, q}, {y, p, diagonal[2], s}, {z, q, s, diagonal[3]}};
  int row = 0;
  for (int k = 1; k < 4; ++k)
    if (diagonal[k].value > diagonal[row].value) row = k;
  Dual square = 0.0;
  for (const Dual& part : rows[row]) square = square + part * part;
  const Dual length = rows[row][0].value < 0 ? Dual(0.0) - sqrt(square) : sqrt(square);
  for (int k = 0; k < 4; ++k) out[k] = rows[row][k] / length;
}

// Axis-angle vector, at most half a turn, of a unit quaternion with w >= 0.
inline void axis_angle_of(const Dual* q, Dual* out) {
  const Dual squared = q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
  Dual factor;
  if (squared.value < 1e-3) {
    const Dual ratio = squared / (q[0] * q[0]);
    Dual series = Dual(1.0 / 9) - ratio / 11.0;
    for (const double term : {1.0 / 7, 1.0 / 5, 1.0 / 3, 1.0}) series = Dual(term) - ratio * series;
    factor = series * 2.0 / q[0];
  } else {
    const Dual sine = sqrt(squared);
    const double length = sine.value * sine.value + q[0].value * q[0].value;
    factor = chained(std::atan2(sine.value, q[0].value), q[0].value / length, sine, -sine.value / length, q[0]) * 2.0 / sine;
  }
  for (int k = 0; k < 3; ++k) out[k] = factor * q[1 + k];
}

constexpr int kMotion = 22;  // rotation, translation, code, quaternion

// `tracked` is rotation, neck, translation, root joint, neck joint and origin, three numbers each.
inline void head_motion(const double* tracked, const double* correction, Dual* out) {
  const double *neck_angles = tracked + 3, *shift = tracked + 6, *base = tracked + 9, *joint = tracked + 12, *origin = tracked + 15;
  Dual turn[3], bend[3], root[9], neck[9];
  for (int k = 0; k < 3; ++k) {
    turn[k] = tracked[k] + correction[k];
    turn[k].by[k] = 1;
    bend[k] = neck_angles[k];
  }
  rotation_of(turn, root);
  rotation_of(bend, neck);
  Dual *rotation = out, *translation = out + 9, *code = out + 12, *quaternion = out + 18;
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k)
      rotation[3 * i + k] = root[3 * i] * neck[k] + root[3 * i + 1] * neck[3 + k] + root[3 * i + 2] * neck[6 + k];
  for (int i = 0; i < 3; ++i) {
    Dual sum = base[i] + shift[i] + correction[3 + i];
    sum.by[3 + i] = 1;
    for (int k = 0; k < 3; ++k)
      sum = sum + root[3 * i + k] * (joint[k] - base[k]) + rotation[3 * i + k] * (origin[k] - joint[k]);
    translation[i] = code[3 + i] = sum;
  }
  quaternion_of(rotation, quaternion);
  axis_angle_of(quaternion, code);
}

}  // namespace headbench::gha

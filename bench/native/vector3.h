// Vectors of three floats. Functions are always inlined: code of every instruction set may use them, see simd.h.
#pragma once

#include <cstdint>

#include "inline.h"

namespace headbench {

struct Vec3 {
  float x, y, z;
};

HEADBENCH_INLINE Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
HEADBENCH_INLINE Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
HEADBENCH_INLINE Vec3 operator*(float s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
HEADBENCH_INLINE Vec3 operator*(Vec3 a, float s) { return s * a; }
HEADBENCH_INLINE float dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
HEADBENCH_INLINE Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

// Row of an (N, 3) array.
HEADBENCH_INLINE Vec3 row(const float* values, std::int64_t number) {
  return {values[3 * number], values[3 * number + 1], values[3 * number + 2]};
}

}  // namespace headbench

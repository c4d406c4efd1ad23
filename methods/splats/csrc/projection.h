// Projection of splats onto the image plane and its derivative, one splat per lane.
//
// The formulas are those of reference.py, `project`. The covariance is kept in factored form Q Qᵀ + eps I, its
// inverse as a triangular L with  log2 alpha = log2 opacity - u² - v²,  u = l11 dx + l21 dy,  v = l22 dy.
#pragma once

#include <math.h>

#include "bench/native/simd.h"
#include "scene.h"

namespace headbench::HEADBENCH_ISA {

constexpr float kSqrtHalfLog2e = 0.8493218002880191f;

// Floats per record.
constexpr int record_stride(int channels) {
  return (kGeometry + channels + kRecordUnit - 1) / kRecordUnit * kRecordUnit;
}

// W splats, component by component. Lanes without a splat hold a copy of the first.
struct SplatLanes {
  alignas(64) float mean[3][W], quat[4][W], scale[3][W], opacity[W], offset[2][W];
};

HEADBENCH_INLINE void load_lane(const Splats& splats, std::int64_t splat, int lane, SplatLanes& out) {
  for (int k = 0; k < 3; ++k) out.mean[k][lane] = splats.means[3 * splat + k];
  for (int k = 0; k < 4; ++k) out.quat[k][lane] = splats.quats[4 * splat + k];
  for (int k = 0; k < 3; ++k) out.scale[k][lane] = splats.scales[3 * splat + k];
  out.opacity[lane] = splats.opacities[splat];
  for (int k = 0; k < 2; ++k) out.offset[k][lane] = splats.offset ? splats.offset[2 * splat + k] : 0.0f;
}

// W splats' means as the camera sees them, in float64: splats are drawn in the order of z, and where float32 would make
// two of them equal, whole pixels would show the wrong one in front.
struct CameraLanes {
  alignas(64) double x[W], y[W], z[W], ratio_x[W], ratio_y[W];  // ratios to z
};

HEADBENCH_INLINE void to_camera(const Camera& view, const SplatLanes& in, CameraLanes& out) {
  double r[9], t[3];
  for (int k = 0; k < 9; ++k) r[k] = view.rotation[k];
  for (int k = 0; k < 3; ++k) t[k] = view.translation[k];
  for (int lane = 0; lane < W; ++lane) {
    const double x = in.mean[0][lane], y = in.mean[1][lane], z = in.mean[2][lane];
    out.x[lane] = r[0] * x + r[1] * y + r[2] * z + t[0];
    out.y[lane] = r[3] * x + r[4] * y + r[5] * z + t[1];
    out.z[lane] = r[6] * x + r[7] * y + r[8] * z + t[2];
  }
  for (int lane = 0; lane < W; ++lane) {
    const double inv_z = 1.0 / out.z[lane];
    out.ratio_x[lane] = out.x[lane] * inv_z;
    out.ratio_y[lane] = out.y[lane] * inv_z;
  }
}

HEADBENCH_INLINE Real load_rounded(const double* p) {
  alignas(64) float rounded[W];
  for (int lane = 0; lane < W; ++lane) rounded[lane] = static_cast<float>(p[lane]);
  return load(rounded);
}

// Every intermediate value the derivative needs.
struct Projection {
  Real mean[3], scale[3];
  Real inv_z, ratio_x, ratio_y;
  Real slope_x, slope_y;
  Mask free_x, free_y;  // slope not clamped
  Real quat[4], inv_norm;
  Mask normalised;  // quaternion long enough to be divided by its own norm
  Real rotation[9];
  Real axes[9];         // rotation times scales
  Real camera_axes[9];  // the same seen by the camera
  Real q0[3], q1[3];
  Real cross[3];  // q0 x q1
  Real area2;     // its square: the determinant without eps
  Real xx, xy, yy, det;
  Real l11, l21, l22;
};

HEADBENCH_INLINE void rotation_matrix(const Real* q, Real* r) {
  const Real w = q[0], x = q[1], y = q[2], z = q[3], two = 2.0f, one = 1.0f;
  r[0] = fnma(two, fma(y, y, z * z), one);
  r[1] = two * fnma(w, z, x * y);
  r[2] = two * fma(w, y, x * z);
  r[3] = two * fma(w, z, x * y);
  r[4] = fnma(two, fma(x, x, z * z), one);
  r[5] = two * fnma(w, x, y * z);
  r[6] = two * fnma(w, y, x * z);
  r[7] = two * fma(w, x, y * z);
  r[8] = fnma(two, fma(x, x, y * y), one);
}

HEADBENCH_INLINE Real dot3(const Real* a, const Real* b) { return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2])); }

HEADBENCH_INLINE void cross3(const Real* a, const Real* b, Real* out) {
  out[0] = fnma(a[2], b[1], a[1] * b[2]);
  out[1] = fnma(a[0], b[2], a[2] * b[0]);
  out[2] = fnma(a[1], b[0], a[0] * b[1]);
}

HEADBENCH_INLINE Real absolute(Real a) { return max(a, Real(0.0f) - a); }

inline void project_lanes(const Camera& view, const SplatLanes& in, const CameraLanes& camera, Projection& p) {
  for (int k = 0; k < 3; ++k) p.mean[k] = load(in.mean[k]);
  for (int k = 0; k < 3; ++k) p.scale[k] = load(in.scale[k]);
  p.inv_z = Real(1.0f) / load_rounded(camera.z);
  p.ratio_x = load_rounded(camera.ratio_x);
  p.ratio_y = load_rounded(camera.ratio_y);

  const float margin_x = kFrustumMargin * 0.5f * view.width / view.fx;
  const float margin_y = kFrustumMargin * 0.5f * view.height / view.fy;
  const Real low_x = -view.cx / view.fx - margin_x, high_x = (view.width - view.cx) / view.fx + margin_x;
  const Real low_y = -view.cy / view.fy - margin_y, high_y = (view.height - view.cy) / view.fy + margin_y;
  p.free_x = (p.ratio_x >= low_x) & (high_x >= p.ratio_x);
  p.free_y = (p.ratio_y >= low_y) & (high_y >= p.ratio_y);
  p.slope_x = min(max(p.ratio_x, low_x), high_x);
  p.slope_y = min(max(p.ratio_y, low_y), high_y);

  // Dividing by the largest component first keeps every square in range; true divisions, because the largest
  // must become exactly 1 for the test below.
  Real quat[4];
  for (int k = 0; k < 4; ++k) quat[k] = load(in.quat[k]);
  const Real largest = max(max(max(absolute(quat[0]), absolute(quat[1])), max(absolute(quat[2]), absolute(quat[3]))),
                           Real(kQuaternionMin));
  for (int k = 0; k < 4; ++k) quat[k] = quat[k] / largest;
  const Real norm2 = fma(quat[0], quat[0], fma(quat[1], quat[1], fma(quat[2], quat[2], quat[3] * quat[3])));
  p.normalised = norm2 >= Real(1.0f);
  const Real inv = Real(1.0f) / sqrt(max(norm2, Real(1.0f)));
  p.inv_norm = inv / largest;
  for (int k = 0; k < 4; ++k) p.quat[k] = quat[k] * inv;

  rotation_matrix(p.quat, p.rotation);
  for (int i = 0; i < 9; ++i) p.axes[i] = p.rotation[i] * p.scale[i % 3];
  for (int i = 0; i < 3; ++i) {
    const float* r = view.rotation + 3 * i;
    for (int j = 0; j < 3; ++j)
      p.camera_axes[3 * i + j] = fma(r[0], p.axes[j], fma(r[1], p.axes[3 + j], Real(r[2]) * p.axes[6 + j]));
  }
  const Real fx_z = Real(view.fx) * p.inv_z, fy_z = Real(view.fy) * p.inv_z;
  for (int j = 0; j < 3; ++j) {
    p.q0[j] = fx_z * fnma(p.slope_x, p.camera_axes[6 + j], p.camera_axes[j]);
    p.q1[j] = fy_z * fnma(p.slope_y, p.camera_axes[6 + j], p.camera_axes[3 + j]);
  }
  cross3(p.q0, p.q1, p.cross);
  p.area2 = dot3(p.cross, p.cross);
  const Real xx = dot3(p.q0, p.q0), yy = dot3(p.q1, p.q1), eps = view.eps2d;
  p.xy = dot3(p.q0, p.q1);
  p.det = fma(eps, xx + yy, fma(eps, eps, p.area2));
  p.xx = xx + eps;
  p.yy = yy + eps;
  const Real root = sqrt(p.yy);
  p.l11 = Real(kSqrtHalfLog2e) * root / sqrt(p.det);
  p.l21 = Real(0.0f) - p.l11 * p.xy / p.yy;
  p.l22 = Real(kSqrtHalfLog2e) / root;
}

// Tile index of a pixel coordinate, clamped to the image while still a float: huge values are safe.
inline std::uint16_t tile_of(float pixel, int tiles) {
  const float tile = floorf(pixel / kTile);
  return static_cast<std::uint16_t>(tile > 0.0f ? (tile < tiles - 1 ? tile : tiles - 1) : 0.0f);
}

// The radius that the published rasteriser gives a splat (`published_radii` in reference.py), whatever its opacity:
// three standard deviations along the longest axis.
HEADBENCH_INLINE Real published_radius(const Projection& p) {
  const Real half = Real(0.5f) * (p.xx - p.yy);
  const Real spread = sqrt(max(fma(half, half, p.xy * p.xy), Real(0.1f)));
  return ceil(Real(3.0f) * sqrt(fma(Real(0.5f), p.xx + p.yy, spread)));
}

// Where that rasteriser finds at least one whole tile: its pixel centres lie at whole numbers, half a pixel from ours.
HEADBENCH_INLINE Mask in_view_of_tiles(const Camera& view, Real x, Real y, Real radius) {
  return (x + radius >= Real(1.5f)) & (y + radius >= Real(1.5f)) &
         (Real(static_cast<float>(view.tiles_x * kTile) + 0.5f) > x - radius) &
         (Real(static_cast<float>(view.tiles_y * kTile) + 0.5f) > y - radius);
}

inline void project(const Camera& view, const Splats& splats, const FrameData& frame, std::int64_t begin,
                    std::int64_t end) {
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = static_cast<int>(end - first < W ? end - first : W);
    SplatLanes in;
    for (int lane = 0; lane < W; ++lane) load_lane(splats, first + (lane < used ? lane : 0), lane, in);
    CameraLanes camera;
    to_camera(view, in, camera);
    Projection p;
    project_lanes(view, in, camera, p);
    alignas(64) double mean_x[W], mean_y[W];
    for (int lane = 0; lane < W; ++lane) {
      mean_x[lane] = view.fx * camera.ratio_x[lane] + view.cx + in.offset[0][lane];
      mean_y[lane] = view.fy * camera.ratio_y[lane] + view.cy + in.offset[1][lane];
    }
    const Real x = load_rounded(mean_x), y = load_rounded(mean_y);

    Real opacity = load(in.opacity);
    if (view.antialiased) opacity = opacity * sqrt(p.area2 / p.det);
    alignas(64) float opacities[W], level_log2[W];
    store(opacities, opacity);
    for (int lane = 0; lane < W; ++lane) level_log2[lane] = log2f(opacities[lane]);
    const Real log2_opacity = load(level_log2);
    const Real level = Real(2.0f * kLn2) * max(log2_opacity - Real(view.log2_alpha_min), 0.0f);
    const Real extent_x = sqrt(level * p.xx), extent_y = sqrt(level * p.yy);
    const Real reach_x = ceil(extent_x), reach_y = ceil(extent_y), radius = max(reach_x, reach_y);
    // All conditions positive: a NaN anywhere culls.
    const Mask in_image = (x + reach_x > Real(0.0f)) & (y + reach_y > Real(0.0f)) &
                          (Real(static_cast<float>(view.width)) > x - reach_x) &
                          (Real(static_cast<float>(view.height)) > y - reach_y);
    const Real largest = 3e38f;
    const Mask resolved = (p.det > Real(0.0f)) & (largest > p.det) & (largest > p.l11);
    const Mask drawable = resolved & (Real(kRadiusMax) > radius) & (opacity >= Real(view.alpha_min));
    const Real published = published_radius(p);
    const Mask in_view = in_view_of_tiles(view, x, y, published) & resolved & (Real(kRadiusMax) > published);

    alignas(64) float drawn[W], field[kGeometry][W], radii[W], half_x[W], half_y[W];
    store(drawn, zero_unless(in_image & drawable, 1.0f));
    store(radii, zero_unless(in_view, published));
    store(field[kMeanX], x);
    store(field[kMeanY], y);
    for (int lane = 0; lane < W; ++lane) {
      field[kRestX][lane] = static_cast<float>(mean_x[lane] - field[kMeanX][lane]);
      field[kRestY][lane] = static_cast<float>(mean_y[lane] - field[kMeanY][lane]);
    }
    store(field[kL11], p.l11);
    store(field[kL21], p.l21);
    store(field[kL22], p.l22);
    store(field[kLog2Opacity], log2_opacity);
    store(half_x, extent_x);
    store(half_y, extent_y);
    for (int lane = 0; lane < used; ++lane) {
      const std::int64_t splat = first + lane;
      const bool in_depth = camera.z[lane] > view.near && camera.z[lane] < view.far;
      frame.radii[splat] = in_depth ? static_cast<std::int32_t>(radii[lane]) : 0;
      if (!in_depth || drawn[lane] == 0.0f) {
        frame.depths[splat] = 0.0;
        continue;
      }
      frame.depths[splat] = camera.z[lane];
      // A tenth of a pixel covers rounding; tiles that turn out untouched are dropped when pairs are found.
      const float w = half_x[lane] + 0.1f, h = half_y[lane] + 0.1f;
      const float center_x = field[kMeanX][lane], center_y = field[kMeanY][lane];
      frame.rects[splat] = {tile_of(center_x - w, view.tiles_x), tile_of(center_y - h, view.tiles_y),
                            tile_of(center_x + w, view.tiles_x), tile_of(center_y + h, view.tiles_y)};
      float* record = frame.records + splat * record_stride(splats.channels);
      for (int k = 0; k < kGeometry; ++k) record[k] = field[k][lane];
      for (int c = 0; c < splats.channels; ++c) record[kGeometry + c] = splats.colors[splat * splats.channels + c];
    }
  }
}

}  // namespace headbench::HEADBENCH_ISA

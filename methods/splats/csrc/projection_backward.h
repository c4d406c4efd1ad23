// From moments of the alpha gradient over pixels back to the splats' parameters and the camera.
#pragma once

#include "projection.h"

namespace headbench::HEADBENCH_ISA {

// Derivative of `rotation_matrix` followed by the normalisation; d is the gradient of the matrix.
HEADBENCH_INLINE void rotation_backward(const Projection& p, const Real* d, Real* out) {
  const Real w = p.quat[0], x = p.quat[1], y = p.quat[2], z = p.quat[3], two = 2.0f;
  const Real a = d[7] - d[5], b = d[2] - d[6], c = d[3] - d[1];
  const Real e = d[1] + d[3], f = d[2] + d[6], g = d[5] + d[7];
  Real q[4];
  q[0] = two * fma(x, a, fma(y, b, z * c));
  q[1] = two * fma(w, a, fma(y, e, fma(z, f, Real(-2.0f) * x * (d[4] + d[8]))));
  q[2] = two * fma(w, b, fma(x, e, fma(z, g, Real(-2.0f) * y * (d[0] + d[8]))));
  q[3] = two * fma(w, c, fma(x, f, fma(y, g, Real(-2.0f) * z * (d[0] + d[4]))));
  const Real along = fma(w, q[0], fma(x, q[1], fma(y, q[2], z * q[3])));
  const Real remove = zero_unless(p.normalised, along);
  for (int k = 0; k < 4; ++k) out[k] = p.inv_norm * fnma(remove, p.quat[k], q[k]);
}

// Gradients of W splats' inputs, component by component.
struct SplatGradients {
  Real mean2d[2], mean[3], quat[4], scale[3], opacity;
};

// Add the derivative of the antialiasing factor. Its logarithm is half of log area² - log det, and `along` is what
// the logarithm of the opacity receives; 1/area² - 1/det is written without a difference of near equals.
HEADBENCH_INLINE void compensation_backward(const Camera& view, const Projection& p, Real along, Real* dq0, Real* dq1) {
  const Real eps = view.eps2d, gap = eps * (p.xx + p.yy - eps);
  const Real by_area = along * gap / (p.area2 * p.det), by_det = along * eps / p.det;
  Real beside0[3], beside1[3];
  cross3(p.q1, p.cross, beside0);
  cross3(p.cross, p.q0, beside1);
  for (int j = 0; j < 3; ++j) {
    dq0[j] = dq0[j] + fnma(by_det, p.q0[j], by_area * beside0[j]);
    dq1[j] = dq1[j] + fnma(by_det, p.q1[j], by_area * beside1[j]);
  }
}

// `moments` are sums over pixels of v, v dx, v dy, v dx², v dx dy, v dy² with v = alpha dL/dalpha (zero where
// alpha was clamped) and (dx, dy) the pixel's centre minus the splat's mean. With A the inverse covariance,
//   dL/dmean2d = A Σ v d,    dL/dcovariance = 1/2 A (Σ v d dᵀ) A,    A = 2 ln2 L Lᵀ.
inline void project_lanes_backward(const Camera& view, const Projection& p, const Real* moments, Real opacity,
                                   SplatGradients& out, Real* view_gradient) {
  out.opacity = moments[kSum] / opacity;

  const Real u = fma(p.l11, moments[kSumX], p.l21 * moments[kSumY]), v = p.l22 * moments[kSumY];
  const Real two_ln2 = 2.0f * kLn2;
  out.mean2d[0] = two_ln2 * p.l11 * u;
  out.mean2d[1] = two_ln2 * fma(p.l21, u, p.l22 * v);

  // N = Lᵀ M L, then G = 2 ln2² L N Lᵀ; the middle matrix has entries of order Σ v however thin the splat.
  const Real mx0 = fma(p.l11, moments[kSumXX], p.l21 * moments[kSumXY]);
  const Real mx1 = fma(p.l11, moments[kSumXY], p.l21 * moments[kSumYY]);
  const Real n00 = fma(p.l11, mx0, p.l21 * mx1), n01 = p.l22 * mx1, n11 = p.l22 * p.l22 * moments[kSumYY];
  const Real h00 = p.l11 * n00, h01 = p.l11 * n01, h10 = fma(p.l21, n00, p.l22 * n01),
             h11 = fma(p.l21, n01, p.l22 * n11);
  const Real factor = 2.0f * kLn2 * kLn2;
  const Real g00 = factor * p.l11 * h00, g01 = factor * fma(p.l21, h00, p.l22 * h01),
             g11 = factor * fma(p.l21, h10, p.l22 * h11);

  // covariance = Q Qᵀ + eps I;  Q = J camera_axes.
  Real dq0[3], dq1[3];
  for (int j = 0; j < 3; ++j) {
    dq0[j] = Real(2.0f) * fma(g00, p.q0[j], g01 * p.q1[j]);
    dq1[j] = Real(2.0f) * fma(g01, p.q0[j], g11 * p.q1[j]);
  }
  if (view.antialiased) compensation_backward(view, p, moments[kSum], dq0, dq1);
  const Real fx_z = Real(view.fx) * p.inv_z, fy_z = Real(view.fy) * p.inv_z;
  const Real dslope_x = Real(0.0f) - fx_z * dot3(dq0, p.camera_axes + 6);
  const Real dslope_y = Real(0.0f) - fy_z * dot3(dq1, p.camera_axes + 6);
  Real daxes_camera[9];
  for (int j = 0; j < 3; ++j) {
    daxes_camera[j] = fx_z * dq0[j];
    daxes_camera[3 + j] = fy_z * dq1[j];
    daxes_camera[6 + j] = Real(0.0f) - fma(p.slope_x, daxes_camera[j], p.slope_y * daxes_camera[3 + j]);
  }

  // Both rows of Q are proportional to 1/z; the means and unclamped slopes depend on x/z and y/z.
  const Real dratio_x = fma(view.fx, out.mean2d[0], zero_unless(p.free_x, dslope_x));
  const Real dratio_y = fma(view.fy, out.mean2d[1], zero_unless(p.free_y, dslope_y));
  const Real grow_x = dot3(dq0, p.q0), grow_y = dot3(dq1, p.q1), shrink = grow_x + grow_y;
  Real dcamera[3];
  dcamera[0] = dratio_x * p.inv_z;
  dcamera[1] = dratio_y * p.inv_z;
  dcamera[2] = Real(0.0f) - p.inv_z * fma(dratio_x, p.ratio_x, fma(dratio_y, p.ratio_y, shrink));

  Real daxes[9];
  for (int i = 0; i < 3; ++i) {
    const Real r0 = view.rotation[i], r1 = view.rotation[3 + i], r2 = view.rotation[6 + i];
    out.mean[i] = fma(r0, dcamera[0], fma(r1, dcamera[1], r2 * dcamera[2]));
    for (int j = 0; j < 3; ++j)
      daxes[3 * i + j] = fma(r0, daxes_camera[j], fma(r1, daxes_camera[3 + j], r2 * daxes_camera[6 + j]));
  }
  Real drotation[9];
  for (int i = 0; i < 9; ++i) drotation[i] = daxes[i] * p.scale[i % 3];
  for (int j = 0; j < 3; ++j)
    out.scale[j] = fma(daxes[j], p.rotation[j], fma(daxes[3 + j], p.rotation[3 + j], daxes[6 + j] * p.rotation[6 + j]));
  rotation_backward(p, drotation, out.quat);

  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j)
      view_gradient[3 * i + j] = fma(dcamera[i], p.mean[j], dot3(daxes_camera + 3 * i, p.axes + 3 * j));
    view_gradient[9 + i] = dcamera[i];
  }
  // The limits of clamped slopes are (a - c) / f with a constant a.
  const Real inv_fx = 1.0f / view.fx, inv_fy = 1.0f / view.fy;
  const Real limit_x = inv_fx * (dslope_x - zero_unless(p.free_x, dslope_x));
  const Real limit_y = inv_fy * (dslope_y - zero_unless(p.free_y, dslope_y));
  view_gradient[12] = fnma(limit_x, p.slope_x, fma(out.mean2d[0], p.ratio_x, grow_x * inv_fx));
  view_gradient[13] = fnma(limit_y, p.slope_y, fma(out.mean2d[1], p.ratio_y, grow_y * inv_fy));
  view_gradient[14] = out.mean2d[0] - limit_x;
  view_gradient[15] = out.mean2d[1] - limit_y;
}

// Ask for the gradient records of splats drawn[begin .. end).
HEADBENCH_INLINE void prefetch_records(const FrameData& frame, const Gradients& grads, std::int64_t begin,
                                       std::int64_t end) {
  for (std::int64_t i = begin; i < end; ++i) {
    const EntryRange range = frame.ranges[frame.drawn[i]];
    for (std::uint32_t e = range.begin; e < range.begin + range.count; ++e) {
      const float* record = grads.records + static_cast<std::size_t>(frame.places[e]) * grads.record_stride;
      for (int k = 0; k < grads.record_stride; k += 16) HEADBENCH_PREFETCH(record + k);
    }
  }
}

inline void project_backward(const Camera& view, const Splats& splats, const FrameData& frame,
                             const Gradients& grads, std::int64_t begin, std::int64_t end,
                             double* view_gradient) {
  const int stride = grads.record_stride, vectors = stride / W, channels = splats.channels;
  for (std::int64_t first = begin; first < end; first += W) {
    const int used = static_cast<int>(end - first < W ? end - first : W);
    if (first == begin) prefetch_records(frame, grads, begin, begin + used);
    SplatLanes in;
    alignas(64) float moments[kMoments][W];
    for (int lane = 0; lane < W; ++lane) {
      const std::int64_t splat = frame.drawn[first + (lane < used ? lane : 0)];
      load_lane(splats, splat, lane, in);
      if (first + W + lane < end) prefetch_records(frame, grads, first + W + lane, first + W + lane + 1);
      if (lane >= used) {
        for (int k = 0; k < kMoments; ++k) moments[k][lane] = 0.0f;
        continue;
      }
      // A splat's records are added in the order of its entries: the sum does not depend on who drew the tiles.
      alignas(64) float sum[kMoments + kChannelsMax + 2 * W];
      const EntryRange range = frame.ranges[splat];
      for (int i = 0; i < vectors; ++i) {
        Real total = 0.0f;
        for (std::uint32_t e = range.begin; e < range.begin + range.count; ++e)
          total = total + load(grads.records + static_cast<std::size_t>(frame.places[e]) * stride + i * W);
        store(sum + i * W, total);
      }
      for (int k = 0; k < kMoments; ++k) moments[k][lane] = sum[k];
      for (int c = 0; c < channels; ++c) grads.colors[splat * channels + c] += sum[kMoments + c];
    }

    CameraLanes camera;
    to_camera(view, in, camera);
    Projection p;
    project_lanes(view, in, camera, p);
    Real lanes[kMoments], view_lanes[kViewGradient];
    for (int k = 0; k < kMoments; ++k) lanes[k] = load(moments[k]);
    SplatGradients g;
    project_lanes_backward(view, p, lanes, load(in.opacity), g, view_lanes);

    alignas(64) float mean2d[2][W], mean[3][W], quat[4][W], scale[3][W], opacity[W], lane_view[W];
    for (int k = 0; k < 2; ++k) store(mean2d[k], g.mean2d[k]);
    for (int k = 0; k < 3; ++k) store(mean[k], g.mean[k]);
    for (int k = 0; k < 4; ++k) store(quat[k], g.quat[k]);
    for (int k = 0; k < 3; ++k) store(scale[k], g.scale[k]);
    store(opacity, g.opacity);
    for (int k = 0; k < kViewGradient; ++k) {
      store(lane_view, view_lanes[k]);
      for (int lane = 0; lane < used; ++lane) view_gradient[k] += lane_view[lane];
    }
    for (int lane = 0; lane < used; ++lane) {
      const std::int64_t splat = frame.drawn[first + lane];
      for (int k = 0; k < 3; ++k) grads.means[3 * splat + k] += mean[k][lane];
      for (int k = 0; k < 4; ++k) grads.quats[4 * splat + k] += quat[k][lane];
      for (int k = 0; k < 3; ++k) grads.scales[3 * splat + k] += scale[k][lane];
      grads.opacities[splat] += opacity[lane];
      if (grads.means2d)
        for (int k = 0; k < 2; ++k) grads.means2d[2 * splat + k] += mean2d[k][lane];
    }
  }
}

}  // namespace headbench::HEADBENCH_ISA

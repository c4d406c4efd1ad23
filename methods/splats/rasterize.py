"""The renderer's one public function and the choice of its backend."""

from __future__ import annotations

from torch import Tensor

from . import cpu, cuda
from .reference import rasterize_reference
from .request import ALPHA_MIN, TRANSMITTANCE_MIN, ArrayLike, Rendering, Request, make_request


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: ArrayLike,
    K: ArrayLike,
    width: int,
    height: int,
    *,
    background: ArrayLike | None = None,
    near: float = 0.01,
    far: float = 1e10,
    eps2d: float = 0.3,
    antialiased: bool = False,
    alpha_min: float = ALPHA_MIN,
    transmittance_min: float = TRANSMITTANCE_MIN,
    means2d_offset: Tensor | None = None,
    backend: str = "auto",
    threads: int | None = None,
    check_values: bool = True,
) -> Rendering:
    """Render 3D Gaussians for a camera; differentiable in every tensor.

    Names, meanings and constants are gsplat's. To render depth or features, pass them as colours.

    - ``means``: (N, 3) metres, float32 or float64; all outputs have its dtype.
    - ``quats``: (N, 4) rotations, wxyz, of any length; zero means no rotation.
    - ``scales``: (N, 3) standard deviations along the splat's axes, metres, >= 0 (not their logarithms); 0 makes it flat.
    - ``opacities``: (N,) in [0, 1]. A splat below ``alpha_min`` is not drawn, so its gradient is zero.
    - ``colors``: (N, C), any range, 1 <= C <= 32.
    - ``viewmat``: (4, 4) world to camera, OpenCV axes, metres.
    - ``K``: (3, 3) pixels; focal lengths, > 0, and principal point are used, skew is ignored. The centre of the top left pixel
      is at (0.5, 0.5).
    - ``width``, ``height``: image size, pixels.
    - ``background``: (C,), black if None.
    - ``near``, ``far``: splats with camera z outside this range (metres) are neither drawn nor in view.
    - ``eps2d``: low-pass filter: variance added to both image axes, square pixels.
    - ``antialiased``: multiply each opacity by the square root of the ratio of the 2D covariance's determinants without and
      with ``eps2d``, so that small splats become fainter instead of larger (gsplat's mode "antialiased"; Yu et al.,
      "Mip-Splatting", CVPR 2024, eq. 9). The cut at ``alpha_min`` applies to the product.
    - ``alpha_min``: splats are skipped in pixels where their alpha is smaller, and everywhere if their opacity is. The default,
      1/255, is gsplat's; larger values are faster and less exact (``headbench doctor bench splats --tradeoffs`` measures it).
    - ``transmittance_min``: the splat that would reduce a pixel's transmittance to this or below is skipped, with all behind
      it. The default, 1e-4, is gsplat's; larger values are faster and less exact. Backend "cuda" supports only the defaults.
    - ``means2d_offset``: (N, 2) pixels, added to the projected means. Zeros that require a gradient collect the gradient with
      respect to the 2D means, in pixel units like gsplat's; splats that are not drawn get zero.
    - ``backend``: one of `available_backends`, or "auto": for float32 the kernel on the CPU and gsplat on a GPU, else the
      reference. If float32 uses the reference, which is slow, a warning names the remedy once per process.
    - ``threads``: threads of the kernel; None uses `shared.threads.threads`. Results are bit-identical for any number.
    - ``check_values``: whether to refuse NaN and infinity in any tensor, and scales, opacities and focal lengths outside of
      their ranges. Training disables the check, which costs a pass over the splats and, on a GPU, a wait for its result.
      Without it a non-finite geometry is culled, a non-finite colour spreads to the pixels around it, and ranges are the
      caller's responsibility.
    - Returns image (H, W, C), alpha (H, W) and radii (N,). ``radii > 0`` selects the splats in view, regardless of their
      opacity, which training counts, as in the rasteriser published with 3D Gaussian Splatting: camera z from ``near`` (0.2 m
      there) to ``far``, and at least one whole tile of 16 x 16 pixels within that many pixels of the mean in x and y. The
      radius is 3 standard deviations along the longest axis in the image, including the low-pass filter, rounded up. It is 0 if
      float32 does not resolve the splat (2^24 pixels and more). A splat in view is not always drawn: a splat below
      ``alpha_min`` is in view but not drawn, and the rim of an opaque one beside the image beyond 3 standard deviations is
      drawn, although it is out of view.
    """
    request = make_request(
        *(means, quats, scales, opacities, colors, viewmat, K, width, height),
        background=background,
        near=near,
        far=far,
        eps2d=eps2d,
        antialiased=antialiased,
        alpha_min=alpha_min,
        transmittance_min=transmittance_min,
        means2d_offset=means2d_offset,
        check_values=check_values,
    )
    if backend == "auto":
        backend = _choose(request)
    if backend == "reference":
        return rasterize_reference(request)
    if backend == "cuda":
        return cuda.rasterize_cuda(request)
    return cpu.rasterize_cpu(request, backend, threads)


def available_backends(device: str = "cpu") -> tuple[str, ...]:
    """Available values of ``backend`` in `rasterize` for tensors on ``device``, besides "auto"; the preferred one
    first."""
    if device == "cpu":
        return (*cpu.instruction_sets(), "reference")
    return ("cuda", "reference") if cuda.installed() else ("reference",)


def _choose(request: Request) -> str:
    if cpu.supports(request) and cpu.KERNEL.load_or_warn():
        return "cpu"
    return "cuda" if cuda.draws_or_warns(request) else "reference"

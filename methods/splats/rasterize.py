"""The renderer's one public function and the choice of its backend."""

from __future__ import annotations

from torch import Tensor

from . import cpu, cuda
from .constants import ALPHA_MIN, TRANSMITTANCE_MIN
from .reference import rasterize_reference
from .request import ArrayLike, Rendering, Request, make_request


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
    means2d_abs: Tensor | None = None,
    backend: str = "auto",
    threads: int | None = None,
    check_values: bool = True,
    mask_non_finite: bool = False,
) -> Rendering:
    """Render 3D Gaussians into one camera or several; differentiable in every tensor.

    Names, meanings and constants are gsplat's. To render depth or features, pass them as colours.

    Parameters
    ----------
    means : (N, 3) metres, float32 or float64; everything that comes out has its dtype.
    quats : (N, 4) rotations, wxyz, of any length; zero means no rotation.
    scales : (N, 3) standard deviations along the splat's axes, metres, >= 0 (not their logarithms); 0 makes it flat.
    opacities : (N,) in [0, 1]. A splat below ``alpha_min`` is not drawn, so its gradient is zero.
    colors : (N, C), any range, 1 <= C <= 32; or (V, N, C), a set for each of V cameras.
    viewmat : (4, 4) world to camera, OpenCV axes, metres; or (V, 4, 4). With a leading V in this or in ``K``, everything
        that comes out has it, and gradients of what is common to the cameras are summed.
    K : (3, 3) pixels; focal lengths, > 0, and principal point count, skew does not. The centre of the top left
        pixel is at (0.5, 0.5). Or (V, 3, 3).
    width, height : image size, pixels, of all cameras.
    background : (C,) or (V, C), black if None.
    near, far : splats with camera z outside this range (metres) are neither drawn nor in view.
    eps2d : low-pass filter: variance added to both image axes, square pixels.
    antialiased : multiply each opacity by the square root of the ratio of the 2D covariance's determinants without and
        with ``eps2d``, so that the low-pass filter makes small splats faint, not bigger (gsplat's mode "antialiased";
        Yu et al., "Mip-Splatting", CVPR 2024, eq. 9). The cut at ``alpha_min`` applies to the product.
    alpha_min : a splat is left out of pixels where its alpha is below this, and altogether where its opacity is. The
        default, 1/255, is gsplat's; more is faster and less exact (``headbench doctor bench splats --tradeoffs`` measures it).
    transmittance_min : the splat that would bring a pixel's transmittance to this or below is left out, with all behind
        it. The default, 1e-4, is gsplat's; more is faster and less exact. Backend "cuda" has the defaults alone.
    means2d_offset : (N, 2), or (V, N, 2) with several cameras. Pixels, added to the projected means. Zeros that require a gradient collect the
        gradient by the 2D means, in pixel units as gsplat's; splats that are not drawn get zero.
    means2d_abs : like ``means2d_offset``, but adds nothing. Where it requires a gradient it collects, as that, the sum
        over pixels of the absolute gradients by the 2D mean, x and y apart (gsplat's absgrad; Ye et al., "AbsGS", ACM MM
        2024): a measure for densification, not a derivative.
    backend : one of `available_backends`, or "auto": for float32 the kernel on the CPU and gsplat on a GPU, else the
        reference. Where float32 goes to the reference, which is slow, a warning names the remedy once per process.
    threads : of the kernel; None takes `shared.threads.threads`. Results are equal bit for bit for any number.
    check_values : refuse NaN and infinity in any tensor, and scales, opacities and focal lengths outside of their ranges.
        Training leaves the check out: it costs a pass over the splats, and on a GPU a wait for its result. Then a
        non-finite geometry is culled, a non-finite colour spreads to the pixels about it, and ranges are the caller's
        to keep.
    mask_non_finite : leave out splats of which any value is not finite, and count them in the result's ``masked``;
        cameras and background are checked all the same.

    Returns
    -------
    `Rendering`: image (H, W, C), alpha (H, W), radii (N,), each with a leading V for several cameras.

        ``radii > 0`` says which splats are in view, whatever their opacity, as the rasteriser published with 3D
        Gaussian Splatting has it, by which training counts views and takes means: camera z from ``near`` (0.2 m there)
        to ``far``, and at least one whole tile of 16 x 16 pixels within that many pixels of the mean in x and y. The
        radius is 3 standard deviations along the longest axis on the image, low-pass filter included, rounded up. It is
        0 as well where float32 does not resolve the splat (2^24 pixels and more), and where it is masked. What is drawn
        is another matter: a splat below ``alpha_min`` is in view but not drawn, and of an opaque one beside the image
        the rim beyond 3 standard deviations is drawn, although it is out of view.

    Raises
    ------
    ValueError : an argument has a wrong type, shape, dtype, device or value; the message names it.
    UnavailableError : the backend asked for cannot be had here.
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
        means2d_abs=means2d_abs,
        check_values=check_values,
        mask_non_finite=mask_non_finite,
    )
    if backend == "auto":
        backend = _choose(request)
    if backend == "reference":
        return rasterize_reference(request)
    if backend == "cuda":
        return cuda.rasterize_cuda(request)
    return cpu.rasterize_cpu(request, backend, threads)


def available_backends(device: str = "cpu") -> tuple[str, ...]:
    """Names `rasterize` accepts as ``backend`` here for tensors on ``device``, besides "auto"; the preferred one first."""
    if device == "cpu":
        return (*cpu.instruction_sets(), "reference")
    return ("cuda", "reference") if cuda.installed() else ("reference",)


def _choose(request: Request) -> str:
    if cpu.supports(request) and cpu.KERNEL.load_or_warn():
        return "cpu"
    return "cuda" if cuda.draws_or_warns(request) else "reference"

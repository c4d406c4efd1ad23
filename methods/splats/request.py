"""Checked arguments and results of a rendering call."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

TILE = 16
"""Side of the square tiles splats are sorted into, pixels."""
ALPHA_MIN = 1.0 / 255.0
"""A splat does not contribute to pixels where its alpha is below this."""
ALPHA_MAX = float(np.float32(0.99))
"""Alpha is clamped here; the gradient through the clamp is zero.

It is the float32 number also in float64. The transmittance of two opaque splats is then below `TRANSMITTANCE_MIN` in
either precision, whereas with 0.99 in float64 a second one would be drawn that float32, gsplat's precision, skips.
"""
TRANSMITTANCE_MIN = 1e-4
"""The splat that would reduce a pixel's transmittance to this or below is skipped, with all behind it."""
FRUSTUM_MARGIN = 0.3
"""Ray slopes in the projection's Jacobian are clamped to the image, extended by this fraction of its half size."""
QUATERNION_MIN = 1e-12
"""Minimum norm by which quaternions are divided (zero gives the identity)."""
RADIUS_MAX = float(2**24)
"""Splats with a larger extent, in pixels, are culled because float32 does not resolve them."""
CHANNELS_MAX = 32
"""Maximum number of colour channels of one call."""


_SMALLEST = torch.finfo(torch.float32).tiny
"""Minimum focal length, pixels."""
ArrayLike = Tensor | np.ndarray | Sequence[Any]


@dataclass(frozen=True, eq=False)
class Rendering:
    """A rendered image."""

    image: Tensor
    """(H, W, C), composited over the background."""
    alpha: Tensor
    """(H, W) in [0, 1]: one minus the transmittance."""
    find_radii: Callable[[], Tensor]
    """Computes `radii` on first access."""

    @functools.cached_property
    def radii(self) -> Tensor:
        """(N,) int32 radii in pixels, above 0 for splats in view, regardless of opacity; see `rasterize`.

        Computed on first access, since gsplat's radii have another definition.
        """
        return self.find_radii()


@dataclass(frozen=True, eq=False)
class Request:
    """The checked arguments of `rasterize`: tensors of one floating dtype on one device."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor  # (N, C)
    viewmat: Tensor  # (4, 4)
    K: Tensor  # (3, 3)
    background: Tensor  # (C,)
    width: int
    height: int
    means2d_offset: Tensor | None = None  # (N, 2)
    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    antialiased: bool = False
    alpha_min: float = ALPHA_MIN
    transmittance_min: float = TRANSMITTANCE_MIN


def make_request(
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
    background: ArrayLike | None,
    near: float,
    far: float,
    eps2d: float,
    antialiased: bool,
    means2d_offset: Tensor | None,
    check_values: bool,
    alpha_min: float = ALPHA_MIN,
    transmittance_min: float = TRANSMITTANCE_MIN,
) -> Request:
    """Check the arguments of `rasterize`. Raises ValueError naming the argument, what it must be and what it is."""
    splats = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    tensors = splats if means2d_offset is None else {**splats, "means2d_offset": means2d_offset}
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            raise _error(name, "a torch tensor", type(value).__name__)
    if means.dtype not in (torch.float32, torch.float64):
        raise _error("means", "dtype float32 or float64", str(means.dtype))

    cameras = {"viewmat": _as_like("viewmat", viewmat, (4, 4), means), "K": _as_like("K", K, (3, 3), means)}
    count = len(means) if means.ndim else 0
    channels = colors.shape[-1] if colors.ndim == 2 else 0
    shapes: dict[str, tuple[int, ...]] = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "opacities": (count,),
        "colors": (count, channels),
        "means2d_offset": (count, 2),
    }
    for name, value in tensors.items():
        _check_like(name, value, shapes[name], means)
    if not 1 <= channels <= CHANNELS_MAX:
        expected = f"shape (N, C) with C from 1 to {CHANNELS_MAX}"
        raise _error("colors", expected, f"shape {tuple(colors.shape)}")

    background = means.new_zeros(channels) if background is None else background
    over = _as_like("background", background, (channels,), means)
    for name, size in {"width": width, "height": height}.items():
        if not isinstance(size, (int, np.integer)) or size < 1:
            raise _error(name, "a positive integer", repr(size))
    if not 0 < near < far:
        raise _error("near, far", "0 < near < far", f"{near}, {far}")
    if not 0 <= eps2d < math.inf:
        raise _error("eps2d", "a finite number >= 0", repr(eps2d))
    if not ALPHA_MIN <= alpha_min < ALPHA_MAX:
        raise _error("alpha_min", f"a number from 1/255 to below {ALPHA_MAX}", repr(alpha_min))
    if not TRANSMITTANCE_MIN <= transmittance_min < 1:
        raise _error(
            "transmittance_min", f"a number from {TRANSMITTANCE_MIN} to below 1", repr(transmittance_min)
        )

    if check_values:
        for name, value in {**tensors, **cameras, "background": over}.items():
            _check_finite(name, value)
        _check_range("scales", tensors["scales"], "values >= 0", 0.0, math.inf)
        _check_range("opacities", tensors["opacities"], "values in [0, 1]", 0.0, 1.0)
        focals = cameras["K"].diagonal(dim1=-2, dim2=-1)[..., :2]
        _check_range("K", focals, "focal lengths > 0", _SMALLEST, math.inf)
    return Request(
        **tensors,
        **cameras,
        background=over,
        width=int(width),
        height=int(height),
        near=float(near),
        far=float(far),
        eps2d=float(eps2d),
        antialiased=antialiased,
        alpha_min=float(alpha_min),
        transmittance_min=float(transmittance_min),
    )


def _check_like(name: str, value: Tensor, shape: tuple[int, ...], means: Tensor) -> None:
    """Require a shape, and the dtype and device of ``means``."""
    if tuple(value.shape) != shape:
        letters = "(N, C)" if name == "colors" else str(shape)
        expected = f"shape {letters}, with N = {len(means)} from means"
        raise _error(name, expected, f"shape {tuple(value.shape)}")
    if value.dtype != means.dtype:
        raise _error(name, f"dtype {means.dtype}, as means has", str(value.dtype))
    if value.device != means.device:
        raise _error(name, f"device {means.device}, as means has", str(value.device))


def _as_like(name: str, value: ArrayLike, shape: tuple[int, ...], means: Tensor) -> Tensor:
    """Turn a small array into a tensor of ``means``' dtype and device; gradients pass through."""
    # A copy: cameras' arrays are read-only, which torch.as_tensor warns of.
    tensor = value if isinstance(value, Tensor) else torch.tensor(value)
    if tuple(tensor.shape) != shape:
        raise _error(name, f"shape {shape}", f"shape {tuple(tensor.shape)}")
    return tensor.to(dtype=means.dtype, device=means.device)


def _check_finite(name: str, value: Tensor) -> None:
    """Refuse NaN and infinity. A sum detects them; the values are counted only if it is not finite."""
    if torch.isfinite(value.detach().sum()):
        return
    bad = ~torch.isfinite(value.detach())
    if not bad.any():  # the sum alone overflowed
        return
    first = tuple(int(i) for i in bad.nonzero()[0])
    raise _error(name, "finite values", f"{int(bad.sum())} that are not, the first at index {first}")


def _check_range(name: str, value: Tensor, expected: str, low: float, high: float) -> None:
    """Refuse values below ``low`` or above ``high``."""
    if not value.numel():
        return
    least, most = value.detach().aminmax()
    if least >= low and most <= high:
        return
    bad = (value.detach() < low) | (value.detach() > high)
    first = tuple(bad.nonzero()[0].tolist())
    found = f"{int(bad.sum())} outside, the first {value[first].item():g} at index {first}"
    raise _error(name, expected, found)


def _error(name: str, expected: str, found: str) -> ValueError:
    return ValueError(f"{name}: expected {expected}, found {found}.")

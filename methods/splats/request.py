"""Checked arguments and results of a rendering call."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .constants import ALPHA_MAX, ALPHA_MIN, CHANNELS_MAX, TRANSMITTANCE_MIN

_SMALLEST = torch.finfo(torch.float32).tiny
"""Minimum focal length, pixels."""

ArrayLike = Tensor | np.ndarray | Sequence[Any]


@dataclass(frozen=True, eq=False)
class Rendering:
    """A rendered image, or V images along a leading dimension for V cameras."""

    image: Tensor
    """(H, W, C), composited over the background."""
    alpha: Tensor
    """(H, W) in [0, 1]: one minus the transmittance."""
    find_radii: Callable[[], Tensor]
    """Computes `radii` on first access."""
    masked: int = 0
    """Number of splats skipped because a value is not finite; counted only with ``mask_non_finite``."""

    @functools.cached_property
    def radii(self) -> Tensor:
        """(N,) int32 radii in pixels, above 0 for splats in view, regardless of opacity; see `rasterize`.

        Computed on first access, since gsplat's radii have another definition.
        """
        return self.find_radii()


class CameraInputs(NamedTuple):
    """Request for one camera."""

    viewmat: Tensor  # (4, 4)
    K: Tensor  # (3, 3)
    background: Tensor  # (C,)
    colors: Tensor  # (N, C)
    means2d_offset: Tensor | None  # (N, 2)
    means2d_abs: Tensor | None  # (N, 2)


@dataclass(frozen=True, eq=False)
class Request:
    """The checked arguments of `rasterize`: tensors of one floating dtype on one device, V cameras."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor  # (N, C) or (V, N, C)
    viewmats: Tensor  # (V, 4, 4)
    Ks: Tensor  # (V, 3, 3)
    backgrounds: Tensor  # (V, C)
    width: int
    height: int
    means2d_offset: Tensor | None = None  # (V, N, 2)
    means2d_abs: Tensor | None = None  # (V, N, 2)
    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    antialiased: bool = False
    batched: bool = False
    masked: Tensor | None = None  # (N,) bool, splats to skip; None skips none
    alpha_min: float = ALPHA_MIN
    transmittance_min: float = TRANSMITTANCE_MIN

    def view(self, index: int) -> CameraInputs:
        """The part of the request that differs by camera."""
        return CameraInputs(
            self.viewmats[index],
            self.Ks[index],
            self.backgrounds[index],
            self.colors[index] if self.colors.ndim == 3 else self.colors,
            None if self.means2d_offset is None else self.means2d_offset[index],
            None if self.means2d_abs is None else self.means2d_abs[index],
        )

    def unstacked(self, values: Tensor) -> Tensor:
        """Values of all cameras, without the leading V if the caller gave one camera without it."""
        return values if self.batched else values[0]

    def rendering(self, image: Tensor, alpha: Tensor, find_radii: Callable[[], Tensor]) -> Rendering:
        """The result of `rasterize` from image, alpha and a function that returns (V, N) radii."""

        def radii() -> Tensor:
            found = self.unstacked(find_radii())
            return found if self.masked is None else found.masked_fill(self.masked, 0)

        return Rendering(image, alpha, radii, 0 if self.masked is None else int(self.masked.sum()))


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
    means2d_abs: Tensor | None,
    check_values: bool,
    mask_non_finite: bool,
    alpha_min: float = ALPHA_MIN,
    transmittance_min: float = TRANSMITTANCE_MIN,
) -> Request:
    """Check the arguments of `rasterize`. Raises ValueError naming the argument, what it must be and what it is."""
    splats = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    collectors = {"means2d_offset": means2d_offset, "means2d_abs": means2d_abs}
    tensors = {**splats, **{name: value for name, value in collectors.items() if value is not None}}
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            raise _error(name, "a torch tensor", type(value).__name__)
    if means.dtype not in (torch.float32, torch.float64):
        raise _error("means", "dtype float32 or float64", str(means.dtype))

    cameras = {"viewmat": _as_like("viewmat", viewmat, (4, 4), means), "K": _as_like("K", K, (3, 3), means)}
    batched, views = _count_views(cameras)
    count = len(means) if means.ndim else 0
    channels = colors.shape[-1] if colors.ndim in (2, 3) else 0
    front = (views,) if batched else ()
    shapes: dict[str, tuple[int, ...]] = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "opacities": (count,),
        "colors": (*front, count, channels) if colors.ndim == 3 and batched else (count, channels),
        **dict.fromkeys(collectors, (*front, count, 2)),
    }
    for name, value in tensors.items():
        _check_like(name, value, shapes[name], means)
    if not 1 <= channels <= CHANNELS_MAX:
        expected = f"shape (N, C) with C from 1 to {CHANNELS_MAX}"
        raise _error("colors", expected, f"shape {tuple(colors.shape)}")

    background = means.new_zeros(channels) if background is None else background
    over = _as_like("background", background, (channels,), means)
    if over.ndim == 2 and (not batched or len(over) != views):
        shape = f"({views}, {channels})" if batched else f"({channels},)"
        raise _error("background", f"shape {shape}", f"shape {tuple(over.shape)}")
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

    masked = None
    if mask_non_finite:
        tensors, masked = _mask(tensors)
    if check_values or mask_non_finite:
        for name, value in {**tensors, **cameras, "background": over}.items():
            _check_finite(name, value)
        _check_range("scales", tensors["scales"], "values >= 0", 0.0, math.inf)
        _check_range("opacities", tensors["opacities"], "values in [0, 1]", 0.0, 1.0)
        focals = cameras["K"].diagonal(dim1=-2, dim2=-1)[..., :2]
        _check_range("K", focals, "focal lengths > 0", _SMALLEST, math.inf)
    return Request(
        **{name: tensors[name] if name in splats or batched else tensors[name][None] for name in tensors},
        viewmats=cameras["viewmat"].expand(views, 4, 4),
        Ks=cameras["K"].expand(views, 3, 3),
        backgrounds=over.expand(views, channels),
        width=int(width),
        height=int(height),
        near=float(near),
        far=float(far),
        eps2d=float(eps2d),
        antialiased=antialiased,
        batched=batched,
        masked=masked,
        alpha_min=float(alpha_min),
        transmittance_min=float(transmittance_min),
    )


def _count_views(cameras: dict[str, Tensor]) -> tuple[bool, int]:
    """Whether inputs have a leading camera dimension, and the number of cameras."""
    counts = {name: len(value) for name, value in cameras.items() if value.ndim == 3}
    if len(set(counts.values())) > 1:
        raise _error("viewmat, K", "as many cameras in both", f"{counts['viewmat']} and {counts['K']}")
    views = next(iter(counts.values()), 1)
    if views < 1:
        raise _error(next(iter(counts)), "at least one camera", "none")
    return bool(counts), views


def _mask(tensors: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor | None]:
    """Replace splats with non-finite values by zeros, so that they have neither opacity nor gradient."""
    count = len(tensors["means"])
    bad = torch.zeros(count, dtype=torch.bool, device=tensors["means"].device)
    for value in tensors.values():
        finite = torch.isfinite(value.detach())
        finite = finite if value.ndim == 1 else finite.all(-1)
        bad |= ~(finite if finite.ndim == 1 else finite.all(0))
    if not bad.any():
        return tensors, None
    return {
        name: value.masked_fill(bad if value.ndim == 1 else bad[:, None], 0.0)  # also under a leading V
        for name, value in tensors.items()
    }, bad


def _check_like(name: str, value: Tensor, shape: tuple[int, ...], means: Tensor) -> None:
    """Require a shape, and the dtype and device of ``means``."""
    if tuple(value.shape) != shape:
        letters = "(N, C), or (V, N, C) with V cameras" if name == "colors" else str(shape)
        expected = f"shape {letters}, with N = {len(means)} from means"
        raise _error(name, expected, f"shape {tuple(value.shape)}")
    if value.dtype != means.dtype:
        raise _error(name, f"dtype {means.dtype}, as means has", str(value.dtype))
    if value.device != means.device:
        raise _error(name, f"device {means.device}, as means has", str(value.device))


def _as_like(name: str, value: ArrayLike, shape: tuple[int, ...], means: Tensor) -> Tensor:
    """Turn a small array, or a stack of them, into a tensor of ``means``' dtype and device; gradients pass through."""
    # A copy: cameras' arrays are read-only, which torch.as_tensor warns of.
    tensor = value if isinstance(value, Tensor) else torch.tensor(value)
    if tuple(tensor.shape[-len(shape) :]) != shape or tensor.ndim > len(shape) + 1:
        stacked = ", ".join(["V", *map(str, shape)])
        raise _error(name, f"shape {shape} or ({stacked})", f"shape {tuple(tensor.shape)}")
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

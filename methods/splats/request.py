"""What a rendering call asks for and gives, after its arguments were checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .constants import CHANNELS_MAX

ArrayLike = Tensor | np.ndarray | Sequence[Any]


class Rendering(NamedTuple):
    """A rendered image."""

    image: Tensor
    """(H, W, C), composited over the background."""
    alpha: Tensor
    """(H, W) in [0, 1]: one minus the transmittance."""
    radii: Tensor
    """(N,) int32, pixels: how far the splat reaches from its mean along the wider image axis; 0 where culled."""


@dataclass(frozen=True, eq=False)
class Request:
    """The checked arguments of `rasterize`: tensors of one floating dtype on one device."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmat: Tensor
    K: Tensor
    background: Tensor
    means2d_offset: Tensor | None
    width: int
    height: int
    near: float
    far: float
    eps2d: float

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by argument name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}


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
    means2d_offset: Tensor | None,
    check_finite: bool,
) -> Request:
    """Check the arguments of `rasterize`. Raises ValueError naming the argument, what it must be and what it is."""
    splats = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    per_splat = dict(splats) if means2d_offset is None else {**splats, "means2d_offset": means2d_offset}
    for name, value in per_splat.items():
        if not isinstance(value, Tensor):
            raise _error(name, "a torch tensor", type(value).__name__)
    if means.dtype not in (torch.float32, torch.float64):
        raise _error("means", "dtype float32 or float64", str(means.dtype))

    count = len(means) if means.ndim else 0
    channels = colors.shape[-1] if colors.ndim == 2 else 0
    for name, value in per_splat.items():
        shape = {
            "means": (count, 3),
            "quats": (count, 4),
            "scales": (count, 3),
            "opacities": (count,),
            "colors": (count, channels),
            "means2d_offset": (count, 2),
        }[name]
        _check_like(name, value, shape, means)
    if not 1 <= channels <= CHANNELS_MAX:
        raise _error(
            "colors", f"shape (N, C) with C from 1 to {CHANNELS_MAX}", f"shape {tuple(colors.shape)}"
        )

    view = _as_like("viewmat", viewmat, (4, 4), means)
    intrinsics = _as_like("K", K, (3, 3), means)
    over = means.new_zeros(channels) if background is None else background
    for name, size in {"width": width, "height": height}.items():
        if not isinstance(size, (int, np.integer)) or size < 1:
            raise _error(name, "a positive integer", repr(size))
    if not 0 < near < far:
        raise _error("near, far", "0 < near < far", f"{near}, {far}")
    if not eps2d >= 0:
        raise _error("eps2d", "a number >= 0", repr(eps2d))

    request = Request(
        **splats,
        means2d_offset=means2d_offset,
        viewmat=view,
        K=intrinsics,
        background=_as_like("background", over, (channels,), means),
        width=int(width),
        height=int(height),
        near=float(near),
        far=float(far),
        eps2d=float(eps2d),
    )
    if check_finite:
        for name, value in request.tensors().items():
            _check_finite(name, value)
    return request


def _check_like(name: str, value: Tensor, shape: tuple[int, ...], means: Tensor) -> None:
    """Require a shape, and the dtype and device of ``means``."""
    if tuple(value.shape) != shape:
        letters = {"colors": "(N, C)"}.get(name, str(shape))
        raise _error(
            name, f"shape {letters}, with N = {len(means)} from means", f"shape {tuple(value.shape)}"
        )
    if value.dtype != means.dtype:
        raise _error(name, f"dtype {means.dtype}, as means has", str(value.dtype))
    if value.device != means.device:
        raise _error(name, f"device {means.device}, as means has", str(value.device))


def _as_like(name: str, value: ArrayLike, shape: tuple[int, ...], means: Tensor) -> Tensor:
    """Turn a small array into a tensor of the dtype and device of ``means``; gradients pass through."""
    tensor = torch.as_tensor(value)
    if tuple(tensor.shape) != shape:
        raise _error(name, f"shape {shape}", f"shape {tuple(tensor.shape)}")
    return tensor.to(dtype=means.dtype, device=means.device)


def _check_finite(name: str, value: Tensor) -> None:
    """Refuse NaN and infinity. One sum tells in the usual case; the exact count is taken only on suspicion."""
    if torch.isfinite(value.detach().sum()):
        return
    bad = ~torch.isfinite(value.detach())
    if not bad.any():  # the sum alone overflowed
        return
    first = tuple(int(i) for i in bad.nonzero()[0])
    raise _error(name, "finite values", f"{int(bad.sum())} that are not, the first at index {first}")


def _error(name: str, expected: str, found: str) -> ValueError:
    return ValueError(f"{name}: expected {expected}, found {found}.")

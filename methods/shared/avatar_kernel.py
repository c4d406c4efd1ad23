"""What avatars compute of a frame before its splats are drawn, by the compiled kernel.

Each function has a reference in torch, which is the definition and is used where the kernel is not: other devices, other
dtypes, gradients, or no compiler at installation. The kernel's results do not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from ..splats.cpu import KERNEL, instruction_sets
from . import device_frame
from .binding import Frames, WorldSplats, apply_matrices, to_world
from .networks import sh_degree, sh_to_rgb
from .threads import threads

HARMONICS_BLOCK = 16
"""Splats whose coefficients lie side by side."""
UNITS_STEP = 16
"""Layers of networks are padded with units that are 0 to a multiple of it."""


def available() -> bool:
    """Tell whether the kernel is there; one built from older sources, in an editable installation, counts as none."""
    return hasattr(KERNEL.imported, "photometric")


def usable(like: Tensor) -> bool:
    """Tell whether the kernel is there and takes tensors like this one."""
    return like.dtype == torch.float32 and like.device.type == "cpu" and available()


def triangles(vertices: Tensor, faces: Tensor, backend: str = "cpu") -> Frames:
    """Frames of the triangles of a mesh: the compiled form of `binding.triangle_frames`.

    Parameters
    ----------
    vertices, faces : (V, 3), and (F, 3) int64.
    """
    count, empty = len(faces), vertices.new_empty
    frames = Frames(empty(count, 3, 3), empty(count, 3), empty(count), empty(count, 4))
    call("triangles", vertices, faces, *frames, backend=backend)
    return frames


def splats_to_world(
    frames: Frames, binding: Tensor, means: Tensor, quats: Tensor, scales: Tensor, backend: str = "cpu"
) -> WorldSplats:
    """Transform local splats to world space: the compiled form of `binding.to_world` for unit quaternions and scales.

    Parameters
    ----------
    binding : (N,) int64, the triangle of each splat.
    means, quats, scales : (N, 3) and (N, 3) in units of the triangle's size, (N, 4) unit quaternions wxyz.
    """
    world = WorldSplats(torch.empty_like(means), torch.empty_like(quats), torch.empty_like(scales))
    call("to_world", binding, *frames, means, quats, scales, *world, backend=backend)
    return world


def pack_harmonics(dc: Tensor, rest: Tensor) -> Tensor:
    """Coefficients as `shade` reads them: (ceil(N / 16), 3, K, 16) of (N, 3) and (N, 3, K - 1)."""
    whole = torch.cat([dc[:, :, None], rest], dim=2)
    blocks = -(-len(whole) // HARMONICS_BLOCK)
    padded = pad(whole, (0, 0, 0, 0, 0, blocks * HARMONICS_BLOCK - len(whole)))
    return padded.view(blocks, HARMONICS_BLOCK, *whole.shape[1:]).permute(0, 2, 3, 1).contiguous()


def shade(
    packed: Tensor,
    means: Tensor,
    center: Tensor,
    turns: Tensor | None = None,
    binding: Tensor | None = None,
    backend: str = "cpu",
) -> Tensor:
    """Colours (N, 3) >= 0 as a camera sees them: the compiled form of `networks.sh_to_rgb` along the ways from the camera.

    Parameters
    ----------
    packed : of `pack_harmonics`.
    means, center : (N, 3) and (3,) in the world.
    turns, binding : (F, 3, 3) applied to the directions of the splats of each triangle; both or neither.
    """
    colors = torch.empty_like(means)
    turns = means.new_empty(0, 3, 3) if turns is None else turns
    binding = torch.empty(0, dtype=torch.int64) if binding is None else binding
    call("shade", packed, means, turns, binding, center, colors, backend=backend)
    return colors


def pad_units(values: Tensor, *axes: int) -> Tensor:
    """Zeros after the end of the given axes, up to a multiple of `UNITS_STEP`."""
    widths = [0] * (2 * values.ndim)  # before and after, the last axis first
    for axis in axes:
        widths[-1 - 2 * axis] = -values.shape[axis] % UNITS_STEP
    return (pad(values, widths) if any(widths) else values).contiguous()


def turns_between(to: Tensor, origin: Tensor, backend: str = "cpu") -> Tensor:
    """(F, 3, 3) rotations ``to`` times the transposes of ``origin``: they take directions on one mesh to the other's."""
    turns = torch.empty_like(to)
    call("turns", to, origin, turns, backend=backend)
    return turns


def in_steps(values: Tensor) -> tuple[Tensor, Tensor]:
    """(N, H) int16 and the steps (H,) float32 they count: what is left of a column is half a step, 1.5e-5 of its largest."""
    largest = values.abs().amax(0) if len(values) else values.new_zeros(values.shape[1])
    steps = (largest / torch.iinfo(torch.int16).max).clamp_min(torch.finfo(values.dtype).tiny)
    return (values / steps).round_().to(torch.int16), steps


def shade_network(
    from_position: Tensor,
    steps: Tensor,
    of_direction: Tensor,
    last: Tensor,
    means: Tensor,
    center: Tensor,
    turns: Tensor,
    binding: Tensor,
    backend: str = "cpu",
) -> Tensor:
    """Colours (N, 3) >= 0 as a camera sees them: the compiled form of `ours.field.shade_directions`.

    Parameters
    ----------
    from_position, steps : see `in_steps`; (N, H), padded by `pad_units` along H.
    last : (3, H), padded too.
    of_direction : (3 L, H), padded too: what the coordinates of a direction from the splat to the camera add to the hidden
        layer, at L >= 2 samples of each from -1 to 1; linear between them.
    """
    colors = torch.empty_like(means)
    network = from_position, steps, of_direction, last
    call("color_network", *network, means, turns, binding, center, colors, backend=backend)
    return colors


def offsets_into(
    out: Tensor,
    splats: Tensor,
    table: Tensor,
    first_bias: Tensor,
    rows: Tensor,
    fractions: Tensor,
    second: Tensor,
    second_bias: Tensor,
    last: Tensor,
    last_bias: Tensor,
    backend: str = "cpu",
) -> None:
    """Write offsets into the rows ``splats`` of (N, D) ``out``: the compiled form of `ours.field.line_offsets`.

    Units of the first layer that none of a few neighbours turns on are left out of their second layer.

    Parameters
    ----------
    splats : (M,) int64.
    table, first_bias : (3 L, U) and (U,), padded by `pad_units` along U: the first layer at the lines' samples.
    rows, fractions : (M, 3) int32 lower samples, and ways from them to the next, 0 to 1.
    second, second_bias, last : (U, H), (H,) and (D, H), padded by `pad_units` along U and H.
    last_bias : (D,).
    """
    layers = second, second_bias, last, last_bias
    call("offset_network", table, first_bias, rows, fractions, *layers, splats, out, backend=backend)


def call(name: str, *arguments: Any, backend: str) -> Any:
    """Call a function of the kernel, see `arrays`."""
    function = getattr(KERNEL.load(), name)
    return function(*arrays(*arguments), instruction_sets()[backend], threads())


def arrays(*arguments: Any) -> list[Any]:
    """Tensors as arrays, which reach the kernel faster than tensors do, and other arguments as they are."""
    return [
        value.detach().contiguous().numpy() if isinstance(value, Tensor) else value for value in arguments
    ]


class WorldTransform:
    """Transforms splats to world space: `binding.to_world`, with what no frame changes computed beforehand.

    Parameters
    ----------
    binding : (N,) int64, the triangle of each splat.
    means, log_scales, quats : (N, 3), (N, 3) and (N, 4), as most frames have them.
    """

    def __init__(self, binding: Tensor, means: Tensor, log_scales: Tensor, quats: Tensor):
        self._binding, self._means, self._log_scales, self._quats = binding, means, log_scales, quats
        self._fast, self._on_device = usable(quats), quats.device.type != "cpu"
        if self._fast or self._on_device:
            self._known = _unit(quats), log_scales.exp()
        if self._on_device:
            self._homogeneous = pad(means, (0, 1), value=1.0)

    def __call__(self, frames: Frames, means: Tensor, log_scales: Tensor, quats: Tensor) -> WorldSplats:
        """Splats in the world; log-scales and quaternions may be others than the known ones."""
        if not (self._fast or device_frame.usable(means)):
            return to_world(frames, self._binding, means, log_scales, quats)
        units, scales = self._known
        if quats is not self._quats:
            units = _unit(quats)
        if log_scales is not self._log_scales:
            scales = log_scales.exp()
        if self._fast:
            return splats_to_world(frames, self._binding, means, units, scales)
        means = self._homogeneous if means is self._means else pad(means, (0, 1), value=1.0)
        return device_frame.splats_to_world(frames, self._binding, means, units, scales)


class HarmonicColors:
    """Colours by spherical harmonics, up to the degree that the coefficients have.

    Parameters
    ----------
    dc, rest : (N, 3) and (N, 3, K - 1) coefficients along the ways from the camera to the splats.
    """

    def __init__(self, dc: Tensor, rest: Tensor):
        self._dc, self._rest = dc, rest
        self._packed = pack_harmonics(dc, rest) if usable(dc) else None
        self._on_device = device_frame.coefficients_of(dc, rest) if dc.device.type != "cpu" else None

    def along(self, directions: Tensor) -> Tensor:
        """Colours (N, 3) >= 0 along (N, 3) unit vectors from the camera to the splats."""
        return sh_to_rgb(self._dc, self._rest, directions, sh_degree(self._rest))

    def __call__(
        self, means: Tensor, center: Tensor, turns: Tensor | None = None, binding: Tensor | None = None
    ) -> Tensor:
        """Colours (N, 3) >= 0 of splats at (N, 3) means as a camera at ``center`` sees them.

        ``turns`` (F, 3, 3) are applied to the directions of the splats that ``binding`` (N,) gives to each triangle.
        """
        if self._packed is not None:
            return shade(self._packed, means, center, turns, binding)
        if self._on_device is not None and device_frame.usable(means):
            directions = device_frame.directions_from(means, center, turns, binding)
            return device_frame.shade(self._on_device, directions)
        directions = torch.nn.functional.normalize(means - center, dim=1)
        if turns is not None and binding is not None:
            directions = apply_matrices(turns.reshape(-1, 9).index_select(0, binding), directions)
        return self.along(directions)


def _unit(quats: Tensor) -> Tensor:
    return quats / torch.linalg.vector_norm(quats, dim=1, keepdim=True).clamp_min(1e-12)

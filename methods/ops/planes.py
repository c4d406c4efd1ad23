"""Spherical harmonics, and the tri-planes, lines and small networks of "ours"."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag, normalize, pad

from ...bench.native.dispatch import Operation, to_device
from .kernel import KERNEL, arrays, call, empty_like, pad_units, threads
from .splats import apply_matrices, directions_to

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def coefficient_count(degree: int) -> int:
    """Number of coefficients up to a degree."""
    return (degree + 1) ** 2


def sh_degree(rest: Tensor) -> int:
    """Degree of (N, 3, K - 1) coefficients above degree 0."""
    return math.isqrt(rest.shape[2] + 1) - 1


def occupied_degree(rest: Tensor) -> int:
    """Highest degree with non-zero coefficients among (N, 3, K - 1) above degree 0."""
    degree = sh_degree(rest)
    while degree and not rest[:, :, coefficient_count(degree - 1) - 1 :].any():
        degree -= 1
    return degree


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics of unit directions, (N, (degree+1)^2).

    Order and signs are those of 3DGS: degree by degree, m from -l to l, with the Condon-Shortley phase kept
    (so the m = +-1 terms of degree 1 are -y and -x). No common tool stores degrees above 3.
    """
    x, y, z = directions.unbind(1)
    terms = [torch.full_like(x, C0)]
    if degree >= 1:
        terms += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        terms += [C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * zz - xx - yy), -C2[0] * x * z]
        terms += [C2[2] * (xx - yy)]
    if degree >= 3:
        terms += [-C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, -C3[2] * y * (4 * zz - xx - yy)]
        terms += [C3[3] * z * (2 * zz - 3 * xx - 3 * yy), -C3[2] * x * (4 * zz - xx - yy)]
        terms += [C3[4] * z * (xx - yy), -C3[0] * x * (xx - 3 * yy)]
    return torch.stack(terms, dim=1)


def initial_coefficients(count: int, degree: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Coefficients to start training from, as 3DGS stores them: nearly zero at degree 0, zero above.

    Returns ``sh_dc`` (N, 3) and ``sh_rest`` (N, 3, K - 1), K the `coefficient_count` of ``degree``.
    """
    dc = torch.rand(count, 3, generator=generator) / 255
    return {"sh_dc": dc, "sh_rest": torch.zeros(count, 3, coefficient_count(degree) - 1)}


@Operation
def harmonic_colors(dc: Tensor, rest: Tensor, vectors: Tensor, degree: int) -> Tensor:
    """Colours (N, 3) >= 0 seen along vectors from the camera to the splats, of any length: relu(0.5 + SH).

    - ``dc``: (N, 3) coefficient of degree 0.
    - ``rest``: (N, 3, K - 1) coefficients of higher degrees by channel; those above ``degree`` are not used.
    """
    if degree == 0:
        return torch.relu(0.5 + C0 * dc)
    basis = sh_basis(normalize(vectors, dim=1), degree)[:, 1:, None]
    view = torch.bmm(rest[:, :, : basis.shape[1]], basis)[:, :, 0]
    return torch.relu(0.5 + C0 * dc + view)


@harmonic_colors.compiled(KERNEL)
def _harmonic_colors(dc: Tensor, rest: Tensor, vectors: Tensor, degree: int) -> Tensor:
    return _HarmonicColors.apply(dc, rest, vectors, degree)  # type: ignore[no-untyped-call]


class _HarmonicColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dc: Tensor, rest: Tensor, vectors: Tensor, degree: int) -> Tensor:
        colors = empty_like(dc)
        call("harmonics", degree, dc, rest, vectors, colors)
        ctx.save_for_backward(dc, rest, vectors, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        dc, rest, vectors, colors = ctx.saved_tensors
        gradients = empty_like(dc), empty_like(rest), empty_like(vectors)
        call("harmonics_backward", ctx.degree, dc, rest, vectors, colors, grad, *gradients)
        return *gradients, None


def turned_colors(
    dc: Tensor, rest: Tensor, means: Tensor, rotation: Tensor, center: Tensor, degree: int
) -> Tensor:
    """`harmonic_colors` along the axes of each splat, (N, 3, 3) from these to the world, seen from a camera at ``center`` (3,)."""
    along = torch.bmm((means - center)[:, None], rotation)[:, 0]
    return harmonic_colors(dc, rest, along, degree)


class HarmonicShader(Protocol):
    """Colours by constant spherical harmonics for any number of views, without gradients."""

    def __call__(
        self, means: Tensor, center: Tensor, turns: Tensor | None = None, binding: Tensor | None = None
    ) -> Tensor:
        """Colours (N, 3) >= 0 of splats at (N, 3) means for a camera at ``center``.

        ``turns`` (F, 3, 3) rotate the directions of the splats on each triangle, given by ``binding`` (N,).
        """


@Operation
def harmonic_shader(dc: Tensor, rest: Tensor) -> HarmonicShader:
    """`harmonic_colors` of (N, 3) and (N, 3, K - 1) coefficients, all of which are used."""

    def shade(
        means: Tensor, center: Tensor, turns: Tensor | None = None, binding: Tensor | None = None
    ) -> Tensor:
        vectors = means - center
        if turns is not None and binding is not None:
            vectors = apply_matrices(turns.reshape(-1, 9).index_select(0, binding), vectors)
        return harmonic_colors(dc, rest, vectors, sh_degree(rest))

    return shade


HARMONICS_BLOCK = 16
"""Number of splats whose coefficients are stored side by side."""


@harmonic_shader.compiled(KERNEL)
def _harmonic_shader(dc: Tensor, rest: Tensor) -> HarmonicShader:
    whole = torch.cat([dc[:, :, None], rest], dim=2)
    blocks = -(-len(whole) // HARMONICS_BLOCK)
    padded = pad(whole, (0, 0, 0, 0, 0, blocks * HARMONICS_BLOCK - len(whole)))
    packed = padded.view(blocks, HARMONICS_BLOCK, *whole.shape[1:]).permute(0, 2, 3, 1).contiguous()

    def shade(
        means: Tensor, center: Tensor, turns: Tensor | None = None, binding: Tensor | None = None
    ) -> Tensor:
        colors = empty_like(means)
        call("shade", packed, means, turns, binding, center, colors)
        return colors

    return shade


def sum_rows(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """(N, C) sums over k of ``weights[:, k] * table[rows[:, k]]``; differentiable in table and weights.

    - ``table``: (T, C).
    - ``rows``: (N, K) int64.
    - ``weights``: (N, K), of the table's dtype.
    """
    return embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


PAIRS = (("xy", 0, 1), ("xz", 0, 2), ("yz", 1, 2))
"""Planes in the order of their features: name, coordinate along the width, coordinate along the height."""


FREQUENCIES = (1.0, 2.0, 4.0, 8.0)
ENCODING_SIZE = 3 + 2 * 3 * len(FREQUENCIES)


def sample_plane(plane: Tensor, coordinates: Tensor, resolution: int) -> Tensor:
    """Features (N, C) of a (R * R, C) plane at (N, 2) coordinates in [-1, 1], width first; clamped outside.

    Bilinear, align-corners, border padding, as ``torch.nn.functional.grid_sample`` defines them.
    """
    position = ((coordinates + 1) * (0.5 * (resolution - 1))).clamp(0, resolution - 1)
    corner = position.detach().floor().clamp_max(resolution - 2)
    u, v = (position - corner).unbind(1)
    column, row = corner.to(torch.int64).unbind(1)
    first = row * resolution + column
    indices = torch.stack([first, first + 1, first + resolution, first + resolution + 1], dim=1)
    weights = torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], dim=1)
    return sum_rows(plane, indices, weights)


def encode(values: Tensor, frequencies: int = len(FREQUENCIES)) -> Tensor:
    """(N, D + 2 L D) positional encoding of (N, D) values: identity, then sin and cos at L frequencies 1, 2, 4, 8, ... (no pi)."""
    factors = _frequencies(frequencies, values.dtype, values.device)
    angles = factors[:, None] * values[:, None, :]
    waves = torch.stack([torch.sin(angles), torch.cos(angles)], dim=2)
    return torch.cat([values, waves.flatten(1)], dim=1)


@functools.cache
def _frequencies(count: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Frequencies on a device, cached because creating them at each call would make the host wait for the device."""
    on_device: Tensor = to_device(2 ** torch.arange(count, dtype=dtype), device)
    return on_device


def smoothing(spread: float) -> Tensor:
    """(9 D,) factors that turn `encode` of D = 3 values into its mean for a standard deviation ``spread`` of the
    values.

    A wave of frequency f is scaled by exp(-(f spread)^2 / 2) (integrated positional encoding; Barron et al. 2021,
    arXiv 2103.13415, eq. 13).
    """
    frequencies = torch.tensor(FREQUENCIES).repeat_interleave(2 * 3)
    return torch.cat([torch.ones(3), torch.exp(-0.5 * (frequencies * spread) ** 2)])


class Bounds(NamedTuple):
    """Axis-aligned box: (3,) corners, metres."""

    low: Tensor
    high: Tensor

    def unit(self, points: Tensor) -> Tensor:
        """Map points in the box to [0, 1]."""
        return (points - self.low) / (self.high - self.low)

    def contains(self, points: Tensor) -> Tensor:
        """(N,) whether points are in the box, including its faces."""
        return ((points >= self.low) & (points <= self.high)).all(1)


class ColorNetwork(NamedTuple):
    """Colour as a function of position and direction."""

    xy: Tensor
    xz: Tensor
    yz: Tensor
    """(R * R, C_k) planes."""
    first: Tensor
    last: Tensor
    """(H, C + 27) and (3, H) weights, C the sum of the C_k."""


def triplane_features(planes: Sequence[Tensor], box: Bounds, positions: Tensor) -> tuple[Tensor, ...]:
    """Features (N, C_k) of three planes, in the order of `PAIRS`, at positions in their box; clamped outside."""
    points, resolution = 2 * box.unit(positions) - 1, round(len(planes[0]) ** 0.5)
    return tuple(
        # The two coordinates as a slice, since a list of indices would be copied to the device.
        sample_plane(plane, points[:, width : height + 1 : height - width], resolution)
        for plane, (_, width, height) in zip(planes, PAIRS)
    )


@Operation
def plane_colors(positions: Tensor, directions: Tensor, box: Bounds, network: ColorNetwork) -> Tensor:
    """Colours (N, 3) >= 0: [features, encoded direction] -> hidden -> ReLU -> relu(0.5 + C0 * out), no bias.

    ``positions``, ``directions``: (N, 3), and (N, 3) unit vectors to the camera.
    """
    features = triplane_features(network[:3], box, positions)
    inputs = torch.cat([*features, encode(directions)], dim=1)
    hidden = torch.relu(inputs @ network.first.t())
    return torch.relu(0.5 + C0 * (hidden @ network.last.t()))


@plane_colors.compiled(KERNEL)
def _plane_colors(positions: Tensor, directions: Tensor, box: Bounds, network: ColorNetwork) -> Tensor:
    return _PlaneColors.apply(torch.stack([*box]), positions, directions, *network)  # type: ignore[no-untyped-call]


class _PlaneColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, box: Tensor, *inputs: Tensor) -> Tensor:
        colors = empty_like(inputs[0])
        ctx.done = call("color_training", *inputs, box, colors)
        ctx.save_for_backward(*inputs, box, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_colors: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, box, colors = ctx.saved_tensors
        places, weights = inputs[:2], inputs[2:]
        wanted = any(ctx.needs_input_grad[1:3])
        by_places = [empty_like(value) if wanted else None for value in places]
        gradients = [empty_like(value) for value in weights]
        ctx.done.backward(arrays(*inputs, box, colors, by_colors, *by_places, *gradients), threads())
        return None, *by_places, *gradients


AXES = 3


class LinePosition(NamedTuple):
    """Positions of points on the three lines: rows of the (3 L)-row table and linear weights, (N, 6) each."""

    rows: Tensor
    weights: Tensor


def line_position(points: Tensor, resolution: int) -> LinePosition:
    """Positions of (N, 3) points in [0, 1] on lines of ``resolution`` samples: sample ``t (L - 1)``."""
    position = (points * (resolution - 1)).clamp(0, resolution - 1)
    lower = position.floor().clamp_max(resolution - 2)
    fraction = position - lower
    start = torch.arange(AXES, device=points.device) * resolution
    rows = lower.to(torch.int64) + start
    weights = torch.cat([1 - fraction, fraction], dim=1).to(points.dtype)
    return LinePosition(torch.cat([rows, rows + 1], dim=1), weights)


class OffsetLayers(NamedTuple):
    """Layers of the offset network behind its first weights: (H,), (H, H), (H,), (D, H) and (D,)."""

    bias_0: Tensor
    weight_1: Tensor
    bias_1: Tensor
    weight_2: Tensor
    bias_2: Tensor

    def __call__(self, summed: Tensor) -> Tensor:
        """(N, D): bias, ReLU, layer, ReLU, layer, applied to the output of the first weights, (N, H)."""
        hidden = torch.relu(summed + self.bias_0)
        hidden = torch.relu(torch.addmm(self.bias_1, hidden, self.weight_1.t()))
        return torch.addmm(self.bias_2, hidden, self.weight_2.t())


@Operation
def line_offsets(positions: Tensor, box: Bounds, table: Tensor, layers: OffsetLayers) -> Tensor:
    """(N, D) offsets at (N, 3) positions, 0 outside the box; no gradient for positions and box.

    ``table``: (3 L, H) contribution of each sample of the lines to the first layer.
    """
    # Computed outside as well, since selecting the points inside would make the host wait for a GPU.
    position = line_position(box.unit(positions.detach()), len(table) // AXES)
    offsets = layers(sum_rows(table, *position))
    return torch.where(box.contains(positions)[:, None], offsets, 0)


@line_offsets.compiled(KERNEL)
def _line_offsets(positions: Tensor, box: Bounds, table: Tensor, layers: OffsetLayers) -> Tensor:
    return _LineOffsets.apply(positions.detach(), torch.stack([*box]), table, *layers)  # type: ignore[no-untyped-call]


class _LineOffsets(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions: Tensor, box: Tensor, *weights: Tensor) -> Tensor:
        offsets = positions.new_zeros(len(positions), len(weights[-1]))
        ctx.done = call("line_training", *weights, positions, box, offsets)
        ctx.save_for_backward(*weights)
        return offsets

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_offsets: Tensor) -> tuple[Tensor | None, ...]:
        weights = ctx.saved_tensors
        gradients = [empty_like(value) for value in weights]
        ctx.done.backward(arrays(*weights, by_offsets, *gradients), threads())
        return None, None, *gradients


Shader = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""Colours (N, 3) >= 0 for the arguments of `splats.directions_to`, without gradients."""


@Operation
def shader(from_position: Tensor, of_direction: Tensor, last: Tensor) -> Shader:
    """`plane_colors` of constant positions for any number of views.

    - ``from_position``: (N, H) contribution of the planes to the hidden layer.
    - ``of_direction``, ``last``: (27, H) and (3, H) weights of the encoded direction and of the hidden layer.
    """
    half = torch.full_like(last[:, 0], 0.5)

    def shade(means: Tensor, center: Tensor, turns: Tensor, binding: Tensor) -> Tensor:
        directions = directions_to(means, center, turns, binding)
        hidden = torch.relu(torch.addmm(from_position, encode(directions), of_direction))
        return torch.relu(torch.addmm(half, hidden, last.t(), alpha=C0))

    return shade


SAMPLES = 512
"""Range of a coordinate of directions, from -1 to 1."""


@shader.compiled(KERNEL)
def _shader(from_position: Tensor, of_direction: Tensor, last: Tensor, samples: int = SAMPLES) -> Shader:
    """The position's contribution is quantised to 16 bits (`in_steps`); the direction's is looked up in a table.

    Each coordinate of a direction contributes to the hidden layer through its own waves. The table is interpolated
    linearly: the error of a wave of the highest frequency, 8, is at most 8^2 / (2 SAMPLES^2) = 1e-4 of its amplitude,
    and more samples would not fit into the first cache level. The page of "ours" has the effect of both on images.
    """
    of_direction, last = pad_units(of_direction, 1), pad_units(last, 1)
    network = *in_steps(pad_units(from_position, 1)), direction_table(of_direction, samples), last

    def shade(means: Tensor, center: Tensor, turns: Tensor, binding: Tensor) -> Tensor:
        colors = empty_like(means)
        call("color_network", *network, means, turns, binding, center, colors)
        return colors

    return shade


def in_steps(values: Tensor) -> tuple[Tensor, Tensor]:
    """Quantise to (N, H) int16 with (H,) float32 steps; error at most half a step, 1.5e-5 of the largest value of a column."""
    largest = values.abs().amax(0) if len(values) else values.new_zeros(values.shape[1])
    steps = (largest / torch.iinfo(torch.int16).max).clamp_min(torch.finfo(values.dtype).tiny)
    return (values / steps).round_().to(torch.int16), steps


def direction_table(of_direction: Tensor, samples: int) -> Tensor:
    """(3 L, H): contribution of each coordinate to the hidden layer at L samples from -1 to 1, by (27, H) weights of `encode`."""
    along = torch.linspace(-1, 1, samples, dtype=torch.float64)
    # Selects one coordinate for each frequency.
    waves = encode(along[:, None].expand(-1, AXES)).unflatten(1, (-1, AXES))
    weights = of_direction.double().unflatten(0, (-1, AXES))
    return torch.einsum("lwa,wah->alh", waves, weights).flatten(0, 1).to(of_direction.dtype)


OffsetWriter = Callable[[Tensor, Tensor, Tensor], None]
"""Takes (N, D) offsets, the (M,) int64 rows to write, and a (3 L, H) table of blended lines; without gradients."""


@Operation
def offset_writer(layers: OffsetLayers, position: LinePosition) -> OffsetWriter:
    """The offset network at constant positions on the lines, for any number of tables."""

    def write(out: Tensor, splats: Tensor, table: Tensor) -> None:
        out.index_copy_(0, splats, layers(sum_rows(table, *position)))

    return write


@offset_writer.compiled(KERNEL)
def _offset_writer(layers: OffsetLayers, position: LinePosition) -> OffsetWriter:
    """Units of the first layer that are inactive for a group of neighbours are skipped in the second layer."""
    rows, fractions = position.rows[:, :AXES].to(torch.int32), position.weights[:, AXES:]
    first_bias, second_bias = (pad_units(bias, 0) for bias in (layers.bias_0, layers.bias_1))
    second, last = pad_units(layers.weight_1.t(), 0, 1), pad_units(layers.weight_2, 1)
    places = rows.contiguous(), fractions.contiguous()

    def write(out: Tensor, splats: Tensor, table: Tensor) -> None:
        further = first_bias, *places, second, second_bias, last, layers.bias_2
        call("offset_network", pad_units(table, 1), *further, splats, out)

    return write

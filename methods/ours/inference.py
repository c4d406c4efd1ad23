"""What a stored avatar of "ours" computes per frame, prepared as far as it does not depend on the frame.

Each of these is the fast form of what `appearance` trains with; `tests/methods/ours/test_formula.py` compares
both with the definition in float64. README.md lists what was measured and left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from ..shared import avatar_kernel, device_frame
from ..shared.binding import Frames
from ..shared.networks import C0, CPU_BLOCK, ENCODING_SIZE, FREQUENCIES, encode, sum_rows
from .field import (
    AXES,
    Bounds,
    LinePosition,
    blend_lines,
    canonical_directions,
    line_position,
    line_table,
    normalised_weight,
)


class DrivenPose(NamedTuple):
    """What a pose decides, as far as it is worth keeping for known poses."""

    frames: Frames
    turns: Tensor
    """(F, 3, 3) world directions to canonical ones."""
    offsets: Tensor | None
    """(N, D) of the lines; None without lines."""

    @property
    def bytes(self) -> int:
        """Memory it takes."""
        tensors = (*self.frames, self.turns, *(() if self.offsets is None else (self.offsets,)))
        return sum(value.nbytes for value in tensors)


class LineOffsets:
    """Offsets of the splats inside the lines' box; the others have none.

    Parameters
    ----------
    tensors : of a field with lines.
    positions : (N, 3) canonical positions.
    """

    def __init__(self, tensors: Mapping[str, Tensor], positions: Tensor):
        self._lines, self._count = tensors["lines"], len(positions)
        self._jaw_bases = len(tensors["jaw_bases"])
        box = Bounds(*tensors["line_box"])
        inside = box.contains(positions).nonzero().squeeze(1)
        unit = box.unit(positions.index_select(0, inside))
        position = line_position(unit, self._lines.shape[2])
        # Neighbours on the lines beside each other: they read the same rows, and turn the same units on.
        order = _lexicographic(position.rows[:, :AXES], self._lines.shape[2])
        self.inside = inside[order]
        self._position = LinePosition(*(part[order] for part in position))
        self._first, self._first_bias = normalised_weight(tensors, 0), tensors["line_bias_0"]
        # Transposed once, as the products below want them.
        self._second, self._last = (normalised_weight(tensors, layer).t().contiguous() for layer in (1, 2))
        self._biases = tensors["line_bias_1"], tensors["line_bias_2"]
        self._fast = avatar_kernel.usable(positions)
        if self._fast:
            rows, weights = self._position
            pad = avatar_kernel.pad_units
            self._kernel_places = rows[:, :AXES].to(torch.int32).contiguous(), weights[:, AXES:].contiguous()
            hidden = pad(self._second, 0, 1), pad(self._biases[0], 0)
            self._kernel_layers = *hidden, pad(self._last.t(), 1), self._biases[1]
            self._kernel_first_bias = pad(self._first_bias, 0)
        self._on_device: DeviceLines | None = None
        if positions.device.type != "cpu":
            layers = self._first, self._first_bias, self._second, self._last, *self._biases
            place = self.inside, device_frame.WeightedRows(*self._position), self._count
            self._on_device = DeviceLines(self._lines, self._jaw_bases, layers, *place)

    def __call__(self, coefficients: Tensor) -> Tensor:
        """(N, D) offsets of all splats for the (E + J,) coefficients of a frame, the jaw's last."""
        if self._on_device is not None:
            return self._on_device(coefficients)
        table = self.table(coefficients)
        out = table.new_empty if len(self.inside) == self._count else table.new_zeros
        offsets = out(self._count, self._last.shape[1])
        if self._fast:
            first = avatar_kernel.pad_units(table, 1), self._kernel_first_bias
            avatar_kernel.offsets_into(
                offsets, self.inside, *first, *self._kernel_places, *self._kernel_layers
            )
        else:
            offsets.index_copy_(0, self.inside, self.by_torch(table))
        return offsets

    def table(self, coefficients: Tensor) -> Tensor:
        """(3 L, H) first layer, but for its bias, at the samples of a frame's blended lines."""
        expression, jaw = coefficients.split([len(coefficients) - self._jaw_bases, self._jaw_bases])
        return line_table(blend_lines(self._lines, expression, jaw), self._first)

    def by_torch(self, table: Tensor) -> Tensor:
        """(M, D) offsets of the splats inside."""
        second_bias, last_bias = self._biases
        rows, weights = self._position
        inside = table.new_empty(len(rows), len(last_bias))
        # Blocks whose activations stay in cache; one for other devices.
        step = CPU_BLOCK if rows.device.type == "cpu" else max(len(rows), 1)
        hidden = table.new_empty(min(step, len(rows)), self._second.shape[1])
        for start in range(0, len(rows), step):
            block = slice(start, min(start + step, len(rows)))
            first = sum_rows(table, rows[block], weights[block]).add_(self._first_bias).relu_()
            out = hidden[: len(first)]
            torch.addmm(second_bias, first, self._second, out=out).relu_()
            torch.addmm(last_bias, out, self._last, out=inside[block])
        return inside


class DeviceLines:
    """`LineOffsets` in few operations: the first layer of each line is known, so that a frame blends layers instead.

    Parameters
    ----------
    lines : (E + J, 3, L, C), of which the last ``jaw_bases`` are the jaw's.
    layers : weight and bias of the first layer, (H, 6 C) and (H,), then (H, H) and (H, D), transposed, and their biases.
    inside, at_rows : (M,) int64 of ``count`` splats, and where they read the (3 L, H) first layer at the lines' samples.
    """

    def __init__(
        self,
        lines: Tensor,
        jaw_bases: int,
        layers: tuple[Tensor, ...],
        inside: Tensor,
        at_rows: device_frame.WeightedRows,
        count: int,
    ):
        first, first_bias, self._second, self._last, self._second_bias, self._last_bias = layers
        parts = first.view(len(first), 2, AXES, -1).unbind(1)
        kinds = zip(lines.split([len(lines) - jaw_bases, jaw_bases]), parts)
        columns = [torch.einsum("nalc,hac->alhn", own, part).flatten(0, 2) for own, part in kinds]
        self._layers = torch.cat(columns, dim=1)
        # A point reads one sample of each axis in all, so the bias is read once.
        bias = first_bias.new_zeros(AXES, lines.shape[2], len(first))
        bias[0] = first_bias
        self._bias = bias.flatten()
        self._inside, self._at_rows = inside, at_rows
        self._nothing = first_bias.new_zeros(count, len(self._last_bias))

    def __call__(self, coefficients: Tensor) -> Tensor:
        """(N, D) offsets of all splats for (E + J,) coefficients."""
        table = torch.addmv(self._bias, self._layers, coefficients)
        first = self._at_rows(table.view(-1, len(self._second))).relu_()
        second = torch.addmm(self._second_bias, first, self._second).relu_()
        offsets = torch.addmm(self._last_bias, second, self._last)
        return self._nothing.index_copy(0, self._inside, offsets)


def _lexicographic(rows: Tensor, resolution: int) -> Tensor:
    """(N,) order of (N, 3) rows by their last number, then the middle one, then the first."""
    x, y, z = rows.unbind(1)
    return torch.argsort((z * AXES * resolution + y) * AXES * resolution + x, stable=True)


SAMPLES = 512
"""Of a coordinate of directions, from -1 to 1."""


class PlaneColors:
    """Colours of the planes as directions ask for them, where the part of the position is known.

    Each coordinate of a direction adds to the hidden layer what its own waves make of it. The kernel reads that from a
    table, linear between `SAMPLES`: a wave of the highest frequency, 8, is off by 8^2 / (2 SAMPLES^2) = 1e-4 of its
    amplitude at most, and more samples would not stay in the first caches. The part of the position is the most that a
    frame reads; it is kept in 16 bits (`in_steps`). README.md says what both change of an image.

    Parameters
    ----------
    first, last : (H, C + 27) and (3, H) weights of the colour network.
    from_position : (N, H), what the planes add to the hidden layer: `field.position_part`.
    """

    def __init__(self, first: Tensor, last: Tensor, from_position: Tensor):
        of_direction = first[:, first.shape[1] - ENCODING_SIZE :].t().contiguous()
        self._fast = avatar_kernel.usable(from_position)
        self._network = from_position, of_direction, last
        if self._fast:
            pad = avatar_kernel.pad_units
            parts = pad(of_direction, 1), pad(last, 1)
            self._stored = (
                *avatar_kernel.in_steps(pad(from_position, 1)),
                direction_table(parts[0], SAMPLES),
                parts[1],
            )
        self._known: tuple[Tensor, Tensor, Tensor] | None = None
        self._on_device: device_frame.DirectionLayer | None = None
        if from_position.device.type != "cpu":
            self._on_device = device_frame.DirectionLayer(of_direction)
            self._half, self._scaled = from_position.new_tensor(0.5), (C0 * last).t().contiguous()

    def __call__(self, means: Tensor, center: Tensor, turns: Tensor, binding: Tensor) -> Tensor:
        """Colours (N, 3) >= 0 of splats at (N, 3) means as a camera at ``center`` sees them.

        Parameters
        ----------
        turns : (F, 3, 3) world directions to canonical ones, by triangle.
        binding : (N,) int64, the triangle of each splat.

        The colours of the last call are kept, and given again for the same tensor of means seen from the same place; not on
        a GPU, which would have to be waited for to compare places.
        """
        if self._on_device is not None:
            directions = device_frame.directions_from(means, center, turns, binding)
            hidden = self._on_device(self._network[0], directions).relu_()
            return torch.addmm(self._half, hidden, self._scaled).relu_()
        if self._known is not None and self._known[0] is means and torch.equal(self._known[1], center):
            return self._known[2]
        if self._fast:
            colors = avatar_kernel.shade_network(*self._stored, means, center, turns, binding)
        else:
            colors = self.along(-canonical_directions(turns, binding, means, center))
        self._known = means, center, colors
        return colors

    def along(self, directions: Tensor) -> Tensor:
        """Colours (N, 3) >= 0 along (N, 3) canonical unit vectors from the camera to the splats."""
        from_position, of_direction, last = self._network
        hidden = torch.addmm(from_position, encode_columns(-directions).t(), of_direction).relu_()
        return torch.addmm(hidden.new_tensor(0.5), hidden, last.t(), alpha=C0).relu_()


def direction_table(of_direction: Tensor, samples: int) -> Tensor:
    """(3 L, H): what each coordinate adds to the hidden layer at L samples from -1 to 1, by (27, H) weights of `encode`."""
    along = torch.linspace(-1, 1, samples, dtype=torch.float64)
    waves = encode(along[:, None].expand(-1, AXES)).unflatten(
        1, (-1, AXES)
    )  # the coordinates' turn in each wave
    weights = of_direction.double().unflatten(0, (-1, AXES))
    return torch.einsum("lwa,wah->alh", waves, weights).flatten(0, 1).to(of_direction.dtype)


def encode_columns(directions: Tensor) -> Tensor:
    """(27, N), the transpose of `encode`, from one sine and one cosine per coordinate.

    The frequencies double, so the other waves follow by sin 2a = 2 sin a cos a and cos 2a = 1 - 2 sin^2 a; each step
    doubles the rounding error, to 1e-6 at frequency 8 in float32.
    """
    angles = directions.t().contiguous()
    encoded = angles.new_empty(ENCODING_SIZE // 3, *angles.shape)
    encoded[0] = angles
    sine, cosine = torch.sin(angles), torch.cos(angles)
    for number in range(len(FREQUENCIES)):
        encoded[1 + 2 * number], encoded[2 + 2 * number] = sine, cosine
        sine, cosine = 2 * sine * cosine, 1 - 2 * sine * sine
    return encoded.flatten(0, 1)

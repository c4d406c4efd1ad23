"""Per-frame computation of a stored avatar of "ours", with precomputed values that do not depend on the frame.

`tests/methods/ours/test_formula.py` compares it with the definition in float64.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from ..ops.mesh import TriangleFrames
from ..ops.planes import AXES, Bounds, LinePosition, line_position, offset_writer
from .field import blend_lines, line_table, normalised_weight, offset_layers


class DrivenPose(NamedTuple):
    """What a pose determines, for any camera."""

    frames: TriangleFrames
    turns: Tensor
    """(F, 3, 3) world directions to canonical ones."""
    offsets: Tensor | None
    """(N, D) of the lines; None without lines."""


class LineOffsets:
    """Offsets of the splats inside the lines' box; others have none.

    Parameters
    ----------
    positions : Tensor
        (N, 3) canonical positions.
    """

    def __init__(self, tensors: Mapping[str, Tensor], positions: Tensor):
        self._lines, self._count = tensors["lines"], len(positions)
        self._jaw_bases = len(tensors["jaw_bases"])
        box = Bounds(*tensors["line_box"])
        inside = box.contains(positions).nonzero().squeeze(1)
        unit = box.unit(positions.index_select(0, inside))
        position = line_position(unit, self._lines.shape[2])
        # Neighbours on the lines are stored together because they read the same rows and activate the same units.
        order = _lexicographic(position.rows[:, :AXES], self._lines.shape[2])
        self.inside = inside[order]
        self._first, layers = normalised_weight(tensors, 0), offset_layers(tensors)
        self._outputs = len(layers.bias_2)
        self._write = offset_writer(layers, LinePosition(*(part[order] for part in position)))

    def __call__(self, coefficients: Tensor) -> Tensor:
        """(N, D) offsets of all splats for the (E + J,) coefficients of a frame, jaw weights last."""
        table = self.table(coefficients)
        out = table.new_empty if len(self.inside) == self._count else table.new_zeros
        offsets = out(self._count, self._outputs)
        self._write(offsets, self.inside, table)
        return offsets

    def table(self, coefficients: Tensor) -> Tensor:
        """(3 L, H) first layer without its bias, at the samples of a frame's blended lines."""
        expression, jaw = coefficients.split([len(coefficients) - self._jaw_bases, self._jaw_bases])
        return line_table(blend_lines(self._lines, expression, jaw), self._first)


def _lexicographic(rows: Tensor, resolution: int) -> Tensor:
    """(N,) order of (N, 3) rows by the last column, then the middle one, then the first."""
    x, y, z = rows.unbind(1)
    return torch.argsort((z * AXES * resolution + y) * AXES * resolution + x, stable=True)

"""What a stored avatar of "ours" computes per frame, prepared as far as it does not depend on the frame.

Each of these is the fast twin of what `ours_appearance` trains with; `tests/methods/test_ours_formula.py` compares
both with the definition in float64.

Measured and left out, since they save less than they cost. A splat's offset cannot matter where the Lipschitz bound
|W2| |W1|_2 |h(frame) - h(rest)| of the offset network changes its opacity by less than a tolerance: at 1e-3 this held
for 0.02 to 6 % of the splats of two trained avatars. Splats that the projection culls, with the head in view: 0.2 and
1.4 %; whose colour reaches no pixel, known only after drawing: 9 and 15 %. The middle layer in bfloat16: no faster,
conversions included.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from .binding import Frames, WorldSplats
from .dynamics import LocalSplats
from .feature_lines import LinePosition, blend_lines, line_position, line_table, normalised_weight
from .networks import CPU_BLOCK
from .ours_field import Box
from .row_sums import sum_rows
from .sh import C0
from .triplane import ENCODING_SIZE, FREQUENCIES


class Posed(NamedTuple):
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


class Placed(NamedTuple):
    """Splats of a pose in the world, before a camera looks at them."""

    splats: LocalSplats
    world: WorldSplats
    turns: Tensor
    """(F, 3, 3) world directions to canonical ones."""


class LineOffsets:
    """Offsets of the splats inside the lines' box; the others have none.

    Parameters
    ----------
    tensors : of a field with lines.
    positions : (N, 3) canonical positions.
    """

    def __init__(self, tensors: Mapping[str, Tensor], positions: Tensor):
        self._lines, self._count = tensors["lines"], len(positions)
        box = Box(*tensors["line_box"])
        self.inside = box.contains(positions).nonzero().squeeze(1)
        unit = box.unit(positions.index_select(0, self.inside))
        self._position: LinePosition = line_position(unit, self._lines.shape[2])
        self._first, self._first_bias = normalised_weight(tensors, 0), tensors["line_bias_0"]
        # Transposed once, as the products below want them.
        self._layers = [
            (normalised_weight(tensors, layer).t().contiguous(), tensors[f"line_bias_{layer}"])
            for layer in (1, 2)
        ]

    def __call__(self, expression: Tensor, jaw: Tensor) -> Tensor:
        """(N, D) offsets of all splats for a frame's coefficients."""
        table = line_table(blend_lines(self._lines, expression, jaw), self._first)
        # The two weights of an axis add up to 1, so the bias on the rows of one axis reaches each splat once.
        table[: self._lines.shape[2]] += self._first_bias
        (second, second_bias), (last, last_bias) = self._layers
        rows, weights = self._position
        inside = table.new_empty(len(rows), len(last_bias))
        # Blocks whose activations stay in cache; one for other devices.
        step = CPU_BLOCK if rows.device.type == "cpu" else max(len(rows), 1)
        hidden = table.new_empty(min(step, len(rows)), second.shape[1])
        for start in range(0, len(rows), step):
            block = slice(start, min(start + step, len(rows)))
            first = sum_rows(table, rows[block], weights[block]).relu_()
            out = hidden[: len(first)]
            torch.addmm(second_bias, first, second, out=out).relu_()
            torch.addmm(last_bias, out, last, out=inside[block])
        if len(self.inside) == self._count:
            return inside
        return inside.new_zeros(self._count, inside.shape[1]).index_copy_(0, self.inside, inside)


class PlaneColors:
    """Colours of the planes as directions ask for them, where the part of the position is known.

    Parameters
    ----------
    first, last : (H, C + 27) and (3, H) weights of the colour network.
    from_position : (N, H), what the planes add to the hidden layer: `ours_field.position_part`.
    """

    def __init__(self, first: Tensor, last: Tensor, from_position: Tensor):
        self.from_position = from_position
        self._of_direction = first[:, first.shape[1] - ENCODING_SIZE :].t().contiguous()
        self._last = last.t().contiguous()
        self._half = last.new_tensor(0.5)
        self._known: tuple[Tensor, Tensor] | None = None

    def __call__(self, directions: Tensor) -> Tensor:
        """Colours (N, 3) >= 0 of (N, 3) canonical directions.

        The colours of the last call are kept: where no more than half of the directions differ from that call's, bit
        for bit, only theirs are computed.
        """
        if self._known is None:
            colors = self.shade(directions)
        else:
            changed = (directions != self._known[0]).any(1).nonzero().squeeze(1)
            if 2 * len(changed) > len(directions):
                colors = self.shade(directions)
            else:
                some = self.shade(directions.index_select(0, changed), changed)
                colors = self._known[1].index_copy(0, changed, some)
        self._known = directions, colors
        return colors

    def shade(self, directions: Tensor, rows: Tensor | None = None) -> Tensor:
        """The same for some splats (their numbers) or all, whatever is known."""
        known = self.from_position if rows is None else self.from_position.index_select(0, rows)
        hidden = torch.addmm(known, encode_columns(directions).t(), self._of_direction).relu_()
        return torch.addmm(self._half, hidden, self._last, alpha=C0).relu_()


def encode_columns(directions: Tensor) -> Tensor:
    """(27, N), the transpose of `triplane.encode_directions`, from one sine and one cosine per coordinate.

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

"""Neutral splats plus differences, weighted by expression coefficients, carried by a pose."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag, normalize

from ..shared.binding import WorldSplats, apply_matrices
from ..shared.networks import coefficient_count, sh_to_rgb
from .rig import Carried

LARGEST_SCALE = 0.1
"""Metres; training removes neutral splats that are larger, and no expression makes one so."""
SMALLEST_SCALE = 1e-7


def difference_widths(degree: int) -> dict[str, int]:
    """Columns of the differences by attribute; harmonics above degree 0 up to ``degree``."""
    rest = 3 * (coefficient_count(degree) - 1)
    return {"means": 3, "log_scales": 3, "quats": 4, "opacities": 1, "sh_dc": 3, "sh_rest": rest}


class Entries(NamedTuple):
    """Which rows of the differences belong to which splat, and to which expression.

    Attributes
    ----------
    starts : (N + 1,) int64, the first row of each splat, and the number of all.
    owners : (M,) int64, splat of each row, ascending.
    expressions : (M,) int64.
    weights : (M,) with which a row counts; 1 where it holds what is added at coefficient 1.
    """

    starts: Tensor
    owners: Tensor
    expressions: Tensor
    weights: Tensor

    @classmethod
    def of(cls, counts: Tensor, expressions: Tensor, weights: Tensor) -> Entries:
        """From the (N,) numbers of rows."""
        starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        owners = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
        return cls(starts, owners, expressions, weights)

    def sum(self, differences: Tensor, coefficients: Tensor) -> Tensor:
        """(N, C) differences of each splat, blended by the (K,) coefficients of a pose."""
        weights = self.weights * coefficients.index_select(0, self.expressions)
        return _SumEntries.apply(differences, weights, self.starts, self.owners)  # type: ignore[no-untyped-call]


class _SumEntries(torch.autograd.Function):
    """Sums of weighted rows of a table, run by run. The adjoint is one gather: torch's own scatters."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, weights: Tensor, starts: Tensor, owners: Tensor) -> Tensor:
        ctx.save_for_backward(weights, owners)
        rows = torch.arange(len(table), device=table.device)
        return embedding_bag(
            rows, table, starts, per_sample_weights=weights, mode="sum", include_last_offset=True
        )

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        weights, owners = ctx.saved_tensors
        return grads[0].index_select(0, owners).mul_(weights[:, None]), None, None, None


class Placed(NamedTuple):
    """Splats of a pose in the world: geometry, (N,) opacities, harmonics, and the (N, 3, 3) turn of their axes."""

    world: WorldSplats
    opacities: Tensor
    sh_dc: Tensor
    sh_rest: Tensor
    rotation: Tensor

    def colors(self, center: Tensor, degree: int) -> Tensor:
        """(N, 3) as seen from a camera at ``center`` (3,); the harmonics turn with the surface."""
        directions = normalize(self.world.means - center, dim=1)
        own = torch.bmm(directions[:, None], self.rotation)[:, 0]
        return sh_to_rgb(self.sh_dc, self.sh_rest, own, degree)


def place(neutral: Mapping[str, Tensor], differences: Tensor, carried: Carried) -> Placed:
    """Splats of a pose.

    Each attribute is the neutral one plus its differences, initial and learnt (section 3.2 of the paper); positions
    and rotations then follow the joints (section 3.4).

    Parameters
    ----------
    neutral : means (N, 3) metres, log_scales (N, 3), quats (N, 4), opacities (N,) logits, sh_dc (N, 3) and sh_rest
        (N, 3, R).
    differences : (N, C), learnt and blended, in the columns of `difference_widths`.
    """
    rest = neutral["sh_rest"]
    by_rest = differences.shape[1] - sum(difference_widths(0).values())
    moved, scaled, turned, opaque, coloured, rest_change = differences.split([3, 3, 4, 1, 3, by_rest], dim=1)
    means = (
        apply_matrices(carried.linear.contiguous(), neutral["means"] + carried.shift + moved) + carried.offset
    )
    quats = normalize(neutral["quats"] + carried.turn + turned, dim=1)
    scales = (neutral["log_scales"] + scaled).exp().clamp(SMALLEST_SCALE, LARGEST_SCALE)
    if by_rest:
        changed = by_rest // 3
        rest = torch.cat(
            [rest[:, :, :changed] + rest_change.view(-1, 3, changed), rest[:, :, changed:]], dim=2
        )
    return Placed(
        WorldSplats(means, apply_matrices(carried.product.contiguous(), quats), scales),
        torch.sigmoid(neutral["opacities"] + opaque[:, 0]),
        neutral["sh_dc"] + coloured,
        rest,
        carried.rotation.reshape(-1, 3, 3),
    )

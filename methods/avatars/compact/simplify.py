"""Remove invisible splats and lines from an avatar before it is stored compactly."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from ....bench.contracts import HeadPose
from ...ours.avatar import OursAvatar
from ...ours.storage import PER_SPLAT, SPLAT_WIDTHS, StoredField
from ...splats.constants import ALPHA_MIN
from .encoding import negligible_lines
from .precision import Precision


def simplify(avatar: OursAvatar, poses: Iterable[HeadPose], precision: Precision) -> StoredField:
    """The avatar's field with its splats sorted by triangle, without splats and lines that are invisible in all poses.

    Parameters
    ----------
    poses : Iterable[HeadPose]
        Training poses. A splat whose opacity stays below 1/255 in all of them is removed; the
        renderer culls such splats, so these poses do not change. Without poses no splat is removed.
    precision : Precision
        Lines that it rounds to zero are set to zero. If no other lines remain, and the lines change only opacity,
        every pose changes an opacity by the same number; it is added once, and lines and network are removed.
    """
    field = avatar.field
    tensors = dict(field.tensors)
    kept = _visible(avatar, poses)
    # Splats of equal depth are drawn in index order; stable sorting keeps the order within a triangle.
    order = kept[torch.argsort(tensors["splats"][kept, -1], stable=True)]
    for name in PER_SPLAT:
        if name in tensors:
            tensors[name] = tensors[name].index_select(0, order)
    if "lines" not in tensors:
        return StoredField(tensors, field.dynamic)
    silent = torch.from_numpy(negligible_lines(tensors, precision.lines))
    mask = silent.to(tensors["lines"].device)[:, None, None, None]
    tensors["lines"] = tensors["lines"].masked_fill(mask, 0)
    if silent.all() and field.dynamic == ("opacity",):
        column = SPLAT_WIDTHS["means"]
        tensors["splats"][:, column] = avatar.static_logits().index_select(0, order)
        lines = {name for name in tensors if name.startswith(("lines", "line_"))} - {"line_box"}
        tensors = {name: value for name, value in tensors.items() if name not in lines}
        tensors["jaw_bases"] = tensors["jaw_bases"][:0]
    return StoredField(tensors, field.dynamic)


def _visible(avatar: OursAvatar, poses: Iterable[HeadPose]) -> Tensor:
    """Indices of the splats that are visible in some pose."""
    splats = avatar.field.tensors["splats"]
    keep = None
    for pose in poses:
        shown = torch.from_numpy(avatar.splats(pose).opacities) >= ALPHA_MIN
        keep = shown if keep is None else keep | shown
    keep = torch.ones(len(splats), dtype=torch.bool) if keep is None else keep
    return keep.nonzero().squeeze(1).to(splats.device)

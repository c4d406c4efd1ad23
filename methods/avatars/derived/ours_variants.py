"""Variants of a trained avatar of "ours"."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from ....bench.contracts import Clip, HeadAsset, Variant
from ...ours.avatar import OursAvatar
from ...ours.storage import DYNAMIC, FIELD_FILE, PER_SPLAT, StoredField, field_of, read_field, save_field
from ...shared.avatar_files import (
    COMPACT_FILE,
    SUBJECT_FILE,
    read_shared_head,
    save_shared_head,
    write_subject,
)
from ...shared.subject_mesh import SubjectMesh
from ..compact.codecs import parts_of, write_coded
from ..compact.precision import Precision
from ..views import training_views
from .recipes import (
    OURS,
    Recipe,
    coarser_lines,
    coarser_planes,
    contributions,
    kept_rows,
    read_reduced,
    write_reduced,
)

EXACT_PARTS = ("plane_box", "line_box", "jaw_bases")
TRIANGLES = "triangles"
_ANY = 1 << 30  # no reduction


def variants(folder: Path, clip: Clip, device: str) -> Iterator[Variant]:
    """The variants of `recipes.OURS` that change this avatar."""
    whole = OursAvatar.read(folder, device)
    head = read_shared_head(folder)
    weights = cache(lambda: contributions(whole, training_views(clip)))
    for recipe in OURS:
        if _idle(recipe, whole.field):
            continue
        yield Variant(recipe.name, recipe.summary, partial(_make, whole, head, clip, weights, recipe, device))


def _idle(recipe: Recipe, field: StoredField) -> bool:
    """Whether a recipe only reduces samples of planes or lines, and the avatar has no more samples than that."""
    if replace(recipe, planes=None, lines=None) != Recipe():
        return False
    changed = _resampled(field.tensors, recipe)
    return all(changed[name] is value for name, value in field.tensors.items())


def _resampled(tensors: dict[str, Tensor], recipe: Recipe) -> dict[str, Tensor]:
    return coarser_lines(coarser_planes(tensors, recipe.planes or _ANY), recipe.lines or _ANY)


def _make(
    whole: OursAvatar,
    head: HeadAsset,
    clip: Clip,
    weights: Callable[[], Tensor],
    recipe: Recipe,
    device: str,
    out: Path,
) -> OursAvatar:
    """Write an avatar reduced by a recipe; return the avatar that is read back."""
    rows = kept_rows(weights, recipe.splats, len(whole.field.tensors["splats"])).to(device)
    tensors = dict(whole.field.tensors)
    for name in PER_SPLAT:
        if name in tensors:
            tensors[name] = tensors[name].index_select(0, rows)
    tensors = _resampled(tensors, recipe)
    field = StoredField(tensors, whole.field.dynamic)
    save_shared_head(out, head)
    subject, stored = whole.subject, [out / COMPACT_FILE]
    if recipe.storage == "coded":
        reduced = OursAvatar([], whole.mesh, subject, field, device)
        write_coded(parts_of(reduced, head, clip), head, out, Precision(step=recipe.step), None)
        coded = OursAvatar.read(out, device)
        subject, field = coded.subject, coded.field
    else:
        write_subject(out / SUBJECT_FILE, subject)
        path = out / FIELD_FILE
        if recipe.storage == "exact":
            save_field(path, field)
            field = read_field(path, head, device)
        else:
            table, triangles = tensors["splats"][:, :-1], tensors["splats"][:, -1]
            narrow = {**tensors, "splats": table, TRIANGLES: triangles.to(torch.int32)}
            write_reduced(path, narrow, recipe.storage, EXACT_PARTS)
            read = read_reduced(path)
            triangles = read.pop(TRIANGLES)[:, None].to(torch.float32)
            read["splats"] = torch.cat([read["splats"], triangles], dim=1)
            field = field_of(path, read, {DYNAMIC: ",".join(field.dynamic)}, head, device)
        stored = [path, out / SUBJECT_FILE]
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
    return OursAvatar(stored, mesh, subject, field, device, recipe.cutoffs)

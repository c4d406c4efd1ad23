"""Variants of a trained avatar of GaussianAvatars."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from ....bench.contracts import Clip, HeadAsset, Variant
from ...ga.method import GAAvatar
from ...ga.storage import PLY_FILE, read_ga_splats, write_ga_splats
from ...ops.harmonics import coefficient_count
from ...ours.storage import SPLAT_WIDTHS, splat_columns
from ...shared.avatar_files import (
    SUBJECT_FILE,
    Subject,
    read_shared_head,
    read_subject,
    save_shared_head,
    write_subject,
)
from ...shared.subject_mesh import SubjectMesh
from ..compact.container import Arrays, Content, read_content, write_content
from ..compact.encoding import decode_splats, encode_splats
from ..compact.file import COMPACT_FILE, decode_subject, encode_subject
from ..compact.precision import Precision
from .recipes import GA, Recipe, contributions, most_contributing, read_reduced, training_views, write_reduced

REDUCED_FILE = "splats.safetensors"
TRIANGLES = "binding"


def variants(folder: Path, clip: Clip, device: str) -> Iterator[Variant]:
    """The variants of `recipes.GA`. All variants use the tracking refined in training."""
    whole, head = GAAvatar.read(folder, device), read_shared_head(folder)
    weights = contributions(whole, training_views(clip))
    for recipe in GA:
        rows = most_contributing(weights, recipe.splats).to(device)
        yield Variant(recipe.name, recipe.summary, partial(_make, whole, head, rows, recipe, device))


def _make(whole: GAAvatar, head: HeadAsset, rows: Tensor, recipe: Recipe, device: str, out: Path) -> GAAvatar:
    """Write an avatar reduced by a recipe; return the avatar that is read back."""
    splats = {name: value.index_select(0, rows) for name, value in whole.splat_tensors.items()}
    binding = whole.binding.index_select(0, rows)
    if recipe.degree is not None:
        splats["sh_rest"] = splats["sh_rest"][:, :, : coefficient_count(recipe.degree) - 1].contiguous()
    save_shared_head(out, head)
    subject: Subject = whole.subject
    if recipe.storage == "compact":
        path = out / COMPACT_FILE
        write_content(path, _content(splats, binding, subject))
        subject, splats, binding = _read_content(path, head, device)
        stored = [path]
    else:
        write_subject(out / SUBJECT_FILE, subject)
        subject = read_subject(out / SUBJECT_FILE, head)
        if recipe.storage == "exact":
            path = out / PLY_FILE
            write_ga_splats(path, splats, binding)
            splats, binding = read_ga_splats(path, len(head.faces), device)
        else:
            path = out / REDUCED_FILE
            tensors = {
                **splats,
                "opacities": splats["opacities"][:, None],
                TRIANGLES: binding.to(torch.int32),
            }
            write_reduced(path, tensors, recipe.storage)
            splats = {name: value.to(device) for name, value in read_reduced(path).items()}
            binding = splats.pop(TRIANGLES).to(torch.int64)
            splats["opacities"] = splats["opacities"][:, 0]
        stored = [path, out / SUBJECT_FILE]
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
    return GAAvatar(stored, mesh, subject, splats, binding, whole.refined, device, recipe.cutoffs)


def _content(splats: dict[str, Tensor], binding: Tensor, subject: Subject) -> Content:
    """Store splats with harmonics as "ours" does: sorted by triangle, stably, since equal depths are drawn in
    order."""
    order = torch.argsort(binding, stable=True)
    columns = {**splats, "opacities": splats["opacities"][:, None], TRIANGLES: binding[:, None].float()}
    table = torch.cat([columns[name] for name in SPLAT_WIDTHS], dim=1)
    tensors = {"splats": table, "sh_dc": splats["sh_dc"], "sh_rest": splats["sh_rest"]}
    tensors = {name: value.index_select(0, order).cpu() for name, value in tensors.items()}
    precision = Precision()
    arrays, steps = encode_splats(tensors, precision, turned=False)
    person = encode_subject(subject, precision)
    return Content({**arrays, **person.arrays}, person.text, {**steps, **person.steps})


def _read_content(path: Path, head: HeadAsset, device: str) -> tuple[Subject, dict[str, Tensor], Tensor]:
    """Subject, per-splat tensors and binding of a file of `_content`."""
    arrays = Arrays(path, read_content(path))
    subject, tensors = decode_subject(arrays, head), decode_splats(arrays)
    columns = splat_columns(tensors.pop("splats"))
    splats = {name: value.contiguous().to(device) for name, value in {**columns, **tensors}.items()}
    binding = splats.pop(TRIANGLES)[:, 0].to(torch.int64)
    splats["opacities"] = splats["opacities"][:, 0]
    return subject, splats, binding

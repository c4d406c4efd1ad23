"""Variants of a trained avatar of GaussianAvatars."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from ....bench.contracts import Clip, HeadAsset, Variant
from ...ga.method import GAAvatar
from ...ga.storage import BINDING, PLY_FILE, read_ga_splats, write_ga_splats
from ...ops.harmonics import coefficient_count
from ...shared.avatar_files import (
    COMPACT_FILE,
    SUBJECT_FILE,
    Subject,
    read_shared_head,
    read_subject,
    save_shared_head,
    write_subject,
)
from ...shared.subject_mesh import SubjectMesh
from ..compact.codecs import parts_of, write_coded
from ..compact.precision import Precision
from ..views import training_views
from .recipes import GA, Recipe, contributions, kept_rows, read_reduced, write_reduced

REDUCED_FILE = "splats.safetensors"


def variants(folder: Path, clip: Clip, device: str) -> Iterator[Variant]:
    """The variants of `recipes.GA`. All variants use the tracking refined in training."""
    whole, head = GAAvatar.read(folder, device), read_shared_head(folder)
    weights = cache(lambda: contributions(whole, training_views(clip)))
    for recipe in GA:
        yield Variant(recipe.name, recipe.summary, partial(_make, whole, head, clip, weights, recipe, device))


def _make(
    whole: GAAvatar,
    head: HeadAsset,
    clip: Clip,
    weights: Callable[[], Tensor],
    recipe: Recipe,
    device: str,
    out: Path,
) -> GAAvatar:
    """Write an avatar reduced by a recipe; return the avatar that is read back."""
    rows = kept_rows(weights, recipe.splats, len(whole.binding)).to(device)
    splats = {name: value.index_select(0, rows) for name, value in whole.splat_tensors.items()}
    binding = whole.binding.index_select(0, rows)
    if recipe.degree is not None:
        splats["sh_rest"] = splats["sh_rest"][:, :, : coefficient_count(recipe.degree) - 1].contiguous()
    save_shared_head(out, head)
    subject: Subject = whole.subject
    stored = [out / COMPACT_FILE]
    if recipe.storage == "coded":
        reduced = GAAvatar([], whole.mesh, subject, splats, binding, whole.refined, device)
        write_coded(parts_of(reduced, head, clip), head, out, Precision(step=recipe.step), None)
        coded = GAAvatar.read(out, device)
        subject, splats, binding = coded.subject, coded.splat_tensors, coded.binding
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
                BINDING: binding.to(torch.int32),
            }
            write_reduced(path, tensors, recipe.storage)
            splats = {name: value.to(device) for name, value in read_reduced(path).items()}
            binding = splats.pop(BINDING).to(torch.int64)
            splats["opacities"] = splats["opacities"][:, 0]
        stored = [path, out / SUBJECT_FILE]
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
    return GAAvatar(stored, mesh, subject, splats, binding, whole.refined, device, recipe.cutoffs)

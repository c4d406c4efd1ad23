"""Derived variants of a trained avatar: coded, each change alone, then several together."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors.torch import save
from torch import Tensor

from ....bench.contracts import Avatar, Camera, Clip, HeadAsset, HeadPose, SplatAvatar, Variant
from ....bench.engine.config import CODED
from ....bench.io.files import write_bytes
from ...ga.method import BINDING, PLY_FILE, GAAvatar, read_ga_splats, write_ga_splats
from ...ops.planes import coefficient_count
from ...ours.field import (
    DYNAMIC,
    FIELD_FILE,
    PER_SPLAT,
    PLANES,
    StoredField,
    field_of,
    read_field,
    save_field,
)
from ...ours.method import OursAvatar
from ...shared.avatar_files import (
    COMPACT_FILE,
    SUBJECT_FILE,
    Subject,
    read_shared_head,
    read_subject,
    save_shared_head,
    write_subject,
)
from ...shared.rendering import USUAL, Cutoffs
from ...shared.surface_points import SubjectMesh
from ...shared.tensor_files import read_safetensors
from ..compact.codecs import parts_of, write_coded
from ..harmonics import contribution, training_views
from ..settings import Precision

STEPS = (1.0, 0.25, 0.5, 2.0, 4.0)
"""Factors of all quantisation steps."""


def coded_name(step: float) -> str:
    """Name of a variant by the factor of its steps: "coded", "coded-x0.5"."""
    return CODED if step == 1 else f"{CODED}-x{step:g}"


def coded_summary(step: float) -> str:
    """Description of that variant."""
    return "quantised by visible effect, compressed" + (f", steps times {step:g}" if step != 1 else "")


def _variants(module: str, name: str, folder: Path, clip: Clip, device: str) -> Iterator[Variant]:
    """The coded variants of an avatar of the class ``name`` in a module of `methods`, for `MethodSpec.variants`."""
    avatar_class = getattr(import_module(f"...{module}", __package__), name)
    for step in STEPS:
        make = partial(make_coded, avatar_class, folder, clip, device, step)
        yield Variant(coded_name(step), coded_summary(step), make)


gbs_variants = partial(_variants, "gbs.method", "GBSAvatar")
gha_variants = partial(_variants, "gha.method", "GHAAvatar")
insta_variants = partial(_variants, "insta.avatar", "InstaAvatar")
rgbavatar_variants = partial(_variants, "rgbavatar.method", "RGBAvatarAvatar")
flashavatar_variants = partial(_variants, "flashavatar.method", "FlashAvatarAvatar")


def make_coded(avatar_class: Any, folder: Path, clip: Clip, device: str, step: float, out: Path) -> Avatar:
    """Write the coded form of the avatar of a folder; return the avatar that is read back."""
    from ..compact.codecs import DRIVING_FILE, parts_of, write_coded

    avatar, head = avatar_class.read(folder, "cpu"), read_shared_head(folder)
    write_coded(parts_of(avatar, head, clip), head, out, Precision(step=step), folder / DRIVING_FILE)
    coded: Avatar = avatar_class.read(out, device)
    return coded


Storage = Literal["exact", "half", "8bit", "coded"]
STORAGE_SUMMARIES: Mapping[Storage, str] = {
    "exact": "",
    "half": "16-bit floats",
    "8bit": "8 bits between each column's extremes",
}
# Both avatars of a capture at 144x208 (20,000 splats, 2,000 iterations) lost 0.3 and 0.8 dB, and twice their LPIPS, with
# the earlier cutoffs, without measurably less processor time; hence no other variant has them.
EARLY = Cutoffs(2 / 255, 1e-3)
EARLIER = Cutoffs(4 / 255, 1e-2)


@dataclass(frozen=True)
class Recipe:
    """Changes of an avatar, applied in this order; None and 1 change nothing."""

    splats: float = 1.0
    """Fraction of the splats that are kept: those that contribute most to training views."""
    degree: int | None = None

    planes: int | None = None
    lines: int | None = None
    """Samples along a side of a plane, along a line."""
    storage: Storage = "exact"

    cutoffs: Cutoffs = USUAL
    """Thresholds of the renderer."""
    step: float = 1.0
    """Factor of all quantisation steps of a coded avatar."""

    @property
    def name(self) -> str:
        """Short, unique among recipes of one method."""
        parts = [
            f"splats{round(100 * self.splats)}" if self.splats < 1 else "",
            "" if self.degree is None else f"sh{self.degree}",
            "" if self.planes is None else f"planes{self.planes}",
            "" if self.lines is None else f"lines{self.lines}",
            {"exact": "", "coded": coded_name(self.step)}.get(self.storage, self.storage),
            "" if self.cutoffs == USUAL else f"cut{round(255 * self.cutoffs.alpha_min)}",
        ]
        return "-".join(part for part in parts if part)

    @property
    def summary(self) -> str:
        """Description of the change."""
        cutoffs = f"alpha from {self.cutoffs.alpha_min:.3f}, transmittance from {self.cutoffs.transmittance_min:g} on"
        parts = [
            f"the {self.splats:.0%} of splats that contribute most" if self.splats < 1 else "",
            "" if self.degree is None else f"harmonics up to degree {self.degree}",
            "" if self.planes is None else f"planes of {self.planes}x{self.planes}",
            "" if self.lines is None else f"lines of {self.lines} samples",
            coded_summary(self.step) if self.storage == "coded" else STORAGE_SUMMARIES[self.storage],
            "" if self.cutoffs == USUAL else cutoffs,
        ]
        return "; ".join(part for part in parts if part)


COMMON = (
    *(Recipe(splats=fraction) for fraction in (0.75, 0.5, 0.25)),
    *(Recipe(storage=storage) for storage in ("half", "8bit")),
    *(Recipe(storage="coded", step=step) for step in STEPS),
    *(Recipe(cutoffs=cutoffs) for cutoffs in (EARLY, EARLIER)),
    Recipe(splats=0.5, storage="coded"),
)

GA = (
    *COMMON,
    *(Recipe(degree=degree) for degree in (2, 1, 0)),
    *(Recipe(degree=degree, storage="coded") for degree in (2, 1, 0)),
    *(Recipe(splats=f, degree=1, storage="coded") for f in (0.75, 0.5, 0.25)),
)

OURS = (
    *COMMON,
    *(Recipe(planes=resolution) for resolution in (64, 32)),
    Recipe(lines=16),
    *(Recipe(planes=resolution, lines=16, storage="coded") for resolution in (64, 32)),
    *(Recipe(splats=f, planes=64, lines=16, storage="coded") for f in (0.75, 0.5, 0.25)),
)


def contributions(avatar: SplatAvatar, views: Sequence[tuple[Camera, HeadPose]]) -> Tensor:
    """(N,) blending weight of each splat, summed over all pixels of all views; see `contribution`."""
    return torch.stack([contribution(avatar.splats(pose), camera) for camera, pose in views]).sum(0)


def most_contributing(weights: Tensor, fraction: float) -> Tensor:
    """Ascending indices of the given fraction of splats that contribute most; ties by index."""
    count = max(1, round(fraction * len(weights)))
    return torch.argsort(weights, descending=True, stable=True)[:count].sort().values


def kept_rows(weights: Callable[[], Tensor], fraction: float, count: int) -> Tensor:
    """Like `most_contributing`, for ``count`` splats; weights are computed only if some splats are left out."""
    return torch.arange(count) if fraction >= 1 else most_contributing(weights(), fraction)


Kind = Literal["half", "8bit"]
LEVELS = 255
LOW, STEP = "/low", "/step"
"""Name suffixes of an 8-bit tensor's lowest values and steps by column."""


def write_reduced(path: Path, tensors: Mapping[str, Tensor], kind: Kind, exact: Collection[str] = ()) -> None:
    """Write float tensors as 16-bit floats ("half") or 8-bit numbers ("8bit"); tensors in ``exact``, vectors and
    integers are unchanged."""
    stored: dict[str, Tensor] = {}
    for name, value in tensors.items():
        if name in exact or value.ndim < 2 or not value.is_floating_point():
            stored[name] = value.contiguous()
        elif kind == "half":
            stored[name] = value.to(torch.float16).contiguous()
        else:
            stored |= _eight_bits(name, value)
    write_bytes(path, save({name: value.cpu() for name, value in stored.items()}))


def read_reduced(path: Path) -> dict[str, Tensor]:
    """Read the output of `write_reduced`: float32 up to rounding, exact tensors unchanged."""
    stored, _ = read_safetensors(path)
    result: dict[str, Tensor] = {}
    for name, value in stored.items():
        if name.endswith((LOW, STEP)):
            continue
        if f"{name}{STEP}" in stored:
            value = stored[f"{name}{LOW}"] + value.to(torch.float32) * stored[f"{name}{STEP}"]
        elif value.dtype == torch.float16:
            value = value.to(torch.float32)
        result[name] = value
    return result


def _eight_bits(name: str, value: Tensor) -> dict[str, Tensor]:
    """Levels, lowest value and step of each column (index of the last axis)."""
    columns = value.reshape(-1, value.shape[-1])
    if not len(columns):
        return {name: value.contiguous()}
    low = columns.amin(0)
    step = (columns.amax(0) - low) / LEVELS
    # A constant column has the step 0, and level 0 throughout.
    levels = torch.where(step > 0, (columns - low) / step.clamp_min(torch.finfo(step.dtype).tiny), 0.0)
    quantised = levels.round().clamp(0, LEVELS).to(torch.uint8).reshape(value.shape)
    return {name: quantised.contiguous(), f"{name}{LOW}": low, f"{name}{STEP}": step}


def coarser_planes(tensors: dict[str, Tensor], resolution: int) -> dict[str, Tensor]:
    """The same tensors with (resolution^2, C) planes; unchanged where they have no more samples."""
    planes = [name for name in PLANES if name in tensors]
    return tensors | {name: _coarser_plane(tensors[name], resolution) for name in planes}


def coarser_lines(tensors: dict[str, Tensor], resolution: int) -> dict[str, Tensor]:
    """The same tensors with lines of (K, 3, resolution, C); unchanged where they have no more samples."""
    lines = tensors.get("lines")
    if lines is None or lines.shape[2] <= resolution:
        return dict(tensors)
    fit = fitting_matrix(lines.shape[2], resolution).to(lines)
    return {**tensors, "lines": torch.einsum("rl,kalc->karc", fit, lines).contiguous()}


def _coarser_plane(plane: Tensor, resolution: int) -> Tensor:
    side = round(len(plane) ** 0.5)
    if side <= resolution:
        return plane
    fit = fitting_matrix(side, resolution).to(plane)
    image = plane.reshape(side, side, -1)
    return torch.einsum("ry,sx,yxc->rsc", fit, fit, image).reshape(resolution**2, -1).contiguous()


def fitting_matrix(samples: int, fewer: int) -> Tensor:
    """(fewer, samples) float64 matrix from samples to the fewer samples that interpolate them best in least squares.

    Samples are evenly spaced with the outermost on the ends (align-corners); ``fewer`` is from 2 to ``samples``.
    """
    places = torch.linspace(0, fewer - 1, samples, dtype=torch.float64)
    nodes = torch.arange(fewer, dtype=torch.float64)
    interpolation = (1 - (places[:, None] - nodes).abs()).clamp_min(0)
    return torch.linalg.pinv(interpolation)


REDUCED_FILE = "splats.safetensors"


def ga_variants(folder: Path, clip: Clip, device: str) -> Iterator[Variant]:
    """The variants of `recipes.GA`. All variants use the tracking refined in training."""
    whole, head = GAAvatar.read(folder, device), read_shared_head(folder)
    weights = cache(lambda: contributions(whole, training_views(clip)))
    for recipe in GA:
        yield Variant(
            recipe.name, recipe.summary, partial(_make_ga, whole, head, clip, weights, recipe, device)
        )


def _make_ga(
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
            tensors = {**splats, "opacities": splats["opacities"][:, None], BINDING: binding.to(torch.int32)}
            write_reduced(path, tensors, recipe.storage)
            splats = {name: value.to(device) for name, value in read_reduced(path).items()}
            binding = splats.pop(BINDING).to(torch.int64)
            splats["opacities"] = splats["opacities"][:, 0]
        stored = [path, out / SUBJECT_FILE]
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
    return GAAvatar(stored, mesh, subject, splats, binding, whole.refined, device, recipe.cutoffs)


EXACT_PARTS = ("plane_box", "line_box", "jaw_bases")
TRIANGLES = "triangles"
_ANY = 1 << 30  # no reduction


def ours_variants(folder: Path, clip: Clip, device: str) -> Iterator[Variant]:
    """The variants of `recipes.OURS` that change this avatar."""
    whole = OursAvatar.read(folder, device)
    head = read_shared_head(folder)
    weights = cache(lambda: contributions(whole, training_views(clip)))
    for recipe in OURS:
        if _idle(recipe, whole.field):
            continue
        yield Variant(
            recipe.name, recipe.summary, partial(_make_ours, whole, head, clip, weights, recipe, device)
        )


def _idle(recipe: Recipe, field: StoredField) -> bool:
    """Whether a recipe only reduces samples of planes or lines, and the avatar has no more samples than that."""
    if replace(recipe, planes=None, lines=None) != Recipe():
        return False
    changed = _resampled(field.tensors, recipe)
    return all(changed[name] is value for name, value in field.tensors.items())


def _resampled(tensors: dict[str, Tensor], recipe: Recipe) -> dict[str, Tensor]:
    return coarser_lines(coarser_planes(tensors, recipe.planes or _ANY), recipe.lines or _ANY)


def _make_ours(
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

"""The trained avatar of "ours": its files and its rendering."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from ..bench.contracts import Camera, Frame, HeadPose
from ..bench.errors import InputError
from ..bench.files import atomic_path
from .avatar_files import SUBJECT_FILE, read_shared_head, read_subject
from .binding import WorldSplats, to_world
from .bound_avatar import PosedSplats, posed_splats, render_splats
from .bound_training import view_of
from .configs import Dynamic
from .dynamics import WIDTHS, LocalSplats, apply_offsets, changed_colors, offset_width
from .feature_lines import blend_lines, line_offsets, line_position
from .ours_appearance import driving_coefficients
from .ours_field import (
    Box,
    CanonicalFrames,
    canonical_directions,
    plane_features,
    position_part,
    shade_directions,
)
from .sh import coefficient_count, sh_degree, sh_to_rgb
from .subject_mesh import SubjectMesh
from .triplane import ENCODING_SIZE, PAIRS

FIELD_FILE = "avatar.safetensors"
DYNAMIC = "dynamic"
"""Key of the file's metadata: what the lines change, in the order of the offset network's outputs."""

SPLAT_WIDTHS = {"means": 3, "opacities": 1, "log_scales": 3, "quats": 4, "binding": 1}
"""Columns of the (N, 12) float32 splat table, 48 bytes each; the triangle is exact up to 2^24."""


def write_field(
    path: Path,
    splats: Mapping[str, Tensor],
    binding: Tensor,
    shared: Mapping[str, Tensor],
    plane_box: Box,
    line_box: Box,
    jaw_bases: np.ndarray,
    dynamic: Sequence[Dynamic],
) -> None:
    """Write splats, planes, lines, networks, boxes and jaw bases as float32 safetensors."""
    columns = {**splats, "opacities": splats["opacities"][:, None], "binding": binding[:, None]}
    table = torch.cat([columns[name].detach().to("cpu", torch.float32) for name in SPLAT_WIDTHS], dim=1)
    tensors = {name: value.detach().cpu().contiguous() for name, value in shared.items()}
    tensors |= {
        "splats": table,
        "plane_box": torch.stack(list(plane_box)).cpu(),
        "line_box": torch.stack(list(line_box)).cpu(),
        "jaw_bases": torch.from_numpy(np.asarray(jaw_bases, dtype=np.float32)),
    }
    tensors |= {
        name: splats[name].detach().cpu().contiguous() for name in ("sh_dc", "sh_rest") if name in splats
    }
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, {DYNAMIC: ",".join(dynamic)})


class Field(NamedTuple):
    """What an avatar's file holds: its tensors by name, and what the lines change."""

    tensors: dict[str, Tensor]
    dynamic: tuple[Dynamic, ...]


def read_field(path: Path, face_count: int, expression_size: int, device: str) -> Field:
    """Read and check what `write_field` wrote. Raises `InputError` where a tensor is missing or does not fit."""
    try:
        with safe_open(path, framework="pt", device=device) as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
            names = (file.metadata() or {}).get(DYNAMIC, "opacity")
    except (SafetensorError, OSError) as error:
        raise InputError(path, "", "a safetensors file", str(error)) from error
    given = names.split(",")
    if len(set(given)) != len(given) or not set(given) <= set(WIDTHS):
        raise InputError(path, DYNAMIC, f"names among {', '.join(WIDTHS)}, each once", repr(names)[:80])
    dynamic = cast(tuple[Dynamic, ...], tuple(given))
    needed = ["splats", "plane_box", "line_box", "jaw_bases"]
    if "sh_dc" in tensors:
        needed += ["sh_rest"]
    else:
        needed += ["color_weight_0", "color_weight_1", *(f"plane_{name}" for name, _, _ in PAIRS)]
    if "lines" in tensors:
        needed += [f"line_{part}_{layer}" for layer in range(3) for part in ("direction", "gain", "bias")]
    for name in needed:
        if name not in tensors:
            raise InputError(path, name, "a tensor of that name", "none")
    for name, value in tensors.items():
        if value.dtype != torch.float32 or not torch.isfinite(value).all():
            raise InputError(path, name, "finite float32 numbers", f"{value.dtype} or non-finite numbers")
    _check_shapes(path, tensors, face_count, expression_size, offset_width(dynamic))
    return Field(tensors, dynamic)


def _check_shapes(
    path: Path, tensors: Mapping[str, Tensor], face_count: int, expression_size: int, outputs: int
) -> None:
    """Raise `InputError` at the first tensor that does not fit the others, so that no rendering can."""

    def require(name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise InputError(path, name, expected, f"shape {tuple(tensors[name].shape)}")

    def exactly(name: str, *shape: int) -> None:
        require(name, tensors[name].shape == shape, f"shape {shape}")

    splats = tensors["splats"]
    width = sum(SPLAT_WIDTHS.values())
    require("splats", splats.ndim == 2 and splats.shape[1] == width, f"(N, {width})")
    binding = splats[:, -1]
    if len(binding) and not (0 <= float(binding.min()) and float(binding.max()) < face_count):
        found = f"{float(binding.min()):g} to {float(binding.max()):g}"
        raise InputError(path, "splats, triangle", f"0 to {face_count - 1}", found)
    for name in ("plane_box", "line_box"):
        exactly(name, 2, 3)
        if not (tensors[name][0] < tensors[name][1]).all():
            raise InputError(path, name, "a low corner below the high one", str(tensors[name].tolist()))

    if "sh_dc" in tensors:
        exactly("sh_dc", len(splats), 3)
        rest = tensors["sh_rest"]
        counts = [coefficient_count(degree) - 1 for degree in range(4)]
        fits = rest.shape[:2] == (len(splats), 3) and rest.ndim == 3 and rest.shape[2] in counts
        require("sh_rest", fits, f"({len(splats)}, 3, K), K one of {counts}")
    else:
        planes = [f"plane_{pair}" for pair, _, _ in PAIRS]
        for name in planes:
            plane = tensors[name]
            square = plane.ndim == 2 and round(len(plane) ** 0.5) ** 2 == len(plane) >= 4
            require(
                name, square and len(plane) == len(tensors[planes[0]]), "(R * R, C), R of all planes equal"
            )
        inputs = sum(tensors[name].shape[1] for name in planes) + ENCODING_SIZE
        first = tensors["color_weight_0"]
        require("color_weight_0", first.ndim == 2 and first.shape[1] == inputs, f"(H, {inputs})")
        exactly("color_weight_1", 3, len(first))

    bases = tensors["jaw_bases"]
    require("jaw_bases", bases.ndim == 2 and bases.shape[1] == 4, "(J, 4)")
    if "lines" not in tensors:
        return
    lines, jaws = tensors["lines"], len(bases)
    fits = lines.ndim == 4 and lines.shape[1] == 3 and jaws <= len(lines) <= jaws + expression_size
    require(
        "lines", fits and lines.shape[2] >= 2, f"(E + {jaws}, 3, L, C), E at most {expression_size}, L > 1"
    )
    sizes = [6 * lines.shape[3], *(len(tensors[f"line_bias_{layer}"]) for layer in (0, 1)), outputs]
    for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        exactly(f"line_direction_{layer}", fan_out, fan_in)
        exactly(f"line_gain_{layer}", fan_out, 1)
        exactly(f"line_bias_{layer}", fan_out)


class OursAvatar:
    """A trained head: splats without colour, planes, lines and two small networks.

    What depends on canonical position alone (plane features, places on the lines) is computed once when loaded.
    """

    def __init__(self, folder: Path, mesh: SubjectMesh, field: Field, device: str):
        tensors = field.tensors
        self._folder, self._mesh, self._tensors, self._device = folder, mesh, tensors, device
        self._dynamic = field.dynamic
        table = tensors["splats"].split(list(SPLAT_WIDTHS.values()), dim=1)
        columns = {name: column.contiguous() for name, column in zip(SPLAT_WIDTHS, table)}
        self._neutral = LocalSplats(
            columns["means"], columns["log_scales"], columns["quats"], columns["opacities"][:, 0]
        )
        self._binding = columns["binding"][:, 0].to(torch.int64)
        self._canonical = CanonicalFrames.of(mesh.frames(mesh.canonical))
        positions = self._canonical.positions(self._binding, self._neutral.means)
        if "sh_dc" not in tensors:
            features = plane_features(tensors, Box(*tensors["plane_box"]), positions)
            self._from_position = position_part(tensors, features)
        self._jaw_bases = tensors["jaw_bases"].cpu().numpy().astype(np.float64)
        if "lines" in tensors:
            box = Box(*tensors["line_box"])
            self._inside = box.contains(positions).nonzero().squeeze(1)
            unit = box.unit(positions.index_select(0, self._inside))
            self._line_position = line_position(unit, tensors["lines"].shape[2])

    @classmethod
    def read(cls, folder: Path, device: str) -> OursAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or foreign files."""
        head = read_shared_head(folder)
        subject = read_subject(folder / SUBJECT_FILE, head)
        mesh = SubjectMesh(head, subject.shape, subject.static_offset, device)
        field = read_field(folder / FIELD_FILE, len(mesh.faces), mesh.model.expression_size, device)
        return cls(folder, mesh, field, device)

    @torch.no_grad()
    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Render one frame. Raises `InputError` where the pose is of another head model."""
        splats, world, turns = self._world(pose)
        view = view_of(camera, self._device)
        colors = self._colors(splats, world, turns, view.center)
        return render_splats(world, torch.sigmoid(splats.logits), colors, view, background)

    @torch.no_grad()
    def splats(self, pose: HeadPose, camera: Camera | None = None) -> PosedSplats:
        """Splats of a pose in the world; with colours where a camera says from where they are seen."""
        splats, world, turns = self._world(pose)
        colors = None
        if camera is not None:
            colors = self._colors(splats, world, turns, view_of(camera, self._device).center)
        return posed_splats(world, torch.sigmoid(splats.logits), colors)

    def files(self) -> Sequence[Path]:
        """The field with its splats, and the subject."""
        return [self._folder / FIELD_FILE, self._folder / SUBJECT_FILE]

    def _world(self, pose: HeadPose) -> tuple[LocalSplats, WorldSplats, Tensor]:
        frames = self._mesh.frames(self._mesh.posed(self._mesh.arguments([pose])))
        splats = self._changed(pose)
        world = to_world(frames, self._binding, splats.means, splats.log_scales, splats.quats)
        return splats, world, self._canonical.turns(frames)

    def _colors(self, splats: LocalSplats, world: WorldSplats, turns: Tensor, center: Tensor) -> Tensor:
        directions = canonical_directions(turns, self._binding, world.means, center)
        if "sh_dc" in self._tensors:
            dc, rest = self._tensors["sh_dc"], self._tensors["sh_rest"]
            colors = sh_to_rgb(dc, rest, -directions, sh_degree(rest))
        else:
            colors = shade_directions(self._tensors, self._from_position, directions)
        return changed_colors(colors, splats)

    def _changed(self, pose: HeadPose) -> LocalSplats:
        if "lines" not in self._tensors:
            return self._neutral
        lines = self._tensors["lines"]
        expressions = len(lines) - len(self._jaw_bases)
        blended = blend_lines(lines, *driving_coefficients(pose, expressions, self._jaw_bases, self._device))
        inside = line_offsets(self._tensors, blended, self._line_position)
        offsets = inside.new_zeros(len(self._binding), inside.shape[1]).index_copy(0, self._inside, inside)
        return apply_offsets(self._neutral, offsets, self._dynamic)

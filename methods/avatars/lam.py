"""Export of splat avatars as the folder of LAM's viewers, and the loss of quality.

LAM: He et al., "LAM: Large avatar model for one-shot animatable Gaussian head", SIGGRAPH 2025. Files as in aigc3d/LAM
(`app_lam.py`, `tools/AVATAR_EXPORT_GUIDE.md`) and as read by myned-ai/gsplat-flame-avatar-renderer 1.2.0, all of them required:

- ``offset.ply``: splats as in 3DGS, but ``f_dc`` are colours from 0 to 1 and positions are relative to the vertex of the
  same number in ``skin.glb``.
- ``skin.glb``: a skinned mesh with a vertex for each splat, ARKit's blendshapes as morph targets, and bones, among them "hip"
  and "head".
- ``vertex_order.json``: splats from back to front.
- ``animation.glb``: clips of the bones, the first of them played at rest.

A viewer adds blendshapes to the centres of splats and moves all of them by the bone "head". It reads colours and opacities with
8 bits.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ...bench.contracts import FloatArray, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_output_folder, check_writable, entries, write_json
from ...bench.io.provenance import RENDER, note
from ...bench.specs import CommandResult, command
from ...datasets.drive.signal import ARKIT, AVATAR, SignalRequest, apply_blendshapes, arkit_columns
from ...datasets.drive.timing import Timing
from ...datasets.drive.transfer import transfer
from ...datasets.head.arrays import HeadArrays
from ..shared.tensor_files import read_ply, write_ply
from ..splats.reference import rotation_matrices
from .glb import ELEMENT_ARRAY_BUFFER, Glb, GlbWriter
from .harmonics import camera_at, direction_of, extent
from .settings import ExportLamSettings
from .web.bake import AWAY_M, Moved, Source, colors_from, rotation_of, skinning_weights
from .web.export import NECK, VIEWS, camera_of, open_source, psnr, quaternions, view_around

PLY, SKIN, ORDER, ANIMATION = "offset.ply", "skin.glb", "vertex_order.json", "animation.glb"
FILES = PLY, SKIN, ORDER, ANIMATION
COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
BONES = ("hip", "head", "jaw", "leftEye", "rightEye")
"""FLAME's joints root, neck, jaw and eyes; the viewers need the names of the first two."""
TRIANGLES = 4
MOST_SPLATS = 4096 * 2048 // (len(ARKIT) + 1)
"""The viewers have one texture for the positions at rest and in each blendshape."""
LEVELS = 255
GRID = 2.0**17
"""Steps of blendshapes per metre, so that archives are small."""
STILL_M = 1e-4
"""Blendshapes that move no splat farther are listed as missing."""
CAMERA, PITCH, FIELD_OF_VIEW = (0.0, 1.8, 1.0), -10.0, 50.0
"""Position, metres, and angles, degrees, of the viewers' fixed camera."""
FILLED = 0.75
"""Fraction of the height of the picture that the splats fill."""
SEEN_FROM = ((0.0, 0.0), (0.5, 0.0), (-0.5, 0.0), (0.0, 0.3), (0.0, -0.3))
"""Azimuth and elevation, radians, of the views whose mean colours are exported; the viewers look from the front."""
TOGETHER = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "eyeBlinkLeft")
"""Blendshapes that are at 0.5 at once, for which the loss is measured."""


@dataclass(frozen=True, eq=False)
class LamAvatar:
    """Content of a folder. N splats in the head's frame, metres."""

    means: FloatArray
    rotations: FloatArray
    log_scales: FloatArray
    opacities: FloatArray
    colors: FloatArray
    """(N, 3), (N, 3, 3), (N, 3), (N,), (N, 3) of the face at rest."""
    morphs: FloatArray
    """(52, N, 3) displacements by the blendshapes of `ARKIT` at 1."""
    weights: FloatArray
    """(N, 5) skinning weights of `BONES`."""
    joints: FloatArray
    """(5, 3) positions of `BONES`."""

    def moved(self, values: FloatArray, turn: FloatArray) -> Moved:
        """The splats as a viewer shows them: (52,) blendshapes, and (3,) axis-angle of the bone "head"."""
        means = self.means + np.tensordot(values, self.morphs, axes=1)
        means = (means - self.joints[1]) @ rotation_of(turn[None])[0].T + self.joints[1]
        axes = self.rotations * np.exp(self.log_scales)[:, None, :]
        return Moved(means, axes, self.opacities, self.colors)


class Face(NamedTuple):
    """A pose of the avatar's face, and its values of the blendshapes."""

    values: FloatArray
    pose: HeadPose


class PerformedFaces(NamedTuple):
    """The faces that are sampled."""

    single: list[Face]
    """Each blendshape of `ARKIT` at 1, mouthClose together with jawOpen, which it counters."""
    together: Face
    """`TOGETHER`."""
    residual_mm: float | None
    """Error of the transfer from the embedded head, millimetres; None for heads with shapes of ARKit's names."""


def perform(head: HeadArrays, rest: HeadPose, progress: Progress) -> PerformedFaces:
    """The blendshapes as poses of a head model, as `headbench drive` performs them: heads without shapes of ARKit's names
    have them from the embedded head."""
    rows = np.eye(len(ARKIT))
    rows[ARKIT.index("mouthClose"), ARKIT.index("jawOpen")] = 1.0
    rows = np.concatenate([rows, [[0.5 * (name in TOGETHER) for name in ARKIT]]])
    request = SignalRequest(Path("blendshapes"), head, signal_head=AVATAR if arkit_columns(head) else "")
    signal = apply_blendshapes(request, dict(zip(ARKIT, rows.T)), Timing.regular(len(rows)))
    found = transfer(signal, head, None, progress)
    place: dict[str, Any] = {"rotation": rest.rotation, "neck": rest.neck, "translation": rest.translation}
    faces = [Face(row, replace(pose, **place, timestep=None)) for row, pose in zip(rows, found.poses)]
    return PerformedFaces(faces[:-1], faces[-1], found.residual_mm)


def sample(source: Source, faces: Sequence[Face], progress: Progress) -> LamAvatar:
    """Sample the splats of an avatar at rest and in one face for each blendshape."""
    rest = source.seen(source.rest)
    middle = rest.means.mean(axis=0)
    cameras = [camera_at(middle + AWAY_M * direction_of(*angles)) for angles in SEEN_FROM]
    colors = [colors_from(source, source.rest, camera) for camera in cameras]
    displaced = np.empty((len(ARKIT), *rest.means.shape))
    for number, face in enumerate(faces):
        displaced[number] = source.seen(face.pose).means - rest.means
        progress(number + 1, len(ARKIT), ARKIT[number])
    morphs = np.tensordot(np.linalg.inv([face.values for face in faces]), displaced, axes=1)
    weights = skinning_weights(source, rest)
    return LamAvatar(
        *(rest.means, rest.rotations, rest.log_scales, 1 / (1 + np.exp(-rest.logits))),
        np.mean(colors, axis=0).clip(0, 1),
        morphs=np.round(morphs * GRID) / GRID,
        weights=np.concatenate([1 - weights.sum(axis=1, keepdims=True), weights], axis=1).clip(0, 1),
        joints=np.concatenate([source.root[None], source.joints]),
    )


def write_folder(folder: Path, avatar: LamAvatar) -> None:
    """Write the files of a folder."""
    count = len(avatar.means)
    # The viewers round down to 8 bits, and the logit of an opacity of 1 is infinite.
    colors = (np.round(LEVELS * avatar.colors) + 0.5) / LEVELS
    opacities = (np.round(LEVELS * avatar.opacities[:, None]).clip(max=LEVELS - 1) + 0.5) / LEVELS
    table = [np.zeros((count, 6)), colors, np.log(opacities / (1 - opacities))]
    table += [avatar.log_scales, quaternions(avatar.rotations)]
    write_ply(folder / PLY, COLUMNS, np.concatenate(table, axis=1), note(RENDER))
    _write_skin(folder / SKIN, avatar)
    write_json(folder / ORDER, np.argsort(avatar.means[:, 2], kind="stable").tolist())
    _write_animation(folder / ANIMATION, avatar)


def _write_skin(path: Path, avatar: LamAvatar) -> None:
    writer = GlbWriter()
    strongest = np.argsort(-avatar.weights, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(avatar.weights, strongest, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    inverse = np.tile(np.eye(4), (len(BONES), 1, 1))
    inverse[:, 3, :3] = -avatar.joints  # column-major
    primitive = {
        "attributes": {
            "POSITION": writer.add(avatar.means.astype(np.float32), bounds=True),
            "JOINTS_0": writer.add(np.where(weights > 0, strongest, 0).astype(np.uint8)),
            "WEIGHTS_0": writer.add(weights.astype(np.float32)),
        },
        "indices": writer.add(np.arange(3, dtype=np.uint16), ELEMENT_ARRAY_BUFFER),
        "mode": TRIANGLES,
        "targets": [
            {"POSITION": writer.add(morph.astype(np.float32), bounds=True, omit_zeros=True)}
            for morph in avatar.morphs
        ],
    }
    matrices = writer.add(inverse.reshape(-1, 16).astype(np.float32), None)
    nodes = [*_bone_nodes(avatar), {"name": "avatar", "mesh": 0, "skin": 0}]
    mesh = {"primitives": [primitive], "extras": {"targetNames": ARKIT}, "weights": [0] * len(ARKIT)}
    skin = {"joints": list(range(len(BONES))), "skeleton": 0, "inverseBindMatrices": matrices}
    scene = {"scene": 0, "scenes": [{"nodes": [0, len(BONES)]}], "nodes": nodes}
    writer.write(path, {**scene, "meshes": [mesh], "skins": [skin]})


def _write_animation(path: Path, avatar: LamAvatar) -> None:
    writer = GlbWriter()
    still = np.tile(np.array([0, 0, 0, 1], np.float32), (2, 1))
    times = writer.add(np.array([0, 1], np.float32), None, bounds=True)
    clip = {
        "name": "idle",
        "samplers": [{"input": times, "output": writer.add(still, None)}],
        "channels": [{"sampler": 0, "target": {"node": BONES.index("head"), "path": "rotation"}}],
    }
    scene = {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": _bone_nodes(avatar)}
    writer.write(path, {**scene, "animations": [clip]})


def _bone_nodes(avatar: LamAvatar) -> list[dict[str, Any]]:
    """The bones, the hip where the head is in front of the viewers' camera."""
    low, high = extent(avatar.means)
    pitch, half = np.radians(PITCH), np.radians(FIELD_OF_VIEW / 2)
    ahead = np.array([0, np.sin(pitch), -np.cos(pitch)])
    distance = float((high - low).max()) / (2 * FILLED * np.tan(half))
    place = CAMERA + distance * ahead - (low + high) / 2
    hip, head, *others = avatar.joints
    offsets = [hip + place, head - hip, *(joint - head for joint in others)]
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": offset.tolist()} for name, offset in zip(BONES, offsets)
    ]
    nodes[0]["children"], nodes[1]["children"] = [1], list(range(2, len(BONES)))
    return nodes


def read_folder(folder: Path) -> LamAvatar:
    """Read what `write_folder` wrote, with the precision of the viewers."""
    table = read_ply(folder / PLY, COLUMNS).astype(np.float64)
    skin = Glb.read(folder / SKIN)
    (primitive,) = skin.header["meshes"][0]["primitives"]
    attributes = {name: skin.array(number) for name, number in primitive["attributes"].items()}
    weights = np.zeros((len(table), len(BONES)))
    rows = np.arange(len(table))[:, None]
    np.add.at(weights, (rows, attributes["JOINTS_0"].astype(np.intp)), attributes["WEIGHTS_0"])
    inverse = skin.array(skin.header["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4)
    return LamAvatar(
        means=table[:, :3] + attributes["POSITION"],
        rotations=rotation_matrices(torch.from_numpy(table[:, 13:17])).numpy(),
        log_scales=table[:, 10:13],
        opacities=np.floor(LEVELS / (1 + np.exp(-table[:, 9]))) / LEVELS,
        colors=np.floor(LEVELS * table[:, 6:9]).clip(max=LEVELS) / LEVELS,
        morphs=np.stack([skin.array(target["POSITION"]) for target in primitive["targets"]]),
        weights=weights,
        joints=-inverse[:, 3, :3].astype(np.float64),
    )


def measure_losses(
    source: Source, found: LamAvatar, faces: PerformedFaces, progress: Progress
) -> dict[str, float]:
    """Minimum PSNR in dB against the avatar itself: at rest, from the front and over `VIEWS`, of single blendshapes from the
    front, of several at once, and of a turned head."""
    view = view_around(found.means)
    still: FloatArray = np.zeros(3)
    trials: list[tuple[str, Face, FloatArray, Sequence[tuple[float, float]]]]
    neutral = Face(np.zeros(len(ARKIT)), source.rest)
    trials = [("front", neutral, still, VIEWS[:1]), ("rest", neutral, still, VIEWS)]
    trials += [("blendshapes", face, still, VIEWS[:1]) for face in faces.single]
    trials.append(("together", faces.together, still, VIEWS))
    for axis in (0, 1):
        turn: FloatArray = NECK / 2 * np.eye(3)[axis]
        pose = replace(source.rest, neck=turn.astype(source.rest.neck.dtype))
        trials.append(("head turned", neutral._replace(pose=pose), turn, VIEWS))
    losses: dict[str, float] = {}
    for number, (name, face, turn, views) in enumerate(trials):
        moved = found.moved(face.values, turn)
        lost = [psnr(source, moved, face.pose, camera_of(view, *angles)) for angles in views]
        losses[name] = min(losses.get(name, np.inf), *lost)
        progress(number + 1, len(trials), f"comparing, {name}")
    return losses


@command("export lam", group="export")
def export_lam(settings: ExportLamSettings, progress: Progress = no_progress) -> CommandResult:
    """Write an avatar as the folder that LAM's viewers animate by ARKit's blendshapes."""
    out = Path(settings.out)
    archive = out.suffix == ".zip"
    if archive:
        check_writable(out, "--out")
    else:
        check_output_folder(out)
        if others := [path.name for path in entries(out) if path.name not in FILES]:
            raise InputError(out, "", "a new folder, or that of an earlier export", f"also {others[0]}")
    _, head, source, _ = open_source(settings, progress)
    count = len(source.avatar.splats(source.rest).means)
    if not 0 < count <= MOST_SPLATS:
        expected = f"an avatar of 1 to {MOST_SPLATS} splats, which the viewers can show"
        raise InputError(Path(settings.avatar), "", expected, str(count))
    faces = perform(head, source.rest, progress)
    sampled = sample(source, faces.single, progress)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary, out.stem) if archive else out
        folder.mkdir(parents=True, exist_ok=True)
        write_folder(folder, sampled)
        if archive:
            shutil.make_archive(str(out.with_suffix("")), "zip", temporary, out.stem)
        found = read_folder(folder)
        size = out.stat().st_size if archive else sum((folder / name).stat().st_size for name in FILES)
    reach = np.linalg.norm(found.morphs, axis=2).max(axis=1)
    missing = [name for name, far in zip(ARKIT, reach) if far < STILL_M]
    losses = measure_losses(source, found, faces, progress)
    text = f"{out}: {count} splats, {len(ARKIT) - len(missing)} blendshapes, {size / 1e6:.2f} MB; "
    text += "PSNR against headbench's renderer: "
    text += ", ".join(f"{name} {value:.1f}" for name, value in losses.items()) + " dB"
    if missing:
        text += f"\nThe head model has no {', '.join(missing)}."
    if faces.residual_mm is not None:
        text += f"\nBlendshapes are those of the embedded head, transferred with {faces.residual_mm:.2f} mm of error."
    data = {"out": out, "splats": count, "bytes": size, "psnr": losses, "missing": missing}
    return CommandResult(text, data | {"residual_mm": faces.residual_mm})

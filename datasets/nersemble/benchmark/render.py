"""Reads the sequences of the benchmark's monocular track and renders their test frames from a stored avatar."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ....bench.contracts import Camera, FloatArray, HeadPose, Progress, no_progress
from ....bench.engine.config import AvatarFolder
from ....bench.engine.stored import AVATAR_FILE, HEAD_FILE, open_avatar
from ....bench.errors import InputError
from ....bench.io.arrays import MAX_MAGNITUDE, check_numbers, read_arrays
from ....bench.io.images import quantise, write_png
from ....bench.specs import CommandResult, command
from ...head.arrays import HeadArrays, read_head
from ...head.loaders import load_head
from ...head.teeth import with_teeth_where_possible
from ..recording import read_calibration
from .submission import MEMBERS, MONO, BenchmarkTrack, tracking_file

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SubmissionRenderSettings:
    """Render the test frames of a participant of the NeRSemble benchmark's monocular track from a stored avatar, which was
    trained on the participant's training sequences."""

    avatar: AvatarFolder

    data: str
    """The benchmark's folder, as nersemble-benchmark-download leaves it: it holds mono_flame_avatar/."""

    participant: str
    """Participant of the avatar: 393, 404, 461, 477 or 486."""

    out: str
    """Folder to write: OUT/PARTICIPANT/SEQUENCE_TIMESTEP_SERIAL.png."""

    head: str | None = None
    """FLAME 2023 (flame2023.pkl); default: the head model beside the avatar."""

    method: str = ""
    """Method of the avatar as package.module:SPEC, where it is not registered."""

    device: str = "cpu"
    """Where to render."""


MOST_SCALE = 1000.0
EULER_TOLERANCE = 1e-3
"""Difference between entries of a rotation matrix in the file and from its angles that is not worth a warning."""


@dataclass(frozen=True, eq=False)
class BenchmarkSequence:
    """A tracked sequence: cameras by serial, poses by timestep from 0, (S,) shape coefficients of the file."""

    cameras: Mapping[str, Camera]
    poses: tuple[HeadPose, ...]
    shape: FloatArray


def read_sequence(
    data: Path,
    track: BenchmarkTrack,
    participant: str,
    sequence: str,
    head: HeadArrays,
    shape: FloatArray | None = None,
) -> BenchmarkSequence:
    """Read cameras and tracking of a sequence from the benchmark's folder. ``head``: FLAME 2023 with or without teeth;
    coefficients are padded with zeros to its bases. ``shape``: (S,) shape that poses are for; default: that of the file."""
    path = tracking_file(data, participant, sequence)
    arrays = read_arrays(path, MEMBERS)
    for name, values in arrays.items():
        check_numbers(path, name, values, MAX_MAGNITUDE)
    scale = float(arrays["scale"][0, 0])
    if not 1 / MOST_SCALE <= scale <= MOST_SCALE:
        raise InputError(path, "scale", f"from {1 / MOST_SCALE:g} to {MOST_SCALE:g}", f"{scale:g}")
    rotations = Rotation.from_euler("XYZ", arrays["rotation"].astype(np.float64))
    off = float(np.abs(rotations.as_matrix() - arrays["rotation_matrices"]).max(initial=0.0))
    if off > EULER_TOLERANCE:
        why = "%s, rotation_matrices: entries differ by up to %.3g from those of the angles in rotation, which are used"
        log.warning(why, path, off)
    own = _padded(path, "shape", arrays["shape"], head.shape_basis.shape[2])[0]
    expression = _padded(path, "expression", arrays["expression"], head.expression_basis.shape[2])
    neutral = head.template + head.shape_basis @ (own if shape is None else shape)
    regressor = head.joint_regressor[0]
    roots = regressor @ neutral + np.einsum("v,vce,te->tc", regressor, head.expression_basis, expression)
    # scale (R x + t / scale) = scale (R (x - root) + root + t'), the outer scale being the cameras'.
    translations = arrays["translation"] / scale + rotations.apply(roots) - roots
    eyelids = None if head.eyelid_basis is None else np.zeros(head.eyelid_basis.shape[2], np.float32)
    poses = tuple(
        HeadPose(
            head.version,
            expression=expression[row].astype(np.float32),
            rotation=rotations[row].as_rotvec().astype(np.float32),
            neck=arrays["neck"][row].astype(np.float32),
            jaw=arrays["jaw"][row].astype(np.float32),
            eyes=arrays["eyes"][row].astype(np.float32),
            translation=translations[row].astype(np.float32),
            eyelids=eyelids,
            subject=participant,
        )
        for row in range(len(expression))
    )
    calibration = read_calibration(data / track.name / participant / "calibration" / "camera_params.json")
    missing = [serial for serial in track.serials if serial not in calibration.world_to_camera]
    if missing:
        raise InputError(
            calibration.file, "world_2_cam", f"cameras {', '.join(track.serials)}", f"no {missing[0]}"
        )
    cameras = {serial: calibration.camera(serial, track.size, track.size) for serial in track.serials}
    return BenchmarkSequence({s: _nearer(camera, scale) for s, camera in cameras.items()}, poses, own)


def _nearer(camera: Camera, scale: float) -> Camera:
    """The camera in a world divided by ``scale``."""
    matrix = camera.world_to_camera.copy()
    matrix[:3, 3] /= scale
    return replace(camera, world_to_camera=matrix)


def _padded(path: Path, name: str, values: FloatArray, size: int) -> FloatArray:
    if values.shape[1] > size:
        remedy = "Give FLAME 2023 with all its bases: flame2023.pkl."
        raise InputError(
            path, name, f"at most the {size} coefficients of the head model", f"{values.shape[1]}", remedy
        )
    return np.pad(values.astype(np.float64), ((0, 0), (0, size - values.shape[1])))


WHITE = (1.0, 1.0, 1.0)


@command("submission render", group="export", writes="out")
def render_participant(settings: SubmissionRenderSettings, progress: Progress = no_progress) -> CommandResult:
    """Render the test frames of a NeRSemble benchmark participant."""
    if settings.participant not in MONO.sequences:
        expected = f"one of {', '.join(MONO.sequences)}"
        raise InputError("command line", "--participant", expected, repr(settings.participant))
    stored = open_avatar(Path(settings.avatar), settings.method)
    folder, method = stored.folder, stored.method
    head = _head(folder, settings.head)
    shape = stored.shape_of(head.version, head.shape_basis.shape[2])
    sequences = {
        name: read_sequence(Path(settings.data), MONO, settings.participant, name, head, shape)
        for name in MONO.sequences[settings.participant]
    }
    if not method.spec.resolution.native:
        expected = "one that works at the size of the benchmark's images, 512x512"
        found = f"{method.spec.name}, which works at another"
        raise InputError(folder / AVATAR_FILE, "resolution", expected, found, "Train it with another preset.")
    for name, sequence in sequences.items():
        mismatch = stored.shows_another(settings.participant, sequence.shape, head.version)
        if mismatch:
            log.warning(
                "%s shows %s, with another shape than %s has in %s",
                folder,
                mismatch,
                settings.participant,
                name,
            )
    avatar = stored.load(settings.device)
    home = Path(settings.out) / settings.participant
    total = sum(len(sequence.poses) * len(sequence.cameras) for sequence in sequences.values())
    done = 0
    for name, sequence in sequences.items():
        for timestep, pose in enumerate(sequence.poses):
            for serial, camera in sequence.cameras.items():
                image = quantise(avatar.render(camera, pose, WHITE).rgb)
                write_png(home / f"{name}_{timestep:05d}_{serial}.png", image)
                done += 1
                progress(done, total, name)
    return CommandResult(
        f"{home}: {total} frames of {len(sequences)} sequences", {"out": home, "frames": total}
    )


def _head(folder: Path, given: str | None) -> HeadArrays:
    if given is not None:
        return with_teeth_where_possible(load_head(Path(given)))
    path = folder / HEAD_FILE
    if not path.is_file():
        remedy = "Name it with --head: flame2023.pkl."
        raise InputError(path, "", "the head model beside the avatar", "no such file", remedy)
    return read_head(path)

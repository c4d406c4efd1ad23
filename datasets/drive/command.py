"""``headbench drive``: renders an avatar with a driving signal, as a video or a capture, and measures the result."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import (
    Avatar,
    ByteArray,
    FloatArray,
    FrameKey,
    HeadPose,
    IntArray,
    Progress,
    no_progress,
)
from ...bench.engine.adaptation import AdaptedClip, MethodNeeds, adapt
from ...bench.engine.stored import HEAD_FILE, SUBJECT_FILE, StoredAvatar, open_avatar
from ...bench.errors import InputError
from ...bench.experiments.extremes import training_poses
from ...bench.experiments.reenactment import AT_ORIGIN, RigidMean, retarget, view_camera
from ...bench.io.arrays import MAX_MAGNITUDE, Member, read_arrays
from ...bench.io.files import check_kind, check_output_folder, check_writable, write_json
from ...bench.io.images import ENCODINGS, browser_encoder, quantise, write_browser_video, write_png
from ...bench.io.lock import locked
from ...bench.io.provenance import RENDER
from ...bench.io.videos import SUFFIXES
from ...bench.specs import CommandResult, command
from ..clip import CaptureClip, without_images
from ..ga.writer import CANONICAL_JAW, CapturePlan, CaptureWriter, SequencePlan
from ..head.arrays import JOINT_NAMES, HeadArrays, read_head
from ..head.model import PosedSubject, pose_in_head_frame, resting
from ..head.refit.identity import FACE
from ..mesh_pictures import portrait_camera
from .formats import read_signal
from .settings import DriveSettings
from .signal import DrivingSignal, SignalRequest
from .transfer import Transferred, head_motion, resampled, smoothed, transfer, window_length

FPS = 25.0
"""Frames per second where neither the signal nor an option states them."""
SEQUENCE = "drive"
"""Name of the driven sequence in captures."""


@dataclass(frozen=True, eq=False)
class AvatarScene:
    """An avatar's subject before a camera."""

    clip: CaptureClip
    """Clip of the subject with one camera; its poses are replaced."""
    rest: RigidMean
    """Head pose at rest."""

    @property
    def head(self) -> HeadArrays:
        """Head model of the driven poses."""
        return self.clip.head

    def placed(self, poses: Sequence[HeadPose]) -> list[HeadPose]:
        """Poses around the origin, moved to the head's rest position."""
        return [retarget(pose, AT_ORIGIN, self.rest, self.clip.subject) for pose in poses]

    def driven(self, poses: Mapping[int, HeadPose], sequences: Mapping[int, str]) -> CaptureClip:
        """The clip with other poses, all of them to be rendered; ``sequences`` names that of each timestep."""
        (camera,) = self.clip.cameras
        keys = [FrameKey(self.clip.subject, sequences[t], t, camera) for t in sorted(poses)]
        return self.clip.to_render("drive", {"frames": len(keys)}, keys, poses, self.clip.cameras)


def make_scene(settings: DriveSettings, stored: StoredAvatar, progress: Progress) -> AvatarScene:
    """The scene of the settings: in the capture that is named, else in front of the avatar's own head."""
    if settings.capture:
        clip = settings.open(settings.capture, progress)
        stored.check_subject(clip)
        camera = view_camera(clip, settings.camera or None)
        seen = replace(clip, cameras={camera.id: camera}, excluded={})
        return AvatarScene(seen, RigidMean.of(training_poses(clip)))
    path = stored.folder / HEAD_FILE
    if not path.is_file():
        remedy = "Name the capture that the avatar was trained on: --capture."
        raise InputError(path, "", "the head model beside the avatar", "no such file", remedy)
    head = read_head(path)
    shape, offset = _identity(stored, head)
    neutral = PosedSubject(head, shape, offset).neutral
    camera = portrait_camera(neutral, settings.size, settings.size)
    fields = without_images(head, {}) | {"static_offset": offset, "cameras": {camera.id: camera}}
    subject = str(stored.record["subject"])
    return AvatarScene(CaptureClip(subject=subject, shape=shape, splits={}, files={}, **fields), AT_ORIGIN)


def _identity(stored: StoredAvatar, head: HeadArrays) -> tuple[FloatArray, FloatArray]:
    """(S,) shape and (V, 3) static offset of an avatar; without a file of them, the recorded shape and no offset."""
    path, sizes = stored.folder / SUBJECT_FILE, {"S": head.shape_basis.shape[2], "V": len(head.template)}
    if path.is_file():
        members = {
            "shape": Member("f", ("S",), MAX_MAGNITUDE),
            "static_offset": Member("f", ("V", 3), MAX_MAGNITUDE),
        }
        arrays = read_arrays(path, members, sizes)
        return arrays["shape"], arrays["static_offset"]
    shape = np.asarray(stored.record["shape"], np.float64)
    if shape.shape != (sizes["S"],):
        expected = f"{sizes['S']} coefficients, as its head model has"
        raise InputError(stored.folder, "shape", expected, str(shape.size), "Name its capture: --capture.")
    return shape, np.zeros(head.template.shape)


REST = "REST"
"""Training sequence of a driven capture, which has to have one: one frame, see `canonical`."""


def canonical(head: HeadArrays) -> HeadPose:
    """The face at rest with an open mouth, as VHAP's canonical parameters have it: unlike the frames of any signal at
    rest. Splits of a capture must not share images."""
    return replace(resting(head), jaw=np.array(CANONICAL_JAW))


class Renderer:
    """Renders the frames of a clip in the form required by the avatar's method, and records their times.

    Attributes
    ----------
    seconds : list[float]
        Time of each rendered frame.
    """

    def __init__(self, avatar: Avatar, clip: CaptureClip, adapted: AdaptedClip, progress: Progress):
        self._avatar, self._clip, self._adapted, self._progress = avatar, clip, adapted, progress
        self.seconds: list[float] = []

    def frames(self, keys: Sequence[FrameKey]) -> Iterator[ByteArray]:
        """(H, W, 3) 8-bit images of frames, in order."""
        background = [float(value) for value in self._clip.background]
        for number, key in enumerate(keys, 1):
            seen = self._adapted.key(key)
            camera, pose = self._adapted.clip.cameras[seen.camera], self._adapted.clip.poses[seen.timestep]
            start = time.perf_counter()
            rgb: FloatArray = self._avatar.render(camera, pose, background).rgb
            self.seconds.append(time.perf_counter() - start)
            self._progress(number, len(keys), str(key))
            yield quantise(self._adapted.restore(key, rgb))


def write_driven_video(path: Path, renderer: Renderer, clip: CaptureClip, fps: float) -> None:
    """Write the driven sequence of a clip as a video."""
    keys = [key for key in clip.splits["self_reenactment"] if key.sequence != REST]
    write_browser_video(path, renderer.frames(keys), fps, RENDER)


def write_driven_capture(out: Path, renderer: Renderer, clip: CaptureClip) -> Path:
    """Write the frames and poses of a clip in the GaussianAvatars layout; return the folder for readers. The driven
    sequence is held out for self-reenactment; the sequence `REST` is for training."""
    keys = list(clip.splits["self_reenactment"])
    sequences: dict[str, list[HeadPose]] = {}
    places = []
    for key in keys:
        poses = sequences.setdefault(key.sequence, [])
        places.append((key.sequence, len(poses), key.camera))
        poses.append(clip.poses[key.timestep])
    red, green, blue = (float(value) for value in clip.background)
    plan = CapturePlan(
        subject=clip.subject.replace("_", "-"),
        head=clip.head,
        shape=clip.shape,
        static_offset=clip.static_offset,
        cameras=[*clip.cameras.values()],
        sequences=[SequencePlan(name, poses) for name, poses in sequences.items()],
        test_sequences=[name for name in sequences if name != REST],
        novel_view_cameras=[],
        background=(red, green, blue),
    )
    writer = CaptureWriter(out, plan)
    for place, frame in zip(places, renderer.frames(keys)):
        write_png(writer.image_path(*place), frame, RENDER)
    return writer.write_metadata()


_MILLIMETRES = 1e3
_MIDDLE = 0.25
"""Share of the lips' width, on either side of their middle, in which the distance of the lips is measured; corners touch."""
_JAW = JOINT_NAMES.index("jaw")


class DrivenMeasures:
    """Measures on the vertices of one subject. ``shape``: (S,) identity of the avatar. ``static_offset``: (V, 3)
    metres."""

    def __init__(self, head: HeadArrays, shape: FloatArray, static_offset: FloatArray):
        self._subject = PosedSubject(head, shape, static_offset)
        everything = np.arange(len(head.template))
        face = np.asarray(head.regions.get(FACE, everything))
        self._face = face if len(face) else everything
        self._lips = _lips(head, self._subject.neutral)

    def jitter_mm(self, poses: Sequence[HeadPose]) -> float | None:
        """Mean length of the second difference over time of the vertices of the face, millimetres; None for fewer than 3 frames."""
        if len(poses) < 3:
            return None
        total, before = 0.0, []
        for mesh in self._meshes(poses, self._face):
            before.append(mesh)
            if len(before) == 3:
                total += float(np.linalg.norm(before[2] - 2 * before[1] + before[0], axis=1).mean())
                before.pop(0)
        return _MILLIMETRES * total / (len(poses) - 2)

    def spill_mm(self, pose: HeadPose) -> float:
        """Root mean square distance of the vertices of the face between the neutral head and a pose, head motion apart; millimetres."""
        (mesh,) = self._meshes([pose_in_head_frame(pose)], self._face)
        squares = np.square(mesh - self._subject.neutral[self._face]).sum(axis=1)
        return _MILLIMETRES * float(np.sqrt(squares.mean()))

    def lip_distances_mm(self, poses: Sequence[HeadPose]) -> FloatArray | None:
        """(T,) smallest distances between the middle of the upper and the lower lip, millimetres; None for heads without lips."""
        if self._lips is None:
            return None
        both, count, distances = np.concatenate(self._lips), len(self._lips[0]), []
        for mesh in self._meshes(poses, both):
            gaps = mesh[:count, None] - mesh[None, count:]
            distances.append(np.linalg.norm(gaps, axis=2).min())
        return _MILLIMETRES * np.array(distances)

    def _meshes(self, poses: Sequence[HeadPose], vertices: IntArray) -> Iterator[FloatArray]:
        """(n, 3) vertices of each pose."""
        for batch in self._subject.batches(poses):
            yield from batch[:, vertices]


def _lips(head: HeadArrays, neutral: FloatArray) -> tuple[IntArray, IntArray] | None:
    """Vertices of the middle of the upper and of the lower lip, which are those that the jaw moves less or more than half way."""
    lips = np.asarray(head.regions.get("lips", ()), np.int64)
    if not len(lips):
        return None
    across = neutral[lips, 0]
    middle, width = (across.min() + across.max()) / 2, np.ptp(across)
    lips = lips[np.abs(across - middle) < _MIDDLE * width]
    share = head.skinning_weights[lips, _JAW]
    share = share / max(float(share.max(initial=0.0)), np.finfo(np.float64).tiny)
    upper, lower = lips[share < 0.5], lips[share >= 0.5]
    return (upper, lower) if len(upper) and len(lower) else None


RESULT_FILE = "drive.json"


@command("drive", group="inspect")
def drive_avatar(settings: DriveSettings, progress: Progress = no_progress) -> CommandResult:
    """Drive a stored avatar with any signal: coefficients, blendshapes, FLAME parameters, a capture."""
    out = Path(settings.out)
    is_video = out.suffix.lower() in ENCODINGS
    with ExitStack() as stack:
        if is_video:
            browser_encoder(out)
            check_writable(out, "--out")
        elif out.suffix.lower() in SUFFIXES:
            raise InputError(
                "command line", "--out", f"a folder, or a file in {', '.join(ENCODINGS)}", out.name
            )
        else:
            check_output_folder(out)
            check_kind(out, "captures")
            stack.enter_context(locked(out))
        stored = open_avatar(Path(settings.avatar), settings.method)
        scene = make_scene(settings, stored, progress)
        sizes = {(camera.width, camera.height) for camera in scene.clip.cameras.values()}
        if is_video and any(side % 2 for size in sizes for side in size):
            remedy = "Write a folder, or leave out --capture."
            size_text = " and ".join(f"{width}x{height}" for width, height in sizes)
            raise InputError(
                "command line", "--capture", "a camera of even size, for a video", size_text, remedy
            )
        start = time.perf_counter()
        request = SignalRequest(
            Path(settings.signal),
            scene.head,
            signal_head=settings.signal_head,
            map=settings.map,
            sequence=settings.sequence,
            fps=settings.fps,
            options=settings,
            progress=progress,
        )
        signal = read_signal(request, settings.form)
        fps = settings.fps or signal.timing.fps or FPS
        regular, filled = resampled(request.path, signal.poses, signal.timing, fps)
        signal = replace(signal, poses=regular)
        window_length(len(signal.poses), settings.smooth, fps)
        transferred = transfer(signal, scene.head, settings.neutral, progress)
        moving = head_motion(transferred.poses, settings.still_head)
        driven = smoothed(moving, settings.smooth, fps)
        transfer_ms = 1e3 * (time.perf_counter() - start) / len(driven)
        data = measured(settings, scene, signal, transferred, (moving, driven))
        data |= {"fps": fps, "interpolated": filled, "transfer_ms": round(transfer_ms, 2)}
        poses = dict(enumerate(scene.placed([*driven, canonical(scene.head)])))
        sequences = dict.fromkeys(poses, SEQUENCE) | {len(driven): REST}
        if is_video:
            poses.pop(len(driven))
        clip = scene.driven(poses, sequences)
        kept = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        form = adapt(clip, MethodNeeds.of(stored.method.spec), stored.heads, kept)
        avatar = stored.load(settings.device)
        renderer = Renderer(avatar, clip, form, progress)
        written = out
        if is_video:
            write_driven_video(out, renderer, clip, fps)
        else:
            written = write_driven_capture(out, renderer, clip)
        data |= {
            "render_ms": round(1e3 * float(np.median(renderer.seconds)), 2),
            "written": written.as_posix(),
        }
        if not is_video:
            write_json(out / RESULT_FILE, data)
    return CommandResult(report_text(data), data)


def measured(
    settings: DriveSettings,
    scene: AvatarScene,
    signal: DrivingSignal,
    found: Transferred,
    motion: tuple[Any, Any],
) -> dict[str, Any]:
    """Measures of the driven poses as plain values, and the channels of the signal that drive nothing. ``motion`` has
    the poses before and after smoothing."""
    measures = DrivenMeasures(scene.head, scene.clip.shape, scene.clip.static_offset)
    before, after = motion
    reference = settings.neutral or 0
    gaps = measures.lip_distances_mm([resting(scene.head), *after])
    return {
        "signal": settings.signal,
        "format": signal.form,
        "frames": len(after),
        "signal_fps": signal.timing.fps,
        "head_models": [signal.head.version, scene.head.version],
        "refit_residual_mm": _rounded(found.residual_mm),
        "jitter_mm": {
            "before": _rounded(measures.jitter_mm(before)),
            "after": _rounded(measures.jitter_mm(after)),
        },
        "spill_frame": reference,
        "spill_mm": {
            "as_read": _rounded(measures.spill_mm(found.read[reference])),
            "driven": _rounded(measures.spill_mm(after[reference])),
        },
        "lips_mm": None
        if gaps is None
        else {
            "neutral": _rounded(gaps[0]),
            "smallest": _rounded(gaps[1:].min()),
            "largest": _rounded(gaps[1:].max()),
        },
        "unused": {**signal.unused, **found.unused},
    }


def report_text(data: dict[str, Any]) -> str:
    """Text of the measures for a terminal."""
    source, target = data["head_models"]
    jitter, spill, lips = data["jitter_mm"], data["spill_mm"], data["lips_mm"]
    residual, stated, filled = data["refit_residual_mm"], data["signal_fps"], data["interpolated"]
    rate = f"{data['fps']:g} frames a second"
    if stated != data["fps"]:
        rate += ", as the signal states none" if stated is None else f", resampled from {stated:g}"
    fitted = "coefficients as they are" if residual is None else f"refit, {residual:.3f} mm on the face"
    lines = [
        f"{data['written']}: {data['frames']} frames of {data['signal']} ({data['format']})",
        f"  rate            {rate}",
        f"  head models     {source} to {target}: {fitted}",
        "  jitter          "
        + (
            "fewer than 3 frames"
            if jitter["before"] is None
            else f"{jitter['before']:.3f} mm, smoothed {jitter['after']:.3f} mm (mean second difference of the face)"
        ),
        f"  identity spill  {spill['as_read']:.3f} mm as read, {spill['driven']:.3f} mm driven (frame {data['spill_frame']})",
        "  lips            "
        + (
            "the head model has no lips"
            if lips is None
            else f"{lips['smallest']:.2f} to {lips['largest']:.2f} mm apart, neutral {lips['neutral']:.2f} mm"
        ),
        f"  latency         {data['transfer_ms']:.1f} ms a frame to read and transfer, {data['render_ms']:.1f} ms to render",
    ]
    if filled:
        count = sum(last - first + 1 for first, last in filled)
        ranges = ", ".join(f"{first} to {last}" if last > first else f"{first}" for first, last in filled)
        what = f"{count} of {data['frames']} frames, without a face or missing in the signal"
        lines.insert(2, f"  interpolated    {what}: {ranges}")
    reasons: dict[str, list[str]] = {}
    for channel, reason in data["unused"].items():
        reasons.setdefault(reason, []).append(channel)
    lines += [f"  not driven      {', '.join(names)} ({reason})" for reason, names in reasons.items()]
    return "\n".join(lines)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), 4)

"""Common code for repositories that train on a tracked video: straight alpha, 6D rotations, the head's frame, and files of
Metrical Tracker."""

from __future__ import annotations

import sys
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import torch

from ...bench.contracts import (
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    Frame,
    FrameKey,
    HeadAsset,
    HeadPose,
    IntArray,
    Progress,
)
from ...bench.errors import InputError
from ...bench.io.files import atomic_path
from ...bench.io.images import read_pixels
from ...datasets.head.loaders import FLAME_IDENTITY_SIZE
from ...datasets.head.model import BATCH, PosedSubject, camera_in_head_frame, pose_in_head_frame
from ...datasets.head.rotations import rotation_of
from ...datasets.images import write_image
from ...datasets.steps.masks import recomposite
from ..insta.marching import CanonicalSurface, PosedSurface
from ..insta.occupancy import camera_rays
from ..shared.avatar_files import Subject
from ..shared.surface_points import pose_key
from .ga.head_files import EXPRESSION_SIZE, ArrayPickler, OfficialHead, padded
from .method import OfficialMethod
from .spec import OfficialConfig
from .workplace import Listed, Workplace, write_launcher


@dataclass(frozen=True, eq=False)
class VisibleSurface:
    """The surface in P covered pixels of a frame."""

    rows: IntArray
    columns: IntArray
    """(P,) the pixels."""
    triangles: IntArray
    """(P,) first triangle of the head on the ray of each; -1 for pixels beside the mesh."""
    depths: FloatArray
    """(P,) metres along the camera's axis; not defined for pixels beside the mesh."""
    vertices: FloatArray
    """(V, 3) the posed mesh in the head's frame, metres."""

    @property
    def hit(self) -> np.ndarray:
        """(P,) whether a pixel shows the mesh."""
        return np.asarray(self.triangles >= 0)


class VisibleMesh:
    """Casts rays at the mesh of a subject in the head's frame; the mesh of the last pose is cached."""

    def __init__(self, head: HeadAsset, posed: PosedSubject):
        self._posed = posed
        self._surface = CanonicalSurface(head, torch.from_numpy(posed.neutral))
        self._last: tuple[bytes, PosedSurface] | None = None

    def seen(self, pose: HeadPose, camera: Camera, coverage: ByteArray) -> VisibleSurface:
        """The surface in the pixels that an (H, W) mask covers, for a camera in the head's frame."""
        rows, columns = np.nonzero(coverage)
        rays = camera_rays(camera, columns, rows, 0.0)
        surface = self._of(pose)
        hits = surface.first_hit(rays)
        along = rays.directions @ np.asarray(camera.world_to_camera[2, :3])
        vertices = np.asarray(surface.vertices.numpy(), np.float64)
        return VisibleSurface(rows, columns, hits.triangles.numpy(), hits.values.numpy() * along, vertices)

    def _of(self, pose: HeadPose) -> PosedSurface:
        still = pose_in_head_frame(pose)
        key = pose_key(still)
        if self._last is None or self._last[0] != key:
            self._last = key, self._surface.pose(torch.from_numpy(self._posed.meshes([still])[0]))
        return self._last[1]


SAME_INTRINSICS = 0.05
"""Tolerance of focal lengths and principal points of one video, pixels."""


def check_masks(clip: Clip) -> None:
    """Raise `InputError` for a clip without masks, judged by its first training frame; `straight_rgba` checks the others."""
    coverage_of(clip, clip.splits["train"][0])


def coverage_of(clip: Clip, key: FrameKey) -> ByteArray:
    """(H, W) mask of a frame."""
    mask = clip.mask(key)
    if mask is None:
        expected = "a mask; the code trains only on the head, selected by the fourth channel of its images"
        remedy = "Matte the capture (INSTA's generate.sh does), or use the native method, which needs none."
        raise InputError(f"clip {clip.subject}", str(key), expected, "none", remedy)
    return mask


def straight_rgba(clip: Clip, key: FrameKey) -> ByteArray:
    """(H, W, 4) straight alpha: contribution of the head to a pixel divided by its coverage, without the background.

    Colours times coverage equal the frame on black within half a level.
    """
    mask = coverage_of(clip, key)
    coverage = mask.astype(np.float32) / 255
    image = clip.image(key).astype(np.float32) / 255
    black = np.zeros(3, np.float32)
    colours = recomposite(image, coverage, np.asarray(clip.background, np.float32), black)
    colours /= np.maximum(coverage, 1 / 255)[..., None]
    return np.dstack([np.round(255 * colours).astype(np.uint8), mask])


def six_numbers(turns: FloatArray) -> FloatArray:
    """(6 n,) the first two rows of each rotation's matrix, of (3 n,) axis-angle vectors."""
    matrices = rotation_of(turns.reshape(-1, 3)).as_matrix()
    return np.asarray(matrices[:, :2].ravel(), np.float64)


def at_rest(posed: PosedSubject, frames: Sequence[Listed]) -> list[Listed]:
    """Frames with cameras in the head's frame; poses are unchanged."""
    frames_at_rest = []
    for start in range(0, len(frames), BATCH):
        block = frames[start : start + BATCH]
        motions = posed.motions([frame.pose for frame in block])
        frames_at_rest += [
            replace(f, camera=camera_in_head_frame(f.camera, m)) for f, m in zip(block, motions)
        ]
    return frames_at_rest


def training_frames(clip: Clip, posed: PosedSubject) -> list[Listed]:
    """Training frames in the order of the video, by timestep and camera, `at_rest`."""
    keys = sorted(clip.splits["train"], key=lambda key: (key.timestep, key.camera))
    listed = [Listed(i, k, clip.cameras[k.camera], clip.poses[k.timestep]) for i, k in enumerate(keys)]
    return at_rest(posed, listed)


# ------------------------------------------------------------------ cameras


def check_no_skew(camera: Camera) -> None:
    """Raise `InputError` for a camera with skew, which the code does not read."""
    if camera.K[0, 1]:
        raise InputError(f"camera {camera.id}", "K[0, 1]", "no skew", f"{camera.K[0, 1]:g}")


def check_one_camera(clip: Clip) -> Camera:
    """The camera of the first training frame."""
    first = clip.cameras[clip.splits["train"][0].camera]
    for name in sorted({key.camera for key in clip.splits["train"]}):
        camera = clip.cameras[name]
        same_size = (camera.width, camera.height) == (first.width, first.height)
        if not same_size or np.abs(camera.K - first.K).max() > SAME_INTRINSICS:
            expected = f"size and intrinsics of camera {first.id}; the code reads those of the first frame"
            found = f"{camera.width}x{camera.height}, K {np.round(camera.K[:2], 2).tolist()}"
            remedy = "Give it a capture whose cameras are equal, or of one camera."
            raise InputError(f"clip {clip.subject}", f"camera {name}", expected, found, remedy)
    return first


# ------------------------------------------------------------------ Metrical Tracker's files


def image_name(number: int) -> str:
    """Path of a frame's image, as INSTA's ``generate.sh`` names it."""
    return f"images/{number:05d}.png"


def frame_name(number: int) -> str:
    """Path of a frame's parameters."""
    return f"checkpoint/{number:05d}.frame"


def flame_values(subject: Subject, pose: HeadPose) -> dict[str, FloatArray]:
    """Coefficients (300,) and (100,), jaw (6,) and eyes (12,) as 6D rotations, eyelids (2,); without rigid motion."""
    return {
        "shape": padded(np.asarray(subject.shape), FLAME_IDENTITY_SIZE),
        "exp": padded(np.asarray(pose.expression), EXPRESSION_SIZE),
        "jaw": six_numbers(pose.jaw),
        "eyes": six_numbers(pose.eyes),
        "eyelids": np.zeros(2) if pose.eyelids is None else np.asarray(pose.eyelids),
    }


def opencv_values(camera: Camera) -> dict[str, FloatArray]:
    """Rotation (3, 3) and translation (3,) from the head's frame, metres, and K (3, 3), pixels."""
    world = np.asarray(camera.world_to_camera, np.float64)
    return {"R": world[:3, :3], "t": world[:3, 3], "K": np.asarray(camera.K, np.float64)}


def frame_parts(**parts: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Content of a frame's file: arrays in float32 with a leading axis of one."""
    return {
        part: {name: np.asarray(array, np.float32)[None] for name, array in values.items()}
        for part, values in parts.items()
    }


@dataclass(frozen=True, eq=False)
class FlameSubject:
    """A head model with FLAME's vertices and one identity, for loaders of tracked videos."""

    official: OfficialHead
    """The model without teeth."""
    identity: Subject

    posed: PosedSubject
    """The clip's own, with teeth if it has them."""

    @classmethod
    def of(cls, head: HeadAsset, subject: Subject, vertices: int, file: Path) -> FlameSubject:
        """Raises `InputError` unless the head has as many vertices as ``file`` of the checkout, which is ``vertices``."""
        official = OfficialHead.numbered(head)
        if len(official.order) != vertices:
            expected = f"{vertices} vertices, as {file} has, since their code needs FLAME's texture chart"
            remedy = "Refit the capture to FLAME 2020 (headbench prepare refit)."
            where = f"head model {head.version!r}"
            raise InputError(where, "template", expected, str(len(official.order)), remedy)
        return cls(official, subject, PosedSubject(head, subject.shape, subject.static_offset))

    @classmethod
    def whole(cls, head: HeadAsset, subject: Subject) -> FlameSubject:
        """A head of another topology, with teeth and its own vertex numbering."""
        official = OfficialHead(head, np.arange(len(head.template)), np.asarray(head.faces))
        return cls(official, subject, PosedSubject(head, subject.shape, subject.static_offset))

    def model(self) -> dict[str, np.ndarray]:
        """Arrays of FLAME's file, with the static offset in the template."""
        return self.official.model(self.identity.static_offset)

    def frame(self, camera: Camera, pose: HeadPose) -> dict[str, Any]:
        """Content of the file of a frame, its camera in the head's frame.

        RGBAvatar and FlashAvatar read ``img_size`` as width and height. The tracker writes height and width, which is
        the same for the square images that their authors use.
        """
        parts = frame_parts(flame=flame_values(self.identity, pose), opencv=opencv_values(camera))
        return {**parts, "img_size": np.array([camera.width, camera.height])}


def write_torch(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file for ``torch.load`` with numpy arrays that every version of numpy can read."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        torch.save(dict(content), stream, pickle_module=_ArrayPickles)


class _ArrayPickles:
    """The part of a pickle module that ``torch.save`` uses."""

    Pickler = ArrayPickler


def write_video(
    clip: Clip,
    posed: PosedSubject,
    folder: Path,
    frame: Callable[[Camera, HeadPose], Mapping[str, Any]],
    progress: Progress,
) -> tuple[dict[str, FrameKey], Mapping[str, Any]]:
    """Write images with straight alpha and parameters of the training frames, numbered from 0 without gaps.

    ``frame`` makes the content of a file of a camera in the head's frame. Returns the key of every image, by path in
    the folder, and the content of the first file.
    """
    frames = training_frames(clip, posed)
    for each in frames:
        write_image(folder / image_name(each.number), straight_rgba(clip, each.key))
        write_torch(folder / frame_name(each.number), frame(each.camera, each.pose))
        progress(each.number + 1, len(frames), "exporting")
    return {image_name(each.number): each.key for each in frames}, frame(frames[0].camera, frames[0].pose)


# ------------------------------------------------------------------ renders with coverage


def on_background(rgb: FloatArray, alpha: FloatArray, background: Sequence[float]) -> Frame:
    """A frame of colours on black (H, W, 3) and coverage (H, W), on a background."""
    ground = np.array([float(level) for level in background], np.float32)
    return Frame(np.clip(rgb + (1 - alpha[..., None]) * ground, 0, 1), np.ascontiguousarray(alpha))


def read_covered(frame: Listed, path: Path, background: Sequence[float]) -> Frame:
    """A render (RGBA) on black, on a background."""
    pixels = read_pixels(path, size=(frame.camera.width, frame.camera.height))
    if pixels.ndim != 3 or pixels.shape[2] != 4:
        raise InputError(path, str(frame.key), "colours and coverage (RGBA)", f"shape {pixels.shape}")
    rgba = cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA).astype(np.float32) / 255
    return on_background(rgba[..., :3], rgba[..., 3], background)


LAUNCHER = Path(__file__).with_name("parts.py")

Config = TypeVar("Config", bound=OfficialConfig)


@dataclass(frozen=True)
class RenderCall:
    """One call of the authors' renderer."""

    command: list[str]
    """The command, run in the program's working directory."""
    numbers: list[int]
    """Numbers of its frames in the list, in the order in which it renders them."""
    renders: str
    """Folder of its renders ``00000.png`` and following."""
    cameras: list[str] = field(default_factory=list)
    """A JSON of the listed cameras, and the one that the program writes beside its renders, which must agree; empty if it
    writes none."""


class PartsMethod(OfficialMethod[Config]):
    """Renders a list by the launcher `parts`, which gives each render the number of its frame."""

    frame_line = r"^headbench: drawn (\d+)"
    starts_launcher = False

    def command_of(self, calls: Sequence[RenderCall], drawn: str, work: Workplace) -> list[str]:
        """Write the launcher and its plan; return its command, for headbench's interpreter.

        ``drawn`` is a regular expression for the frames done in the output of the calls.
        """
        renders = work.model / self.render_folder
        renders.mkdir(parents=True)
        plan = {"drawn": drawn, "renders": str(renders), "parts": [asdict(call) for call in calls]}
        return [sys.executable, *write_launcher(LAUNCHER, plan, work)]

    def read_back(self, frame: Listed, path: Path, background: Sequence[float], work: Workplace) -> Frame:
        """A render on black, composited on the background by its coverage."""
        return read_covered(frame, path, background)


def same_intrinsics(frame: Listed) -> Hashable:
    """Equal for frames of one image size, focal length and principal point."""
    return frame.camera.width, frame.camera.height, frame.camera.K.tobytes()


def in_parts(
    frames: Sequence[Listed], key: Callable[[Listed], Hashable], most: int
) -> Iterator[list[Listed]]:
    """Groups of frames with equal keys, at most ``most`` each, in order."""
    groups: dict[Hashable, list[Listed]] = {}
    for frame in frames:
        groups.setdefault(key(frame), []).append(frame)
    for same in groups.values():
        for start in range(0, len(same), most):
            yield same[start : start + most]

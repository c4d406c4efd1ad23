"""Images of a scene: panels of all avatars side by side, and splats for browsers that draw them themselves."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, FrameKey, HeadPose, SplatAvatar
from ...bench.io.images import quantise
from .scene import LIVE, FreeView, Scene, ShownAvatar, State

LABEL_PX = 22
CAPTURED = "captured"
LEAST_PX = 16
HEAD_ASPECT = 0.75
"""Aspect ratio of a head; the arrangement of panels maximises its size."""


class DrawnPanes(NamedTuple):
    """An (H, W, 3) image and the milliseconds that each avatar took."""

    image: ByteArray
    milliseconds: dict[str, float]


class SplatArrays(NamedTuple):
    """Splats of an avatar, float32: (N, 3) centres in metres, (N, 3, 3) covariances, (N, 3) colours, (N, 1) opacities."""

    centers: FloatArray
    covariances: FloatArray
    colors: FloatArray
    opacities: FloatArray


def key_of(scene: Scene, state: State) -> FrameKey | None:
    """The frame of the pose, of the requested camera if it was recorded. None: neutral."""
    recording = scene.recordings.get(state.recording)
    cameras = None if recording is None else recording.get(state.timestep)
    if cameras is None:
        return None
    return cameras.get(state.camera) or cameras[min(cameras)]


def draw(scene: Scene, state: State, view: FreeView, size: tuple[int, int], scale: float = 1.0) -> DrawnPanes:
    """Draw all avatars in one image of about ``size`` (width, height) times ``scale``.

    In a camera of the capture, panels show frames as for metrics, scaled to fit (below a scale of 1, drawn at
    that size); otherwise the free view.
    """
    key = key_of(scene, state)
    captured = key if key is not None and key.camera == state.camera else None
    truth = captured is not None and captured.subject == scene.first.clip.subject
    if truth:
        state = replace(state, background=tuple(scene.first.clip.background))
    labels = [*([CAPTURED] if truth else []), *(shown.label for shown in scene.shown)]
    width, height = (max(LEAST_PX, round(side * scale)) for side in size)
    rows, columns = arrangement(len(labels), width, height)
    strip = max(1, round(LABEL_PX * scale))
    place = max(LEAST_PX, width // columns), max(LEAST_PX, height // rows - strip)
    ground = np.round(255 * np.array(state.background)).astype(np.uint8)
    panels, milliseconds = [], {}
    if truth and captured is not None:
        panels.append(_fitted(scene.first.clip.image(captured), place, ground))
    for shown in scene.shown:
        start = time.perf_counter()
        if truth and captured is not None and shown.clip.subject == captured.subject:
            panel = _frame(shown, state, captured, place if scale < 1 else None)
        else:
            camera = moved(scene, shown, view.camera(*place), key)
            panel = quantise(shown.avatar.render(camera, pose_of(shown, state, key), state.background).rgb)
        milliseconds[shown.label] = 1e3 * (time.perf_counter() - start)
        panels.append(_fitted(panel, place, ground))
    image = np.full((rows * (place[1] + strip), columns * place[0], 3), ground, np.uint8)
    ink = (0, 0, 0) if ground.mean() > 127 else (255, 255, 255)
    for number, (label, panel) in enumerate(zip(labels, panels)):
        top, left = number // columns * (place[1] + strip), number % columns * place[0]
        image[top + strip : top + strip + place[1], left : left + place[0]] = panel
        where = (left + round(6 * scale), top + round(16 * scale))
        cv2.putText(image, label, where, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, ink, 1, cv2.LINE_AA)
    return DrawnPanes(image, milliseconds)


def arrangement(count: int, width: int, height: int) -> tuple[int, int]:
    """Rows and columns for a number of panels that maximise the size of a head in each."""

    def head(rows: int) -> float:
        return min(width / -(-count // rows) / HEAD_ASPECT, height / rows)

    rows = max(range(1, count + 1), key=head)
    return rows, -(-count // rows)


def pose_of(shown: ShownAvatar, state: State, key: FrameKey | None) -> HeadPose:
    """The pose of an avatar."""
    return state.sliders.added(shown.live_pose() if state.recording == LIVE else shown.pose(key))


def moved(scene: Scene, shown: ShownAvatar, camera: Camera, key: FrameKey | None) -> Camera:
    """Convert a camera to an avatar's world; for another subject, relative to its head."""
    motion = np.eye(4)
    motion[:3, 3] = scene.first.center - shown.center
    there = Camera(camera.id, camera.width, camera.height, camera.K, camera.world_to_camera @ motion)
    return shown.camera(there, key)


def splats_of(scene: Scene, shown: ShownAvatar, state: State, view: FreeView) -> SplatArrays | None:
    """Splats of an avatar in the first one's world, coloured for the view; None if it provides none."""
    if not isinstance(shown.avatar, SplatAvatar):
        return None
    key = key_of(scene, state)
    camera = moved(scene, shown, view.camera(LEAST_PX, LEAST_PX), key)
    found = shown.avatar.splats(pose_of(shown, state, key), camera)
    if found.colors is None:
        return None
    # From the method's world into that of the first avatar: the same camera in both.
    back = np.linalg.inv(view.world_to_camera) @ camera.world_to_camera
    axes = (back[:3, :3] @ rotations(found.quats)) * found.scales[:, None, :]
    return SplatArrays(
        (found.means @ back[:3, :3].T + back[:3, 3]).astype(np.float32),
        np.asarray(axes @ axes.transpose(0, 2, 1), np.float32),
        np.clip(found.colors, 0.0, 1.0),
        found.opacities[:, None],
    )


def _frame(shown: ShownAvatar, state: State, key: FrameKey, place: tuple[int, int] | None) -> ByteArray:
    """A frame of the capture as for metrics; with a place, drawn at most at its size."""
    pose, camera = pose_of(shown, state, key), shown.form.clip.cameras[shown.form.key(key).camera]
    if place is None:
        return quantise(shown.form.restore(key, shown.avatar.render(camera, pose, state.background).rgb))
    factor = min(1.0, place[0] / camera.width, place[1] / camera.height)
    small = camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
    return quantise(shown.avatar.render(small, pose, state.background).rgb)


def _fitted(image: ByteArray, place: tuple[int, int], ground: Sequence[int] | ByteArray) -> ByteArray:
    """Fit an image centred into its place; unchanged if it already has its size."""
    height, width = image.shape[:2]
    if (width, height) == place:
        return image
    factor = min(place[0] / width, place[1] / height)
    new = max(1, round(width * factor)), max(1, round(height * factor))
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_NEAREST
    whole = np.full((place[1], place[0], 3), ground, np.uint8)
    left, top = (place[0] - new[0]) // 2, (place[1] - new[1]) // 2
    whole[top : top + new[1], left : left + new[0]] = cv2.resize(image, new, interpolation=how)
    return whole


def rotations(quats: FloatArray) -> FloatArray:
    """(N, 3, 3) of (N, 4) unit quaternions wxyz."""
    w, x, y, z = np.asarray(quats, np.float64).T
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return np.stack(rows, axis=1).reshape(-1, 3, 3)

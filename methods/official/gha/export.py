"""Export of captures and lists of frames for Gaussian Head Avatar's datasets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from ....bench.contracts import ByteArray, Camera, Clip, FloatArray, FrameKey, HeadAsset, HeadPose, Progress
from ....bench.errors import InputError
from ....bench.io.images import write_png
from ....datasets.ga.writer import save_npz
from ...gha.config import GHAConfig
from ...gha.driving import Driver, landmark_vertices
from ...shared.avatar_files import Subject, head_arrays
from ..ga.export import mark
from ..ga.head_files import write_npy
from ..ga.windows import Window, cameras_of, square, square_side
from ..workplace import Listed, Workplace, read_sized

MOUTH_ROWS = slice(48, 66)
"""Landmarks of the mouth in their code, around which it adds points; other landmarks have no special role."""
COARSE = 256
"""Side of the images for the mesh head, as their preprocessing writes them."""
MARK_SIDE = 8
IMAGES, PARAMETERS, CAMERAS = "images", "params", "cameras"


@dataclass(frozen=True, eq=False)
class GHATracking:
    """Tracked parameters of one subject for their code, as in the native method.

    A point of the canonical head is ``R (S x) + T`` in the world: R, T of the head's root and neck, S metres a unit.
    """

    driver: Driver

    rows: np.ndarray
    """(L,) vertices that correspond to their landmarks and to each hundredth vertex of their face model."""

    @classmethod
    def of(cls, head: HeadAsset, subject: Subject) -> GHATracking:
        """Landmarks of a subject. Raises `InputError` for a head model without face or lips."""
        if not len(head.regions.get("lips", ())):
            known = ", ".join(sorted(head.regions)) or "no regions"
            raise InputError(f"head model {head.version!r}", "regions", "a region 'lips'", known)
        published = GHAConfig()
        identity = (head, subject.shape, subject.static_offset)
        neutral = Driver(*identity, np.zeros(3), 1.0, None, "cpu").neutral.numpy()
        facial = landmark_vertices(head, neutral, published.landmarks)
        lips_alone = replace(head_arrays(head), regions={"face": head.regions["lips"]})
        lips = landmark_vertices(lips_alone, neutral, MOUTH_ROWS.stop - MOUTH_ROWS.start)
        before = np.resize(facial, MOUTH_ROWS.start)
        mouth = np.resize(lips, MOUTH_ROWS.stop - MOUTH_ROWS.start)
        more = facial[MOUTH_ROWS.start : published.landmarks - len(mouth)]
        driver = Driver(*identity, neutral[facial].mean(0), published.unit, None, "cpu")
        return cls(driver, np.concatenate([before, mouth, more]))

    @torch.no_grad()
    def parameters(self, pose: HeadPose) -> dict[str, FloatArray]:
        """Expression code (1, E), axis-angle and translation (1, 6), scale (1,)."""
        (signal,) = self.driver.signals(self.driver.arguments([pose]))
        return {
            "exp_coeff": signal.expression[None].numpy(),
            "pose": self.driver.motion(signal).code[None].numpy(),
            "scale": np.array([self.driver.unit], np.float32),
        }

    @torch.no_grad()
    def landmarks(self, pose: HeadPose) -> FloatArray:
        """(L, 3) points of the posed head, metres."""
        arguments = self.driver.arguments([pose])
        vertices = self.driver.model(canonical=self.driver.neutral[None], **arguments)[0]
        return np.asarray(vertices.numpy()[self.rows])


def write_training(
    clip: Clip, tracking: GHATracking, work: Workplace, progress: Progress
) -> dict[str, FrameKey]:
    """Write only the training frames, with timesteps and cameras numbered from 0. Returns the key of every image.

    Files are PNG under the names of their loader, which end in ``.jpg``; it detects the format by content. Nothing
    beyond the image's border is ``visible``, so there is no loss.
    """
    side, frames = training_side(clip), whole_timesteps(clip)
    windows = {name: square(camera, side) for name, camera in cameras_of(clip, "train").items()}
    names = list(windows)
    images: dict[str, FrameKey] = {}
    total = len(frames) * len(names)
    for number, (timestep, keys) in enumerate(frames.items()):
        frame = f"{number:06d}"
        for index, name in enumerate(names):
            for kind, image in _images(clip, keys[name], windows[name]).items():
                place = f"{IMAGES}/{frame}/{kind}_{index:02d}.jpg"
                write_png(work.input / place, image)
                images[f"input/{place}"] = keys[name]
            write_camera(work.input / CAMERAS / frame / f"camera_{index:02d}.npz", windows[name].camera)
            progress(number * len(names) + index + 1, total, "exporting")
        folder = work.input / PARAMETERS / frame
        save_npz(folder / "params.npz", tracking.parameters(clip.poses[timestep]))
        write_npy(folder / "lmk_3d.npy", np.ascontiguousarray(tracking.landmarks(clip.poses[timestep])))
        # All points are landmarks; their loader would add every hundredth of these vertices.
        write_npy(folder / "vertices.npy", np.zeros((0, 3), np.float32))
    return images


def write_list(
    frames: Sequence[Listed], tracking: GHATracking, side: int, work: Workplace
) -> list[tuple[Path, list[int]]]:
    """Write frames to render, with a folder for each camera; return the folders and frame numbers.

    Their renderer shows the mean of the previous parameters and those of the frame. The parameters written are
    extrapolated so that this mean is the frame's own. It writes the image beside the render, here a mark that encodes
    the frame's number.
    """
    groups: dict[tuple[Any, ...], list[Listed]] = {}
    for frame in frames:
        camera = frame.camera
        same = (camera.id, camera.width, camera.height, camera.K.tobytes(), camera.world_to_camera.tobytes())
        groups.setdefault(same, []).append(frame)
    written = []
    for index, group in enumerate(groups.values()):
        folder = work.input / f"camera_{index:04d}"  # their configuration does not accept a number as a name
        write_camera(folder / "camera.npz", square(group[0].camera, side).camera)
        shown: dict[str, FloatArray] = {}
        for place, frame in enumerate(group):
            wanted = tracking.parameters(frame.pose)
            save_npz(folder / PARAMETERS / f"{place:06d}.npz", overshot(wanted, shown))
            image = np.full((MARK_SIDE, MARK_SIDE, 3), mark(frame.number), np.uint8)
            write_png(folder / IMAGES / f"{place:06d}.png", image)
        written.append((folder, [frame.number for frame in group]))
    return written


def overshot(wanted: Mapping[str, FloatArray], shown: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """Parameters that give the wanted ones in a renderer that averages with the previous ones.

    ``shown`` has the previous parameters, initially none, and is updated with rounding.
    """
    given: dict[str, FloatArray] = {name: np.asarray(value, np.float32) for name, value in wanted.items()}
    half = np.float32(0.5)
    for name in ("exp_coeff", "pose"):
        if name in shown:
            given[name] = (given[name] - shown[name] * half) / half
            shown[name] = shown[name] * half + given[name] * half
        else:
            shown[name] = given[name]
    return given


def write_camera(path: Path, camera: Camera) -> None:
    """Write an OpenCV camera: the 3x4 matrix from the world, in metres, and K in pixels."""
    extrinsic = np.asarray(camera.world_to_camera, np.float64)[:3]
    save_npz(path, {"extrinsic": extrinsic, "intrinsic": np.asarray(camera.K, np.float64)})


def training_side(clip: Clip) -> int:
    """Side of the square images of all training cameras."""
    return square_side(cameras_of(clip, "train").values())


def whole_timesteps(clip: Clip) -> dict[int, dict[str, FrameKey]]:
    """Training frames by timestep and camera. Raises `InputError` for a timestep that some camera lacks."""
    names = list(cameras_of(clip, "train"))
    frames: dict[int, dict[str, FrameKey]] = {}
    for key in sorted(clip.splits["train"], key=lambda key: (key.timestep, key.camera)):
        frames.setdefault(key.timestep, {})[key.camera] = key
    for timestep, keys in frames.items():
        missing = [name for name in names if name not in keys]
        if missing:
            expected = f"a training frame of each of {len(names)} cameras, which their loader requires"
            remedy = "Remove the timestep or the camera from the capture."
            raise InputError(
                f"clip {clip.subject}",
                f"timestep {timestep}",
                expected,
                f"none of {', '.join(missing)}",
                remedy,
            )
    return frames


def _images(clip: Clip, key: FrameKey, window: Window) -> dict[str, ByteArray]:
    """Files of a frame for their loaders, by prefix of the name.

    The mask of the second stage, which serves to composite images on white, is white because images are already on
    white.
    """
    image = clip.image(key)
    mask = clip.mask(key)
    if mask is None:
        raise InputError(f"clip {clip.subject}", str(key), "a mask; the mesh head is fitted to it", "none")
    full = {
        "image": window.padded(image, 255),
        "mask": np.full((window.camera.height, window.camera.width, 3), 255, np.uint8),
        "visible": window.padded(np.full_like(image, 255), 0),
    }
    coverage = window.padded(np.repeat(np.asarray(mask)[..., None], 3, axis=2), 0)
    reduced = {"image": full["image"], "mask": coverage, "visible": full["visible"]}
    small = {f"{name}_lowres": _resized(value, COARSE) for name, value in reduced.items()}
    return {**full, **small}


def _resized(image: Any, side: int) -> Any:
    """A square image at another size: area means when shrinking, linear when growing."""
    if image.shape[0] == side:
        return image
    how = cv2.INTER_AREA if side < image.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(image, (side, side), interpolation=how)


def read_render(path: Path, frame: Listed, side: int, rendered: int) -> tuple[ByteArray, FloatArray]:
    """Input image and render of a file: the render (H, W, 3) in [0, 1] at its camera's size."""
    image = read_sized(path, frame, 2 * rendered, rendered)
    render = _resized(image[:, rendered:].astype(np.float32) / 255, side)
    return image[:, :rendered], square(frame.camera, side).uncut(render, frame.camera)

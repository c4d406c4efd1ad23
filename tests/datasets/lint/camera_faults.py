"""Faults of one camera, planted into a capture of the layout: which code has to find each, and at which camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from headbench.datasets.images import read_image

from .good_capture import GoodCapture, write_pixels

CAMERA, OTHER = "222200001", "222200004"
"""The camera that faults are planted at, and the one that it is exchanged with."""
Plant = Callable[[GoodCapture], None]


def images(capture: GoodCapture, camera: str = "") -> list[Path]:
    """Images in the order of timesteps; of one camera where one is given."""
    frames: list[dict] = []
    capture.each_frame(frames.append)
    frames = [frame for frame in frames if not camera or frame["camera_id"] == camera]
    return [capture.union / f["file_path"] for f in sorted(frames, key=lambda f: f["timestep_index"])]


def change_images(capture: GoodCapture, change: Callable[[np.ndarray], np.ndarray], camera: str = "") -> None:
    for path in images(capture, camera):
        write_pixels(path, change(read_image(path, (1, 1, 1))))


def add_noise(capture: GoodCapture, sigma: float, seed: int = 0) -> None:
    """Sensor noise of ``sigma`` levels in every image."""
    rng = np.random.default_rng(seed)

    def noisy(image):
        return np.clip(image + rng.normal(0, sigma, image.shape), 0, 255).round().astype(np.uint8)

    change_images(capture, noisy)


def exchange(capture: GoodCapture) -> None:
    """Two cameras have each other's calibration."""
    keys = ("transform_matrix", "fl_x", "fl_y", "cx", "cy")
    known: dict[str, dict] = {}
    capture.each_frame(lambda f: known.update({f["camera_id"]: {k: f[k] for k in keys}}))
    turn = {CAMERA: OTHER, OTHER: CAMERA}
    capture.each_frame(lambda f: f.update(known[turn.get(f["camera_id"], f["camera_id"])]))


def _move(change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    def edit(frame):
        if frame["camera_id"] == CAMERA:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    return lambda capture: capture.each_frame(edit)


def _aside(metres: float, axis: int) -> Plant:
    def shift(matrix):
        matrix[:3, 3] += metres * matrix[:3, axis]
        return matrix

    return _move(shift)


def _rotated(degrees: float, axis: int) -> Plant:
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.radians(degrees) * np.eye(3)[axis])[0]
    return _move(lambda matrix: matrix @ turn)


def _late(frames: int) -> Plant:
    """Images (and masks) of so many frames before, within each sequence."""

    def plant(capture):
        content = {p: (p.read_bytes(), _mask(p).read_bytes()) for p in images(capture, CAMERA)}
        for path in content:
            sequence = [other for other in content if other.parent == path.parent]
            source = sequence[min(max(sequence.index(path) - frames, 0), len(sequence) - 1)]
            path.write_bytes(content[source][0])
            _mask(path).write_bytes(content[source][1])

    return plant


def _mask(image: Path) -> Path:
    return image.parent.parent / "fg_masks" / image.name


def _each(change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    return lambda capture: change_images(capture, change, CAMERA)


def _freeze(capture: GoodCapture) -> None:
    first = read_image(images(capture, CAMERA)[0], (1, 1, 1))
    change_images(capture, lambda image: first, CAMERA)


class CameraFault(NamedTuple):
    """``code`` must be found, and name `CAMERA`."""

    name: str
    code: str
    plant: Plant


CAMERA_FAULTS = (
    CameraFault("exchanged", "HB513", exchange),
    CameraFault("3 cm aside", "HB514", _aside(0.03, 0)),
    CameraFault("tilted by 1 degree", "HB514", _rotated(1.0, 0)),
    CameraFault("2 frames late", "HB515", _late(2)),
    CameraFault("blurred by 4 px", "HB517", _each(lambda image: cv2.GaussianBlur(image, (0, 0), 4.0))),
    CameraFault("black", "HB308", _each(np.zeros_like)),
    CameraFault("frozen", "HB516", _freeze),
)

"""Faults of one camera, planted into a capture of the layout: which code has to find each, and at which camera."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from headbench.datasets.images import read_image, write_image

JSONS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")


@dataclass(frozen=True)
class Rig:
    """The union folder of a capture, with the cameras that faults are planted at."""

    union: Path
    camera: str
    other: str

    def edit(self, change: Callable[[dict], object]) -> None:
        """Apply ``change`` to every frame of every split."""
        for name in JSONS:
            path = self.union / name
            document = json.loads(path.read_text())
            for frame in document["frames"]:
                change(frame)
            path.write_text(json.dumps(document))

    def frames(self) -> list[dict]:
        return [frame for name in JSONS for frame in json.loads((self.union / name).read_text())["frames"]]

    def images(self, camera: str = "") -> list[Path]:
        """Images in the order of timesteps; of one camera where one is given."""
        frames = [f for f in self.frames() if not camera or f["camera_id"] == camera]
        return [self.union / f["file_path"] for f in sorted(frames, key=lambda f: f["timestep_index"])]

    def each_image(self, change: Callable[[np.ndarray], np.ndarray], camera: str = "") -> None:
        for path in self.images(camera):
            write_image(path, change(read_image(path, (1, 1, 1))))


def add_noise(rig: Rig, sigma: float, seed: int = 0) -> None:
    """Sensor noise of ``sigma`` levels in every image."""
    rng = np.random.default_rng(seed)

    def noisy(image):
        return np.clip(image + rng.normal(0, sigma, image.shape), 0, 255).round().astype(np.uint8)

    rig.each_image(noisy)


def exchange(rig: Rig) -> None:
    """Two cameras have each other's calibration."""
    keys = ("transform_matrix", "fl_x", "fl_y", "cx", "cy")
    known = {f["camera_id"]: {k: f[k] for k in keys} for f in rig.frames()}
    turn = {rig.camera: rig.other, rig.other: rig.camera}
    rig.edit(lambda f: f.update(known[turn.get(f["camera_id"], f["camera_id"])]))


def _move(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Rig], None]:
    def plant(rig):
        def edit(frame):
            if frame["camera_id"] == rig.camera:
                frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

        rig.edit(edit)

    return plant


def _aside(metres: float, axis: int) -> Callable[[Rig], None]:
    def shift(matrix):
        matrix[:3, 3] += metres * matrix[:3, axis]
        return matrix

    return _move(shift)


def _rotated(degrees: float, axis: int) -> Callable[[Rig], None]:
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.radians(degrees) * np.eye(3)[axis])[0]
    return _move(lambda matrix: matrix @ turn)


def _late(frames: int) -> Callable[[Rig], None]:
    """Images (and masks) of so many frames before, within each sequence."""

    def plant(rig):
        content = {path: (path.read_bytes(), _mask(path).read_bytes()) for path in rig.images(rig.camera)}
        for path in content:
            sequence = [other for other in content if other.parent == path.parent]
            source = sequence[min(max(sequence.index(path) - frames, 0), len(sequence) - 1)]
            path.write_bytes(content[source][0])
            _mask(path).write_bytes(content[source][1])

    return plant


def _mask(image: Path) -> Path:
    return image.parent.parent / "fg_masks" / image.name


def _blur(sigma: float) -> Callable[[Rig], None]:
    return lambda rig: rig.each_image(lambda image: cv2.GaussianBlur(image, (0, 0), sigma), rig.camera)


def _black(rig: Rig) -> None:
    rig.each_image(np.zeros_like, rig.camera)


def _freeze(rig: Rig) -> None:
    first = read_image(rig.images(rig.camera)[0], (1, 1, 1))
    rig.each_image(lambda image: first, rig.camera)


@dataclass(frozen=True)
class CameraFault:
    """``code`` must be found, and name ``camera``."""

    name: str
    code: str
    plant: Callable[[Rig], None]


CAMERA_FAULTS = (
    CameraFault("exchanged", "HB513", exchange),
    CameraFault("3 cm aside", "HB514", _aside(0.03, 0)),
    CameraFault("3 cm down", "HB514", _aside(-0.03, 1)),
    CameraFault("turned by 1 degree", "HB514", _rotated(1.0, 1)),
    CameraFault("tilted by 1 degree", "HB514", _rotated(1.0, 0)),
    CameraFault("2 frames late", "HB515", _late(2)),
    CameraFault("2 frames early", "HB515", _late(-2)),
    CameraFault("blurred by 4 px", "HB517", _blur(4.0)),
    CameraFault("black", "HB308", _black),
    CameraFault("frozen", "HB516", _freeze),
)

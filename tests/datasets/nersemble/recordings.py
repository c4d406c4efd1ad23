"""Tiny recordings for tests: flat colours that tell subject, camera and frame."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from headbench.bench.contracts import Camera
from headbench.datasets.head.arrays import HeadArrays, save_head
from headbench.datasets.nersemble.re_record import RecordingWriter, Release, write_tracked
from headbench.datasets.nersemble.settings import PrepareSettings

from ..head.toy import toy_head
from ..tiny_capture import rig

SUBJECT = "901"
SEQUENCES = {"EMO-1-shout+laugh": 4, "FREE": 6}
WIDTH, HEIGHT = 48, 64
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])  # a rational rotation


def world_cameras(width: int = WIDTH, height: int = HEIGHT) -> list[Camera]:
    """Three cameras in a world turned by `TURN`, as a calibration's world is any."""
    turn = np.eye(4)
    turn[:3, :3] = TURN
    return [
        Camera(c.id, c.width, c.height, c.K, c.world_to_camera @ turn)
        for c in rig(width, height, 0.51 * width, 0.47 * height)
    ]


def colour_of(camera: int, number: int) -> tuple[int, int, int]:
    """RGB of a frame: what is in the middle of it."""
    return 40 + 60 * camera, 30 + 12 * number, 200 - 9 * number


def tone(sequence: str, number: int) -> int:
    """What stands for the frame number in `colour_of`: no two frames of `SEQUENCES` look alike."""
    return number if sequence == "FREE" else number + 8


def frame(camera: int, number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """(H, W, 3) flat frame."""
    return np.full((height, width, 3), colour_of(camera, number), np.uint8)


def mask(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """(H, W) coverage: the middle half, in blocks of 16 so that JPEG keeps it."""
    mask = np.zeros((height, width), np.uint8)
    mask[16 : height - 16, 16 : width - 16] = 255
    return mask


class Recording(NamedTuple):
    """A written recording."""

    root: Path
    writer: RecordingWriter
    tracking: Path
    head: Path

    def settings(self, out: Path, **changes) -> PrepareSettings:
        """Settings that prepare all of it."""
        values = {
            "root": str(self.root),
            "out": str(out),
            "subjects": SUBJECT,
            "sequences": "EMO-1,FREE",
            "downscale": 2,
            "tracking": str(self.tracking),
            "head": str(self.head),
            "every": 1,
        }
        return PrepareSettings(**(values | changes))


def tracked_arrays(head: HeadArrays, count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """VHAP's arrays with random numbers."""
    rng = np.random.default_rng(seed)
    vertices, _, identities = head.shape_basis.shape
    sizes = {"translation": 3, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6}
    arrays = {key: 0.05 * rng.normal(size=(count, size)) for key, size in sizes.items()}
    arrays["translation"] += [0.1, -0.2, 0.3]
    arrays["expr"] = rng.normal(size=(count, head.expression_basis.shape[2]))
    arrays["shape"] = np.linspace(-1, 1, identities)
    arrays["static_offset"] = 0.001 * rng.normal(size=(1, vertices, 3))
    return arrays


def write_recording(
    folder: Path,
    *,
    release: Release = "v2",
    images: bool = True,
    sequences: dict[str, int] | None = None,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> Recording:
    """Write a recording with frames as images with masks, or as videos."""
    cameras = world_cameras(*size)
    writer = RecordingWriter(folder / "recording", SUBJECT, cameras, release)
    writer.write_calibration()
    head = toy_head(16)
    save_head(folder / "head.npz", head)
    for name, count in (sequences or SEQUENCES).items():
        for index, camera in enumerate(cameras):
            frames = [frame(index, tone(name, number), *size) for number in range(count)]
            if images:
                for number, pixels in enumerate(frames):
                    writer.write_frame(name, camera.id, number, pixels, mask(*size))
            else:
                writer.write_video(name, camera.id, frames)
        path = folder / "tracking" / f"{SUBJECT}_{name}_v3_DS2_wBg" / "2026-01-01_00-00-00"
        write_tracked(path / "tracked_flame_params_30.npz", tracked_arrays(head, count), range(count))
    return Recording(writer.root, writer, folder / "tracking", folder / "head.npz")

"""Raw recordings in the layouts of NeRSemble's releases, with VHAP's tracking of them: every frame tells its camera and number."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from headbench.bench.contracts import Camera
from headbench.bench.io.files import write_json, write_text
from headbench.datasets.head.arrays import HeadArrays, save_head
from headbench.datasets.images import write_image
from headbench.datasets.nersemble.names import PrepareSettings
from headbench.datasets.nersemble.recording import read_calibration

from ..head.toy import toy_head
from ..tiny_capture import make_plan, paint, rig

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


@dataclass(frozen=True)
class Recording:
    """One participant below a folder, in the layout of a release: "v2", "v1" (parts merged) or "paper2023"."""

    folder: Path
    release: str = "v2"
    subject: str = SUBJECT

    @property
    def root(self) -> Path:
        return self.folder / "recording"

    @property
    def tracking(self) -> Path:
        return self.folder / "tracking"

    @property
    def head(self) -> Path:
        return self.folder / "head.npz"

    @property
    def calibration_file(self) -> Path:
        places = {
            "v2": f"{self.subject}/calibration",
            "v1": f"camera_params/{self.subject}",
            "paper2023": self.subject,
        }
        return self.root / places[self.release] / "camera_params.json"

    def sequence_folder(self, sequence: str) -> Path:
        return self.root / self.subject / ("" if self.release == "v1" else "sequences") / sequence

    def settings(self, out: Path, **changes) -> PrepareSettings:
        """Settings that prepare all of it."""
        values = {
            "root": str(self.root),
            "out": str(out),
            "subjects": self.subject,
            "sequences": "EMO-1,FREE",
            "downscale": 2,
            "tracking": str(self.tracking),
            "head": str(self.head),
            "every": 1,
        }
        return PrepareSettings(**(values | changes))

    def write_calibration(self, cameras: list[Camera]) -> None:
        value = {
            "world_2_cam": {camera.id: camera.world_to_camera for camera in cameras},
            "intrinsics": cameras[0].K,
            "height": cameras[0].height,
            "width": cameras[0].width,
        }
        write_json(self.calibration_file, value)

    def write_background(self, serial: str, rgb: np.ndarray) -> None:
        write_image(self.sequence_folder("BACKGROUND") / f"image_{serial}.jpg", rgb, *_JPEG)

    def write_metadata(self, sequences: list[str]) -> None:
        rows = ["ID", "wears_glasses", *sequences], [self.subject, "", *("x" for _ in sequences)]
        write_text(self.root / "metadata_sequences.csv", "".join(",".join(row) + "\n" for row in rows))

    def write_video(self, sequence: str, serial: str, frames) -> None:
        folder = self.sequence_folder(sequence) / ("images" if self.release == "v2" else "")
        write_video(folder / f"cam_{serial}.mp4", frames, 73)

    def write_frame(self, sequence: str, serial: str, number: int, rgb, mask=None) -> None:
        """As VHAP's preprocessing does, or the 2023 release, whose frame folders count at 73 frames a second."""
        folder, name, kinds = (
            self.sequence_folder(sequence),
            f"cam_{serial}_{number:06d}.jpg",
            ("images", "alpha_maps"),
        )
        if self.release == "paper2023":
            folder, name, kinds = (
                folder / f"frame_{number:05d}",
                f"cam_{serial}.png",
                ("images-2x", "alpha_map"),
            )
        for kind, pixels in zip(kinds, (rgb, mask)):
            if pixels is not None:
                write_image(folder / kind / name, pixels, *(_JPEG if name.endswith(".jpg") else ()))


_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 97)


def write_video(path: Path, frames, fps: float) -> None:
    """Write (H, W, 3) RGB or (H, W) frames of even size as MPEG-4."""
    frames = [*frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    size = frames[0].shape[1::-1]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    for pixels in frames:
        writer.write(np.dstack([pixels] * 3) if pixels.ndim == 2 else pixels[..., ::-1].copy())
    writer.release()


def write_tracked(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write tracked parameters as VHAP does, see `tracked_arrays`."""
    count = len(next(iter(arrays.values())))
    values = {key: np.asarray(value, np.float32) for key, value in arrays.items()}
    values["timestep_id"] = np.array([f"{number:06d}" for number in range(count)])
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **values, n_processed_frames=np.array(count))


def tracked_arrays(head: HeadArrays, count: int) -> dict[str, np.ndarray]:
    """VHAP's arrays with random numbers."""
    rng = np.random.default_rng(0)
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
    release: str = "v2",
    images: bool = True,
    sequences: dict[str, int] | None = None,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    head: HeadArrays | None = None,
) -> Recording:
    """Write a recording with frames as images with masks, or as videos, and the tracking of a head (a small one)."""
    cameras = world_cameras(*size)
    recording = Recording(folder, release)
    recording.write_calibration(cameras)
    head = head or toy_head(16)
    save_head(recording.head, head)
    for name, count in (sequences or SEQUENCES).items():
        for index, camera in enumerate(cameras):
            frames = [frame(index, tone(name, number), *size) for number in range(count)]
            if images:
                for number, pixels in enumerate(frames):
                    recording.write_frame(name, camera.id, number, pixels, mask(*size))
            else:
                recording.write_video(name, camera.id, frames)
        path = recording.tracking / f"{SUBJECT}_{name}_v3_DS2_wBg" / "2026-01-01_00-00-00"
        write_tracked(path / "tracked_flame_params_30.npz", tracked_arrays(head, count))
    return recording


TRACKED = {
    "translation": "translation",
    "rotation": "rotation",
    "neck_pose": "neck",
    "jaw_pose": "jaw",
    "eyes_pose": "eyes",
    "expr": "expression",
}
"""Attribute of a pose by VHAP's name."""


def write_painted(
    folder: Path, subject: str, head: HeadArrays, *, size: tuple[int, int], seed: int
) -> Recording:
    """Write a recording that shows its tracked head: pixels and masks are those of its silhouette."""
    recording = Recording(folder, subject=subject)
    recording.write_calibration(world_cameras(*size))
    calibration = read_calibration(recording.calibration_file).aligned()
    cameras = [calibration.camera(serial, size, size) for serial in calibration.serials]
    plan = make_plan(head=head, lengths=SEQUENCES, cameras=cameras, seed=seed)
    for sequence in plan.sequences:
        for number, pose in enumerate(sequence.poses):
            for index, camera in enumerate(cameras):
                picture = paint(plan, pose, camera, seed + 3 * number + index)
                recording.write_frame(sequence.name, camera.id, number, *picture)
        arrays = {key: np.stack([getattr(p, name) for p in sequence.poses]) for key, name in TRACKED.items()}
        arrays |= {"shape": plan.shape, "static_offset": plan.static_offset[None]}
        path = recording.tracking / f"{subject}_{sequence.name}_v3_DS2_wBg" / "2026-01-01_00-00-00"
        write_tracked(path / "tracked_flame_params_30.npz", arrays)
    return recording

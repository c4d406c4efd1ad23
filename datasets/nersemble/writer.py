"""Synthetic recordings in NeRSemble's raw layouts, for tests and for trying the pipeline without the data.

Names and keys are those of the real files. Participants get numbers from 900 up and a marker file, so that nobody
takes them for recorded people.
"""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray
from ...bench.errors import InputError
from ...bench.io.files import atomic_path, write_json, write_text
from ..ga.documents import save_npz
from .names import BACKGROUND, FPS, FULL_SIZE, is_subject
from .recording import CAMERA_FILE, COLOUR_FILE, SEQUENCES_FILE

Release = Literal["v2", "v1", "paper2023"]

SYNTHETIC_IDS = 900
"""Participants from this number on are synthetic."""

MARKER_FILE = "SYNTHETIC.txt"
_MARKER = "Synthetic recordings in NeRSemble's layout, written by headbench. No person was recorded.\n"

JPEG_QUALITY = 97
_H264, _MPEG4 = "avc1", "mp4v"


class RecordingWriter:
    """Writes one synthetic participant under ``root``.

    Parameters
    ----------
    subject : three-digit id from 900.
    cameras : in the order of the rig; sizes are those of the recorded images.
    release : whose folders: "v2", "v1" (parts merged) or "paper2023" (a folder of PNGs per frame).
    """

    def __init__(self, root: Path, subject: str, cameras: Sequence[Camera], release: Release = "v2"):
        if not is_subject(subject) or int(subject) < SYNTHETIC_IDS:
            raise InputError("recording", "subject", f"an id from {SYNTHETIC_IDS}", repr(subject))
        self.root, self.subject, self.cameras, self.release = Path(root), subject, cameras, release
        self._participant = self.root / subject

    @property
    def calibration_file(self) -> Path:
        """``camera_params.json``."""
        folder = {
            "v2": self._participant / "calibration",
            "v1": self.root / "camera_params" / self.subject,
            "paper2023": self._participant,
        }[self.release]
        return folder / CAMERA_FILE

    def sequence_folder(self, sequence: str) -> Path:
        """Folder of a sequence."""
        parent = self._participant if self.release == "v1" else self._participant / "sequences"
        return parent / sequence

    def write_calibration(self) -> None:
        """Write ``camera_params.json``: one intrinsic matrix where all cameras share it, else one per camera.

        ``height`` and ``width`` are stated where they are not those of the real recordings.
        """
        write_text(self.root / MARKER_FILE, _MARKER)
        first = self.cameras[0]
        sizes = {(camera.width, camera.height) for camera in self.cameras}
        if len(sizes) > 1:
            raise InputError("recording", "cameras", "cameras of one image size", f"{sorted(sizes)}")
        shared = all(np.array_equal(camera.K, first.K) for camera in self.cameras)
        intrinsics = first.K if shared else {camera.id: camera.K for camera in self.cameras}
        value = {
            "world_2_cam": {camera.id: camera.world_to_camera for camera in self.cameras},
            "intrinsics": intrinsics,
        }
        size = sizes.pop()
        stated = {} if size == FULL_SIZE else {"height": size[1], "width": size[0]}
        write_json(self.calibration_file, {**value, **stated})

    def write_colour(self, matrices: Mapping[str, FloatArray], sequence: str = "") -> None:
        """Write colour calibrations by serial: 3 x N for "v2", 4 x 4 affine otherwise.

        ``sequence`` names the sequence they hold for in "paper2023".
        """
        if self.release == "v2":
            write_json(self.calibration_file.with_name(COLOUR_FILE), dict(matrices))
            return
        folder = self.root / "color_correction" / self.subject
        if self.release == "paper2023":
            folder = self._participant / "annotations" / sequence / "color_correction"
        for serial, matrix in matrices.items():
            with atomic_path(folder / f"{serial}.npy") as temporary:
                np.save(temporary, np.asarray(matrix), allow_pickle=False)

    def write_background(self, serial: str, rgb: ByteArray) -> None:
        """Write the still of the empty set."""
        folder = self.sequence_folder(BACKGROUND)
        _write_image(folder / f"image_{serial}.jpg", rgb)

    def write_video(self, sequence: str, serial: str, frames: Iterable[ByteArray]) -> str:
        """Write a camera's video of RGB frames; return the codec, see `video_codec`."""
        folder = self.sequence_folder(sequence)
        folder = folder / "images" if self.release == "v2" else folder
        return write_video(folder / f"cam_{serial}.mp4", frames)

    def write_frame(
        self, sequence: str, serial: str, number: int, rgb: ByteArray, matte: ByteArray | None = None
    ) -> None:
        """Write a frame as an image file, as VHAP's preprocessing does, or the 2023 release where it is that."""
        folder = self.sequence_folder(sequence)
        if self.release == "paper2023":
            frame = folder / f"frame_{number:05d}"
            image, mask = frame / "images-2x" / f"cam_{serial}.png", frame / "alpha_map" / f"cam_{serial}.png"
        else:
            name = f"cam_{serial}_{number:06d}.jpg"
            image, mask = folder / "images" / name, folder / "alpha_maps" / name
        _write_image(image, rgb)
        if matte is not None:
            _write_image(mask, matte)

    def write_metadata(self, sequences: Sequence[str]) -> None:
        """Write ``metadata_sequences.csv`` with this participant's sequences."""
        header = ["ID", "wears_glasses", *sequences]
        row = [str(int(self.subject)), "", *("x" for _ in sequences)]
        write_text(self.root / SEQUENCES_FILE, "".join(",".join(line) + "\n" for line in (header, row)))


def write_tracked(path: Path, arrays: Mapping[str, FloatArray], numbers: Sequence[int]) -> None:
    """Write tracked parameters as VHAP does, float32: ``rotation``, ``translation``, ``neck_pose``, ``jaw_pose``
    (T, 3), ``eyes_pose`` (T, 6), ``expr`` (T, E), ``shape`` (S,), ``static_offset`` (1, V, 3)."""
    values = {key: np.asarray(value, dtype=np.float32) for key, value in arrays.items()}
    values["timestep_id"] = np.array([f"{number:06d}" for number in numbers])
    values["n_processed_frames"] = np.array(len(numbers))
    save_npz(path, values)


@functools.cache
def video_codec() -> str:
    """Codec that videos are written with: H.264 ("avc1") where OpenCV can, else MPEG-4 part 2 ("mp4v").

    OpenCV's wheels come without an H.264 encoder. They say so at length on the error stream, so another process
    asks.
    """
    asked = (
        "import cv2, sys, tempfile\n"
        "with tempfile.NamedTemporaryFile(suffix='.mp4') as file:\n"
        f"    code = cv2.VideoWriter_fourcc(*{_H264!r})\n"
        "    writer = cv2.VideoWriter(file.name, cv2.CAP_FFMPEG, code, 73.0, (64, 64))\n"
        "    sys.exit(not writer.isOpened())\n"
    )
    answer = subprocess.run([sys.executable, "-c", asked], capture_output=True, check=False)
    return _MPEG4 if answer.returncode else _H264


def write_video(path: Path, frames: Iterable[ByteArray]) -> str:
    """Write RGB (or one-channel) frames as an mp4 of 73 frames per second; return the codec.

    Raises `InputError` for no frames, odd sizes, or where OpenCV cannot write a video.
    """
    codec = video_codec()
    writer: cv2.VideoWriter | None = None
    with atomic_path(path) as temporary:
        for frame in frames:
            height, width = frame.shape[:2]
            if writer is None:
                if width % 2 or height % 2:
                    raise InputError(
                        path, "size", "even width and height, as the codec asks", f"{width}x{height}"
                    )
                code = cv2.VideoWriter.fourcc(*codec)
                writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, code, FPS, (width, height))
                if not writer.isOpened():
                    raise InputError(path, "", "a video that OpenCV can write", f"no encoder for {codec}")
            order = cv2.COLOR_GRAY2BGR if frame.ndim == 2 else cv2.COLOR_RGB2BGR
            writer.write(cv2.cvtColor(frame, order))
        if writer is None:
            raise InputError(path, "", "at least one frame", "none")
        writer.release()
    return codec


def _write_image(path: Path, pixels: ByteArray) -> None:
    order = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    settings = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if path.suffix == ".jpg" else []
    _, data = cv2.imencode(path.suffix, order, settings)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())

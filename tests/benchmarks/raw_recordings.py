"""Writes raw recordings in NeRSemble's layout, with VHAP's tracking, for tests and for the benchmark of `prepare`.

Names and keys are those of the real files. Participants get numbers from 900 up and a marker file, so that nobody
takes them for recorded people.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray
from ...bench.errors import InputError
from ...bench.io.files import atomic_path, write_json, write_text
from ...bench.io.video import write_video
from ...datasets.ga.writer import save_npz
from ...datasets.images import write_image
from ...datasets.nersemble.names import BACKGROUND, FPS, FULL_SIZE, is_subject
from ...datasets.nersemble.recording import CAMERA_FILE, COLOUR_FILE, SEQUENCES_FILE

Release = Literal["v2", "v1", "paper2023"]

SYNTHETIC_IDS = 900
"""Participants from this number on are synthetic."""

MARKER_FILE = "SYNTHETIC.txt"
_MARKER = "Synthetic recordings in NeRSemble's layout, written by headbench. No person was recorded.\n"

_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 97)


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
        write_image(folder / f"image_{serial}.jpg", rgb, *_JPEG)

    def write_video(self, sequence: str, serial: str, frames: Iterable[ByteArray]) -> str:
        """Write a camera's video of RGB frames; return the codec, see `video_codec`."""
        folder = self.sequence_folder(sequence)
        folder = folder / "images" if self.release == "v2" else folder
        return write_video(folder / f"cam_{serial}.mp4", frames, FPS)

    def write_frame(
        self, sequence: str, serial: str, number: int, rgb: ByteArray, mask: ByteArray | None = None
    ) -> None:
        """Write a frame as an image file, as VHAP's preprocessing does, or the 2023 release where it is that."""
        folder = self.sequence_folder(sequence)
        if self.release == "paper2023":
            frame, name, kinds = (
                folder / f"frame_{number:05d}",
                f"cam_{serial}.png",
                ("images-2x", "alpha_map"),
            )
        else:
            frame, name, kinds = folder, f"cam_{serial}_{number:06d}.jpg", ("images", "alpha_maps")
        options = _JPEG if name.endswith(".jpg") else ()
        for kind, pixels in zip(kinds, (rgb, mask)):
            if pixels is not None:
                write_image(frame / kind / name, pixels, *options)

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

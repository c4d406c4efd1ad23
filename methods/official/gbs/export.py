"""Export of videos for GaussianBlendshapes' loader, in the format of Metrical Tracker and INSTA.

``checkpoint/00000.frame``, a torch file of numpy arrays for each frame; ``images/00000.png``, straight alpha;
``canonical.obj``. Frames are numbered without gaps; a separate map has their keys.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ....bench.contracts import Camera, Clip, FloatArray, FrameKey, HeadPose, Progress
from ....bench.errors import InputError
from ....bench.io.arrays import read_npy
from ....bench.io.files import atomic_path, read_bytes, write_bytes, write_text
from ....datasets.head.arrays import faces_in_region
from ....datasets.head.subject import PosedSubject
from ....datasets.head.teeth import with_teeth_where_possible
from ....datasets.images import write_image
from ...shared.avatar_files import Subject, head_arrays
from ..checkout import Checkout
from ..ga.export import mark
from ..ga.head_files import (
    OfficialHead,
    obj_text,
    pickled,
    write_landmarks,
)
from ..video import (
    at_rest,
    flame_values,
    frame_name,
    frame_parts,
    image_name,
    opencv_values,
    write_torch,
    write_video,
)
from ..workplace import Listed, Workplace, write_placeholder

SOURCES = ("*.py", "config/*.py", "FLAME/*.py", "utils/*.py")
"""Their program, which is run from a copy because it opens the eyelid bases beside its own file."""
BILLBOARDS = ("data/up_billboard_tri.obj", "data/down_billboard_tri.obj")
MODEL_FILE, LANDMARKS_FILE = "data/FLAME2020/generic_model.pkl", "data/landmark_embedding.npy"
BACK_FILE, NECK_FILE = "data/FLAME2020/back_of_head.txt", "data/FLAME2020/neck_exclude_vertex.txt"
EYELID_FILES = ("FLAME/blendshapes/l_eyelid.npy", "FLAME/blendshapes/r_eyelid.npy")
MEDIAPIPE_FILE, MEDIAPIPE_LANDMARKS = "FLAME/mediapipe/mediapipe_landmark_embedding.npz", 105
LANDMARKS = {"static_lmk": (51,), "dynamic_lmk": (79, 17)}
LOADER, CONFIG = "FLAME/dataset.py", "config/config_blendshapes.py"
TEXTURE_SIZE = 140
"""Number of texture coefficients of a frame, which are loaded and never used."""
GRIDS = {"WeightID_256.pt": "grid_id", "Weight5node_256.pt": "tar_feature"}
"""Files of their look-up grids, and the values looked up."""


def held_out(checkout: Checkout) -> int:
    """Number of last frames of every video that their loader uses as a test."""
    return int(checkout.constant(LOADER, r"self\.n_seg = (\d+)", "n_seg"))


class VideoHead:
    """A head model and one identity for their code: without teeth, with the static offset in the template."""

    def __init__(self, subject: Subject, head: Any, checkout: Checkout):
        self.official = OfficialHead.numbered(head)
        self.identity = subject
        self.posed = PosedSubject(head, subject.shape, subject.static_offset)
        self._checkout = checkout.folder
        eyelids = read_npy(self._checkout / EYELID_FILES[0])
        self.is_flames = len(eyelids) == len(self.official.order)
        """Whether vertices and triangles are FLAME's, so that indices in their code are valid."""
        if not self.is_flames:
            self._back = self._triangles("scalp")
            self._offset = self._mouth() - self._cylinder(checkout)

    def write_program(self, folder: Path) -> None:
        """Write their program and the files that it opens relative to its working directory."""
        for pattern in SOURCES:
            for path in sorted(self._checkout.glob(pattern)):
                name = path.relative_to(self._checkout).as_posix()
                write_bytes(folder / name, read_bytes(path, "a source file"))
        for name in BILLBOARDS:
            write_bytes(folder / name, read_bytes(self._checkout / name, "an OBJ file"))
        write_bytes(folder / MODEL_FILE, pickled(self.official.model(self.identity.static_offset)))
        write_landmarks(folder / LANDMARKS_FILE, LANDMARKS)
        count = MEDIAPIPE_LANDMARKS
        landmarks: dict[str, np.ndarray] = {
            "lmk_face_idx": np.zeros(count, np.int64),
            "lmk_b_coords": np.full((count, 3), 1 / 3, np.float32),
            "landmark_indices": np.arange(count),
        }
        with atomic_path(folder / MEDIAPIPE_FILE) as temporary, temporary.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **landmarks)
        self.official.write_eyelids(*(folder / name for name in EYELID_FILES))
        self._write_lists(folder)

    def write_identity(self, folder: Path) -> None:
        """Write the canonical mesh and, for heads other than FLAME's, the position of the mouth."""
        head, neutral = self.official, self.posed.neutral
        write_text(folder / "canonical.obj", obj_text(head.vertices(neutral), head.faces))
        if not self.is_flames:
            write_text(folder / "offset.txt", "{:.9g} {:.9g} {:.9g}\n".format(*self._offset))

    def frame(self, camera: Camera, pose: HeadPose) -> dict[str, dict[str, np.ndarray]]:
        """Content of a frame's file with the camera in the head's frame: arrays with a leading axis of one."""
        world, K = np.asarray(camera.world_to_camera, np.float64), np.asarray(camera.K, np.float64)
        # PyTorch3D's camera, x to the left and y up, lengths in halves of the image's smaller side. It draws the mesh
        # beside the renders; splats are projected by the OpenCV camera.
        turned = np.diag([-1.0, -1.0, 1.0])
        half = min(camera.width, camera.height) / 2
        middle = np.array([camera.width, camera.height]) / 2
        pytorch3d = {
            "R": (turned @ world[:3, :3]).T[:2].ravel(),
            "t": turned @ world[:3, 3],
            "fl": K[:1, 0] / half,
            "pp": -(K[:2, 2] - middle) / half,
        }
        flame = flame_values(self.identity, pose) | {"tex": np.zeros(TEXTURE_SIZE)}
        return frame_parts(flame=flame, camera=pytorch3d, opencv=opencv_values(camera))

    def _write_lists(self, folder: Path) -> None:
        """Triangles of the back of the head and vertices of the neck: theirs for FLAME, else those of the head's regions."""
        if self.is_flames:
            for name in (BACK_FILE, NECK_FILE):
                content = read_bytes(self._checkout / name, "a list of numbers")
                write_bytes(folder / name, content)
            return
        for name, numbers in ((BACK_FILE, self._back), (NECK_FILE, self.official.region("neck"))):
            write_text(folder / name, "".join(f"{number}\n" for number in numbers))

    def _triangles(self, region: str) -> np.ndarray:
        """Triangles of a region, by their indices in the exported mesh."""
        head = self.official.head
        faces_in_region(head, region)  # its error names what is missing
        inside = np.isin(self.official.order, head.regions[region])
        triangles = np.flatnonzero(inside[self.official.faces].all(axis=1))
        if len(triangles) < 3:
            where = f"head model {head.version!r}"
            raise InputError(
                where, f"regions[{region}]", "a part of the surface", f"{len(triangles)} triangles"
            )
        return triangles

    def _mouth(self) -> FloatArray:
        """(3,) middle of the box around the teeth, metres."""
        head = with_teeth_where_possible(head_arrays(self.official.head))
        if "teeth" not in head.regions:
            expected = "lips, behind which their code places teeth"
            raise InputError(f"head model {head.version!r}", "regions", expected, "none")
        offset = np.zeros((len(head.template), 3))
        offset[: len(self.identity.static_offset)] = self.identity.static_offset
        teeth = PosedSubject(head, self.identity.shape, offset).neutral[head.regions["teeth"]]
        return np.asarray(0.5 * (teeth.min(0) + teeth.max(0)), np.float64)

    @staticmethod
    def _cylinder(checkout: Checkout) -> FloatArray:
        """(3,) middle of the volume to which their teeth are limited, metres."""
        numbers = checkout.constant(CONFIG, r"cylinder_params = \[([^\]]+)\]", "cylinder_params")
        return np.array([float(number) for number in numbers.split(",")[:3]])


def write_training(
    clip: Clip, head: VideoHead, placeholders: int, work: Workplace, progress: Progress
) -> dict[str, FrameKey]:
    """Write the training frames as a video, followed by placeholders for the frames that their loader holds out.

    A placeholder has an image of one pixel, and pose and camera of the first training frame. Returns the key of every
    other image by its path.
    """
    head.write_identity(work.input)
    images, first = write_video(clip, head.posed, work.input, head.frame, progress)
    for number in range(len(images), len(images) + placeholders):
        write_placeholder(work.input / image_name(number))
        write_torch(work.input / frame_name(number), first)
    return {f"input/{name}": key for name, key in images.items()}


def write_list(frames: Sequence[Listed], head: VideoHead, work: Workplace) -> None:
    """Write frames to render as a video whose images are marks, see `..ga.export.mark`.

    Their renderer first fills two look-up grids of 256^3 nodes, which takes minutes, although it reads the required
    values from the checkpoint. Grids of one node in its cache files avoid that.
    """
    head.write_identity(work.input)
    for frame in at_rest(head.posed, frames):
        image = np.full((frame.camera.height, frame.camera.width, 4), 255, np.uint8)
        image[..., :3] = mark(frame.number)
        write_image(work.input / image_name(frame.number), image)
        write_torch(work.input / frame_name(frame.number), head.frame(frame.camera, frame.pose))
    for file, name in GRIDS.items():
        box = {"bbox_min": torch.zeros(3), "bbox_max": torch.ones(3), "grid_size": [1, 1, 1]}
        write_torch(work.input / file, {**box, name: torch.zeros(1, 1, 1, 1)})

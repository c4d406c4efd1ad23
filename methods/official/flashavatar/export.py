"""Export of videos and lists of frames for FlashAvatar's loader, in the layout of its page.

Of an identity NAME: ``metrical-tracker/output/NAME/checkpoint/00000.frame``, numbered from 0, and
``dataset/NAME/imgs/00001.jpg``, ``alpha/00001.jpg``, ``parsing/00001_neckhead.png`` and ``parsing/00001_mouth.png``,
whose numbers are one higher. Images are PNG under these names; the loader recognises the format by the content. It
takes identity, image size and focal lengths from frame 0, and the principal point to be the middle of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from ....bench.contracts import ByteArray, Camera, Clip, FrameKey, HeadAsset, HeadPose, Progress
from ....bench.io.files import grouped_writes, read_bytes, write_bytes
from ....bench.io.images import write_png
from ....datasets.head.arrays import region
from ...insta.warp import mouth_triangles, touching
from ...shared.avatar_files import Subject
from ..checkout import Checkout
from ..ga.export import mark
from ..ga.head_files import MOST_TEMPLATE, pickled, read_obj
from ..ga.windows import around, inside
from ..surface import VisibleMesh
from ..video import FlameSubject, at_rest, frame_name, straight_rgba, training_frames, write_torch
from ..workplace import Listed, Workplace

SOURCES = (
    "*.py",
    *(f"{name}/*.py" for name in ("arguments", "flame", "gaussian_renderer", "scene", "src", "utils")),
)
"""Their program, which is run from a copy because it opens the eyelid bases beside its own file."""
MESH_FILE = Path("flame/FlameMesh.obj")
"""FLAME's triangles, more that close the lips, and their texture chart."""
UNCHANGED = (
    MESH_FILE,
    Path("flame/landmark_embedding.npy"),
    Path("flame/mediapipe/mediapipe_landmark_embedding.npz"),
)
MODEL_FILE, MASKS_FILE = Path("flame/generic_model.pkl"), Path("flame/FLAME_masks/FLAME_masks.pkl")
EYELID_FILES = (Path("flame/blendshapes/l_eyelid.npy"), Path("flame/blendshapes/r_eyelid.npy"))
BOUNDARY = "boundary"
"""The region at the lower end of the neck: their code has no splats on it, and what lies beyond it is not head."""
FULL = 255


def flame_subject(subject: Subject, head: HeadAsset, checkout: Checkout) -> FlameSubject:
    """The head model and one identity. Raises `InputError` for another topology than FLAME's, and without regions."""
    vertices, _ = read_obj(checkout.folder / MESH_FILE)
    for name in (BOUNDARY, "lips"):
        region(head, name)
    return FlameSubject.of(head, subject, vertices, MESH_FILE)


def write_program(identity: Subject, head: HeadAsset, work: Workplace) -> FlameSubject:
    """Write their program and the files that it opens relative to its working directory or beside itself.

    Returns the identity on the head model; raises the errors of `flame_subject`.
    """
    checkout, folder = work.checkout, work.program
    subject = flame_subject(identity, head, checkout)
    paths = [path for pattern in SOURCES for path in sorted(checkout.folder.glob(pattern))]
    for path in (*paths, *(checkout.folder / name for name in UNCHANGED)):
        content = read_bytes(path, "a file of the program", MOST_TEMPLATE)
        write_bytes(folder / path.relative_to(checkout.folder), content)
    write_bytes(folder / MODEL_FILE, pickled(subject.model()))
    write_bytes(folder / MASKS_FILE, pickled({BOUNDARY: subject.official.region(BOUNDARY)}))
    subject.official.write_eyelids(*(folder / name for name in EYELID_FILES))
    return subject


class ParsingMasks:
    """Masks of head with neck, and of the mouth, by the tracked mesh in place of a network that parses faces.

    The mouth is where the mesh shows lips, teeth or the inside of the mouth. Head and neck are the covered pixels that
    show the mesh above its boundary, and those beside the mesh (hair) whose nearest projected vertex is not on the
    boundary; shoulders and clothes are left out.
    """

    def __init__(self, head: HeadAsset, subject: FlameSubject):
        self._mesh = VisibleMesh(head, subject.posed)
        self._mouth = mouth_triangles(head).numpy()
        self._below = touching(head, BOUNDARY)
        self._on_boundary = np.isin(np.arange(len(head.template)), head.regions[BOUNDARY])

    def of(self, pose: HeadPose, camera: Camera, coverage: ByteArray) -> tuple[ByteArray, ByteArray]:
        """(H, W) masks of head with neck, and of the mouth, 0 or 255, for a camera in the head's frame."""
        found = self._mesh.seen(pose, camera, coverage)
        triangles = found.triangles.clip(0)
        head, mouth = (np.zeros(coverage.shape, np.uint8) for _ in range(2))
        mouth[found.rows, found.columns] = FULL * (found.hit & self._mouth[triangles])
        inside_head = found.hit & ~self._below[triangles]
        beside = np.flatnonzero(~found.hit)
        if len(beside):
            world = np.asarray(camera.world_to_camera, np.float64)
            points = (found.vertices @ world[:3, :3].T + world[:3, 3]) @ np.asarray(camera.K, np.float64).T
            pixels = np.stack([found.columns[beside], found.rows[beside]], axis=1) + 0.5
            _, nearest = KDTree(points[:, :2] / points[:, 2:]).query(pixels)
            inside_head[beside] = ~self._on_boundary[nearest]
        head[found.rows, found.columns] = FULL * inside_head
        return head, mouth


def write_training(
    clip: Clip, subject: FlameSubject, name: str, work: Workplace, progress: Progress
) -> dict[str, FrameKey]:
    """Write the training frames as an identity of this name, cut to the window with the principal point in its middle.

    Returns the key of every image by its path.
    """
    frames = training_frames(clip, subject.posed)
    masks = ParsingMasks(clip.head, subject)
    images: dict[str, FrameKey] = {}
    with grouped_writes():
        for frame in frames:
            window = inside(frame.camera)
            pixels = straight_rgba(clip, frame.key)
            head, mouth = masks.of(frame.pose, frame.camera, pixels[..., 3])
            parts = (np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3]), head, mouth)
            for place, image in zip(image_names(name, frame.number), parts):
                write_png(work.program / place, window.cut(image))
                images[f"program/{place}"] = frame.key
            write_torch(
                work.program / tracked_name(name, frame.number), subject.frame(window.camera, frame.pose)
            )
            progress(frame.number + 1, len(frames), "exporting")
    return images


def write_list(frames: Sequence[Listed], subject: FlameSubject, name: str, work: Workplace) -> None:
    """Write frames of one camera's intrinsics as an identity, in windows around their images.

    Images are marks, see `..ga.export.mark`; the renderer writes each beside the render. Masks have one pixel.
    """
    white, black = np.full((1, 1), FULL, np.uint8), np.zeros((1, 1), np.uint8)
    with grouped_writes():
        for index, frame in enumerate(at_rest(subject.posed, frames)):
            window = around(frame.camera).camera
            image = np.full((window.height, window.width, 3), mark(frame.number), np.uint8)
            for place, pixels in zip(image_names(name, index), (image, white, white, black)):
                write_png(work.program / place, pixels)
            write_torch(work.program / tracked_name(name, index), subject.frame(window, frame.pose))


def image_names(name: str, number: int) -> tuple[str, str, str, str]:
    """Paths of image, coverage, mask of head and neck, and mask of the mouth; their numbers begin with 1."""
    folder, place = f"dataset/{name}", f"{number + 1:05d}"
    masks = (f"{folder}/parsing/{place}_{mask}.png" for mask in ("neckhead", "mouth"))
    return (f"{folder}/imgs/{place}.jpg", f"{folder}/alpha/{place}.jpg", *masks)  # type: ignore[return-value]


def tracked_name(name: str, number: int) -> str:
    """Path of a frame's parameters, numbered from 0."""
    return f"metrical-tracker/output/{name}/{frame_name(number)}"

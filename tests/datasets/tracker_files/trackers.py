"""Files of trackers, written from one camera of a capture by the formulae of the trackers' own programs."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.model import PosedSubject

from ..monocular.videos import Recording, six_numbers

HEAD_FILE = "head.npz"
SHAPES, EXPRESSIONS = 300, 100
"""Coefficients that Metrical Tracker and Pixel3DMM write."""
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
LEFT_UP = np.array([-1.0, -1.0, 1.0])
"""Signs from OpenCV's axes to PyTorch3D's."""
RIGHT_UP_BACK = np.array([1.0, -1.0, -1.0])
"""Signs from OpenCV's axes to OpenGL's."""


def save(path: Path, content: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(content, path)


def single(values: Any, *shape: int) -> np.ndarray:
    return np.asarray(values, np.float32).reshape(1, *shape)


def resting(recording: Recording, key: Any) -> tuple[Any, np.ndarray]:
    """A pose without root motion, and that motion as a matrix."""
    pose = recording.pose(key)
    nothing = np.zeros(3)
    motion = recording.subject.motions([replace(pose, neck=nothing)])[0]
    return replace(pose, rotation=nothing, translation=nothing), motion


def flame(recording: Recording, pose: Any, lids: Any) -> dict[str, np.ndarray]:
    """The part that both trackers have; bases of the files are larger than the head's."""
    shape, expression = recording.clip.shape, pose.expression
    return {
        "exp": single(np.pad(expression, (0, EXPRESSIONS - len(expression))), EXPRESSIONS),
        "shape": single(np.pad(shape, (0, SHAPES - len(shape))), SHAPES),
        "eyes": single(six_numbers(pose.eyes), 12),
        "eyelids": single(lids, 2),
        "jaw": single(six_numbers(pose.jaw), 6),
    }


def lids_of(pose: Any) -> np.ndarray:
    return np.array([0.25, 0.5]) if pose.eyelids is None else pose.eyelids


def write_metrical(recording: Recording, folder: Path) -> Path:
    """``checkpoint`` and ``input`` of Metrical Tracker; images with straight alpha."""
    width, height, K = recording.camera.width, recording.camera.height, recording.camera.K
    half = min(width, height) / 2
    for number, key in enumerate(recording.keys):
        pose, motion = resting(recording, key)
        view = recording.camera.world_to_camera @ motion
        R, t = (LEFT_UP[:, None] * view[:3, :3]).T, LEFT_UP * view[:3, 3]
        focal, centre = K[0, 0] / half, (np.array([width, height]) / 2 - K[:2, 2]) / half
        focal, centre, R, t = (np.asarray(values, np.float32) for values in (focal, centre, R, t))
        pixels = np.eye(3)
        pixels[0, 0] = pixels[1, 1] = focal * half
        pixels[:2, 2] = np.array([width, height]) / 2 - centre * half
        content = {
            "flame": flame(recording, pose, lids_of(pose))
            | {"tex": single(np.zeros(140), 140), "sh": single(np.ones(27), 9, 3)},
            "camera": {"R": single(R[:2], 6), "t": single(t, 3)}
            | {"fl": single(focal, 1), "pp": single(centre, 2)},
            "opencv": {
                "R": single((R * LEFT_UP).T, 3, 3),
                "t": single(t * LEFT_UP, 3),
                "K": single(pixels, 3, 3),
            },
            "img_size": np.array([height, width]),
            "frame_id": f"{number:05d}",
            "global_step": 7 * number,
        }
        save(folder / f"checkpoint/{number:05d}.frame", content)
        image = folder / f"input/{number:05d}.png"
        image.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(image), recording.rgba(key))
    save_head(folder / HEAD_FILE, recording.head)
    return folder


def write_flashavatar(recording: Recording, folder: Path) -> Path:
    """The same, and FlashAvatar's images from number 1: colours, matte, and the mask of head and neck."""
    write_metrical(recording, folder)
    for name in ("imgs", "alpha", "parsing"):
        (folder / name).mkdir()
    for number in range(len(recording.keys)):
        rgba = cv2.imread(str(folder / f"input/{number:05d}.png"), cv2.IMREAD_UNCHANGED)
        (folder / f"input/{number:05d}.png").unlink()
        name = f"{number + 1:05d}"
        cv2.imwrite(str(folder / f"imgs/{name}.jpg"), rgba[..., :3], JPEG)
        cv2.imwrite(str(folder / f"alpha/{name}.jpg"), rgba[..., 3], JPEG)
        cv2.imwrite(str(folder / f"parsing/{name}_neckhead.png"), upper(*rgba.shape[:2]))
        cv2.imwrite(str(folder / f"parsing/{name}_mouth.png"), np.zeros(rgba.shape[:2], np.uint8))
    return folder


def upper(height: int, width: int) -> np.ndarray:
    """A mask of the upper half of an image."""
    return np.repeat(255 * (np.arange(height) < height // 2), width).reshape(height, width).astype(np.uint8)


def write_pixel3dmm(recording: Recording, folder: Path, *, tracked: int) -> Path:
    """Pixel3DMM's ``checkpoint``, with ``cropped`` and ``seg_og`` beside it; images are larger than ``tracked``."""
    camera = recording.camera.resized(tracked, tracked)
    base = np.eye(4)
    base[:3] = RIGHT_UP_BACK[:, None] * camera.world_to_camera[:3]
    for number, key in enumerate(recording.keys):
        pose, motion = resting(recording, key)
        content = {
            "flame": flame(recording, pose, lids_of(pose))
            | {
                "neck": single(six_numbers(pose.neck), 6),
                "R": single(motion[:2, :3], 6),
                "R_rotation_matrix": single(motion[:3, :3], 3, 3),
                "t": single(motion[:3, 3], 3),
            },
            "img_size": np.array([tracked, tracked]),
            "frame_id": number,
            "global_step": 4494,
            "camera": {
                "R_base_0": single(base[:3, :3], 3, 3),
                "t_base_0": single(base[:3, 3], 3),
                "fl": single(camera.K[0, 0] / tracked, 1),
                "pp": single(camera.K[:2, 2] / (tracked / 2 + 0.5) - 1, 2),
            },
            "joint_transforms": single(np.tile(np.eye(4), (5, 1, 1)), 5, 4, 4),
        }
        save(folder / f"track/checkpoint/{number:05d}.frame", content)
        rgba = recording.rgba(key)
        labels = np.where(rgba[..., 3] > 127, 18, 20 * (upper(*rgba.shape[:2]) > 0))
        for name, pixels in (("cropped", rgba[..., :3]), ("seg_og", labels)):
            path = folder / name / f"{number:05d}.png"
            path.parent.mkdir(exist_ok=True)
            cv2.imwrite(str(path), pixels.astype(np.uint8))
    save_head(folder / "track" / HEAD_FILE, recording.head)
    return folder / "track"


def rest_mesh(recording: Recording, key: Any) -> np.ndarray:
    """(V, 3) vertices with the root at rest, metres."""
    return recording.subject.meshes([resting(recording, key)[0]])[0]


def seen_by_pytorch3d(content: Mapping[str, Any], mesh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Camera-space points in OpenCV's axes, and pixels, from ``camera`` by PyTorch3D's row-vector convention in NDC."""
    height, width = content["img_size"]
    camera = {name: values[0].astype(float) for name, values in content["camera"].items()}
    first, second = camera["R"][:3], camera["R"][3:]
    R = np.stack([first, second, np.cross(first, second)])
    points = mesh @ R + camera["t"]
    ndc = camera["fl"] * points[:, :2] / points[:, 2:] + camera["pp"]
    half = min(width, height) / 2
    return points * LEFT_UP, np.array([width, height]) / 2 - half * ndc


def seen_by_nvdiffrast(
    content: Mapping[str, Any], mesh: np.ndarray, shown: int
) -> tuple[np.ndarray, np.ndarray]:
    """Camera-space points in OpenCV's axes, and pixels of an image of ``shown`` pixels, by OpenGL's clip coordinates."""
    size = content["img_size"][0]
    flame, camera = content["flame"], content["camera"]
    world = mesh @ flame["R_rotation_matrix"][0].astype(float).T + flame["t"][0]
    points = world @ camera["R_base_0"][0].astype(float).T + camera["t_base_0"][0]
    focal = float(camera["fl"][0, 0]) * size
    x, y = size / 2 + 0.5 + camera["pp"][0].astype(float) * (size / 2 + 0.5)
    clip_x = 2 * focal / size * points[:, 0] + (size - 2 * x) / size * points[:, 2]
    clip_y = -2 * focal / size * points[:, 1] + (size - 2 * y) / size * points[:, 2]
    ndc = np.stack([clip_x, clip_y], axis=1) / -points[:, 2:]
    return points * RIGHT_UP_BACK, (ndc + 1) / 2 * shown


def subject_of(clip: Any) -> PosedSubject:
    return PosedSubject(clip.head, clip.shape, clip.static_offset)

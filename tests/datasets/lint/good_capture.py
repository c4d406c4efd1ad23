"""A small capture without any fault: a toy head with a painted skin, moving smoothly, softly masked."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from headbench.bench.contracts import Camera, HeadPose
from headbench.datasets.ga.writer import CapturePlan, CaptureWriter, SequencePlan
from headbench.datasets.head.arrays import HeadArrays
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.head.teeth import with_teeth
from headbench.datasets.mesh_pictures import rasterize_mesh

from ..head.toy import toy_head
from ..tiny_capture import TinyCapture, edit_npz, look_at

WIDTH, HEIGHT = 60, 80
LENGTHS = {"EMO-1-shout+laugh": 6, "SEN-01-cramp_small_danger": 6, "FREE": 10}
SERIALS = ("222200042", "222200040", "222200037", "222200049")
FRONTAL = "222200037"
SKIN = (205, 152, 124)


def cameras(cx: float = WIDTH / 2 + 0.4, cy: float = HEIGHT / 2 - 0.6, scale: int = 1) -> list[Camera]:
    """Four cameras on an arc of 90 degrees, a little above the head; images ``scale`` times as large."""
    size = scale * WIDTH, scale * HEIGHT
    angles = np.radians([-50.0, -20.0, 10.0, 40.0])
    places = (np.array([np.sin(a), 0.08, np.cos(a)]) for a in angles)
    return [look_at(name, at, *size, scale * cx, scale * cy) for name, at in zip(SERIALS, places)]


def smooth_poses(head: HeadArrays, count: int, phase: float) -> list[HeadPose]:
    """Slow waves in every parameter."""
    poses = []
    for t in range(count):
        angle = phase + 0.35 * t
        waves = np.sin(angle * np.arange(1, head.expression_basis.shape[2] + 1) + phase)
        poses.append(
            HeadPose(
                head_model=head.version,
                expression=(0.8 * waves).astype(np.float32),
                rotation=np.array([0.08 * np.sin(angle), 0.15 * np.cos(angle), 0.03], np.float32),
                neck=np.array([0.02 * np.cos(angle), 0.0, 0.0], np.float32),
                jaw=np.array([0.15 + 0.12 * np.sin(2 * angle), 0, 0], np.float32),
                eyes=np.full(6, 0.1 * np.sin(angle), np.float32),
                translation=np.array([0.003 * np.sin(angle), 0.004 * np.cos(angle), 0], np.float32),
            )
        )
    return poses


def trained_poses(head: HeadArrays, count: int, phase: float) -> list[HeadPose]:
    """Poses whose expressions are about those of the first sequence."""
    known = itertools.cycle(smooth_poses(head, next(iter(LENGTHS.values())), 0)[1:])
    return [
        replace(p, expression=0.96 * k.expression) for p, k in zip(smooth_poses(head, count, phase), known)
    ]


def good_plan(**changes: Any) -> CapturePlan:
    """Two training sequences and FREE."""
    head = changes.pop("head", None) or with_teeth(toy_head(16, version="toy2023"))
    vertices, _, identities = head.shape_basis.shape
    rng = np.random.default_rng(5)
    settings: dict[str, Any] = {
        "subject": "901",
        "head": head,
        "shape": rng.normal(size=identities).astype(np.float32),
        "static_offset": (0.0005 * rng.normal(size=(vertices, 3))).astype(np.float32),
        "cameras": cameras(),
        "sequences": [
            SequencePlan(n, trained_poses(head, c, i) if n == "FREE" else smooth_poses(head, c, i))
            for i, (n, c) in enumerate(LENGTHS.items())
        ],
        "test_sequences": ("FREE",),
        "novel_view_cameras": (FRONTAL,),
    }
    return CapturePlan(**(settings | changes))


def paint(
    plan: CapturePlan, vertices: np.ndarray, camera: Camera, fine: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (H, W, 3) and coverage (H, W) of the mesh, its skin darker and lighter in patches of 2 cm."""
    front = rasterize_mesh(
        vertices, plan.head.faces, camera.resized(fine * camera.width, fine * camera.height)
    ).face
    middle = plan.head.template[plan.head.faces].mean(axis=1)
    patches = 18 * np.sin(150 * middle[:, 0]) + 18 * np.sin(150 * middle[:, 1] + 40 * middle[:, 2])
    shades = patches[:, None] + np.array(SKIN)
    alpha = (front >= 0).astype(np.float32)
    sums = cv2.resize(
        alpha[..., None] * shades[front].astype(np.float32),
        (camera.width, camera.height),
        interpolation=cv2.INTER_AREA,
    )
    alpha = cv2.resize(alpha, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return sums / np.maximum(alpha, 1e-6)[..., None], alpha


def composite(colour: np.ndarray, alpha: np.ndarray, background: float = 1.0) -> np.ndarray:
    """(H, W, 3) 8-bit."""
    return np.round(colour * alpha[..., None] + 255 * background * (1 - alpha[..., None])).astype(np.uint8)


def write_pixels(path: Path, pixels: np.ndarray) -> None:
    """Replace an image by (H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA, without the care of a capture's writer."""
    turned = pixels if pixels.ndim == 2 else np.dstack([pixels[..., 2::-1], pixels[..., 3:]])
    cv2.imwrite(str(path), turned)


def read_rgb(path: Path) -> np.ndarray:
    """(H, W, 3) 8-bit."""
    return cv2.imread(str(path), cv2.IMREAD_COLOR)[..., ::-1]


def read_grey(path: Path) -> np.ndarray:
    """(H, W) 8-bit."""
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)


class GoodCapture(TinyCapture):
    """A written capture and ways to damage it."""

    def files(self, pattern: str) -> list[Path]:
        """Files of the sequence folders, sorted: "images", "fg_masks" or "flame_param"."""
        return sorted(self.writer.root.glob(f"901_*/{pattern}/*"))

    def each_image(
        self, change: Callable[[np.ndarray, np.ndarray], np.ndarray], *, masks: bool = False
    ) -> None:
        """Replace every image (or mask) by what ``change`` makes of (H, W, 3) RGB and its (H, W) mask."""
        for path in self.files("images"):
            mask_path = path.parent.parent / "fg_masks" / path.name
            image, mask = read_rgb(path), read_grey(mask_path)
            write_pixels(mask_path if masks else path, change(image, mask))

    def each_parameters(self, change: Callable[[dict[str, np.ndarray], int], None]) -> None:
        """Apply ``change`` to the arrays of every parameter file, given its position in the order of files."""
        for index, path in enumerate(self.files("flame_param")):
            edit_npz(path, lambda arrays, index=index: change(arrays, index))


def write_good_capture(root: Path, plan: CapturePlan | None = None) -> GoodCapture:
    """Write a whole capture."""
    plan = plan or good_plan()
    writer = CaptureWriter(root, plan)
    subject = PosedSubject(plan.head, plan.shape, plan.static_offset)
    for sequence in plan.sequences:
        for timestep, vertices in enumerate(subject.meshes(sequence.poses)):
            for camera in plan.cameras:
                colour, alpha = paint(plan, vertices, camera)
                image, mask = composite(colour, alpha), np.round(alpha * 255).astype(np.uint8)
                writer.write_frame(sequence.name, timestep, camera.id, image, mask)
    writer.write_metadata()
    return GoodCapture(writer)

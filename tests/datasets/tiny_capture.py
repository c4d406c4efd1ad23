"""A tiny capture on disk for tests: a toy head, flat-shaded by its silhouette, written by our writer."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np

from headbench.bench.contracts import Camera, HeadPose
from headbench.bench.experiments import viewpoints
from headbench.datasets.ga.writer import CapturePlan, CaptureWriter, SequencePlan
from headbench.datasets.head.arrays import HeadArrays
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.head.teeth import with_teeth

from .head.toy import toy_head

SERIALS = ("222200042", "222200037", "222200038")
FRONTAL = "222200037"


def look_at(name: str, position: np.ndarray, width: int, height: int, cx: float, cy: float) -> Camera:
    """Camera at ``position`` looking at the origin, +y up."""
    focal = 3.2 * width
    K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
    motion = viewpoints.look_at(position, np.zeros(3), np.array([0.0, 1.0, 0.0]))
    return Camera(name, width, height, K, motion)


def in_camera(points: np.ndarray, camera: Camera) -> np.ndarray:
    """(n, 3) points in the camera's axes, metres."""
    return points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]


def projected(points: np.ndarray, camera: Camera) -> np.ndarray:
    """(n, 2) pixels of points, by the definition of `Camera`."""
    rays = in_camera(points, camera) @ camera.K.T
    return rays[:, :2] / rays[:, 2:]


def edit_json(path: Path, change: Callable[[dict], object]) -> None:
    """Apply ``change`` to the content of a JSON file."""
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def edit_npz(path: Path, change: Callable[[dict[str, np.ndarray]], object]) -> None:
    """Apply ``change`` to the arrays of an npz file."""
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name].copy() for name in archive.files}
    change(arrays)
    np.savez(path, allow_pickle=False, **arrays)


def rig(width: int = 48, height: int = 64, cx: float = 24.7, cy: float = 29.3) -> list[Camera]:
    """Three cameras on an arc in front of the head."""
    angles = np.radians([-40.0, 0.0, 40.0])
    return [
        look_at(name, np.array([np.sin(a), 0.1, np.cos(a)]), width, height, cx, cy)
        for name, a in zip(SERIALS, angles)
    ]


def random_pose(head: HeadArrays, rng: np.random.Generator) -> HeadPose:
    """A pose whose numbers float32 holds exactly."""

    def draw(size: int, scale: float) -> np.ndarray:
        return (scale * rng.normal(size=size)).astype(np.float32)

    return HeadPose(
        head_model=head.version,
        expression=draw(head.expression_basis.shape[2], 1.0),
        rotation=draw(3, 0.05),
        neck=draw(3, 0.05),
        jaw=np.abs(draw(3, 0.2)) * np.array([1, 0, 0], np.float32),
        eyes=draw(6, 0.1),
        translation=draw(3, 0.003),
        eyelids=None if head.eyelid_basis is None else draw(2, 0.3),
    )


def make_plan(
    *, lengths: dict[str, int] | None = None, cameras: list[Camera] | None = None, seed: int = 0, **changes
) -> CapturePlan:
    """Plan of two training sequences and FREE, whose last frame shows the tongue."""
    head = changes.pop("head", None) or with_teeth(toy_head(16))
    rng = np.random.default_rng(seed)
    lengths = lengths or {"FREE": 3, "EMO-1-shout+laugh": 2, "SEN-01-cramp_small_danger": 2}
    vertices, _, identities = head.shape_basis.shape
    sequences = [
        SequencePlan(
            name,
            [random_pose(head, rng) for _ in range(count)],
            {count - 1: "tongue out"} if name == "FREE" else {},
        )
        for name, count in lengths.items()
    ]
    settings = {
        "subject": "901",
        "head": head,
        "shape": rng.normal(size=identities).astype(np.float32),
        "static_offset": (0.001 * rng.normal(size=(vertices, 3))).astype(np.float32),
        "cameras": cameras or rig(),
        "sequences": sequences,
        "test_sequences": ("FREE",),
        "novel_view_cameras": (FRONTAL,),
    }
    return CapturePlan(**(settings | changes))


def posed_vertices(plan: CapturePlan, pose: HeadPose) -> np.ndarray:
    """(V, 3) mesh of a pose, metres."""
    return PosedSubject(plan.head, plan.shape, plan.static_offset).meshes([pose])[0]


def silhouette(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: pixels whose centre is covered, tested for each triangle with barycentric signs."""
    corners = projected(vertices, camera)[faces]
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(corners.min(axis=1)).astype(int), 0, size)
    high = np.clip(np.ceil(corners.max(axis=1)).astype(int), 0, size)
    steps = np.indices((high - low).max(axis=0)).reshape(2, -1).T
    pixels = low[:, None] + steps  # (F, n, 2)
    x, y = np.moveaxis(pixels + 0.5, -1, 0)
    sides = np.stack(
        [
            (q[:, :1] - p[:, :1]) * (y - p[:, 1:]) - (q[:, 1:] - p[:, 1:]) * (x - p[:, :1])
            for p, q in zip(np.moveaxis(corners, 1, 0), np.moveaxis(np.roll(corners, -1, axis=1), 1, 0))
        ]
    )
    inside = ((sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)) & (pixels < high[:, None]).all(axis=-1)
    covered = np.zeros((camera.height, camera.width), dtype=bool)
    covered[tuple(pixels[inside].T[::-1])] = True
    return covered


def paint(plan: CapturePlan, pose: HeadPose, camera: Camera, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Image (noise and a gradient inside the silhouette, white outside) and mask of a frame."""
    covered = silhouette(posed_vertices(plan, pose), plan.head.faces, camera)
    noise = np.random.default_rng(seed).integers(20, 80, size=(camera.height, camera.width, 3))
    noise += np.linspace(0, 120, camera.height, dtype=int)[:, None, None]
    image = np.where(covered[..., None], noise, 255).astype(np.uint8)
    return image, (covered * 255).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class TinyCapture:
    """A written capture: its writer, and (image, mask) by (sequence, timestep in it, camera)."""

    writer: CaptureWriter
    frames: dict[tuple[str, int, str], tuple[np.ndarray, np.ndarray]] = field(
        default_factory=dict, repr=False
    )

    @property
    def union(self) -> Path:
        return self.writer.union

    def copied(self, root: Path) -> Self:
        """The same capture in another place, which a test may damage."""
        shutil.copytree(self.writer.root, root)
        return type(self)(CaptureWriter(root, self.writer.plan), self.frames)

    def edit(self, file: str, change: Callable[[dict], object]) -> None:
        """Apply ``change`` to a JSON of the union folder."""
        edit_json(self.union / file, change)

    def each_frame(self, change: Callable[[dict], object]) -> None:
        """Apply ``change`` to every frame of every split."""
        for split in ("train", "val", "test"):
            self.edit(f"transforms_{split}.json", lambda value: [change(frame) for frame in value["frames"]])

    def without_masks(self) -> None:
        """No frame names a mask."""
        self.each_frame(lambda frame: frame.pop("fg_mask_path"))


def write_tiny_capture(root: Path, plan: CapturePlan | None = None) -> TinyCapture:
    """Write a whole capture."""
    plan = plan or make_plan()
    writer = CaptureWriter(root, plan)
    frames = {}
    for sequence in plan.sequences:
        for timestep, pose in enumerate(sequence.poses):
            for camera in plan.cameras:
                key = (sequence.name, timestep, camera.id)
                frames[key] = paint(plan, pose, camera, len(frames))
                writer.write_frame(*key, *frames[key])
    writer.write_metadata()
    return TinyCapture(writer, frames)

"""A clip in memory whose images come from known splats on the toy head, so that training has a true answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from headbench.bench.contracts import Camera, FrameKey, HeadPose, StepRecord
from headbench.bench.experiments import viewpoints
from headbench.bench.io.files import digest
from headbench.datasets.head.arrays import HeadArrays
from headbench.methods.ops.splats import to_world
from headbench.methods.shared.surface_points import SubjectMesh
from headbench.methods.splats import rasterize


@dataclass(frozen=True, eq=False)
class ToyClip:
    """A `Clip` of arrays."""

    head: HeadArrays
    shape: np.ndarray
    static_offset: np.ndarray
    cameras: Mapping[str, Camera]
    poses: Mapping[int, HeadPose]
    splits: Mapping[str, tuple[FrameKey, ...]]
    images: Mapping[FrameKey, np.ndarray]
    masks: Mapping[FrameKey, np.ndarray]
    background: np.ndarray
    subject: str = "toy"
    excluded: Mapping[FrameKey, str] = field(default_factory=dict)
    steps: Sequence[StepRecord] = ()

    @property
    def fingerprint(self) -> str:
        keys = sorted(self.images)
        return digest([str(key) for key in keys], *(self.images[key] for key in keys))

    def image(self, key: FrameKey) -> np.ndarray:
        return self.images[key]

    def mask(self, key: FrameKey) -> np.ndarray:
        return self.masks[key]


def look_at(position: np.ndarray, target: np.ndarray, name: str, width: int, height: int) -> Camera:
    """Camera at a position looking at a target, y up in the world, with a 40 degree field of view."""
    focal = 0.5 * height / np.tan(np.radians(20))
    K = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]])
    return Camera(name, width, height, K, viewpoints.look_at(position, target, np.array([0.0, 1.0, 0.0])))


def toy_cameras(count: int, width: int, height: int) -> dict[str, Camera]:
    """Cameras on an arc in front of the head, 0.5 m away."""
    cameras = {}
    for index, angle in enumerate(np.linspace(-0.9, 0.9, count)):
        position = 0.5 * np.array([np.sin(angle), 0.1 * np.cos(3 * angle), np.cos(angle)])
        cameras[f"{index:02d}"] = look_at(position, np.zeros(3), f"{index:02d}", width, height)
    return cameras


def toy_pose(head: HeadArrays, rng: np.random.Generator, timestep: int | None, subject: str) -> HeadPose:
    """A random pose of moderate size."""

    def small(size: int, scale: float) -> np.ndarray:
        return (scale * rng.standard_normal(size)).astype(np.float32)

    return HeadPose(
        head.version,
        expression=small(head.expression_basis.shape[2], 1.0),
        rotation=small(3, 0.05),
        neck=small(3, 0.05),
        jaw=np.array([abs(rng.standard_normal()) * 0.1, 0, 0], np.float32),
        eyes=small(6, 0.05),
        translation=small(3, 0.003),
        subject=subject,
        timestep=timestep,
    )


def splat_pictures(
    mesh: SubjectMesh, waves: float = 60.0
) -> Callable[[HeadPose, Camera], tuple[np.ndarray, np.ndarray]]:
    """Draws 8-bit image and mask of a pose on white: an opaque splat per triangle, whose colours are waves in space, radians a metre."""
    faces = len(mesh.faces)
    center = mesh.canonical[mesh.faces].mean(1).numpy()
    colors = torch.from_numpy(0.5 + 0.5 * np.sin(waves * center + np.array([0.0, 2.0, 4.0]))).float()
    log_scales = torch.log(torch.tensor([0.4, 0.05, 0.4])).expand(faces, 3)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(faces, 4)

    def draw(pose: HeadPose, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        frames = mesh.frames(mesh.posed(mesh.arguments([pose])))
        world = to_world(frames, torch.arange(faces), torch.zeros(faces, 3), log_scales, quats)
        rendering = rasterize(
            *(*world, torch.full((faces,), 0.95), colors),
            *(camera.world_to_camera, camera.K, camera.width, camera.height),
            background=np.ones(3),
        )
        image, mask = (
            np.round(each.clamp(0, 1).numpy() * 255).astype(np.uint8)
            for each in (rendering.image, rendering.alpha)
        )
        return image, mask

    return draw


def toy_clip(
    head: HeadArrays,
    *,
    timesteps: int = 3,
    cameras: int = 4,
    width: int = 40,
    height: int = 48,
    seed: int = 0,
    held_out: int = 1,
) -> ToyClip:
    """Render a clip: one opaque coloured splat per triangle. The last camera and ``held_out`` timesteps are held out."""
    rng = np.random.default_rng(seed)
    shape = rng.standard_normal(head.shape_basis.shape[2]) * 0.5
    offset = np.zeros_like(head.template)
    mesh = SubjectMesh(head, shape, offset, "cpu")
    draw = splat_pictures(mesh)
    rig = toy_cameras(cameras, width, height)
    names = list(rig)
    count = timesteps + held_out
    poses = {t: toy_pose(head, rng, t, "toy") for t in range(count)}
    background = np.ones(3)
    images, masks = {}, {}
    splits: dict[str, list[FrameKey]] = {"train": [], "novel_view": [], "self_reenactment": []}
    for t, pose in poses.items():
        for name, camera in rig.items():
            sequence = "TRAIN" if t < timesteps else "FREE"
            key = FrameKey("toy", sequence, t, name)
            images[key], masks[key] = draw(pose, camera)
            split = "self_reenactment" if t >= timesteps else "novel_view" if name == names[-1] else "train"
            splits[split].append(key)
    return ToyClip(
        head,
        shape,
        offset,
        rig,
        poses,
        {name: tuple(keys) for name, keys in splits.items()},
        images,
        masks,
        background,
    )


def first_view(clip, split: str = "train") -> tuple[Camera, HeadPose]:
    """Camera and pose of the first frame of a split."""
    key = clip.splits[split][0]
    return clip.cameras[key.camera], clip.poses[key.timestep]


def check_frame(frame, width: int, height: int) -> None:
    """A frame has its size, and finite colours and coverage from 0 to 1."""
    assert frame.rgb.shape == (height, width, 3)
    for values in (frame.rgb, frame.alpha):
        assert values.dtype == np.float32
        assert np.isfinite(values).all()
        assert values.min() >= 0
        assert values.max() <= 1

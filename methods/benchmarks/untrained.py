"""Untrained avatars of any size, with a capture in memory that shows them, for benchmarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from ...bench.contracts import ByteArray, Camera, FloatArray, FrameKey, HeadAsset, HeadPose, StepRecord
from ...datasets.head.procedural.model import procedural_head
from ...datasets.steps.clusters import jaw_quaternions
from ..ga.method import GAAvatar
from ..ours.avatar import OursAvatar
from ..ours.config import OursConfig
from ..ours.field import initial_parameters, line_box, plane_box
from ..ours.storage import StoredField
from ..shared.avatar_files import Subject
from ..shared.schedule import numpy_generator, torch_generator
from ..shared.subject_mesh import SubjectMesh

DISTANCE = 1.0  # metres, from the camera to the middle of the head
FILL = 0.8  # fraction of the image height covered by the head's mesh


@dataclass(frozen=True, eq=False)
class MemoryClip:
    """A `Clip` in memory, whose images are optional."""

    head: HeadAsset
    shape: FloatArray
    static_offset: FloatArray
    cameras: Mapping[str, Camera]
    poses: Mapping[int, HeadPose]
    splits: Mapping[str, tuple[FrameKey, ...]]
    images: Mapping[FrameKey, ByteArray] = field(default_factory=dict)
    background: FloatArray = field(default_factory=lambda: np.ones(3))
    subject: str = "untrained"
    fingerprint: str = ""
    excluded: Mapping[FrameKey, str] = field(default_factory=dict)
    steps: Sequence[StepRecord] = ()

    def image(self, key: FrameKey) -> ByteArray:
        """The picture of a frame."""
        return self.images[key]

    def mask(self, key: FrameKey) -> None:
        """None: there are no masks."""


def untrained(
    count: int, width: int, height: int, *, version: str = "2020", cameras: int = 4, timesteps: int = 8
) -> tuple[MemoryClip, OursAvatar]:
    """A capture without images of the procedural head, and an avatar of `ours` with ``count`` splats on it."""
    head = procedural_head(version)
    rig = {camera.id: camera for camera in cameras_around(head, cameras, width, height)}
    poses = {
        number: replace(pose, timestep=number, subject="untrained")
        for number, pose in enumerate(random_poses(head, timesteps))
    }
    keys = tuple(FrameKey("untrained", "EMO-1", timestep, camera) for timestep in poses for camera in rig)
    shape, offset = np.zeros(head.shape_basis.shape[2], np.float32), np.zeros(head.template.shape, np.float32)
    clip = MemoryClip(head, shape, offset, rig, poses, {"train": keys})
    return clip, untrained_avatar(head, count)


def with_images(clip: MemoryClip, avatar: OursAvatar) -> MemoryClip:
    """The capture with pictures of an avatar."""
    images = {
        key: np.rint(255 * avatar.render(clip.cameras[key.camera], clip.poses[key.timestep]).rgb)
        for key in clip.splits["train"]
    }
    return replace(clip, images={key: image.astype(np.uint8) for key, image in images.items()})


def untrained_avatar(head: HeadAsset, count: int) -> OursAvatar:
    """Splats spread over the triangles like trained ones: flat, and smaller if there are more."""
    config = OursConfig()
    subject = Subject(
        "untrained",
        head.version,
        np.zeros(head.shape_basis.shape[2], np.float32),
        np.zeros(head.template.shape, np.float32),
    )
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, "cpu")
    rng = torch_generator(0, "untrained")

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng)

    faces = len(head.faces)
    binding = torch.arange(count) * faces // max(count, 1)
    size = 0.4 * (faces / max(count, 1)) ** 0.5 * torch.exp(0.5 * normal(count, 1))
    table = torch.cat(
        [
            normal(count, 3) * torch.tensor([0.25, 0.02, 0.25]),
            0.4 + 1.8 * normal(count, 1),
            torch.cat([size, 0.2 * size, size], dim=1).log(),
            torch.tensor([1.0, 0, 0, 0]) + 0.2 * normal(count, 4),
            binding[:, None].float(),
        ],
        dim=1,
    )
    expressions = min(config.lines.expressions, head.expression_basis.shape[2])
    poses = random_poses(head, config.lines.jaw_bases, seed=1)
    tensors = {
        name: value for name, (value, _) in initial_parameters(config, expressions, len(poses), rng).items()
    }
    if "lines" in tensors:
        tensors["lines"] = 0.05 * normal(*tensors["lines"].shape)
    tensors |= {
        "splats": table,
        "plane_box": torch.stack(list(plane_box(mesh.canonical, config.planes.bounds_variant))),
        "line_box": torch.stack(list(line_box(mesh.canonical))),
        "jaw_bases": torch.from_numpy(jaw_quaternions(poses).astype(np.float32)),
    }
    return OursAvatar([], mesh, subject, StoredField(tensors, config.lines.dynamic), "cpu")


def random_poses(head: HeadAsset, count: int, *, seed: int = 0) -> list[HeadPose]:
    """Poses of moderate size, all different."""
    rng = numpy_generator(seed, "poses")
    return [
        HeadPose(
            head.version,
            expression=np.asarray(rng.normal(size=head.expression_basis.shape[2])),
            rotation=0.05 * np.asarray(rng.normal(size=3)),
            neck=0.05 * rng.normal(size=3),
            jaw=np.array([0.1, 0.0, 0.0]) * np.abs(rng.normal(size=1)),
            eyes=0.05 * rng.normal(size=6),
            translation=0.003 * rng.normal(size=3),
            eyelids=None if head.eyelid_basis is None else np.zeros(2),
        )
        for _ in range(count)
    ]


def cameras_around(head: HeadAsset, count: int, width: int, height: int) -> list[Camera]:
    """Cameras on an arc in front of the face, which looks along z with y up; the whole mesh is in view."""
    low, high = head.template.min(0), head.template.max(0)
    middle = 0.5 * (low + high)
    focal = FILL * height * DISTANCE / (high[1] - low[1])
    K = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])
    result = []
    for number, angle in enumerate(np.linspace(-0.6, 0.6, count)):
        forward = -np.array([np.sin(angle), 0.0, np.cos(angle)])
        right = np.cross(forward, [0.0, 1.0, 0.0])
        rotation = np.stack([right, np.cross(forward, right), forward])
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = -rotation @ (middle - DISTANCE * forward)
        result.append(Camera(f"{number:02d}", width, height, K, matrix))
    return result


def beside_ga(avatar: OursAvatar) -> GAAvatar:
    """An avatar of `ga` with the splats of one of `ours`, and harmonics of degree 3 at random."""
    splats = {name: getattr(avatar.neutral, name) for name in ("means", "log_scales", "quats")}
    harmonics = 0.2 * torch.randn(len(splats["means"]), 3, 16, generator=torch.Generator().manual_seed(0))
    splats |= {
        "opacities": avatar.neutral.logits,
        "sh_dc": harmonics[:, :, 0],
        "sh_rest": harmonics[:, :, 1:],
    }
    binding = avatar.field.tensors["splats"][:, -1].to(torch.int64)
    return GAAvatar([], avatar.mesh, avatar.subject, splats, binding, None, "cpu")

"""An avatar of ours that nobody trained: the procedural head with parameters at random, of any size."""

from __future__ import annotations

import numpy as np
import torch

from ....bench.contracts import Camera, HeadAsset, HeadPose
from ....datasets.steps.jaw_bases import jaw_quaternions
from ....methods.ours.avatar import OursAvatar
from ....methods.ours.config import OursConfig
from ....methods.ours.field import initial_parameters, line_box, plane_box
from ....methods.ours.storage import Field
from ....methods.shared.avatar_files import Subject
from ....methods.shared.schedule import numpy_generator, torch_generator
from ....methods.shared.subject_mesh import SubjectMesh

DISTANCE = 1.0  # metres, from the camera to the middle of the head
FILL = 0.8  # part of the image height that the head's mesh takes


def untrained_avatar(
    head: HeadAsset, count: int, config: OursConfig | None = None, *, seed: int = 0
) -> OursAvatar:
    """Splats spread over the triangles as training leaves them: flat, smaller the more there are."""
    config = config or OursConfig()
    subject = Subject(
        "untrained",
        head.version,
        np.zeros(head.shape_basis.shape[2], np.float32),
        np.zeros(head.template.shape, np.float32),
    )
    mesh = SubjectMesh(head, subject.shape, subject.static_offset, "cpu")
    rng = torch_generator(seed, "untrained")

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
    poses = random_poses(head, config.lines.jaw_bases, seed=seed + 1)
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
    return OursAvatar([], mesh, subject, Field(tensors, config.lines.dynamic), "cpu")


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

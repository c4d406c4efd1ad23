"""Rigid motion of the head against skinned vertices, and its move into the camera."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.bench.contracts import Camera, HeadPose
from headbench.datasets.head.model import (
    BATCH,
    HeadModel,
    PosedSubject,
    camera_in_head_frame,
    pose_in_head_frame,
)

from .toy import toy_head


@pytest.fixture(scope="module")
def head():
    return toy_head(16)


def make_poses(head, count, seed=0):
    rng = np.random.default_rng(seed)
    sizes = (head.expression_basis.shape[2], 3, 3, 3, 6, 3)
    scales = (1, 1, 1, 0.2, 0.1, 1)
    return [
        HeadPose("toy", *(scale * rng.normal(size=size) for size, scale in zip(sizes, scales)))
        for _ in range(count)
    ]


def test_motions_take_rigid_vertices_to_world_space(head):
    """By the whole model, for more poses than one batch holds; the neck's correctives are left out of it."""
    rng = np.random.default_rng(1)
    shape, offset = rng.normal(size=6), 0.002 * rng.normal(size=head.template.shape)
    poses = make_poses(head, BATCH + 3)
    motions = PosedSubject(head, shape, offset).motions(poses)
    assert motions.shape == (BATCH + 3, 4, 4)
    correctives = head.pose_basis.copy()
    correctives[:, :, :9] = 0
    model = HeadModel(replace(head, pose_basis=correctives), dtype=torch.float64)
    canonical = model.canonical(torch.tensor(shape), torch.tensor(offset))
    rigid = head.skinning_weights[:, 1] > 1 - 1e-9

    def vertices(poses):
        return model(canonical=canonical, **model.pose_arguments(poses)).numpy()[:, rigid]

    world = vertices(poses)
    still = [pose_in_head_frame(pose) for pose in poses]
    local = vertices(still)
    assert PosedSubject(head, shape, offset).motions(still[:1])[0] == pytest.approx(np.eye(4), abs=1e-15)
    carried = local @ motions[:, :3, :3].transpose(0, 2, 1) + motions[:, None, :3, 3]
    assert np.abs(carried - world).max() < 1e-12


def test_a_moved_camera_sees_the_head_frame_as_it_saw_the_world(head):
    motion = PosedSubject(head, np.zeros(6), np.zeros_like(head.template)).motions(make_poses(head, 1))[0]
    world_to_camera = np.eye(4)
    world_to_camera[:3, 3] = [0.1, -0.2, 1.5]
    camera = Camera("c", 10, 10, np.eye(3), world_to_camera)
    moved = camera_in_head_frame(camera, motion)
    point = np.array([0.03, 0.01, 0.08, 1.0])
    assert moved.world_to_camera @ point == pytest.approx(world_to_camera @ (motion @ point))
    assert (moved.id, moved.width) == ("c", 10)

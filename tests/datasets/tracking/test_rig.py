"""Points on a head model against the model itself, and their derivatives against automatic differentiation."""

import numpy as np
import pytest
import torch

from headbench.datasets.head.model import HeadModel
from headbench.datasets.tracking.rig import ANGLES, PointRig, PoseColumns

from ..head.toy import toy_head


def drawn(head, seed=3):
    rng = np.random.default_rng(seed)
    pose = 0.4 * rng.standard_normal(PoseColumns.of(head).size)
    return rng, pose, rng.standard_normal(head.shape_basis.shape[2])


def vertices_of(head, pose, shape):
    """Vertices by the head model, differentiable."""
    columns = PoseColumns.of(head)
    lids = columns.size - columns.eyelid_size
    parts = {"expression": pose[ANGLES + 3 : lids], "rotation": pose[:3], "neck": pose[3:6], "jaw": pose[6:9]}
    parts |= {"eyes": pose[9:15], "translation": pose[15:18]}
    parts |= {"eyelids": pose[lids:]} if columns.eyelid_size else {}
    return HeadModel(head, dtype=torch.float64)(shape=shape, **parts)[0]


@pytest.mark.parametrize("eyelids", [False, True])
def test_derivatives_are_those_of_the_head_model(eyelids):
    head = toy_head(16, eyelids=eyelids)
    rng, pose, shape = drawn(head)
    vertices = rng.choice(len(head.template), 40, replace=False)
    found = PointRig.at_vertices(head, vertices, np.float64).linearised(shape, pose)
    given = torch.tensor(pose), torch.tensor(shape)
    chosen = torch.tensor(vertices)
    by_pose, by_shape = torch.autograd.functional.jacobian(
        lambda p, s: vertices_of(head, p, s)[chosen], given
    )
    np.testing.assert_allclose(found.points, vertices_of(head, *given)[chosen], atol=1e-12)
    np.testing.assert_allclose(found.by_pose, by_pose, atol=1e-12)
    np.testing.assert_allclose(found.by_shape, by_shape, atol=1e-12)


def test_points_without_derivatives_are_the_same():
    head = toy_head(16, eyelids=True)
    _, pose, shape = drawn(head)
    rig = PointRig.at_vertices(head, np.arange(30))
    np.testing.assert_allclose(rig.points(shape, pose), rig.linearised(shape, pose).points, atol=1e-6)


def test_poses_keep_the_columns():
    head = toy_head(16, eyelids=True)
    _, pose, shape = drawn(head)
    (made,) = PoseColumns.of(head).poses(pose[None], head, "someone", [7])
    wanted = vertices_of(head, torch.tensor(pose), torch.tensor(shape))
    np.testing.assert_allclose(head(made, shape), wanted, atol=1e-6)
    assert (made.timestep, made.subject) == (7, "someone")
    np.testing.assert_allclose(PoseColumns.of(head).rows([made])[0], pose, atol=1e-6)

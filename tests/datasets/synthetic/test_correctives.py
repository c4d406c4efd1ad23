"""Shapes that the tracked basis lacks: of the amount stated, smooth, and in pictures alone."""

import numpy as np
import pytest

from headbench.datasets.head.arrays import region
from headbench.datasets.synthetic.subject import (
    DRIVERS,
    FACE_MM,
    RenderedSubject,
    displacement,
    make_correctives,
)

from .conftest import settled

SMILE = {"smile_left": 1.0, "smile_right": 1.0, "jaw_open": 0.6, "cheek_raise_left": 0.8}


@pytest.fixture(scope="module")
def shapes(plan, subject):
    head = plan.geometry.head
    return make_correctives(plan.person, subject.anatomy, head, subject.neutral, plan.geometry.translation)


def test_each_displaces_the_face_by_the_amount_stated(plan, subject, shapes, rest):
    face = np.intersect1d(region(plan.geometry.head, "face"), subject.anatomy.skin_faces)
    for first, second in DRIVERS:
        alone = [displacement(shapes, level, {**rest, first: 1.0, second: 1.0})[face] for level in (1.0, 2.0)]
        once, twice = (1e3 * np.sqrt((each**2).sum(1).mean()) for each in alone)
        assert 0.9 * FACE_MM < once < 1.5 * FACE_MM, (first, second)  # a square may act beside a product
        assert twice == pytest.approx(2.0 * once, rel=1e-3)


def test_joints_eyes_and_the_tracked_mesh_stay(plan, subject, shapes, rest):
    np.testing.assert_allclose(plan.geometry.head.joint_regressor @ shapes[0], 0.0, atol=1e-8)
    other = RenderedSubject(plan.person, plan.geometry, plan.shape, correctives=1.0)
    smiling = {**rest, **SMILE, "head_turn": 0.2}
    pose = plan.geometry.translation.pose(smiling, "900", 0)
    np.testing.assert_array_equal(other.tracked(pose), subject.tracked(pose))
    state = settled(smiling, plan.person)
    with_, without = (each.posed_meshes(pose, smiling, state) for each in (other, subject))
    for name in ("eye_left", "eye_right", "hair", "tongue"):
        np.testing.assert_array_equal(with_[name].vertices, without[name].vertices)
    # Skin moves as far as the shape says, whose vectors turn with the head.
    fine = subject._fine
    expected = np.linalg.norm(fine.interpolate(displacement(shapes, 1.0, smiling)), axis=1)
    found = np.linalg.norm(with_["skin"].vertices - without["skin"].vertices, axis=1)
    assert np.corrcoef(expected, found)[0, 1] > 0.95
    assert found.max() > 1e-3

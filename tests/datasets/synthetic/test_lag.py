"""Hair and neck follow the head late; all else is where it was."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from headbench.datasets.synthetic.history import (
    HAIR_DAMPING,
    NECK_DAMPING,
    NECK_FREQUENCY,
    follow,
    hair_frequency,
)
from headbench.datasets.synthetic.performance import CONTROLS, Performed
from headbench.datasets.synthetic.subject import LatePoses

from .conftest import settled

STEP, LENGTH = 1.0, 0.18


def turning(turn):
    """A performance that only turns the head, by ``turn`` of time."""

    def curves(time):
        values = {name: np.zeros(len(time)) for name in CONTROLS}
        return {**values, "head_turn": turn(time), "jaw_open": 0.2 + 0.0 * time}

    return Performed("FREE", (), {}, 1.0, np.zeros(1), curves)


stepping = turning(lambda time: np.where(time < STEP, 0.0, 0.25))


@pytest.mark.parametrize("part", ["hair", "neck"])
def test_a_turn_is_followed_as_the_equation_says(part):
    """Against a numerical solution of the damped spring."""
    frequency, damping = {
        "hair": (hair_frequency(LENGTH), HAIR_DAMPING),
        "neck": (NECK_FREQUENCY, NECK_DAMPING),
    }[part]
    speed = 2.0 * np.pi * frequency
    after = np.array([0.03, 0.1, 0.2, 0.3, 0.5, 1.0])
    solved = solve_ivp(
        lambda _, y: (y[1], speed**2 * (0.25 - y[0]) - 2.0 * damping * speed * y[1]),
        *((0.0, 1.0), (0.0, 0.0)),
        t_eval=after,
        rtol=1e-8,
    )
    found = [getattr(follow(stepping, STEP + t, 1.0, LENGTH), part)["head_turn"] for t in after]
    fastest = 0.25 * speed / 73.0  # a sample of the past is half of this off at most
    np.testing.assert_allclose(found, solved.y[0], atol=0.5 * fastest)
    assert max(found) > 0.25  # it swings over


def test_a_still_head_is_not_left(rest):
    still = turning(lambda time: np.full(len(time), 0.125))
    lagging = follow(still, 3.0, 1.0, LENGTH)
    for late in (lagging.hair, lagging.neck):
        assert late == {**rest, "head_turn": 0.125, "jaw_open": 0.2}


def test_hair_and_neck_move_and_nothing_else(plan, subject, rest):
    pose = plan.geometry.translation.pose
    state = settled(rest, plan.person)
    now = pose({**rest, "head_turn": 0.2}, "900", 0)
    behind = pose({**rest, "head_turn": 0.1}, "900", 0)
    before = subject.posed_meshes(now, rest, state)
    after = subject.posed_meshes(now, rest, state, LatePoses(behind, behind))
    moved = {
        name: np.linalg.norm(mesh.vertices - before[name].vertices, axis=1) for name, mesh in after.items()
    }
    assert moved["hair"].max() > 1e-4
    neck, fine = plan.geometry.head.regions["neck"], subject._fine
    touching = subject.anatomy.skin_faces[np.isin(subject.anatomy.skin_faces, neck).any(1)]
    face = np.setdiff1d(plan.geometry.head.regions["face"], touching)  # their normals turn with the neck
    assert (
        moved["skin"][np.isin(fine.parents, face).all(1)].max() < 1e-4
    )  # whose own turn the fine ones beside them
    assert 1e-4 < moved["skin"].max() < 0.3 * 0.1 * 0.2  # 0.3 of a turn of 0.1 within 20 cm
    for name in moved.keys() - {"hair", "skin", "beard"}:
        assert moved[name].max() == 0.0, name

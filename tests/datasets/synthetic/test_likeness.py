"""The dressed head against its tracked mesh."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from headbench.datasets.synthetic.likeness import Likeness
from headbench.datasets.synthetic.performance import CONTROLS, EXPRESSION_CONTROLS
from headbench.datasets.synthetic.skin import make_folds


def test_tracked_vertices_lie_on_the_skin_that_is_rendered(take, likeness, rest):
    """With hair and folds taken off, the rendered skin passes through every tracked skin vertex."""
    pose = take.geometry.translation.pose(
        {**rest, "jaw_open": 0.6, "smile_left": 0.5, "head_turn": 0.2}, "900", 0
    )
    tracked = likeness.tracked(pose)
    fine = likeness._fine
    corners = fine.weights.max(1) == 1.0
    own = np.take_along_axis(fine.parents, fine.weights.argmax(1)[:, None], 1)[:, 0]
    np.testing.assert_allclose(fine.positions(tracked)[corners], tracked[own[corners]], atol=1e-12)
    assert set(own[corners]) == set(np.unique(likeness.anatomy.skin_faces))


def test_eyeballs_follow_the_tracked_ones(take, likeness, rest):
    pose = take.geometry.translation.pose(
        {**rest, "gaze_left": 1.0, "head_nod": 0.2, "sway_x": 0.01}, "900", 0
    )
    tracked, surfaces = likeness.tracked(pose), likeness.surfaces(pose, rest)
    for side in ("left", "right"):
        region = take.geometry.head.regions[f"{side}_eyeball"]
        before, after = likeness.neutral[region], tracked[region]
        # Independent rigid fit (Kabsch) of the tracked ball.
        u, _, vt = np.linalg.svd((before - before.mean(0)).T @ (after - after.mean(0)))
        turn = vt.T @ np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
        rest_mesh = likeness._eyes[side].vertices
        expected = (rest_mesh - before.mean(0)) @ turn.T + after.mean(0)
        np.testing.assert_allclose(surfaces[f"eye_{side}"].vertices, expected, atol=2e-4)


@pytest.mark.parametrize(
    ("face", "place"),
    [
        ({"brow_inner_up": 1.0, "brow_outer_up_left": 1.0, "brow_outer_up_right": 1.0}, "forehead"),
        ({"brow_down_left": 1.0, "brow_down_right": 1.0}, "glabella"),
        ({"smile_left": 1.0, "smile_right": 1.0}, "left_cheek"),
        ({"nose_sneer_left": 1.0, "nose_sneer_right": 1.0}, "nose_tip"),
        ({"pucker": 1.0}, "mouth"),
    ],
)
def test_expressions_change_skin_beyond_the_tracked_mesh(take, likeness, rest, face, place):
    """Same tracked mesh, different activations: colour changes by several 8-bit levels, and skin is displaced."""
    pose = take.geometry.translation.pose(rest, "900", 0)
    calm, moved = likeness.surfaces(pose, rest)["skin"], likeness.surfaces(pose, {**rest, **face})["skin"]
    near = np.linalg.norm(likeness._rest_points - likeness.anatomy[place], axis=1) < 0.022

    def display(linear):
        return 255 * np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)

    change = np.abs(display(moved.albedo[near]) - display(calm.albedo[near])).max(1)
    assert np.percentile(change, 90) > 4
    far = np.linalg.norm(likeness._rest_points - likeness.anatomy["vertex_top"], axis=1) < 0.05
    np.testing.assert_allclose(moved.albedo[far], calm.albedo[far], atol=1e-4)
    if place != "nose_tip":
        lift = np.linalg.norm(moved.vertices[near] - calm.vertices[near], axis=1)
        assert 0.0002 < lift.max() < 0.005


def test_folds_grow_continuously_with_activation(take, likeness, rest):
    pose = take.geometry.translation.pose(rest, "900", 0)
    heights = [
        likeness.surfaces(pose, {**rest, "brow_inner_up": a})["skin"].vertices for a in (0.0, 0.5, 0.55, 1.0)
    ]
    step = [np.abs(b - a).max() for a, b in itertools.pairwise(heights)]
    assert step[1] < 0.3 * min(step[0], step[2])


def test_poses_are_what_is_stored(take):
    for poses in take.poses.values():
        for pose in poses:
            for values in (pose.expression, pose.jaw, pose.neck, pose.rotation, pose.eyes, pose.translation):
                np.testing.assert_array_equal(values, values.astype(np.float32))


def test_other_person_looks_different_on_the_same_head(take, likeness):
    other = Likeness(
        replace(take.person, seed=take.person.seed + 1, skin=0.5 * take.person.skin),
        take.geometry,
        take.shape,
    )
    assert other.fixtures()["skin"].albedo.mean() < 0.75 * likeness.fixtures()["skin"].albedo.mean()


def test_controls_are_complete_and_distinct():
    assert len(set(CONTROLS)) == len(CONTROLS)
    assert set(EXPRESSION_CONTROLS) < set(CONTROLS)


def test_dynamics_scale_what_expressions_do_to_skin_beyond_moving_it(take, likeness, rest):
    """Folds and logarithms of colour factors are proportional to it; at 0 skin stays as it is."""
    points = likeness._rest_points[::50]
    lips = np.linspace(0.0, 1.0, len(points))

    def change(factor):
        person = replace(take.person, dynamics=factor)
        folds = make_folds(person, likeness.anatomy, points, lips, np.ones(len(points)))
        lift, albedo = folds.apply({**rest, "brow_inner_up": 0.4}, np.full((len(points), 3), 0.1))
        return lift, np.log(albedo / 0.1)

    still, once, twice = change(0.0), change(1.0), change(2.0)
    assert all(np.abs(part).max() < 1e-12 for part in still)
    np.testing.assert_allclose(twice[0], 2 * once[0], atol=1e-15)
    flushed = (once[1] > 0.02).all(1)  # paler: blood alone, no shade of folds
    assert flushed.sum() > 20
    np.testing.assert_allclose(twice[1][flushed], 2 * once[1][flushed], rtol=0.01)

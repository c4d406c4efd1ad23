"""The dressed head against its tracked mesh."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.datasets.synthetic.history import SkinState, coupled_strengths
from headbench.datasets.synthetic.skin import flush_strengths, make_folds

from .conftest import settled


def test_eyeballs_follow_the_tracked_ones(plan, subject, rest):
    pose = plan.geometry.translation.pose(
        {**rest, "gaze_left": 1.0, "head_nod": 0.2, "sway_x": 0.01}, "900", 0
    )
    tracked, posed_meshes = (
        subject.tracked(pose),
        subject.posed_meshes(pose, rest, settled(rest, plan.person)),
    )
    for side in ("left", "right"):
        region = plan.geometry.head.regions[f"{side}_eyeball"]
        before, after = subject.neutral[region], tracked[region]
        # Independent rigid fit (Kabsch) of the tracked ball.
        u, _, vt = np.linalg.svd((before - before.mean(0)).T @ (after - after.mean(0)))
        turn = vt.T @ np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
        rest_mesh = subject._eyes[side].vertices
        expected = (rest_mesh - before.mean(0)) @ turn.T + after.mean(0)
        np.testing.assert_allclose(posed_meshes[f"eye_{side}"].vertices, expected, atol=2e-4)


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
def test_expressions_change_skin_beyond_the_tracked_mesh(plan, subject, rest, face, place):
    """Same tracked mesh, different activations: colour changes by several 8-bit levels, and skin is displaced."""
    pose = plan.geometry.translation.pose(rest, "900", 0)
    young = replace(plan.person, lines_at_rest=0.0)
    calm, moved = (
        subject.posed_meshes(pose, rest, settled(controls, young))["skin"]
        for controls in (rest, {**rest, **face})
    )
    near = np.linalg.norm(subject._rest_points - subject.anatomy[place], axis=1) < 0.022

    def display(linear):
        return 255 * np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)

    change = np.abs(display(moved.albedo[near]) - display(calm.albedo[near])).max(1)
    assert np.percentile(change, 90) > 4
    far = np.linalg.norm(subject._rest_points - subject.anatomy["vertex_top"], axis=1) < 0.05
    np.testing.assert_allclose(moved.albedo[far], calm.albedo[far], atol=1e-4)
    if place != "nose_tip":
        lift = np.linalg.norm(moved.vertices[near] - calm.vertices[near], axis=1)
        assert 0.0002 < lift.max() < 0.005


def test_dynamics_scale_folds_and_colour_changes(plan, subject, rest):
    """Folds and logarithms of colour factors are proportional to it; at 0 skin stays as it is."""
    points = subject._rest_points[::50]
    lips = np.linspace(0.0, 1.0, len(points))
    raised = {**rest, "brow_inner_up": 0.4}
    state = SkinState(coupled_strengths(raised), flush_strengths(raised))

    def change(factor):
        person = replace(plan.person, dynamics=factor)
        folds = make_folds(person, subject.anatomy, points, lips, np.ones(len(points)))
        lift, albedo = folds.apply(state.folds, state.flushes, np.full((len(points), 3), 0.1))
        return lift, np.log(albedo / 0.1)

    still, once, twice = change(0.0), change(1.0), change(2.0)
    assert all(np.abs(part).max() < 1e-12 for part in still)
    np.testing.assert_allclose(twice[0], 2 * once[0], atol=1e-15)
    flushed = (once[1] > 0.02).all(1)  # paler: blood alone, no shade of folds
    assert flushed.sum() > 20
    np.testing.assert_allclose(twice[1][flushed], 2 * once[1][flushed], rtol=0.01)

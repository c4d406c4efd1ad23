"""Motion carried over, against scipy's rotations and against what it means."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import HeadPose
from headbench.bench.errors import InputError
from headbench.reports.robustness.reenactment import RigidMean, check_heads, retarget


def poses(seed, count=5, spread=0.3, timestep=0):
    rng = np.random.default_rng(seed)
    base = rng.normal(size=3)

    def turn():
        return (Rotation.from_rotvec(base) * Rotation.from_rotvec(spread * rng.normal(size=3))).as_rotvec()

    return [
        HeadPose(
            "m",
            rng.normal(size=4),
            turn(),
            spread * rng.normal(size=3),
            rng.normal(size=3),
            rng.normal(size=6),
            base + 0.01 * rng.normal(size=3),
            rng.normal(size=2),
            "source",
            timestep + t,
        )
        for t in range(count)
    ]


def same_turn(a, b):
    return np.allclose(Rotation.from_rotvec(a).as_matrix(), Rotation.from_rotvec(b).as_matrix(), atol=1e-6)


def test_the_mean_is_that_of_scipy():
    many = poses(1, 20)
    mean = RigidMean.of(many)
    assert np.allclose(mean.rotation, Rotation.from_rotvec([p.rotation for p in many]).mean().as_matrix())
    assert np.allclose(mean.neck, Rotation.from_rotvec([p.neck for p in many]).mean().as_matrix())
    assert np.allclose(mean.translation, np.mean([p.translation for p in many], axis=0))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000))
def test_a_subject_driven_by_itself_is_unchanged(seed):
    many = poses(seed)
    mean = RigidMean.of(many)
    for pose in many:
        driven = retarget(pose, mean, mean, "target")
        assert same_turn(driven.rotation, pose.rotation)
        assert same_turn(driven.neck, pose.neck)
        assert np.allclose(driven.translation, pose.translation)


def test_the_mean_of_the_source_becomes_the_mean_of_the_target():
    source, target = RigidMean.of(poses(1)), RigidMean.of(poses(2))
    vectors = [Rotation.from_matrix(m).as_rotvec() for m in (source.rotation, source.neck)]
    rest = HeadPose(
        "m", np.zeros(4), vectors[0], vectors[1], np.zeros(3), np.zeros(6), source.translation, None
    )
    driven = retarget(rest, source, target, "target")
    assert same_turn(driven.rotation, Rotation.from_matrix(target.rotation).as_rotvec())
    assert same_turn(driven.neck, Rotation.from_matrix(target.neck).as_rotvec())
    assert np.allclose(driven.translation, target.translation)


def test_how_the_source_capture_is_turned_does_not_matter():
    world, shift = Rotation.from_rotvec([0.4, -1.0, 2.0]), np.array([5.0, 1, -3])
    many, target = poses(3), RigidMean.of(poses(4))
    turned = [
        HeadPose(
            p.head_model,
            p.expression,
            (world * Rotation.from_rotvec(p.rotation)).as_rotvec(),
            p.neck,
            p.jaw,
            p.eyes,
            world.apply(p.translation) + shift,
            p.eyelids,
        )
        for p in many
    ]
    for a, b in zip(many, turned):
        one, other = (retarget(p, RigidMean.of(group), target, "t") for p, group in ((a, many), (b, turned)))
        assert same_turn(one.rotation, other.rotation)
        assert np.allclose(one.translation, other.translation)


def test_expression_jaw_eyes_and_eyelids_are_kept_and_no_timestep_is_claimed():
    pose, mean = poses(5)[0], RigidMean.of(poses(6))
    driven = retarget(pose, RigidMean.of(poses(5)), mean, "target")
    for name in ("expression", "jaw", "eyes", "eyelids"):
        assert getattr(driven, name) is getattr(pose, name)
    assert (driven.subject, driven.timestep) == ("target", None)


@pytest.mark.parametrize(("version", "count"), [("other", 4), ("m", 5)])
def test_coefficients_of_another_head_model_are_refused_with_the_way_out(version, count):
    def head(version, count):
        return SimpleNamespace(version=version, expression_basis=np.zeros((2, 3, count)))

    check_heads(head("m", 4), head("m", 4), "source s")
    with pytest.raises(InputError, match="headbench refit"):
        check_heads(head(version, count), head("m", 4), "source s")

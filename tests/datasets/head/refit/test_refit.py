"""The whole refit: floors where a solution exists, what stays, what is refused, and that it continues."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.head.refit import refit as block
from headbench.datasets.head.refit.refit import BLOCK, refit
from headbench.datasets.head.refit.settings import RefitSettings
from headbench.datasets.head.teeth import with_teeth

from ..toy import toy_head
from .heads import performance, subdivided

EXACT_MEAN_MM, EXACT_P95_MM = 0.15, 0.40  # residuals allowed where the target's own model made the meshes

TARGET = toy_head(24, eyelids=True, version="target")
SOURCE = replace(TARGET, version="source")  # so that a refit has an exact solution


@pytest.fixture(scope="module")
def exact():
    source = replace(procedural_head("2020"), version="source")
    return performance(source, 24), procedural_head("2020")


def test_an_exact_solution_is_found(exact):
    clip, target = exact
    refitted = refit(clip, target)
    summary = refitted.report.summary()
    assert summary["mean_mm"] < EXACT_MEAN_MM / 10
    assert summary["p95_mm"] < EXACT_P95_MM / 10
    face = target.regions["face"]
    meshes = [
        PosedSubject.of(c).meshes([c.poses[t] for t in sorted(clip.poses)]) for c in (refitted.clip, clip)
    ]
    gaps = 1e3 * np.linalg.norm(meshes[0] - meshes[1], axis=2)[:, face]
    np.testing.assert_allclose([f.mean_mm for f in refitted.report.frames], gaps.mean(axis=1))
    np.testing.assert_allclose([f.p95_mm for f in refitted.report.frames], np.percentile(gaps, 95, axis=1))
    assert np.nanmean(refitted.report.vertex_mm[face]) == pytest.approx(gaps.mean())


def test_another_basis_is_fitted_and_the_step_recorded():
    clip = performance(procedural_head("2023"), 12)
    target = procedural_head("2020")
    derived = refit(clip, target).clip
    step = derived.steps[-1]
    assert (step.name, step.input_fingerprint) == ("refit_head", clip.fingerprint)
    assert step.parameters["target_fingerprint"] == target.fingerprint()
    assert step.parameters["residual"]["mean_mm"] < 0.15
    assert derived.fingerprint != clip.fingerprint
    assert {pose.head_model for pose in derived.poses.values()} == {target.version}
    assert {pose.timestep for pose in derived.poses.values()} == set(clip.poses)
    assert derived.splits == clip.splits
    blinking = np.array([pose.eyelids for pose in derived.poses.values()])
    assert np.ptp(blinking, axis=0).min() > 0.1  # 2023 blinks by its expression, 2020 by eyelids


@pytest.mark.parametrize("neck", ["fold", "keep"])
def test_the_rigid_motion_of_the_head_stays(neck):
    clip = performance(SOURCE, 6)
    derived = refit(clip, TARGET, RefitSettings(neck=neck)).clip
    before, after = (PosedSubject.of(c).motions([c.poses[t] for t in range(6)]) for c in (clip, derived))
    np.testing.assert_allclose(after, before, atol=1e-12)
    turned = np.abs([pose.neck for pose in derived.poses.values()]).max()
    assert turned == (0 if neck == "fold" else np.abs([p.neck for p in clip.poses.values()]).max())


def test_a_residual_offset_makes_the_neutral_head_exact():
    clip = performance(procedural_head("2023"), 2)
    bumpy = replace(
        clip, static_offset=0.002 * np.random.default_rng(0).normal(size=clip.head.template.shape)
    )
    target = procedural_head("2020")
    without, kept = (
        refit(bumpy, target, RefitSettings(static_offset=choice)) for choice in ("zero", "residual")
    )
    assert not without.clip.static_offset.any()
    assert without.report.neutral_mm > 1.0
    assert kept.report.neutral_mm < 1e-4


def test_teeth_are_given_to_the_target_where_the_source_has_them():
    clip = performance(with_teeth(SOURCE), 2)
    derived = refit(clip, TARGET).clip
    assert len(derived.head.template) == len(clip.head.template)
    assert derived.steps[-1].parameters["residual"]["mean_mm"] < 0.1


@pytest.mark.slow
def test_another_topology_is_refitted(exact):
    """The same model on a finer mesh in another order; only correspondence is in the way of an exact solution."""
    _, target = exact
    clip = performance(subdivided(target), 6, strength=0.7)
    refitted = refit(clip, target)
    assert refitted.clip.head is target
    assert refitted.report.summary()["mean_mm"] < 2 * EXACT_MEAN_MM
    with pytest.raises(InputError, match="static offset"):
        refit(clip, target, RefitSettings(static_offset="residual"))


def test_a_target_out_of_reach_ends_at_bounds_that_are_reported():
    clip = performance(SOURCE, 3, strength=30.0)
    report = refit(clip, TARGET, RefitSettings(coefficient_bound=3.0, jaw_bound=0.1)).report
    bounded = {name for frame in report.frames for name in frame.at_bound}
    assert any(name.startswith("expression[") for name in bounded)
    assert "jaw[0]" in bounded
    assert all(np.isfinite(frame.mean_mm) for frame in report.frames)
    assert report.summary()["timesteps_at_bound"] == 3


@pytest.mark.parametrize("field", ["expression", "rotation", "neck", "jaw", "eyes", "translation", "eyelids"])
def test_tracking_that_cannot_be_fitted_is_refused(field):
    clip = performance(SOURCE, 3)
    values = getattr(clip.poses[1], field).copy()
    values[0] = np.nan
    broken = {**clip.poses, 1: replace(clip.poses[1], **{field: values})}
    for change, key in (
        ({"poses": broken}, f"{field}, timestep 1"),
        ({"poses": {}}, "timestep"),
        ({"shape": np.full(6, np.inf)}, "shape"),
    ):
        with pytest.raises(InputError, match=key):
            refit(replace(clip, **change), TARGET)


def test_a_second_call_continues_at_the_first_missing_block(tmp_path, monkeypatch):
    clip = performance(SOURCE, 2 * BLOCK + 5)
    told: list[object] = []
    whole = refit(clip, TARGET, folder=tmp_path, progress=lambda *a: told.append(a[:2])).clip
    assert (told[0], told[-1]) == ((0, len(clip.poses)), (len(clip.poses), len(clip.poses)))
    assert len(list(tmp_path.iterdir())) == 3
    (tmp_path / "refit-00001.npz").unlink()
    solved: list[object] = []
    solve = block.solve_frame

    def counted(problem, frame, *rest):
        solved.append(frame)
        return solve(problem, frame, *rest)

    monkeypatch.setattr(block, "solve_frame", counted)
    again = refit(clip, TARGET, folder=tmp_path).clip
    assert len(solved) == BLOCK
    for t, pose in whole.poses.items():
        np.testing.assert_array_equal(again.poses[t].expression, pose.expression)
        np.testing.assert_array_equal(again.poses[t].translation, pose.translation)
    assert again.fingerprint == whole.fingerprint


def test_blocks_of_other_input_are_not_taken(tmp_path):
    clip = performance(SOURCE, 4)
    refit(clip, TARGET, folder=tmp_path)
    other = {t: replace(pose, jaw=pose.jaw * 0.5) for t, pose in clip.poses.items()}
    again = refit(replace(clip, poses=other), TARGET, folder=tmp_path).clip
    fresh = refit(replace(clip, poses=other), TARGET).clip
    np.testing.assert_array_equal(again.poses[2].jaw, fresh.poses[2].jaw)

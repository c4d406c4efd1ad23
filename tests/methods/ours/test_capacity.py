"""Capacity plans of toy clips: what is not there costs nothing, and what is planned trains."""

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.engine.guard import TrainingView
from headbench.bench.engine.stored import TRAINING_FILE
from headbench.methods.ours.capacity import plan_capacity
from headbench.methods.ours.config import Lines, OursConfig, Penalty, PlannedCapacity
from headbench.methods.ours.method import Ours
from headbench.methods.shared.avatar_files import clip_mesh
from headbench.methods.shared.config import SplatTraining

from .toy import changed

SMALL = OursConfig(
    splats=SplatTraining(max_splats=2000, min_densify_every=40, min_settle=20),
    hidden=16,
    lines=Lines(resolution=8, channels=4, bounds="head"),
    penalty=Penalty(face_mm=0.1, other_mm=0.2),
    capacity=PlannedCapacity(mode="auto"),
)
MEGAPIXEL = 40
"""Enlarges the toy's cameras so that its millimetres are pixels."""


def plan(clip, config=SMALL):
    return plan_capacity(clip, clip_mesh(clip, "cpu"), config)


def chosen(clip, config=SMALL):
    return {each.name: each.chosen for each in plan(clip, config).decisions}


def with_poses(clip, change):
    return replace(clip, poses={t: replace(pose, **change(pose)) for t, pose in clip.poses.items()})


def enlarged(clip, factor):
    cameras = {name: c.resized(factor * c.width, factor * c.height) for name, c in clip.cameras.items()}
    return replace(clip, cameras=cameras)


@pytest.fixture(scope="module")
def sharp(clip):
    return enlarged(clip, MEGAPIXEL)


def still(pose):
    return {"expression": 0 * pose.expression, "jaw": np.zeros(3), "eyes": np.zeros(6)}


def test_all_of_an_expressive_sharp_clip_is_modelled(sharp):
    sizes = chosen(sharp)
    assert sizes["lines.expressions"] == sharp.head.expression_basis.shape[2]
    assert sizes["lines.jaw_bases"] == 2
    assert sizes["planes.resolution"] == SMALL.planes.resolution
    assert sizes["splats.max_splats"] == SMALL.splats.max_splats
    assert plan(sharp).lines


def leading(pose):
    return {"expression": np.where(np.arange(len(pose.expression)) < 3, pose.expression, 0.4)}


@pytest.mark.parametrize(
    ("change", "expressions", "jaw_bases"),
    [
        (still, 0, 0),
        (lambda pose: {"jaw": np.zeros(3)}, None, 0),
        (lambda pose: {"expression": 0 * pose.expression}, 0, 2),
        (leading, 3, 2),
    ],
    ids=["still", "jaw still", "jaw alone", "three directions"],
)
def test_only_what_moves_is_modelled(sharp, change, expressions, jaw_bases):
    found = plan(with_poses(sharp, change))
    sizes = {each.name: each.chosen for each in found.decisions}
    assert sizes["lines.jaw_bases"] == jaw_bases
    assert sizes["lines.expressions"] == expressions or (
        expressions is None and sizes["lines.expressions"] > 0
    )
    assert found.lines == found.apply(SMALL).lines.enabled == (expressions != 0 or jaw_bases > 0)
    assert found.lines or found.lines_within is None


def test_lines_reach_no_further_than_what_moves(sharp):
    found = plan(sharp)
    low, high = map(np.array, found.lines_within)
    canonical = clip_mesh(sharp, "cpu").canonical.numpy()
    assert (low >= canonical.min(0) - 1e-7).all()
    assert (high <= canonical.max(0) + 1e-7).all()
    strict = plan(sharp, changed(SMALL, penalty={"face_mm": 6.0, "other_mm": 6.0}))
    smaller = np.prod(np.subtract(*strict.lines_within[::-1]))
    assert 0 < smaller < np.prod(high - low)


def test_doubling_the_images_raises_planes_and_splats(clip):
    config = changed(SMALL, splats=SplatTraining(), planes={"resolution": 1000})
    once, twice = (chosen(enlarged(clip, factor), config) for factor in (4, 8))
    assert once["planes.resolution"] < twice["planes.resolution"] <= 2 * once["planes.resolution"]
    assert once["splats.max_splats"] <= twice["splats.max_splats"]
    assert chosen(clip)["planes.resolution"] < 40


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(0.05, 50), st.floats(1, 10))
def test_more_tolerance_never_asks_for_more(sharp, tolerance, factor):
    fine, coarse = (chosen(sharp, changed(SMALL, capacity={"tolerance": tolerance * f})) for f in (1, factor))
    for name in ("lines.expressions", "lines.jaw_bases", "planes.resolution", "splats.max_splats"):
        assert coarse[name] <= fine[name]


def test_configured_sizes_are_limits_and_can_be_kept(sharp, clip):
    config = changed(SMALL, lines={"expressions": 2, "jaw_bases": 1}, planes={"resolution": 9})
    sizes = chosen(sharp, config)
    names = ("lines.expressions", "lines.jaw_bases", "planes.resolution")
    assert [sizes[name] for name in names] == [2, 1, 9]
    kept = changed(SMALL, capacity={"keep": ("lines.expressions", "planes.resolution", "lines.bounds")})
    found = plan(with_poses(clip, still), kept)
    resolved = found.apply(kept)
    assert (resolved.lines.expressions, resolved.planes.resolution) == (80, 128)
    assert resolved.lines
    assert found.lines_within is None


def test_held_out_poses_decide_nothing(clip):
    def other(t, pose):
        if t not in {key.timestep for key in clip.splits["self_reenactment"]}:
            return pose
        return replace(pose, expression=50 * pose.expression, jaw=-3 * pose.jaw)

    poses = {t: other(t, pose) for t, pose in clip.poses.items()}
    changed_elsewhere = replace(clip, poses=poses)
    assert plan(TrainingView(changed_elsewhere)) == plan(clip)


@pytest.mark.parametrize("change", ["expressive", "still"])
def test_a_planned_avatar_trains_renders_and_keeps_its_plan(clip, tmp_path, caplog, change):
    if change == "still":
        clip = with_poses(clip, still)
    config = changed(SMALL, capacity={"tolerance": 0.02})
    options = {"device": "cpu", "seed": 0, "progress": no_progress}
    with caplog.at_level(logging.INFO, "headbench"):
        avatar = Ours(config).fit(clip, tmp_path, Budget(iterations=30), **options)
    key = clip.splits["train"][0]
    image = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep]).rgb
    truth = clip.image(key) / 255
    assert np.abs(image - truth).mean() < np.abs(1 - truth).mean()
    (line,) = (text for text in caplog.messages if "capacity" in text)
    assert "planes.resolution" in line
    assert "\n" not in line
    assert len(line) < 400
    record = json.loads((tmp_path / TRAINING_FILE).read_text())["capacity"]
    assert record["lines"] == (change == "expressive")
    planned = {each["name"]: each for each in record["decisions"]}
    assert len(avatar.field.tensors["plane_xy"]) == planned["planes.resolution"]["chosen"] ** 2
    assert planned["planes.resolution"]["numbers"]["longest_px"] > 0
    again = Ours(config).fit(clip, tmp_path, Budget(iterations=30), **options)
    np.testing.assert_array_equal(again.render(clip.cameras[key.camera], clip.poses[key.timestep]).rgb, image)

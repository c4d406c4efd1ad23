"""The mechanism of every native method: seen in its avatars, and gone with the ablation that its spec names."""

import numpy as np
import pytest
import torch

from headbench.bench.contracts import Clip, no_progress
from headbench.bench.engine.cell import training_poses
from headbench.methods.ours.method import OursAvatar
from headbench.metrics.mechanism import dynamic_splats

from .ours.toy import store
from .test_conformance import SPECS, resolved

METHODS = [name for name, spec in SPECS.items() if spec.mechanism]


def ranges(name, clip: Clip, folder, settings):
    method = resolved(name, **settings)
    avatar = method.create().fit(clip, folder, method.budget, device="cpu", seed=0, progress=no_progress)
    details = dynamic_splats(avatar, training_poses(clip)).details
    return [value for key, value in details.items() if key.endswith("_range")]


def test_every_trained_native_method_has_one():
    assert {*METHODS} == {name for name, spec in SPECS.items() if not spec.trivial}


@pytest.mark.parametrize("name", METHODS)
def test_its_ablation_turns_it_off(name, clip, tmp_path):
    spec = SPECS[name]
    assert max(ranges(name, clip, tmp_path / "plain", {})) > 1e-6
    assert (
        max(ranges(name, clip, tmp_path / "off", spec.ablations[spec.mechanism.ablation]), default=0) < 1e-6
    )


def test_lines_change_what_is_drawn(clip, tmp_path):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    workload = training_poses(clip)
    drawn = np.stack([avatar.splats(pose).opacities for _, pose in workload])
    expected = np.ptp(drawn, axis=0)
    found = dynamic_splats(avatar, workload)
    assert found.details["opacity_range"] == pytest.approx(expected.max(), abs=1e-6)
    inside = avatar.line_offsets.inside  # nearly all: the lines' box is that of the head
    assert found.details["splats"] == len(inside) > 0.9 * len(expected)
    assert found.value == pytest.approx(100 * (expected[inside] > 0.05).mean())
    assert 1 < found.value < 100


@torch.no_grad()
def test_lines_without_weights_are_dead(clip, tmp_path):
    folder = store(clip, tmp_path, change=lambda values: values["line_gain_2"].zero_())
    found = dynamic_splats(OursAvatar.read(folder, "cpu"), training_poses(clip))
    assert found.value == found.details["opacity_range"] == found.details["dynamic_penalised"] == 0


def test_penalised_are_splats_on_still_triangles(clip, tmp_path):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    for _, pose in training_poses(clip)[:2]:
        still = pose.expression * 0
        rest = avatar.changes(
            type(pose)(**{**vars(pose), "expression": still, "jaw": still[:3], "eyes": np.zeros(6)})
        )
        assert rest.penalised.all()
        wide = avatar.changes(type(pose)(**{**vars(pose), "expression": 1e3 + still}))
        assert not wide.penalised.all()


def test_the_head_model_stage_of_ours_has_no_lines(clip, tmp_path, monkeypatch):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    order, lines = [], avatar.line_offsets
    monkeypatch.setattr(
        avatar, "line_offsets", lambda coefficients: order.append("lines") or lines(coefficients)
    )
    key = clip.splits["train"][0]
    avatar.draw(clip.cameras[key.camera], clip.poses[key.timestep], (1.0, 1.0, 1.0), order.append)
    assert order[:3] == ["drive", "lines", "deform"]

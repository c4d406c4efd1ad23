"""Avatars of other methods than "ours" with planned sizes, on a toy clip."""

import json
from dataclasses import replace
from math import ceil

import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.methods.ga.method import GA
from headbench.methods.ga.spec import GAConfig
from headbench.methods.gbs.method import GBS
from headbench.methods.gbs.spec import BlendshapeTraining, GBSConfig
from headbench.methods.shared.capacity import with_sizes
from headbench.methods.shared.config import Capacity, SplatTraining

from ...datasets.head.toy import toy_head
from ..toy_clip import toy_clip


@pytest.fixture(scope="module")
def clip():
    made = toy_clip(toy_head(16), timesteps=5, cameras=3, width=28, height=36)
    constant = made.poses[0].expression
    return replace(made, poses={t: replace(pose, expression=constant) for t, pose in made.poses.items()})


METHODS = {
    "ga": lambda mode: GA(
        GAConfig(splats=SplatTraining(max_splats=90_000, initial_opacity=0.5), capacity=Capacity(mode))
    ),
    "gbs": lambda mode: GBS(
        GBSConfig(
            splats=BlendshapeTraining(max_splats=90_000),
            samples=200,
            teeth_samples=20,
            mask_floor_mm=0.5,
            capacity=Capacity(mode),
        )
    ),
}


@pytest.mark.parametrize("name", METHODS)
def test_planned_sizes_are_trained_and_recorded(clip, tmp_path, name):
    options = {"budget": Budget(iterations=20), "device": "cpu", "seed": 3, "progress": no_progress}
    for mode in ("auto", "fixed"):
        METHODS[name](mode).fit(clip, tmp_path / mode, **options)
    auto, fixed = (json.loads((tmp_path / mode / "training.json").read_text()) for mode in ("auto", "fixed"))
    assert "capacity" not in fixed
    planned = {each["name"]: each for each in auto["capacity"]["decisions"]}
    splats = planned["splats.max_splats"]
    assert splats["chosen"] == ceil(splats["numbers"]["surface_px"]) < splats["configured"]
    assert splats["chosen"] > splats["numbers"]["least"]
    if name == "gbs":
        assert planned["expressions"]["chosen"] == 0
        size = {
            mode: sum(file.stat().st_size for file in (tmp_path / mode).glob("*"))
            for mode in ("auto", "fixed")
        }
        assert size["auto"] < size["fixed"]


def test_sizes_are_set_by_dotted_name():
    config = with_sizes(GAConfig(), {"sh_degree": 1, "splats.max_splats": 7, "capacity.mode": "auto"})
    assert config == GAConfig(sh_degree=1, splats=SplatTraining(max_splats=7), capacity=Capacity("auto"))

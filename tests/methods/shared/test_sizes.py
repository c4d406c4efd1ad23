"""Sizes chosen by short trainings: what is held out, what is tried and taken, and the whole of it on a toy clip."""

import json
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.contracts import Budget, FrameKey, no_progress
from headbench.methods.ga.config import GAConfig
from headbench.methods.ga.method import GA
from headbench.methods.gbs.config import BlendshapeTraining, GBSConfig
from headbench.methods.gbs.method import GBS
from headbench.methods.shared.config import Capacity, SplatTraining
from headbench.methods.shared.loop import Fit
from headbench.methods.shared.sizes import HeldOut, Size, choose_sizes, halves, held_out_frames

from ...datasets.head.toy import toy_head
from ..toy_clip import toy_clip

SIZES = (Size("degree", (2, 1, 0)), Size("group.count", (50, 25)))


def keys(**timesteps):
    return tuple(
        FrameKey("toy", sequence, t, camera)
        for sequence, ts in timesteps.items()
        for t in ts
        for camera in "ab"
    )


@pytest.mark.parametrize(
    ("train", "held_out"),
    [
        (keys(A=range(20), B=range(20, 24), C=range(24, 40)), [18, 19, 23, 38, 39]),
        (keys(A=[7], B=[9, 8]), [9]),
        (keys(A=range(32)), range(28, 32)),
        (keys(A=range(3)), range(2, 3)),
        (keys(A=[7]), []),
    ],
)
def test_the_end_of_each_training_sequence_is_held_out(train, held_out):
    clip = SimpleNamespace(splits={"train": train}, fingerprint="0")
    assert {key.timestep for key in held_out_frames(clip)} == {*held_out}
    part = HeldOut(clip)
    assert {*part.splits["train"]} == {key for key in train if key.timestep not in held_out}
    assert [*part.splits] == ["train"]
    assert part.fingerprint != clip.fingerprint


@dataclass(frozen=True)
class Group:
    count: int = 100


@dataclass(frozen=True)
class Config:
    degree: int = 3
    group: Group = field(default_factory=Group)


class Avatar:
    """Renders the truth with an error that its sizes decide."""

    def __init__(self, clip, error, count):
        self.clip, self.error, self.count = clip, error, count

    def render(self, camera, pose, background):
        (key,) = (k for k in self.clip.held_out if (k.camera, k.timestep) == (camera, pose))
        return SimpleNamespace(rgb=self.clip.image(key) / 255 + self.error)


@pytest.mark.parametrize(
    ("errors", "used", "chosen", "tried"),
    [
        ({}, None, (0, 25), 1 + 3 + 2),
        ({"degree": 1}, None, (1, 25), 1 + 3 + 2),  # 2 and 1 hold, 0 does not
        ({"degree": 2}, None, (2, 25), 1 + 2 + 2),  # 1 does not hold, so that 0 is not tried
        ({"count": 100}, None, (0, 100), 1 + 3 + 1),
        ({"degree": 3, "count": 50}, None, (3, 50), 1 + 1 + 2),
        ({}, 40, (0, 25), 1 + 3 + 1),  # 50 says nothing where no more than 40 were used
    ],
)
@pytest.mark.parametrize(("budget", "trial"), [(4_000, 1_000), (1_000, 500), (100, 100)])
def test_the_smallest_size_that_holds_is_taken(tmp_path, errors, used, chosen, tried, budget, trial):
    train = keys(A=range(14), B=range(14, 16))
    pixels = np.random.default_rng(0).integers(60, 200, (24, 20, 3)).astype(np.uint8)
    clip = SimpleNamespace(
        splits={"train": train},
        fingerprint="0",
        cameras={"a": "a", "b": "b"},
        poses={t: t for t in range(16)},
        background=np.ones(3),
        image=lambda key: pixels,
    )
    seen = []

    def fake(config, part, folder, budget, progress):
        assert {key.timestep for key in part.splits["train"]} == {*range(12), 14}
        seen.append((config, budget))
        enough = config.degree >= errors.get("degree", 0) and config.group.count >= errors.get("count", 0)
        return Avatar(part, 0.02 if enough else 0.03, config.group.count)

    sizes = (SIZES[0], replace(SIZES[1], used=used and (lambda avatar: used)))
    fit = Fit(clip, tmp_path, Budget(iterations=budget), "cpu", 0, no_progress, "run")
    config, trials = choose_sizes(fit, Config(), Capacity("auto"), sizes, fake)
    assert (config.degree, config.group.count) == chosen
    assert {budget.iterations for _, budget in seen} == {trial}
    assert len(trials) == len(seen) == tried
    assert trials[0].psnr == pytest.approx(-20 * np.log10(5 / 255), abs=1e-6)  # 0.02 of 255, rounded


def test_halves_stop_at_the_least():
    assert halves(40_000, 10_000) == (20_000, 10_000)
    assert halves(40_000, 10_001) == (20_000,)
    assert halves(None, 1) == ()
    assert halves(1, 1) == ()


@pytest.fixture(scope="module")
def clip():
    return toy_clip(toy_head(16), timesteps=5, cameras=3, width=28, height=36)


METHODS = {
    # The toy's colours do not depend on the direction.
    "ga": lambda mode, degree=3: GA(
        GAConfig(
            splats=SplatTraining(checkpoint_every_s=0.0, initial_opacity=0.5),
            sh_degree=degree,
            min_sh_every=5,
            capacity=Capacity(mode, tolerance_db=0.5, tolerance_ssim=0.05),
        )
    ),
    "gbs": lambda mode: GBS(
        GBSConfig(
            splats=BlendshapeTraining(checkpoint_every_s=0.0),
            samples=200,
            teeth_samples=20,
            mask_floor_mm=0.5,
            capacity=Capacity(mode, tolerance_db=0.5, tolerance_ssim=0.05),
        )
    ),
}


def content(avatar):
    return {path.name: path.read_bytes() for path in avatar.files()}


@pytest.mark.parametrize("name", METHODS)
def test_an_avatar_with_sizes_by_trial_is_smaller_and_resumes(clip, tmp_path, name):
    options = {"device": "cpu", "seed": 3}
    whole = tmp_path / "whole"
    avatar = METHODS[name]("auto").fit(clip, whole, Budget(iterations=32), progress=no_progress, **options)
    record = json.loads((whole / "training.json").read_text())
    taken = [trial for trial in record["trials"] if trial["taken"] and trial["name"]]
    assert taken
    assert not (whole / "trials").exists()
    fixed = METHODS[name]("fixed").fit(
        clip, tmp_path / "fixed", Budget(iterations=32), progress=no_progress, **options
    )
    assert "trials" not in json.loads((tmp_path / "fixed" / "training.json").read_text())
    if name == "gbs":  # ga's file has room for all harmonics, whatever the degree
        assert sum(map(len, content(avatar).values())) < sum(map(len, content(fixed).values()))
    else:
        assert not avatar.splat_tensors["sh_rest"].any()
        assert fixed.splat_tensors["sh_rest"].any()

    calls = []

    def killing(done, total, note=""):
        calls.append(note)
        if len(calls) in (9, 50):
            raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            METHODS[name]("auto").fit(
                clip, tmp_path / "killed", Budget(iterations=32), progress=killing, **options
            )
    again = METHODS[name]("auto").fit(
        clip, tmp_path / "killed", Budget(iterations=32), progress=killing, **options
    )
    assert any(note.startswith("trying ") for note in calls)
    assert content(again) == content(avatar)


def test_shares_and_tolerances_out_of_range_are_refused():
    for changes in ({"share": 0.0}, {"share": 1.5}, {"tolerance_db": -1.0}, {"tolerance_ssim": -1.0}):
        with pytest.raises(ValueError, match="must"):
            Capacity("auto", **changes)

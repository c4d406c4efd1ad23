"""Variants of toy avatars: what each recipe must leave the same, and what it must not."""

import numpy as np
import pytest
import torch

from headbench.bench.contracts import Budget, no_progress
from headbench.methods.avatars.derived.recipes import EARLY, GA, OURS, Recipe, ga_variants, ours_variants
from headbench.methods.ga.method import GA as GAMethod
from headbench.methods.ga.method import GAAvatar
from headbench.methods.ga.spec import GAConfig
from headbench.methods.ours.method import Ours
from headbench.methods.shared.config import SplatTraining

from ...ours.toy import SMALL, changed, store


@pytest.fixture(scope="module")
def ga(clip, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ga")
    config = GAConfig(splats=SplatTraining(max_splats=1200, min_settle=4), min_sh_every=5)
    method = GAMethod(config)
    method.fit(clip, folder, Budget(iterations=40), device="cpu", seed=0, progress=no_progress)
    return folder


@pytest.fixture(scope="module")
def ours(clip, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ours")
    store(clip, folder, changed(SMALL, planes={"resolution": 68}, lines={"resolution": 20}), copies=2)
    return folder


def by_name(derive, folder, clip):
    return {variant.name: variant for variant in derive(folder, clip, "cpu")}


def picture(avatar, clip):
    key = clip.splits["train"][1]
    return avatar.render(clip.cameras[key.camera], clip.poses[key.timestep]).rgb.astype(float)


def psnr(a, b):
    return -10 * np.log10(max(np.mean((a - b) ** 2), 1e-12))


def size(avatar):
    return sum(path.stat().st_size for path in avatar.files())


def test_recipes_have_names_of_their_own():
    for recipes in (GA, OURS):
        assert len({recipe.name for recipe in recipes}) == len(recipes)
        assert all(recipe.summary and recipe.name for recipe in recipes)
    assert Recipe(0.5, 1, storage="coded", cutoffs=EARLY).name == "splats50-sh1-coded-cut2"


MADE = ("splats75", "splats50", "splats25", "half", "8bit", "coded", "splats50-coded", "cut2", "cut4")
"""Variants of both methods that are made and drawn."""


@pytest.mark.parametrize(
    ("derive", "method", "recipes", "more"),
    [
        (ga_variants, GAMethod, GA, ("sh0", "splats75-sh1-coded")),
        (ours_variants, Ours, OURS, ("planes64", "planes32", "lines16", "splats75-planes64-lines16-coded")),
    ],
    ids=["ga", "ours"],
)
def test_variants_are_read_back_from_smaller_own_files(
    derive, method, recipes, more, request, clip, tmp_path
):
    folder = request.getfixturevalue(method.name)
    whole = method().load(folder, device="cpu")
    expected = picture(whole, clip)
    variants = by_name(derive, folder, clip)
    assert set(variants) == {recipe.name for recipe in recipes}
    quality = {}
    for name in (*MADE, *more):
        avatar = variants[name].make(tmp_path / name)
        files = [*avatar.files(), *avatar.shared_files()]
        assert all(path.parent == tmp_path / name and path.is_file() for path in files)
        changed = name not in ("cut2", "cut4")  # which change no file
        assert (size(avatar) < size(whole)) == changed
        quality[name] = psnr(picture(avatar, clip), expected)
    assert quality["half"] > 45
    assert quality["coded"] > 25
    assert quality["splats75"] >= quality["splats50"] >= quality["splats25"]
    assert quality["half"] > quality["8bit"]
    assert quality["cut2"] >= quality["cut4"]


def test_pruning_keeps_what_contributes(ga, clip, tmp_path):
    """Half of the splats, the most contributing, are nearer to the whole than the other half."""
    whole = GAAvatar.read(ga, "cpu")
    half = by_name(ga_variants, ga, clip)["splats50"].make(tmp_path)
    means = {tuple(row) for row in half.splat_tensors["means"].tolist()}
    others = torch.tensor([tuple(row) not in means for row in whole.splat_tensors["means"].tolist()])
    rest = {name: value[others] for name, value in whole.splat_tensors.items()}
    other = GAAvatar([], whole.mesh, whole.subject, rest, whole.binding[others], whole.refined, "cpu")
    assert len(half.binding) == round(0.5 * len(whole.binding))
    half, other = (psnr(picture(avatar, clip), picture(whole, clip)) for avatar in (half, other))
    assert half > other + 3


def test_a_lower_degree_is_the_whole_avatar_with_zeros_above(ga, clip, tmp_path):
    whole = GAAvatar.read(ga, "cpu")
    lower = by_name(ga_variants, ga, clip)["sh1"].make(tmp_path)
    zeroed = dict(whole.splat_tensors)
    zeroed["sh_rest"] = zeroed["sh_rest"].clone()
    assert zeroed["sh_rest"][:, :, 3:].any()
    zeroed["sh_rest"][:, :, 3:] = 0
    twin = GAAvatar([], whole.mesh, whole.subject, zeroed, whole.binding, whole.refined, "cpu")
    np.testing.assert_array_equal(picture(lower, clip), picture(twin, clip))
    saved = 4 * 3 * (15 - 3) * len(whole.binding)
    assert size(whole) - size(lower) == pytest.approx(saved, abs=2_000)


def test_a_recipe_that_changes_nothing_is_left_out(clip, tmp_path):
    store(clip, tmp_path)  # 8 samples a plane, 6 a line
    names = set(by_name(ours_variants, tmp_path, clip))
    assert not names & {"planes64", "planes32", "lines16"}
    assert {"coded", "splats50"} <= names

"""Variants of toy avatars: what each recipe must leave the same, and what it must not."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.contracts import Budget, no_progress
from headbench.methods.avatars.derived.recipes import (
    EARLY,
    GA,
    OURS,
    Recipe,
    coarser_lines,
    coarser_planes,
    contributions,
    fitting_matrix,
    ga_variants,
    most_contributing,
    ours_variants,
    read_reduced,
    write_reduced,
)
from headbench.methods.avatars.harmonics import squared_contribution, training_views
from headbench.methods.ga.method import GA as GAMethod
from headbench.methods.ga.method import GAAvatar
from headbench.methods.ga.spec import GAConfig
from headbench.methods.ops.planes import PAIRS, sample_plane
from headbench.methods.ours.method import Ours
from headbench.methods.shared.config import SplatTraining
from headbench.methods.shared.rendering import PosedSplats, view_of
from headbench.methods.splats import rasterize

from ...ours.toy import SMALL, changed, store


def ramp_plane(side, channels=2):
    """Values linear over the plane: any resampling that keeps the corners keeps the function."""
    rows, columns = torch.meshgrid(*[torch.linspace(-1, 1, side)] * 2, indexing="ij")
    return torch.stack([1 + (c + 1) * columns - 2 * rows for c in range(channels)], dim=2).reshape(
        side**2, channels
    )


def test_a_linear_plane_reads_the_same_after_resampling():
    tensors = {f"plane_{name}": ramp_plane(33) for name, _, _ in PAIRS}
    coarse = coarser_planes(tensors, 9)
    points = 2 * torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) - 1
    for name, plane in coarse.items():
        assert plane.shape == (81, 2)
        fine = sample_plane(tensors[name], points, 33)
        torch.testing.assert_close(sample_plane(plane, points, 9), fine, atol=1e-5, rtol=0)
    assert coarser_planes(coarse, 9)["plane_xy"] is coarse["plane_xy"]


@given(st.integers(2, 12), st.integers(1, 20), st.integers(0, 99))
def test_what_fewer_samples_can_hold_is_kept_else_the_nearest(fewer, more, seed):
    rng = np.random.default_rng(seed)
    samples = fewer + more
    places = np.linspace(0, 1, samples)
    fit = fitting_matrix(samples, fewer).numpy()
    nodes = np.linspace(0, 1, fewer)

    def read(values):
        return np.interp(places, nodes, values)

    values = rng.standard_normal(fewer)
    np.testing.assert_allclose(fit @ read(values), values, atol=1e-9)
    target = rng.standard_normal(samples)
    best = np.sum((read(fit @ target) - target) ** 2)
    for _ in range(5):
        other = fit @ target + 0.1 * rng.standard_normal(fewer)
        assert best <= np.sum((read(other) - target) ** 2) + 1e-12


def test_lines_are_resampled_each_for_itself():
    lines = torch.randn(2, 3, 17, 4, generator=torch.Generator().manual_seed(2))
    coarse = coarser_lines({"lines": lines}, 5)["lines"]
    assert coarse.shape == (2, 3, 5, 4)
    fit = fitting_matrix(17, 5).float()
    for k, a, c in itertools.product(range(2), range(3), range(4)):
        torch.testing.assert_close(coarse[k, a, :, c], fit @ lines[k, a, :, c])
    same = {"other": lines}
    assert coarser_lines(same, 4) == same
    assert coarser_lines({"lines": coarse}, 5)["lines"] is coarse


@pytest.mark.parametrize(("kind", "bytes_each"), [("half", 2), ("8bit", 1)])
def test_reduced_tensors_come_back_within_their_rounding(tmp_path, kind, bytes_each):
    generator = torch.Generator().manual_seed(1)
    values = torch.randn(500, 4, generator=generator) * torch.tensor([1.0, 100.0, 1e-3, 0.0])
    exact, vector = torch.randn(3, 3, generator=generator), torch.randn(7, generator=generator)
    whole = torch.arange(70_000, dtype=torch.int32)[:, None]
    path = tmp_path / "x.safetensors"
    write_reduced(path, {"values": values, "box": exact, "bias": vector, "whole": whole}, kind, ("box",))
    read = read_reduced(path)
    assert set(read) == {"values", "box", "bias", "whole"}
    assert torch.equal(read["box"], exact)
    assert torch.equal(read["bias"], vector)
    assert torch.equal(read["whole"], whole)
    spread = values.amax(0) - values.amin(0)
    bound = values.abs() * 2**-11 + 2**-25 if kind == "half" else 0.5 * spread / 255 * 1.001 + 1e-9
    assert ((read["values"] - values).abs() <= bound).all()
    assert (read["values"] != values).any()
    assert path.stat().st_size < values.numel() * bytes_each + 4 * 70_000 + 2_000


class Ball:
    """Splats in front of the toy cameras, whatever the pose."""

    def __init__(self, count):
        rng = np.random.default_rng(5)
        quats = rng.standard_normal((count, 4))
        self.posed = PosedSplats(
            (0.05 * rng.standard_normal((count, 3))).astype(np.float32),
            (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
            np.exp(-4.5 + 0.4 * rng.standard_normal((count, 3))).astype(np.float32),
            rng.uniform(0.05, 0.95, count).astype(np.float32),
            None,
        )

    def splats(self, pose, camera=None):
        return self.posed


def test_contributions_are_weights_of_splats_coloured_alone(clip):
    ball, views = Ball(20), training_views(clip, 2)
    found = contributions(ball, views)
    # Independent: splat i painted white and all others black, without gradients, in the float64 reference.
    expected = torch.zeros(20, dtype=torch.float64)
    values = [torch.from_numpy(v).double() for v in vars(ball.posed).values() if v is not None]
    for camera, _ in views:
        view = view_of(camera, "cpu")
        for i in range(20):
            colors = torch.zeros(20, 1, dtype=torch.float64)
            colors[i] = 1
            cameras = (view.world_to_camera.double(), view.K.double(), camera.width, camera.height)
            expected[i] += rasterize(*values, colors, *cameras, backend="reference").image.sum()
    torch.testing.assert_close(found.double(), expected, rtol=2e-3, atol=2e-3)
    assert float(expected.max()) > 10 * float(expected.min())


def test_the_most_contributing_stay_in_order():
    weights = torch.tensor([3.0, 0.0, 5.0, 5.0, 1.0])
    assert most_contributing(weights, 0.6).tolist() == [0, 2, 3]
    assert most_contributing(weights, 1.0).tolist() == [0, 1, 2, 3, 4]
    assert most_contributing(weights, 0.01).tolist() == [2]


def test_views_are_of_training_alone_and_spread(clip):
    cameras = {clip.cameras[key.camera].id for key in clip.splits["train"]}
    views = training_views(clip, 5)
    assert len(views) == 5
    assert {camera.id for camera, _ in views} <= cameras
    assert len(training_views(clip, 10_000)) == len(clip.splits["train"])


def test_squared_contributions_are_mean_squares_of_weights(clip):
    """Independent: splat i painted white and all others black, in the float64 reference."""
    ball = Ball(12)
    ((camera, _),) = training_views(clip, 1)
    generator = torch.Generator().manual_seed(0)
    found = torch.stack([squared_contribution(ball.posed, camera, generator) for _ in range(400)]).mean(0)
    values = [torch.from_numpy(v).double() for v in vars(ball.posed).values() if v is not None]
    view = view_of(camera, "cpu")
    cameras = (view.world_to_camera.double(), view.K.double(), camera.width, camera.height)
    colors = torch.eye(12, dtype=torch.float64)
    images = rasterize(*values, colors, *cameras, backend="reference").image
    expected = images.square().mean((0, 1))
    torch.testing.assert_close(found.double(), expected, rtol=0.2, atol=1e-4 * float(expected.max()))


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

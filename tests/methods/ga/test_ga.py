"""GaussianAvatars' own part: colour by viewing direction, its degrees, the learning rates, tracking refined."""

import numpy as np
import pytest
import torch
from torch import nn

from headbench.methods.ga.method import GAAppearance, GAAvatar
from headbench.methods.ga.spec import GAConfig
from headbench.methods.ops.planes import C0, C1
from headbench.methods.shared.avatar_files import TRACKED, Subject
from headbench.methods.shared.optimisation import Optimiser
from headbench.methods.shared.rendering import view_of
from headbench.methods.shared.schedule import Timeline
from headbench.methods.shared.surface_points import SubjectMesh

from ..shared.test_avatar_files import tracking


def make(clip, config=None):
    """Appearance, optimiser with random harmonics of degree 0 and 1, and one splat on every triangle."""
    mesh = SubjectMesh(clip.head, clip.shape, clip.static_offset, "cpu")
    appearance = GAAppearance(mesh, clip, config or GAConfig(), "cpu", 0)
    appearance.begin(Timeline(600_000, 600_000))
    count = len(mesh.faces)
    initial = {**appearance.splat_parameters(count), **appearance.parameters()}
    values = {name: value.clone() for name, (value, _) in initial.items()}
    generator = torch.Generator().manual_seed(0)
    values["sh_dc"] = torch.randn(count, 3, generator=generator)
    values["sh_rest"][:, :, :3] = torch.randn(count, 3, 3, generator=generator)
    values["opacities"] = torch.randn(count, generator=generator)
    values |= {
        "means": torch.zeros(count, 3),
        "log_scales": torch.zeros(count, 3),
        "quats": torch.ones(count, 4),
    }
    optimiser = Optimiser({n: nn.Parameter(v) for n, v in values.items()}, dict.fromkeys(values, 0.1))
    return appearance, optimiser, torch.arange(count)


def shade(clip, appearance, optimiser, binding, iteration):
    """World means and shading of one training image."""
    key = clip.splits["train"][1]
    frames = appearance.frames(key.timestep, optimiser)
    view = view_of(clip.cameras[key.camera], "cpu")
    placed = appearance.place(frames, binding, view, key.timestep, optimiser, iteration)
    # With zero local means every splat sits on its triangle's centroid.
    return key, frames.center[binding], placed


def test_colour_is_seen_along_the_ray_from_the_camera(clip):
    appearance, optimiser, binding = make(clip)
    key, means, shading = shade(clip, appearance, optimiser, binding, 3_000)
    ray = means.detach().double().numpy() - clip.cameras[key.camera].center
    x, y, z = (ray / np.linalg.norm(ray, axis=1, keepdims=True)).T
    dc, rest = (optimiser[name].detach().double().numpy() for name in ("sh_dc", "sh_rest"))
    bases = np.stack([-C1 * y, C1 * z, -C1 * x], axis=1)
    expected = np.maximum(0, 0.5 + C0 * dc + np.einsum("nck,nk->nc", rest[:, :, :3], bases))
    np.testing.assert_allclose(shading.colors.detach(), expected, atol=1e-5)
    logits = optimiser["opacities"].detach().numpy()
    np.testing.assert_allclose(shading.opacities.detach(), 1 / (1 + np.exp(-logits)), rtol=1e-5)
    assert shading.penalty is None


@pytest.mark.parametrize(("iteration", "degree"), [(1, 0), (999, 0), (1_000, 1), (2_000, 2), (600_000, 3)])
def test_a_degree_more_every_thousand_iterations(clip, iteration, degree):
    appearance, optimiser, binding = make(clip)
    _, _, shading = shade(clip, appearance, optimiser, binding, iteration)
    shading.colors.sum().backward()
    gradient = optimiser["sh_rest"].grad
    used = 0 if gradient is None else int(gradient.abs().sum((0, 1)).count_nonzero())
    assert used == (degree + 1) ** 2 - 1


def test_learning_rates_go_to_what_they_are_named_after(clip):
    config = GAConfig(sh_dc_lr=1.0, sh_rest_lr=2.0, expression_lr=3.0, pose_lr=4.0, translation_lr=5.0)
    appearance, _, _ = make(clip, config)
    rates = {name: rate for name, (_, rate) in appearance.parameters().items()}
    poses = dict.fromkeys(("rotation", "neck", "jaw", "eyes"), 4.0)
    assert rates == {"expression": 3.0, "translation": 5.0, **poses}
    assert {name: rate for name, (_, rate) in appearance.splat_parameters(2).items()} == {
        "sh_dc": 1.0,
        "sh_rest": 2.0,
    }


@pytest.mark.parametrize("refine", [True, False])
def test_tracking_of_the_timestep_alone_is_refined_if_asked(clip, refine):
    appearance, optimiser, binding = make(clip, GAConfig(refine_tracking=refine))
    key, means, _ = shade(clip, appearance, optimiser, binding, 1)
    assert means.requires_grad == refine
    assert set(appearance.parameters()) == (set(TRACKED) if refine else set())
    if refine:
        means.square().sum().backward()
        row = appearance.tracked.row[key.timestep]
        for name in TRACKED:
            moved = optimiser[name].grad.abs().sum(1) > 0
            assert moved.nonzero().flatten().tolist() == [row]


def test_an_avatar_shows_a_training_pose_as_it_was_refined(clip):
    appearance, optimiser, binding = make(clip)
    names = ("means", "log_scales", "quats", "opacities", "sh_dc", "sh_rest")
    splats, refined = {name: optimiser[name].detach() for name in names}, tracking(clip)
    plain, avatar = (
        GAAvatar([], appearance._mesh, Subject.of(clip), splats, binding, each, "cpu")
        for each in (None, refined)
    )
    for pose, shown in ((clip.poses[1], refined(clip.poses[1])), (clip.poses[2], clip.poses[2])):
        np.testing.assert_array_equal(avatar.splats(pose).means, plain.splats(shown).means)
    assert not np.array_equal(avatar.splats(clip.poses[1]).means, plain.splats(clip.poses[1]).means)

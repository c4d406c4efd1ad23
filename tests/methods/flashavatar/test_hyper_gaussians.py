"""Conditional means of splats' Gaussians: against the dense covariance, their gradients, the file, and the start."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.methods.avatars.compact.codecs import parts_of, write_coded
from headbench.methods.avatars.settings import EXACT, Precision
from headbench.methods.flashavatar.method import FlashAvatar, FlashAvatarTraining
from headbench.methods.flashavatar.model import (
    WIDTHS,
    TrainedSplats,
    conditional_means,
    gaussian_names,
    gaussian_shapes,
    initial_gaussians,
    layer_of_points,
    network_outputs,
)
from headbench.methods.flashavatar.spec import FlashAvatarConfig
from headbench.methods.shared.schedule import Timeline
from headbench.methods.shared.tensor_files import read_safetensors

from ..toy_clip import first_view
from .small import SMALL

LATENT = 5
CONFIG = FlashAvatarConfig(**{**SMALL, "hyper_gaussians": LATENT})


def random_gaussians(count=4, seed=0):
    generator = torch.Generator().manual_seed(seed)
    zeros = initial_gaussians(count, LATENT)
    found = {name: torch.randn(value.shape, generator=generator).double() for name, value in zeros.items()}
    return found, torch.randn(count, LATENT, generator=generator).double()


def test_conditional_means_are_those_of_the_dense_covariance():
    """mu_o + S_oi S_ii^-1 (x - mu_i) with S the inverse of the precision, whatever the last block of its factor is."""
    tensors, latents = random_gaussians()
    found = conditional_means(tensors, latents).split([*WIDTHS.values()], dim=1)
    rng = np.random.default_rng(2)
    for (part, width), outputs in zip(WIDTHS.items(), found):
        mean, upper, lower = (tensors[name].numpy() for name in gaussian_names(part))
        for splat in range(len(latents)):
            factor = np.zeros((width + LATENT, width + LATENT))
            factor[np.tril_indices(width)] = upper[splat]
            factor[range(width), range(width)] = np.exp(np.diag(factor)[:width])
            factor[width:, :width] = lower[splat].reshape(LATENT, width)
            factor[width:, width:] = np.tril(rng.normal(size=(LATENT, LATENT)), -1) + np.eye(LATENT)
            covariance = np.linalg.inv(factor @ factor.T)
            along = np.linalg.solve(covariance[width:, width:], latents[splat].numpy() - mean[splat, width:])
            expected = mean[splat, :width] + covariance[:width, width:] @ along
            np.testing.assert_allclose(outputs[splat].numpy(), expected, rtol=1e-9, atol=1e-10)


def test_gradients_are_those_of_differences():
    tensors, latents = random_gaussians(2)
    names = [*tensors]
    values = [tensors[name].requires_grad_() for name in names]

    def means(latents, *values):
        return conditional_means(dict(zip(names, values)), latents)

    assert torch.autograd.gradcheck(means, (latents.requires_grad_(), *values))


def test_large_numbers_below_the_diagonal_have_gradients():
    tensors, latents = random_gaussians(1)
    name = gaussian_names("offset")[1]
    tensors[name][:, 1] = 1e3  # its exponential overflows
    tensors[name].requires_grad_()
    conditional_means(tensors, latents).sum().backward()
    assert tensors[name].grad.isfinite().all()


def test_gaussians_start_at_zero_outputs_and_every_tensor_trains(clip):
    config = replace(CONFIG, sh_every=1, min_sh_every=1)
    training = FlashAvatarTraining(clip, config, "cpu", 0)
    training.begin(Timeline(100, 100))
    tensors = {name: training.optimiser[name] for name in training._rates}
    of_points = layer_of_points(tensors, training._encoded)
    assert not network_outputs(tensors, of_points, training._inputs[0], config).any()
    assert {training._rates[name] for name in gaussian_shapes(LATENT)} == {config.network_lr}
    with torch.no_grad():  # at zeros, gradients reach the network only after a step
        for name in gaussian_shapes(LATENT):
            tensors[name] += 0.01 * torch.randn(
                tensors[name].shape, generator=torch.Generator().manual_seed(0)
            )
    training.loss(3, 0).backward()
    training.close()
    assert all(value.grad is not None and value.grad.any() for value in tensors.values())


@pytest.fixture(scope="module")
def trained(clip, tmp_path_factory):
    folder = tmp_path_factory.mktemp("hyper")
    method = FlashAvatar(replace(CONFIG, network_lr=0.01))
    budget = Budget(iterations=30)
    return folder, method, method.fit(clip, folder, budget, device="cpu", seed=0, progress=no_progress)


def test_an_avatar_is_stored_with_its_gaussians(trained, clip):
    folder, method, avatar = trained
    camera, pose = first_view(clip)
    loaded = method.load(folder, device="cpu")
    assert loaded.stored.settings.hyper_gaussians == LATENT
    np.testing.assert_array_equal(loaded.render(camera, pose).rgb, avatar.render(camera, pose).rgb)
    tensors = avatar.stored.tensors
    assert all(tensors[name].abs().max() > 1e-3 for name in gaussian_shapes(LATENT))
    count = len(avatar.stored.points.triangles)
    stored = sum(4 * tensors[name].numel() for name in gaussian_shapes(LATENT))
    assert stored == (128 + 52 * LATENT) * count
    assert sum(path.stat().st_size for path in loaded.files()) > stored


@pytest.mark.parametrize(("precision", "tolerance"), [(EXACT, 2e-3), (Precision(), 0.05)])
def test_a_coded_avatar_has_its_gaussians(trained, clip, tmp_path, precision, tolerance):
    _, method, avatar = trained
    write_coded(parts_of(avatar, clip.head, None), clip.head, tmp_path, precision, None)
    coded = method.load(tmp_path, device="cpu")
    camera, pose = first_view(clip)
    difference = np.abs(coded.render(camera, pose).rgb - avatar.render(camera, pose).rgb)
    assert difference.max() < tolerance
    assert coded.stored.settings.hyper_gaussians == LATENT


def test_damaged_gaussians_are_refused(trained, clip, tmp_path):
    _, _, avatar = trained
    path = tmp_path / "avatar.safetensors"
    avatar.stored.write(path)
    tensors, metadata = read_safetensors(path)
    name = gaussian_names("turn")[1]
    broken = tensors[name].clone()
    broken[0, 2] = 40.0  # on the diagonal
    for change in ({name: broken}, {name: tensors[name][:, :3].clone()}):
        save_file({**tensors, **change}, path, metadata)
        with pytest.raises(InputError, match=name):
            TrainedSplats.of(path, *read_safetensors(path), clip.head, "cpu")
    save_file({key: value for key, value in tensors.items() if key != name}, path, metadata)
    with pytest.raises(InputError, match=name):
        TrainedSplats.of(path, *read_safetensors(path), clip.head, "cpu")

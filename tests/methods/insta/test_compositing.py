"""Volume rendering against densities whose integrals are known."""

import math

import numpy as np
import pytest
import torch

from headbench.methods.insta.compositing import composite

STEP = 0.001


def along(density, values=None, *, start=0.5, length=0.4):
    """Composite one ray through a density given as a function of distance."""
    distances = start + STEP * (torch.arange(round(length / STEP), dtype=torch.float64) + 0.5)
    values = torch.ones(len(distances), 1, dtype=torch.float64) if values is None else values(distances)
    rays = torch.zeros(len(distances), dtype=torch.int64)
    return composite(density(distances) * STEP, values, distances, rays, torch.ones(1, dtype=torch.float64))


@pytest.mark.parametrize("density", [0.1, 5.0, 80.0])
def test_a_slab_of_constant_density_absorbs_by_beer_and_lambert(density):
    result = along(lambda t: torch.full_like(t, density))
    left = math.exp(-density * 0.4)
    assert result.transmittance.item() == pytest.approx(left, rel=1e-12)
    assert result.color.item() == pytest.approx(1 - left, rel=1e-12)
    # Mean of t under density exp(-density (t - 0.5)) on [0.5, 0.9].
    mean = 0.5 * (1 - left) + (1 - left) / density - 0.4 * left
    assert result.distance.item() == pytest.approx(mean, rel=2e-3)


@pytest.mark.parametrize("peak", [1.0, 60.0])
def test_a_gaussian_density_absorbs_by_the_error_function(peak):
    center, width = 0.7, 0.03
    result = along(lambda t: peak * torch.exp(-0.5 * ((t - center) / width) ** 2))
    thickness = peak * width * math.sqrt(2 * math.pi) * math.erf(0.2 / width / math.sqrt(2))
    assert result.transmittance.item() == pytest.approx(math.exp(-thickness), rel=1e-6)


def test_emission_follows_the_integral():
    # Colour t in a slab of density 30, integrated on a grid a hundred times finer.
    density, fine = 30.0, np.linspace(0.5, 0.9, 400_001)
    integrand = density * np.exp(-density * (fine - 0.5)) * fine
    expected = np.trapezoid(integrand, fine)
    result = along(lambda t: torch.full_like(t, density), lambda t: t[:, None])
    assert result.color.item() == pytest.approx(expected, rel=2e-5)


def random_rays(seed=0, samples=60, rays=9):
    generator = torch.Generator().manual_seed(seed)
    owner = torch.randint(rays - 2, (samples,), generator=generator).sort().values + 1  # first and last: none
    thickness = torch.rand(samples, generator=generator, dtype=torch.float64)
    values = torch.rand(samples, 3, generator=generator, dtype=torch.float64)
    distances = torch.rand(samples, generator=generator, dtype=torch.float64)
    entering = torch.rand(rays, generator=generator, dtype=torch.float64) * 0.5 + 0.5
    return thickness, values, distances, owner, entering


def test_many_rays_at_once_are_each_ray_alone():
    thickness, values, distances, owner, entering = random_rays()
    together = composite(thickness, values, distances, owner, entering)
    for ray in range(len(entering)):
        light, color, distance = entering[ray].item(), np.zeros(3), 0.0
        for sample in (owner == ray).nonzero()[:, 0]:
            weight = light * (1 - math.exp(-thickness[sample]))
            color += weight * values[sample].numpy()
            distance += weight * distances[sample].item()
            light *= math.exp(-thickness[sample])
        np.testing.assert_allclose(together.color[ray], color, atol=1e-12)
        assert together.distance[ray].item() == pytest.approx(distance, abs=1e-12)
        assert together.transmittance[ray].item() == pytest.approx(light, abs=1e-12)


def test_gradients_pass_gradcheck():
    thickness, values, distances, owner, entering = random_rays(1, 14, 5)
    for tensor in (thickness, values, entering):
        tensor.requires_grad_()

    def summed(thickness, values, entering):
        return tuple(composite(thickness, values, distances, owner, entering))

    assert torch.autograd.gradcheck(summed, (thickness, values, entering))


def test_float32_keeps_its_digits_on_a_hundred_thousand_rays():
    # The optical depths of all rays are one running sum; that must not cost the last rays their digits.
    rays = 100_000
    thickness = torch.full((3 * rays,), 4.0)
    owner = torch.arange(rays).repeat_interleave(3)
    result = composite(thickness, torch.ones(3 * rays, 1), torch.ones(3 * rays), owner, torch.ones(rays))
    torch.testing.assert_close(result.transmittance, torch.full((rays,), math.exp(-12)), rtol=1e-5, atol=0)
    torch.testing.assert_close(result.color[:, 0], 1 - result.transmittance, rtol=1e-5, atol=0)

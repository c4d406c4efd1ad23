"""The field as a whole: gradients through a rendered image against float64, published sizes, the prior."""

import numpy as np
import pytest
import torch

from headbench.methods.insta.canonical import canonical_surface
from headbench.methods.insta.config import InstaConfig
from headbench.methods.insta.field import Architecture, Field, Prior
from headbench.methods.insta.occupancy import Occupancy
from headbench.methods.insta.parts import mouth_triangles
from headbench.methods.insta.rays import camera_rays
from headbench.methods.insta.rendering import Marching, Scene, render_rays
from headbench.methods.shared.subject_mesh import SubjectMesh

from ..toy_clip import look_at
from .small import SMALL


@pytest.fixture(scope="module")
def stage(head):
    config = InstaConfig(**SMALL)
    mesh = SubjectMesh(head, np.zeros(head.shape_basis.shape[2]), np.zeros_like(head.template), "cpu")
    surface = canonical_surface(head, mesh, config)
    occupancy = Occupancy(surface, config)
    architecture = Architecture.of(config, head.expression_basis.shape[2])
    field = Field(architecture, occupancy.box("cpu"), Prior.of(config))
    return config, surface, occupancy, field, mouth_triangles(head)


def scenes_of(surface, count=2):
    camera = look_at(np.array([0.05, 0.0, 0.5]), np.zeros(3), "c", 9, 11)
    rows, columns = np.divmod(np.arange(99), 9)
    rays = camera_rays(camera, columns, rows, 0.3)
    generator = torch.Generator().manual_seed(4)
    return [Scene(surface.rest, torch.randn(8, generator=generator), rays) for _ in range(count)]


def test_rendered_gradients_are_those_of_float64(stage):
    config, surface, occupancy, field, mouth = stage
    marching = Marching(config.step, 5, 0.0)
    initial = {name: value.clone() for name, value in field.architecture.initial(0).items()}
    initial["table"] = initial["table"] * 2_000  # features of a trained field, not of a blank one
    weights = torch.rand(198, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    results = []
    for dtype in (torch.float32, torch.float64):
        leaves = {name: value.detach().clone().to(dtype).requires_grad_() for name, value in initial.items()}
        seen = render_rays(field, leaves, scenes_of(surface), occupancy.space(), mouth, marching)
        image = torch.cat([seen.color, seen.transmittance[:, None], seen.distance[:, None]], dim=1)
        (image * weights.to(dtype)).sum().backward()
        results.append((image.detach().double(), {n: v.grad.double() for n, v in leaves.items()}))
    (image, gradients), (expected, exact) = results
    assert float(expected[:, 3].min()) < 0.5
    torch.testing.assert_close(image, expected, atol=2e-5, rtol=0)
    for name, gradient in gradients.items():
        scale = float(exact[name].abs().max())
        assert scale > 0, name
        assert float((gradient - exact[name]).abs().max()) < 2e-4 * scale, name


def test_rounds_do_not_change_the_image(stage):
    config, surface, occupancy, field, mouth = stage
    parameters = field.architecture.initial(1)
    images = [
        render_rays(
            field, parameters, scenes_of(surface, 1), occupancy.space(), mouth, Marching(config.step, n, 0.0)
        ).color
        for n in (2, 1000)
    ]
    torch.testing.assert_close(*images, atol=1e-5, rtol=0)


def test_the_expression_is_seen_at_the_mouth_alone(stage):
    config, surface, occupancy, field, mouth = stage
    parameters = field.architecture.initial(2)
    marching = Marching(config.step, 1000, 0.0)
    one, other = scenes_of(surface)
    images = [
        render_rays(field, parameters, [scene], occupancy.space(), which, marching).color
        for which in (mouth, torch.zeros_like(mouth))
        for scene in (one, other)
    ]
    changed = (images[0] - images[1]).abs().amax(1) > 1e-6
    assert 0 < int(changed.sum()) < len(changed) / 2
    assert torch.equal(images[2], images[3])


def test_the_prior_falls_with_the_distance_to_its_floor():
    prior = Prior(2.0, 3.0, 0.01)
    values = prior(torch.tensor([0.0, 0.005, 0.03, 1.0]))
    torch.testing.assert_close(values, torch.tensor([2.0, 1.5, -1.0, -1.0]))


def test_huge_log_densities_stay_finite(stage):
    field = stage[3]
    latent = torch.full((3, 4), 500.0, requires_grad=True)
    density = field.density(latent, torch.zeros(3))
    density.sum().backward()
    assert torch.isfinite(density).all()
    assert torch.isfinite(latent.grad).all()

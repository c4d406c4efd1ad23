"""Rendering without gradients: the kernel against `render_rays`, on random fields of many shapes."""

from typing import NamedTuple

import numpy as np
import pytest
import torch

from headbench.methods.insta import kernel
from headbench.methods.insta.avatar import Inference
from headbench.methods.insta.field import RadianceField
from headbench.methods.insta.marching import Space
from headbench.methods.insta.occupancy import Marching, PosedRays, camera_rays

from ..toy_clip import look_at
from .small import by_threads, make_stage

MODULE = kernel.load()
pytestmark = pytest.mark.skipif(
    MODULE is None, reason="INSTA's kernel is not installed: no C++ compiler was found"
)
INSTRUCTION_SETS = MODULE.instruction_sets() if MODULE else []
SHAPES = {
    "one feature": {"level_features": 1, "levels": 7},
    "two features": {"level_features": 2},
    "four features": {"level_features": 4, "hidden": 12, "latent": 5},
    "eight features": {"level_features": 8, "density_layers": 2, "color_layers": 3},
    "no conditions": {"conditions": 0},
    "coarse": {"base_resolution": 2, "finest_resolution": 2, "levels": 1},
    "the authors' warp": {"warp_variant": "official"},
    "published shapes": {
        "levels": 16,
        "level_features": 8,
        "log2_table": 12,
        "finest_resolution": 2048,
        "hidden": 64,
        "density_layers": 2,
        "color_layers": 3,
        "latent": 16,
        "conditions": 16,
        "prior_depth": 2.0,
    },
}


class Scene(NamedTuple):
    field: RadianceField
    parameters: dict[str, torch.Tensor]
    space: Space
    mouth: torch.Tensor
    scene: PosedRays
    step: float

    def seen(self, backend, *, stop=0.0, most=4):
        marching = Marching(self.step, most, stop)
        inference = Inference(self.field, self.parameters, self.space, self.mouth, marching, backend)
        return inference.render(self.scene)


def make(head, **more):
    config, surface, occupancy, field, mouth = make_stage(head, **more)
    rng = np.random.default_rng(5)
    occupancy.values = np.where(rng.random(len(occupancy.values)) < 0.6, np.float32(np.inf), np.float32(0))
    parameters = field.architecture.initial(0)
    parameters["table"] = parameters["table"] * 5_000  # features of a trained field, not of a blank one
    camera = look_at(np.array([0.05, 0.0, 0.45]), np.zeros(3), "c", 19, 23)
    rows, columns = np.divmod(np.arange(19 * 23), 19)
    condition = torch.randn(16, generator=torch.Generator().manual_seed(3))
    moved = surface.canonical + 0.004 * torch.sin(25 * surface.canonical)
    scene = PosedRays(surface.pose(moved), condition, camera_rays(camera, columns, rows, 0.5))
    return Scene(field, parameters, occupancy.space(), mouth, scene, config.step)


def check_same(ours, theirs):
    assert ours.samples == theirs.samples
    np.testing.assert_allclose(ours.color, theirs.color, atol=2e-5, rtol=0)
    np.testing.assert_allclose(ours.transmittance, theirs.transmittance, atol=2e-5, rtol=0)


@pytest.mark.parametrize("backend", INSTRUCTION_SETS)
@pytest.mark.parametrize("shape", SHAPES)
def test_the_kernel_sees_what_the_definition_sees(head, shape, backend):
    stage = make(head, **SHAPES[shape])
    theirs = stage.seen("reference")
    assert theirs.samples > 1_000
    assert theirs.transmittance.min() < 0.9
    assert theirs.color.std() > 0.02
    check_same(stage.seen(backend), theirs)


@pytest.mark.parametrize("most", [1, 5, 1000])
def test_rays_stop_where_the_definition_stops_them(head, most):
    stage = make(head, density_bias=5.0)
    theirs = stage.seen("reference", stop=0.3, most=most)
    assert most == 1000 or theirs.samples < stage.seen("reference", most=most).samples
    check_same(stage.seen("auto", stop=0.3, most=most), theirs)


def test_what_is_seen_does_not_depend_on_the_number_of_threads(head):
    stage = make(head)
    for one, other in zip(*by_threads(lambda: stage.seen("auto"))):
        np.testing.assert_array_equal(one, other)


def test_huge_densities_and_features_stay_finite(head):
    stage = make(head)
    parameters = {name: 100 * value for name, value in stage.parameters.items()}
    for backend in INSTRUCTION_SETS:
        seen = stage._replace(parameters=parameters).seen(backend)
        assert np.isfinite(seen.color).all()
        assert seen.transmittance.min() >= 0
        assert seen.color.max() <= 1 + 1e-5

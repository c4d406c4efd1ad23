"""Settings that fit the toy head and train in seconds, and what is made of them."""

from typing import NamedTuple

import numpy as np
import torch

from headbench.methods.insta.field import Architecture, Prior, RadianceField
from headbench.methods.insta.marching import CanonicalSurface, canonical_surface, mouth_triangles
from headbench.methods.insta.occupancy import Occupancy
from headbench.methods.insta.spec import InstaConfig
from headbench.methods.shared.surface_points import SubjectMesh
from headbench.methods.shared.threads import torch_threads

SMALL = {
    "levels": 4,
    "level_features": 2,
    "log2_table": 10,
    "base_resolution": 4,
    "finest_resolution": 24,
    "hidden": 8,
    "density_layers": 1,
    "color_layers": 1,
    "latent": 4,
    "conditions": 4,
    "density_bias": 3.0,
    "step": 0.004,
    "shell_outside": 0.02,
    "shell_inside": 0.01,
    "occupancy_resolution": 16,
    "occupancy_every": 4,
    "samples_per_iteration": 2_000,
    "first_rays": 128,
    "images_per_iteration": 2,
}


class Stage(NamedTuple):
    config: InstaConfig
    surface: CanonicalSurface
    occupancy: Occupancy
    field: RadianceField
    mouth: torch.Tensor


def make_stage(head, prior=None, **more):
    """A blank field about a head at rest, with all cells occupied."""
    config = InstaConfig(**{**SMALL, **more})
    mesh = SubjectMesh(head, np.zeros(head.shape_basis.shape[2]), np.zeros_like(head.template), "cpu")
    surface = canonical_surface(head, mesh, config)
    occupancy = Occupancy(surface, config)
    architecture = Architecture.of(config, head.expression_basis.shape[2])
    field = RadianceField(architecture, occupancy.box("cpu"), prior or Prior.of(config))
    return Stage(config, surface, occupancy, field, mouth_triangles(head))


def by_threads(function):
    """What a function gives with one thread and with two."""
    results = []
    for threads in (1, 2):
        with torch_threads(threads):
            results.append(function())
    return results

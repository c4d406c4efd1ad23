"""The head model's motion of the face, to which the deformation network is fitted.

The published network learns motion from landmarks and images of thousands of timesteps. A short clip contains few of
the directions of the expression code; its head model moves the face in all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from ...bench.contracts import FloatArray, IntArray
from ...bench.native.dispatch import to_device
from ...datasets.head.geometry import vertex_normals
from ..shared.optimisation import Optimiser
from ..shared.schedule import log_linear, torch_generator
from .config import GHAConfig
from .driving import TrainingScene, influences
from .networks import Mlp, Weights, encode

TURNING = ("left_eyeball", "right_eyeball")
"""Excluded regions: eyeballs rotate under the lids, and one displacement field cannot represent both."""

CODES, CODES_AT_ONCE = 512, 32
"""Number of stored expression codes, and of those in one draw."""

POINTS_AT_ONCE = 64

RATES = (5e-3, 5e-4)
"""First and last learning rate of the fit before the mesh phase."""

SHARE_TRACKED, AROUND_TRACKED = 0.5, 0.3
"""Fraction of the codes that are drawn around those of training timesteps, and their standard deviation; the others
are standard normal."""

STILL = 0.02
"""Motion in canonical units (2 mm of the published 0.1 m) below which relative errors get no larger weight."""


class TrackedMotion(NamedTuple):
    """Displacements of the head model's n vertices that only expression moves, by expression code."""

    encoded: Tensor  # (n, 27) positional encoding of the vertices at rest (`TrainingScene.rest`)
    codes: Tensor  # (K, E) expression codes
    moves: Tensor  # (K, n, 3) displacements from rest, canonical units
    weights: (
        Tensor  # (n,) inverse of each vertex's mean squared motion, so that lids count as much as the jaw
    )
    scale: float  # of the network's outputs

    @classmethod
    @torch.no_grad()
    def of(cls, scene: TrainingScene, config: GHAConfig) -> TrackedMotion:
        """Codes around those of the training timesteps and random ones, with their displacements of the head model."""
        rows = _rows(scene, config)
        tracked = torch.stack([signal.expression for signal in scene.signals])
        generator = torch_generator(scene.seed, "gha-motion-codes")
        codes = torch.randn(CODES, tracked.shape[1], generator=generator).to(tracked)
        known = round(SHARE_TRACKED * CODES)
        chosen = torch.randint(len(tracked), (known,), generator=generator).to(tracked.device)
        codes[:known] = tracked[chosen] + AROUND_TRACKED * codes[:known]
        rest = scene.rest[rows]
        driver = scene.driver
        parts = codes.split(CODES_AT_ONCE)
        moves = [driver.unposed(driver.rest_arguments(part))[:, rows] - rest for part in parts]
        every = torch.cat(moves)
        weights = 1 / (every.square().sum(2).mean(0) + STILL**2)
        return cls(encode(rest), codes, every, weights, config.displacement_scale)

    def error(self, network: Mlp, weights: Weights, generator: torch.Generator) -> Tensor:
        """Mean squared error of the network's displacements, relative to the vertices' motion, over a draw of codes and vertices."""
        device = self.codes.device
        rows = to_device(torch.randint(self.encoded.shape[0], (POINTS_AT_ONCE,), generator=generator), device)
        drawn = to_device(torch.randint(len(self.codes), (CODES_AT_ONCE,), generator=generator), device)
        found = self.scale * torch.tanh(network(weights, self.encoded[rows], self.codes[drawn]))
        squared = (found - self.moves[drawn[:, None], rows]).square().sum(2)
        return (self.weights[rows] * squared).mean()

    def fitted(self, network: Mlp, initial: Mapping[str, Tensor], steps: int, seed: int) -> dict[str, Tensor]:
        """The network's tensors after a number of steps on `error`."""

        def loss(weights: Weights, step: int) -> Tensor:
            return self.error(network, weights, torch_generator(seed, "gha-motion-start", step))

        return fitted(network, initial, loss, steps, RATES)


def _rows(scene: TrainingScene, config: GHAConfig) -> Tensor:
    """Vertices near the landmarks, on which only expression has an effect."""
    near, _ = influences(scene.rest, scene.rest[scene.landmark_rows], config.near_squared, config.far_squared)
    ruled = torch.zeros(len(scene.rest), dtype=torch.bool, device=scene.rest.device)
    ruled[near.rows[near.weights == 1]] = True
    for name in TURNING:
        if name in scene.clip.head.regions:
            ruled[torch.tensor(scene.clip.head.regions[name], device=ruled.device)] = False
    return ruled.nonzero().squeeze(1)


def fitted(
    network: Mlp,
    initial: Mapping[str, Tensor],
    loss: Callable[[Optimiser, int], Tensor],
    steps: int,
    rates: tuple[float, float],
) -> dict[str, Tensor]:
    """A network's tensors after a number of steps of Adam; ``initial`` may also have other tensors.

    ``loss`` takes the tensors and the number of the step, from 1; ``rates`` are the learning rate of the first half of
    the steps and the final one, log-linear over the second half.
    """
    names = list(network.shapes())
    weights = Optimiser(
        {name: nn.Parameter(initial[name].clone()) for name in names}, dict.fromkeys(names, rates[0])
    )
    for step in range(1, steps + 1):
        rate = log_linear(*rates, max(0.0, 2 * step / steps - 1))
        for name in names:
            weights.set_learning_rate(name, rate)
        loss(weights, step).backward()
        weights.step()
        weights.zero_grad()
    return {name: weights[name].detach() for name in names}


INNER_PARTS = ("teeth", "mouth_socket")
"""Regions behind the skin, which do not separate inside from outside."""

FACING, FORWARD = ("left_eyeball", "right_eyeball", "eye_region"), 0.3
"""Regions of which only forward-facing parts bound the head (minimum component of the normals along z): eyeballs fill
the lids' opening, but their backs, and the inner sides of lids, are behind the skin."""


class TangentDistance:
    """Distance to the nearest vertex, signed by the side of its tangent plane that a point is on; positive outside.

    Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992, section 3.3. At the border of a mesh
    (the neck's lower edge) its walls continue, as needed for a bust. ``faces`` are counter-clockwise seen from
    outside; (K,) ``keep`` are the vertices that count.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray, keep: IntArray):
        normals = vertex_normals(np.asarray(vertices, np.float64), np.asarray(faces))
        self._points, self._normals = np.asarray(vertices, np.float64)[keep], normals[keep]
        self._tree = cKDTree(self._points)

    def __call__(self, places: FloatArray) -> FloatArray:
        """(N,) distances of (N, 3) points."""
        distance, nearest = self._tree.query(places)
        side = np.einsum("ni,ni->n", places - self._points[nearest], self._normals[nearest])
        return np.where(side < 0, -distance, distance)


def outer_vertices(vertices: FloatArray, faces: IntArray, regions: Mapping[str, IntArray]) -> IntArray:
    """(K,) vertices of an unposed head that bound it: all except `INNER_PARTS` and the parts of `FACING` that do not
    face forward."""
    bounding = np.ones(len(vertices), bool)
    for name in INNER_PARTS:
        bounding[regions.get(name, [])] = False
    forward = vertex_normals(vertices, faces)[:, 2] > FORWARD
    for name in FACING:
        rows = np.asarray(regions.get(name, []), np.int64)
        bounding[rows] = forward[rows]
    return np.flatnonzero(bounding)

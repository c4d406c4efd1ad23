"""The mesh head that starts the Gaussians: a neutral surface from a network, moved and coloured by the controllers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..shared.binding import WorldSplats
from ..shared.networks import ENCODING_SIZE, encode
from .config import GHAConfig
from .controllers import Controllers, encode_pose
from .driving import Motion, Signal
from .landmarks import influences
from .networks import Mlp, Weights
from .tetrahedra import TetGrid, marching_tetrahedra

OFFSET_CELLS = 0.3
"""Reach of the grid's vertices in cells, before two tanh: published are 1/128 units in a grid of about 0.026."""

CHUNK = 65_536
"""Vertices of the grid evaluated at once where no gradient is asked for."""

DISC_RADIUS, DISC_THICKNESS, DISC_OPACITY = 0.6, 0.1, 0.95
"""Standard deviations of a vertex's disc in roots of its area, its thickness in radii, and its opacity."""


class Surface(NamedTuple):
    """The neutral head: (V, 3) canonical vertices, (V, F) features within (-1, 1), (M, 3) faces."""

    vertices: Tensor
    features: Tensor
    faces: Tensor


@dataclass(frozen=True)
class MeshHead:
    """The networks of the mesh stage. ``geometry`` gives distance, offset (3) and features of a place."""

    config: GHAConfig
    controllers: Controllers
    geometry: Mlp

    @classmethod
    def of(cls, config: GHAConfig, expression_size: int) -> MeshHead:
        """Networks of the configured widths."""
        outputs = 1 + 3 + config.features
        geometry = Mlp("geometry", ENCODING_SIZE, 0, config.geometry_hidden, outputs)
        return cls(config, Controllers.of(config, expression_size), geometry)

    @property
    def networks(self) -> tuple[Mlp, ...]:
        """All that the mesh stage trains."""
        return self.geometry, *self.controllers.of_mesh

    def distance(self, weights: Weights, places: Tensor) -> Tensor:
        """(N,) signed distance, within (-1, 1), positive outside, of (N, 3) canonical places."""
        return torch.tanh(self.geometry(weights, encode(places), outputs=1))[:, 0]

    def surface(self, weights: Weights, grid: TetGrid) -> Surface:
        """The neutral surface on a grid; differentiable in the geometry network.

        Only vertices of tetrahedra that the surface passes have an effect on it, so only they take part in what is
        differentiated; which ones those are is found without gradients.
        """
        with torch.no_grad():
            parts = [self.distance(weights, chunk) for chunk in grid.vertices.split(CHUNK)]
            inside = torch.cat(parts) < 0
            passed = grid.tets[(inside[grid.tets].sum(1) % 4) > 0]
            used, tets = torch.unique(passed, return_inverse=True)
        places = grid.vertices.index_select(0, used)
        values = torch.tanh(self.geometry(weights, encode(places)))
        reach = OFFSET_CELLS * grid.spacing
        crossings = marching_tetrahedra(values[:, 0], tets)
        vertices = crossings.interpolate(places + reach * torch.tanh(values[:, 1:4]))
        return Surface(vertices, crossings.interpolate(values[:, 4:]), crossings.faces)

    def landmark_offsets(self, weights: Weights, landmarks: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
        """(L,) distance and (L, 3) offset of the geometry network at landmarks."""
        values = torch.tanh(self.geometry(weights, encode(landmarks), outputs=4))
        return values[:, 0], OFFSET_CELLS * spacing * torch.tanh(values[:, 1:])

    def expressed(self, weights: Weights, points: Tensor, expression: Tensor) -> Tensor:
        """(N, 3) points moved by the expression network alone."""
        moves = torch.tanh(self.controllers.expression_deform(weights, encode(points), expression))
        return points + self.config.displacement_scale * moves

    def posed(
        self, weights: Weights, surface: Surface, landmarks: Tensor, signal: Signal, motion: Motion
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(V, 3) vertices in the world, (V, 3) colours, and the mean squared displacement.

        As published, the pose network sees the vertices that the expression network moved, and a sigmoid makes the
        colours. Without it (``residual``) the Gaussians, which have none, start with the mesh's colours.
        """
        c, nets = self.config, self.controllers
        near, far = influences(surface.vertices, landmarks, c.near_squared, c.far_squared)
        pose = encode_pose(motion.code)
        start = surface.vertices.index_select(0, near.rows)
        by_expression = torch.tanh(nets.expression_deform(weights, encode(start), signal.expression))
        step = c.displacement_scale * near.weights[:, None] * by_expression
        vertices = surface.vertices.index_add(0, near.rows, step)
        moved = vertices.index_select(0, far.rows)
        by_pose = torch.tanh(nets.pose_deform(weights, encode(moved), pose))
        vertices = vertices.index_add(0, far.rows, c.displacement_scale * far.weights[:, None] * by_pose)
        displaced = by_expression.square().sum(1).mean() if len(start) else by_expression.sum()
        displaced = displaced + (by_pose.square().sum(1).mean() if len(moved) else by_pose.sum())
        colors = nets.colors(weights, surface.features, (near, far), signal.expression, pose, channels=3)
        world = c.unit * vertices @ motion.rotation.t() + motion.translation
        return world, colors if c.residual else torch.sigmoid(colors), displaced


def vertex_discs(vertices: Tensor, faces: Tensor) -> WorldSplats:
    """A flat Gaussian for each vertex, in the surface and of its share of it: how the mesh is drawn.

    The published mesh stage draws triangles. Discs that touch are the same surface to our renderer, give gradients for
    colours, silhouette and positions alike, and are what the mesh is to become. Their size and direction follow the
    mesh without gradients of their own.

    Parameters
    ----------
    vertices : (V, 3) metres, differentiable.
    faces : (F, 3).
    """
    with torch.no_grad():
        corners = vertices.index_select(0, faces.reshape(-1)).view(-1, 3, 3)
        across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        shares = across[:, None].expand(-1, 3, -1).reshape(-1, 3)
        places = faces.reshape(-1)
        normals = torch.zeros_like(vertices).index_add(0, places, shares)
        area = vertices.new_zeros(len(vertices)).index_add(0, places, shares.norm(dim=1) / 6)
        radius = DISC_RADIUS * area.sqrt()
        scales = torch.stack([radius, radius, DISC_THICKNESS * radius], dim=1).clamp_min(1e-7)
        quats = _turn_z_to(normals)
    return WorldSplats(vertices, quats, scales)


def _turn_z_to(directions: Tensor) -> Tensor:
    """(N, 4) quaternions wxyz, of any length, that turn the z axis to (N, 3) directions, or to the opposite of those
    that point down: a disc has no sides, and half a turn would be undetermined."""
    unit = torch.nn.functional.normalize(directions, dim=1)
    x, y, z = torch.where(unit[:, 2:] < 0, -unit, unit).unbind(1)
    return torch.stack([1 + z, -y, x, torch.zeros_like(x)], dim=1)

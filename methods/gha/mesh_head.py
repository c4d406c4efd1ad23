"""The mesh head that initialises the Gaussians: a neutral surface from a network, moved and coloured by networks.

The published networks concatenate each point's inputs with a condition (expression, pose) that is the same for all points. Here the
condition's part of a layer is computed once and added as a bias, which gives the same result with less work.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import NamedTuple, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..ops.planes import ENCODING_SIZE, encode
from ..ops.splats import WorldSplats
from .driving import POSE_SIZE, HeadMotion, Influence, Signal, influences
from .spec import GHAConfig

SLOPE = 0.01
"""Slope of the leaky ReLU between layers."""


class Weights(Protocol):
    """Tensors by name: a dict or an `Optimiser`."""

    def __getitem__(self, name: str, /) -> Tensor: ...


@dataclass(frozen=True)
class Mlp:
    """An MLP with an input skip connection at layer ``len(widths) // 2``, concatenated after the hidden values."""

    name: str
    """Prefix of its tensors, ``NAME.weight_K`` (out, in) and ``NAME.bias_K`` (out,)."""
    point_inputs: int
    condition_inputs: int
    """Sizes of the two parts of the input, in this order."""
    hidden: tuple[int, ...]
    outputs: int
    """Widths of the layers."""
    zero_condition_weights: bool = False
    """Whether the condition's weights are initially zero. Conditions that do not occur in training then have no effect, instead
    of a random one."""
    zero_initialised: bool = False
    """Whether the last layer is initially zero."""

    @property
    def widths(self) -> tuple[int, ...]:
        """Width of the input and of each layer's output, as published."""
        return (self.point_inputs + self.condition_inputs, *self.hidden, self.outputs)

    @property
    def _skip_layer(self) -> int:
        """Index of the layer with the input skip connection; 0 for a single layer."""
        return len(self.widths) // 2 if self.hidden else 0

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of every tensor, by name."""
        widths = self.widths
        shapes: dict[str, tuple[int, ...]] = {}
        for layer in range(len(widths) - 1):
            extra = widths[0] if layer and layer == self._skip_layer else 0
            shapes[f"{self.name}.weight_{layer}"] = (widths[layer + 1], widths[layer] + extra)
            shapes[f"{self.name}.bias_{layer}"] = (widths[layer + 1],)
        return shapes

    def initial(self, generator: torch.Generator, device: str = "cpu") -> dict[str, Tensor]:
        """Weights and biases uniform within 1 / sqrt(inputs) of a layer."""
        tensors = uniform(self.shapes(), generator, device)
        if self.zero_condition_weights and self.condition_inputs:
            for layer in {0, self._skip_layer}:
                tensors[f"{self.name}.weight_{layer}"][:, -self.condition_inputs :] = 0
        if self.zero_initialised:
            for part in ("weight", "bias"):
                tensors[f"{self.name}.{part}_{len(self.hidden)}"].zero_()
        return tensors

    def __call__(
        self, weights: Weights, points: Tensor, condition: Tensor | None = None, outputs: int | None = None
    ) -> Tensor:
        """(N, outputs) of (N, point_inputs) and (condition_inputs,); (B, N, outputs) for (B, condition_inputs).

        ``outputs`` limits the result to the first outputs.
        """

        count, size = len(self.widths) - 1, self.point_inputs
        values = points
        for layer in range(count):
            weight, bias = weights[f"{self.name}.weight_{layer}"], weights[f"{self.name}.bias_{layer}"]
            if layer == count - 1 and outputs is not None:
                weight, bias = weight[:outputs], bias[:outputs]
            again = layer > 0 and layer == self._skip_layer
            if layer == 0 or again:
                start = self.widths[layer] if again else 0
                if condition is not None:
                    bias = F.linear(condition, weight[:, start + size :], bias).unsqueeze(-2)
                if again:
                    bias = F.linear(values, weight[:, :start]) + bias
                by_points = weight[:, start : start + size].t()
                values = torch.addmm(bias, points, by_points) if bias.ndim < 3 else points @ by_points + bias
            else:
                values = F.linear(values, weight, bias)
            if layer < count - 1:
                values = F.leaky_relu(values, SLOPE)
        return values


def uniform(
    shapes: Mapping[str, Sequence[int]], generator: torch.Generator, device: str
) -> dict[str, Tensor]:
    """Tensors uniform within 1 / sqrt(fan-in); a bias has the fan-in of the weight before it."""
    tensors, bound = {}, 0.0
    for name, shape in shapes.items():
        if len(shape) > 1:
            bound = math.prod(shape[1:]) ** -0.5
        values = (2 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1) * bound
        tensors[name] = values.to(device, torch.float32)
    return tensors


ATTRIBUTES = (3, 4, 1)
"""Columns of log-scale, quaternion and opacity logit."""
Influences = tuple[Influence, Influence]


@dataclass(frozen=True)
class Controllers:
    """The six networks.

    ``expression`` is the (E,) expression code throughout, ``pose`` the (54,) encoded head pose (`encode_pose`).
    """

    expression_color: Mlp
    pose_color: Mlp
    expression_deform: Mlp
    pose_deform: Mlp
    expression_attribute: Mlp
    pose_attribute: Mlp

    @classmethod
    def of(cls, config: GHAConfig, expression_size: int) -> Controllers:
        """Networks of the configured widths for E driving values."""
        pose = POSE_SIZE * ENCODING_SIZE // 3

        def pair(kind: str, inputs: int, outputs: int) -> Iterator[Mlp]:
            starts = (config.zero_initialised, config.zero_initialised and kind != "color")
            for name, size in ((f"expression_{kind}", expression_size), (f"pose_{kind}", pose)):
                yield Mlp(name, inputs, size, getattr(config, f"{name}_hidden"), outputs, *starts)

        return cls(
            *pair("color", config.features, config.channels),
            *pair("deform", ENCODING_SIZE, 3),
            *pair("attribute", config.features, sum(ATTRIBUTES)),
        )

    @property
    def of_mesh(self) -> tuple[Mlp, ...]:
        """The networks trained in the mesh phase."""
        return self.expression_color, self.pose_color, self.expression_deform, self.pose_deform

    @property
    def of_gaussians(self) -> tuple[Mlp, ...]:
        """All networks."""
        return *self.of_mesh, self.expression_attribute, self.pose_attribute

    def colors(
        self,
        weights: Weights,
        features: Tensor,
        influences: Influences,
        expression: Tensor,
        pose: Tensor,
        channels: int | None = None,
    ) -> Tensor:
        """(N, C) of (N, F) features within (-1, 1), without activation; the first ``channels`` if given."""
        networks = (self.expression_color, self.pose_color)
        return blended(networks, weights, features, influences, (expression, pose), channels=channels)

    def attributes(
        self, weights: Weights, features: Tensor, influences: Influences, expression: Tensor, pose: Tensor
    ) -> Tensor:
        """(N, 8) offsets of `ATTRIBUTES`, before their common factor."""
        networks = (self.expression_attribute, self.pose_attribute)
        return blended(networks, weights, features, influences, (expression, pose))

    def displacements(
        self, weights: Weights, encoded: Tensor, influences: Influences, expression: Tensor, pose: Tensor
    ) -> Tensor:
        """(N, 3) displacements of points, whose (N, 27) encoding is given, each within (-1, 1), before their factor."""
        networks = (self.expression_deform, self.pose_deform)
        return blended(networks, weights, encoded, influences, (expression, pose), tanh_output=True)


def encode_pose(code: Tensor) -> Tensor:
    """(54,) of the (6,) code of a head pose."""
    return encode(code[None])[0]


def blended(
    networks: tuple[Mlp, Mlp],
    weights: Weights,
    inputs: Tensor,
    influences: Influences,
    conditions: tuple[Tensor, Tensor],
    *,
    tanh_output: bool = False,
    channels: int | None = None,
) -> Tensor:
    """(N, C) sum of two networks' outputs, with tanh if ``tanh_output``, at (N, F) inputs."""
    parts = [
        network(weights, inputs.index_select(0, part.rows), condition, channels)
        for network, part, condition in zip(networks, influences, conditions)
    ]
    total = parts[0].new_zeros(len(inputs), parts[0].shape[1])
    for part, values in zip(influences, parts):
        values = torch.tanh(values) if tanh_output else values
        total = total.index_add(0, part.rows, part.weights[:, None] * values)
    return total


OFFSET_CELLS = 0.3
"""Maximum offset of the grid's vertices in cells, before two tanh; published: 1/128 units in a grid of about 0.026."""
CHUNK = 65_536
"""Vertices of the grid evaluated at once without gradients."""
DISC_RADIUS, DISC_THICKNESS, DISC_OPACITY = 0.6, 0.1, 0.95
"""Standard deviation of a vertex's disc relative to the square root of its area, thickness relative to the radius, and
opacity."""


class NeutralSurface(NamedTuple):
    """The neutral head: (V, 3) canonical vertices, (V, F) features within (-1, 1), (M, 3) faces."""

    vertices: Tensor
    features: Tensor
    faces: Tensor


@dataclass(frozen=True)
class MeshHead:
    """The networks of the mesh phase. ``geometry`` gives distance, offset (3) and features at a point."""

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
        """All networks trained in the mesh phase."""
        return self.geometry, *self.controllers.of_mesh

    def distance(self, weights: Weights, places: Tensor) -> Tensor:
        """(N,) signed distance, within (-1, 1), positive outside, at (N, 3) canonical points."""
        return torch.tanh(self.geometry(weights, encode(places), outputs=1))[:, 0]

    def surface(self, weights: Weights, grid: TetGrid) -> NeutralSurface:
        """The neutral surface on a grid; differentiable in the geometry network.

        Only vertices of tetrahedra that the surface crosses affect it. They are found without gradients, and only they
        are differentiated.
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
        return NeutralSurface(vertices, crossings.interpolate(values[:, 4:]), crossings.faces)

    def landmark_offsets(self, weights: Weights, landmarks: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
        """(L,) distance and (L, 3) offset of the geometry network at landmarks."""
        values = torch.tanh(self.geometry(weights, encode(landmarks), outputs=4))
        return values[:, 0], OFFSET_CELLS * spacing * torch.tanh(values[:, 1:])

    def expressed(self, weights: Weights, points: Tensor, expression: Tensor) -> Tensor:
        """(N, 3) points moved by the expression network alone."""
        moves = torch.tanh(self.controllers.expression_deform(weights, encode(points), expression))
        return points + self.config.displacement_scale * moves

    def posed(
        self, weights: Weights, surface: NeutralSurface, landmarks: Tensor, signal: Signal, motion: HeadMotion
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(V, 3) vertices in the world, (V, 3) colours, and the mean squared displacement.

        As published, the input of the pose network is the vertices moved by the expression network, and colours pass a
        sigmoid. Without it (``residual``) the Gaussians, which have none, start with the mesh's colours.
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
    """A flat Gaussian for each vertex, tangential to the surface and of its share of the area, to draw the mesh.

    The published mesh phase draws triangles. Touching discs give the same surface in this renderer, with gradients for
    colours, silhouette and positions, and are the initial Gaussians. Only positions, the (V, 3) vertices in metres,
    are differentiable; size and direction follow the mesh without gradients.
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
    """(N, 4) quaternions wxyz, of any length, that rotate the z axis to (N, 3) directions, or to the opposite of those
    that point down: a disc has no sides, and half a turn would be undetermined."""
    unit = torch.nn.functional.normalize(directions, dim=1)
    x, y, z = torch.where(unit[:, 2:] < 0, -unit, unit).unbind(1)
    return torch.stack([1 + z, -y, x, torch.zeros_like(x)], dim=1)


EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
"""Edges of a tetrahedron, by its corners."""


class TetGrid(NamedTuple):
    """Tetrahedra that fill a box."""

    vertices: Tensor  # (V, 3)
    tets: Tensor  # (T, 4) int64, of positive volume: det[v1 - v0, v2 - v0, v3 - v0] > 0
    spacing: float  # edge length of the cubic cells


class Crossings(NamedTuple):
    """The zero surface as points on edges, to which values at the grid's vertices can be interpolated."""

    ends: Tensor  # (K, 2) int64 vertices of the grid, one edge per surface vertex
    weights: Tensor  # (K,) weight of the second end, in [0, 1]; differentiable in the distances
    faces: Tensor  # (F, 3) int64, counter-clockwise seen from where the distance is positive

    def interpolate(self, values: Tensor) -> Tensor:
        """(K, C) values at the surface of (V, C) values at the grid's vertices."""
        first, second = values.index_select(0, self.ends[:, 0]), values.index_select(0, self.ends[:, 1])
        return first + self.weights[:, None] * (second - first)


def tet_grid(low: np.ndarray, high: np.ndarray, spacing: float, device: str = "cpu") -> TetGrid:
    """Fill a box with the tetrahedra of a body-centred cubic lattice.

    Inside, all are congruent, and their edges differ only by a factor of 1.15. At the box's sides pyramids are cut in
    two. The box is extended at ``high`` to whole cubic cells.
    """
    cells = np.maximum(np.ceil((np.asarray(high) - low) / spacing - 1e-9), 1).astype(np.int64)
    corner_shape, total = cells + 1, int(np.prod(cells + 1))
    corners = np.stack(np.meshgrid(*(np.arange(n) for n in corner_shape), indexing="ij"), -1).reshape(-1, 3)
    centers = np.stack(np.meshgrid(*(np.arange(n) for n in cells), indexing="ij"), -1).reshape(-1, 3)
    vertices = np.asarray(low) + spacing * np.concatenate([corners, centers + 0.5])

    def corner_index(place: np.ndarray) -> np.ndarray:
        return np.ravel_multi_index(place.T, tuple(corner_shape))

    def center_index(place: np.ndarray) -> np.ndarray:
        return total + np.ravel_multi_index(place.T, tuple(cells))

    tets = []
    for axis in range(3):
        step, u, v = np.roll(np.eye(3, dtype=np.int64), axis, axis=1)
        for side, outward in ((0, -step), (1, step)):
            # The face of each cell towards `outward`, its corners in a cycle.
            ways = [a * u + b * v for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
            cycle = [corner_index(centers + side * step + way) for way in ways]
            center_number = center_index(centers)
            inside = np.all((centers + outward >= 0) & (centers + outward < cells), 1)
            for corner in ((0, 1, 2), (0, 2, 3)):
                tets.append(np.stack([center_number, *(cycle[k] for k in corner)], 1)[~inside])
            if side == 1:
                other = center_index((centers + outward)[inside])
                for k in range(4):
                    pair = (center_number[inside], other, cycle[k][inside], cycle[(k + 1) % 4][inside])
                    tets.append(np.stack(pair, 1))
    joined = np.concatenate(tets)
    edges = vertices[joined[:, 1:]] - vertices[joined[:, :1]]
    turned = np.linalg.det(edges) < 0
    joined[turned, 2:] = joined[turned, :1:-1]
    return TetGrid(
        torch.as_tensor(vertices, dtype=torch.float32, device=device),
        torch.as_tensor(joined, device=device),
        float(spacing),
    )


def spacing_for(low: np.ndarray, high: np.ndarray, count: int) -> float:
    """Spacing at which a box has about ``count`` vertices, two per cell."""
    return float((2 * np.prod(np.asarray(high, np.float64) - low) / count) ** (1 / 3))


def marching_tetrahedra(distance: Tensor, tets: Tensor) -> Crossings:
    """Zero surface of a (V,) distance, positive outside, at the vertices of `TetGrid`, interpolated linearly.

    Empty without a change of sign. A closed surface inside the grid is watertight: faces share the vertices of common
    edges.
    """
    inside = distance.detach() < 0
    codes = (inside[tets].to(torch.int64) << torch.arange(4, device=tets.device)).sum(1)
    table, counts, ends_of_edges = _cases(tets.device)
    crossed = counts[codes] > 0
    tets, codes = tets[crossed], codes[crossed]
    pairs = tets[:, ends_of_edges].sort(dim=2).values  # (T, 6, 2)
    keys = pairs[..., 0] * len(distance) + pairs[..., 1]
    wanted = []
    for face in range(2):
        rows = (counts[codes] > face).nonzero().squeeze(1)
        wanted.append(keys[rows].gather(1, table[codes[rows], face]))
    edges, faces = torch.unique(torch.cat(wanted), return_inverse=True)
    ends = torch.stack([edges // len(distance), edges % len(distance)], dim=1)
    first, second = distance.index_select(0, ends[:, 0]), distance.index_select(0, ends[:, 1])
    return Crossings(ends, first / (first - second), faces)


@cache
def _cases(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """(16, 2, 3) edges of the triangles of each case, (16,) their number, and `EDGES`; bit k says that corner k is inside.

    Each polygon connects the middles of its edges in a tetrahedron of positive volume, ordered so that its normal
    points away from the corners inside.
    """
    place = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float64)
    table, counts = np.zeros((16, 2, 3), np.int64), np.zeros(16, np.int64)
    for case in range(1, 15):
        inside = [k for k in range(4) if case >> k & 1]
        outside = [k for k in range(4) if k not in inside]
        # Around the polygon, neighbours share a face of the tetrahedron.
        pairs = list(product(inside, outside))
        if len(pairs) == 4:
            pairs = [pairs[0], pairs[1], pairs[3], pairs[2]]
        ring = [EDGES.index((min(pair), max(pair))) for pair in pairs]
        middle = [0.5 * (place[EDGES[edge][0]] + place[EDGES[edge][1]]) for edge in ring]
        normal = np.cross(middle[1] - middle[0], middle[2] - middle[0])
        if normal @ (place[outside].mean(0) - place[inside].mean(0)) < 0:
            ring.reverse()
        counts[case] = len(ring) - 2
        for face in range(counts[case]):
            table[case, face] = ring[0], ring[face + 1], ring[face + 2]
    tables = torch.from_numpy(table), torch.from_numpy(counts), torch.tensor(EDGES)
    return tables[0].to(device), tables[1].to(device), tables[2].to(device)

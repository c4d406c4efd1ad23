"""The mesh phase: training of a neutral surface, its motion and its colours on images, silhouettes and landmarks.

The deformation network is fitted to the head model's motion of the face: the published network learns motion from landmarks and images
of thousands of timesteps. A short clip contains few of the directions of the expression code; its head model moves the face in all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from torch import Tensor, nn

from ...bench.contracts import FloatArray, FrameKey, IntArray
from ...bench.native.dispatch import to_device
from ...datasets.head.geometry import vertex_normals
from ..shared.loop import CHECKPOINT, Fit, recomposited, train
from ..shared.optimisation import Optimiser, OptimiserState
from ..shared.rendering import View, rasterize_view, view_of
from ..shared.schedule import ShuffledEpochs, Timeline, log_linear, torch_generator
from ..shared.tensor_files import load_checkpoint, save_checkpoint
from .driving import TrainingScene, influences
from .mesh_head import (
    DISC_OPACITY,
    MeshHead,
    Mlp,
    TetGrid,
    Weights,
    encode,
    spacing_for,
    tet_grid,
    vertex_discs,
)
from .spec import GHAConfig

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
        displacement = self.scale * torch.tanh(network(weights, self.encoded[rows], self.codes[drawn]))
        squared = (displacement - self.moves[drawn[:, None], rows]).square().sum(2)
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


COLOR, SILHOUETTE, DISPLACEMENT, DISTANCE, SMOOTHNESS = 0.1, 0.1, 0.01, 0.1, 100.0
"""Published weights of the losses, except that of the landmarks, which is a setting."""
MARGIN = 0.3
"""Margin of the grid around the neutral mesh, canonical units."""
SPHERE_BATCH, SPHERE_RATES = 8_192, (1e-3, 1e-3)
"""Points in a step of the fit to a sphere, and its first and last learning rate, as published."""
MESH_PLACES, MESH_BATCH, MESH_RATES = 100_000, 2_048, (5e-3, 5e-4)
"""Number of points with known distance to the tracked mesh, points in a step of the fit to it, and its learning
rates."""
NEAR, FAR = 0.1, 0.3
"""Canonical units: distance of most of those points from the mesh, and their maximum distance."""


class MeshTraining(OptimiserState):
    """A `Trainable`; one iteration uses several views of one timestep.

    ``fitted``: whether to fit the initial surface to the sphere or the tracked mesh; False for a resumed run.
    """

    def __init__(self, scene: TrainingScene, head: MeshHead, *, fitted: bool):
        self._scene, self._head, self._config = scene, head, head.config
        generator = torch_generator(scene.seed, "gha-mesh")
        initial: dict[str, Tensor] = {}
        for network in head.networks:
            initial |= network.initial(generator, scene.device)
        self.grid = grid_about(scene.rest, self._config, scene.device)
        taught = self._config.motion_steps or self._config.motion_weight
        self._motion = TrackedMotion.of(scene, self._config) if taught else None
        if fitted:
            initial |= self._fitted(initial)
            if self._motion is not None:
                network = head.controllers.expression_deform
                initial |= self._motion.fitted(network, initial, self._config.motion_steps, scene.seed)
        rates = dict.fromkeys(initial, self._config.mesh_lr) | {"landmarks": self._config.landmark_lr}
        rows = torch.as_tensor(scene.landmark_rows, device=scene.device)
        initial["landmarks"] = scene.rest.index_select(0, rows)
        self.optimiser = Optimiser({name: nn.Parameter(value) for name, value in initial.items()}, rates)
        self._tracked_landmarks = scene.driver.unposed(scene.tracked).index_select(1, rows)
        self._cameras_of: dict[int, list[FrameKey]] = {}
        for key in scene.keys:
            self._cameras_of.setdefault(key.timestep, []).append(key)
        self._note = ""

    def begin(self, timeline: Timeline) -> None:
        """This phase has no schedules."""

    def loss(self, iteration: int, index: int) -> Tensor:
        """Loss of some views of the timestep that training image ``index`` belongs to."""
        scene, head, weights = self._scene, self._head, self.optimiser
        key = scene.keys[index]
        row = scene.row[key.timestep]
        signal = scene.signals[row]
        motion = scene.driver.motion(signal)
        landmarks = weights["landmarks"]
        surface = head.surface(weights, self.grid)
        distance, offset = head.landmark_offsets(weights, landmarks, self.grid.spacing)
        rows = self._timesteps(iteration, row)
        off = sum(self._landmark_error(landmarks, offset, other) for other in rows)
        loss = self._config.landmark_weight * off / len(rows)
        loss = loss + DISTANCE * distance.abs().mean()
        if self._motion is not None and self._config.motion_weight:
            network, generator = (
                head.controllers.expression_deform,
                torch_generator(scene.seed, "gha-motion", iteration),
            )
            loss = loss + self._config.motion_weight * self._motion.error(network, weights, generator)
        if not len(surface.faces):
            return loss
        vertices, colors, displaced = head.posed(weights, surface, landmarks, signal, motion)
        loss = loss + DISPLACEMENT * displaced + SMOOTHNESS * roughness(vertices, surface.faces)
        discs = vertex_discs(vertices, surface.faces)
        opacities = vertices.new_full((len(vertices),), DISC_OPACITY)
        chosen = self._views(iteration, key)
        for seen in chosen:
            view, target, mask, background = self._target(seen)
            rendering = rasterize_view(discs, opacities, colors, view, background)
            part = COLOR * (rendering.image - target).abs().mean()
            if mask is not None:
                part = part + SILHOUETTE * (1 - soft_overlap(rendering.alpha, mask))
            loss = loss + part / len(chosen)
        self._note = f"mesh of {len(vertices)} vertices"
        return loss

    def after_backward(self, iteration: int) -> None:
        """Nothing to do."""

    def note(self) -> str:
        """Number of vertices."""
        return self._note

    def _landmark_error(self, landmarks: Tensor, offset: Tensor, row: int) -> Tensor:
        """Mean squared component of the difference between moved and tracked landmarks of a timestep."""
        signal = self._scene.signals[row]
        expressed = self._head.expressed(self.optimiser, landmarks, signal.expression) + offset
        return F.mse_loss(expressed, self._tracked_landmarks[row])

    def _timesteps(self, iteration: int, row: int) -> list[int]:
        """The timestep of the images and others, drawn without replacement."""
        generator = torch_generator(self._scene.seed, "gha-landmarks", iteration)
        order = torch.randperm(len(self._scene.timesteps), generator=generator).tolist()
        others = [other for other in order if other != row]
        return [row, *others[: self._config.landmark_timesteps - 1]]

    def _views(self, iteration: int, key: FrameKey) -> list[FrameKey]:
        """The given frame and others of its timestep, drawn without replacement."""
        others = [other for other in self._cameras_of[key.timestep] if other != key]
        generator = torch_generator(self._scene.seed, "gha-views", iteration)
        order = torch.randperm(len(others), generator=generator).tolist()
        return [key, *(others[place] for place in order[: self._config.mesh_views - 1])]

    def _target(self, key: FrameKey) -> tuple[View, Tensor, Tensor | None, Tensor]:
        """View, (H, W, 3) image and (H, W) coverage at the phase's size, and the (3,) background of the image.

        The background is black, as published, if there is a mask to remove the recorded one.
        """
        scene = self._scene
        camera = scene.clip.cameras[key.camera]
        factor = min(1.0, self._config.mesh_size / max(camera.width, camera.height))
        width, height = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
        view = view_of(camera.resized(width, height), scene.device)
        image = _reduced(scene.clip.image(key), height, width, scene.device)
        mask = scene.clip.mask(key)
        if mask is None:
            return view, image, None, scene.background
        coverage = _reduced(mask[..., None], height, width, scene.device)
        black = torch.zeros_like(scene.background)
        return view, recomposited(image, coverage, scene.background, black), coverage[..., 0], black

    def _fitted(self, initial: dict[str, Tensor]) -> dict[str, Tensor]:
        """The geometry network fitted to the distances of the initial surface."""
        head, config, seed = self._head, self._config, self._scene.seed
        low, high = self.grid.vertices.amin(0), self.grid.vertices.amax(0)

        def to_sphere(weights: Optimiser, step: int) -> Tensor:
            generator = torch_generator(seed, "gha-start", step)
            places = low + (high - low) * torch.rand(SPHERE_BATCH, 3, generator=generator).to(low)
            target = torch.linalg.vector_norm(places, dim=1) - 1
            return F.mse_loss(head.distance(weights, places), target)

        def to_mesh(weights: Optimiser, step: int) -> Tensor:
            generator = torch_generator(seed, "gha-start", step)
            rows = torch.randint(MESH_PLACES, (MESH_BATCH,), generator=generator).to(low.device)
            return F.l1_loss(head.distance(weights, places[rows]), distances[rows])

        if config.start == "sphere":
            return fitted(head.geometry, initial, to_sphere, config.start_steps, SPHERE_RATES)
        places, distances = _distances(self._scene, low, high)
        return fitted(head.geometry, initial, to_mesh, config.start_steps, MESH_RATES)


def grid_about(neutral: Tensor, config: GHAConfig, device: str, *, finer: int = 1) -> TetGrid:
    """A grid around the (V, 3) neutral mesh, ``finer`` times as fine as configured."""
    points = neutral.detach().cpu().double().numpy()
    low, high = points.min(0) - MARGIN, points.max(0) + MARGIN
    return tet_grid(low, high, spacing_for(low, high, config.grid_vertices) / finer, device)


def roughness(vertices: Tensor, faces: Tensor) -> Tensor:
    """Mean squared component of the uniform Laplacian, the offset of vertices from the mean of their neighbours."""
    # Each edge of a closed surface belongs to two triangles in opposite directions, so one direction is enough.
    start, stop = faces.t().reshape(-1), faces.roll(-1, 1).t().reshape(-1)
    sums = torch.zeros_like(vertices).index_add(0, start, vertices.index_select(0, stop))
    counts = vertices.new_zeros(len(vertices)).index_add(0, start, vertices.new_ones(len(start)))
    return (sums / counts.clamp_min(1)[:, None] - vertices).square().mean()


def soft_overlap(coverage: Tensor, mask: Tensor) -> Tensor:
    """Intersection over union of two (H, W) coverages in [0, 1]; 1 where both are empty."""
    product = coverage * mask
    intersection, union = product.sum(), (coverage + mask - product).sum()
    return (intersection + 1e-6) / (union + 1e-6)


def _reduced(image: np.ndarray, height: int, width: int, device: str) -> Tensor:
    """(height, width, C) area means in [0, 1] of an 8-bit image."""
    values = to_device(torch.from_numpy(np.array(image, copy=True)), device).float().div_(255)
    if values.shape[:2] == (height, width):
        return values
    planes = F.interpolate(values.permute(2, 0, 1)[None], (height, width), mode="area")
    return planes[0].permute(1, 2, 0).contiguous()


def _distances(scene: TrainingScene, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """(P, 3) points, most of them near the tracked mesh at rest, and their (P,) distances to it, up to `FAR`."""
    head, vertices = scene.clip.head, scene.rest.cpu().double().numpy()
    bounding = outer_vertices(vertices, np.asarray(head.faces), head.regions)
    distance = TangentDistance(vertices, np.asarray(head.faces), bounding)
    generator = torch_generator(scene.seed, "gha-start")
    anywhere = low + (high - low) * torch.rand(MESH_PLACES // 4, 3, generator=generator).to(low)
    count = MESH_PLACES - len(anywhere)
    # Points are denser near the surface, where the distance must be accurate.
    rows = torch.as_tensor(bounding)[torch.randint(len(bounding), (count,), generator=generator)]
    away = torch.randn(count, 3, generator=generator) * torch.rand(count, 1, generator=generator)
    places = torch.cat([scene.rest[rows.to(low.device)] + NEAR * away.to(low), anywhere])
    distances = distance(places.cpu().double().numpy())
    return places, torch.as_tensor(distances).to(places).clamp(-FAR, FAR)


FOLDER, RESULT_FILE = "mesh", "mesh.safetensors"


class MeshResult(NamedTuple):
    """Result of the mesh phase: its tensors by name, iterations done, and seconds spent, including those of its start."""

    tensors: Mapping[str, Tensor]
    iterations: int
    seconds: float


def mesh_phase(scene: TrainingScene, head: MeshHead, fit: Fit) -> MeshResult:
    """Train the mesh head, continue its training, or read what a finished one left under ``fit.out``."""
    folder = fit.out / FOLDER
    stored = load_checkpoint(folder / RESULT_FILE, fit.run, scene.device)
    if stored is None:
        stored = _trained(scene, head, replace(fit, out=folder))
        save_checkpoint(folder / RESULT_FILE, fit.run, stored)
        (folder / CHECKPOINT).unlink(missing_ok=True)
    return MeshResult(stored["tensors"], stored["iterations"], stored["seconds"])


def remove_mesh_phase(out: Path) -> None:
    """Remove the files of the mesh phase, which the avatar no longer needs."""
    folder = out / FOLDER
    for name in (RESULT_FILE, CHECKPOINT):
        (folder / name).unlink(missing_ok=True)
    if folder.exists():
        folder.rmdir()


def _trained(scene: TrainingScene, head: MeshHead, fit: Fit) -> dict[str, Any]:
    training = MeshTraining(scene, head, fitted=not (fit.out / CHECKPOINT).exists())
    config = head.config
    outcome = train(
        training,
        ShuffledEpochs(len(scene.keys), scene.seed),
        fit,
        published_length=max(1, round(config.schedule_length * config.mesh_fraction)),
        checkpoint_every_s=config.checkpoint_every_s,
    )
    names = [*(name for network in head.networks for name in network.shapes()), "landmarks"]
    tensors = {name: training.optimiser[name].detach() for name in names}
    return {"tensors": tensors, "iterations": outcome.iterations, "seconds": outcome.seconds}

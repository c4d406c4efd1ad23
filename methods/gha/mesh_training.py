"""The mesh stage: a neutral surface, its motion and its colours from images, silhouettes and tracked landmarks."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...bench.contracts import FrameKey
from ..seeds import torch_generator
from ..splats import rasterize
from ..training.optimiser import Optimiser
from ..training.schedule import Timeline
from ..views import View, view_of
from .config import GHAConfig
from .mesh_head import DISC_OPACITY, MeshHead, vertex_discs
from .scene import Scene
from .signed_distance import INNER_PARTS, TangentDistance
from .tetrahedra import TetGrid, spacing_for, tet_grid

COLOR, SILHOUETTE, DISPLACEMENT, DISTANCE, SMOOTHNESS = 0.1, 0.1, 0.01, 0.1, 100.0
"""Published weights of the losses, but for that of the landmarks, which is a setting."""

MARGIN = 0.3
"""Canonical units around the neutral mesh that the grid covers."""

START_BATCH, START_RATE = 8_192, 1e-3


class MeshTraining:
    """A `Trainable`: one iteration sees several views of one timestep.

    Parameters
    ----------
    fitted : whether the start is still to be fitted to the sphere or the tracked mesh; a resumed run need not.
    """

    def __init__(self, scene: Scene, head: MeshHead, *, fitted: bool):
        self._scene, self._head, self._config = scene, head, head.config
        generator = torch_generator(scene.seed, "gha-mesh")
        initial: dict[str, Tensor] = {}
        for network in head.networks:
            initial |= network.initial(generator, scene.device)
        neutral = scene.driver.canonical(scene.driver.neutral)
        self.grid = grid_about(neutral, self._config, scene.device)
        if fitted:
            initial |= self._fitted(initial, neutral)
        rates = dict.fromkeys(initial, self._config.mesh_lr) | {"landmarks": self._config.landmark_lr}
        rows = torch.as_tensor(scene.landmark_rows, device=scene.device)
        initial["landmarks"] = neutral.index_select(0, rows)
        self._optimiser = Optimiser({name: nn.Parameter(value) for name, value in initial.items()}, rates)
        self._tracked_landmarks = scene.driver.unposed(scene.tracked).index_select(1, rows)
        self._cameras_of: dict[int, list[FrameKey]] = {}
        for key in scene.keys:
            self._cameras_of.setdefault(key.timestep, []).append(key)
        self._note = ""

    @property
    def optimiser(self) -> Optimiser:
        """Adam over networks and landmarks."""
        return self._optimiser

    def begin(self, timeline: Timeline) -> None:
        """Nothing changes in the course of this stage."""

    def loss(self, iteration: int, index: int) -> Tensor:
        """Loss of some views of the timestep that training image ``index`` belongs to."""
        scene, head, weights = self._scene, self._head, self._optimiser
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
        if not len(surface.faces):
            return loss
        vertices, colors, displaced = head.posed(weights, surface, landmarks, signal, motion)
        loss = loss + DISPLACEMENT * displaced + SMOOTHNESS * roughness(vertices, surface.faces)
        discs = vertex_discs(vertices, surface.faces)
        opacities = vertices.new_full((len(vertices),), DISC_OPACITY)
        chosen = self._views(iteration, key)
        for seen in chosen:
            view, truth, mask = self._target(seen)
            rendering = rasterize(
                *(discs.means, discs.quats, discs.scales, opacities, colors),
                *(view.world_to_camera, view.K, view.camera.width, view.camera.height),
                background=scene.background,
                check_finite=False,
            )
            part = COLOR * (rendering.image - truth).abs().mean()
            if mask is not None:
                part = part + SILHOUETTE * (1 - soft_overlap(rendering.alpha, mask))
            loss = loss + part / len(chosen)
        self._note = f"mesh of {len(vertices)} vertices"
        return loss

    def after_backward(self, iteration: int) -> None:
        """Nothing to do."""

    def state(self) -> dict[str, Any]:
        """Parameters and moments."""
        return {"optimiser": self._optimiser.state()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` gave."""
        self._optimiser.load_state(state["optimiser"])

    def note(self) -> str:
        """Number of vertices."""
        return self._note

    def _landmark_error(self, landmarks: Tensor, offset: Tensor, row: int) -> Tensor:
        """Mean squared component of what moved landmarks lack to the tracked ones of a timestep."""
        signal = self._scene.signals[row]
        expressed = self._head.expressed(self._optimiser, landmarks, signal.expression) + offset
        return F.mse_loss(expressed, self._tracked_landmarks[row])

    def _timesteps(self, iteration: int, row: int) -> list[int]:
        """The timestep of the images, and others, drawn without replacement."""
        generator = torch_generator(self._scene.seed, "gha-landmarks", iteration)
        order = torch.randperm(len(self._scene.timesteps), generator=generator).tolist()
        others = [other for other in order if other != row]
        return [row, *others[: self._config.landmark_timesteps - 1]]

    def _views(self, iteration: int, key: FrameKey) -> list[FrameKey]:
        """The frame asked for, and others of its timestep, drawn without replacement."""
        others = [other for other in self._cameras_of[key.timestep] if other != key]
        generator = torch_generator(self._scene.seed, "gha-views", iteration)
        order = torch.randperm(len(others), generator=generator).tolist()
        return [key, *(others[place] for place in order[: self._config.mesh_views - 1])]

    def _target(self, key: FrameKey) -> tuple[View, Tensor, Tensor | None]:
        """View, (H, W, 3) image and (H, W) coverage at the stage's size."""
        scene = self._scene
        camera = scene.clip.cameras[key.camera]
        factor = min(1.0, self._config.mesh_size / max(camera.width, camera.height))
        width, height = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
        view = view_of(camera.resized(width, height), scene.device)
        mask = scene.clip.mask(key)
        return (
            view,
            _reduced(scene.clip.image(key), height, width, scene.device),
            None if mask is None else _reduced(mask[..., None], height, width, scene.device)[..., 0],
        )

    def _fitted(self, initial: dict[str, Tensor], neutral: Tensor) -> dict[str, Tensor]:
        """The geometry network after it learnt the distances of the start."""
        head, config, device = self._head, self._config, self._scene.device
        names = list(head.geometry.shapes())
        weights = Optimiser(
            {name: nn.Parameter(initial[name].clone()) for name in names}, dict.fromkeys(names, START_RATE)
        )
        low, high = self.grid.vertices.amin(0), self.grid.vertices.amax(0)
        known = _tracked_distance(self._scene, neutral) if config.start == "mesh" else None
        for step in range(1, config.start_steps + 1):
            generator = torch_generator(self._scene.seed, "gha-start", step)
            places = low + (high - low) * torch.rand(START_BATCH, 3, generator=generator).to(device)
            if known is None:
                target = torch.linalg.vector_norm(places, dim=1) - 1
            else:
                # Half of the places close to the surface, where the distance must be right.
                rows = torch.randint(len(neutral), (START_BATCH // 2,), generator=generator).to(device)
                noise = 0.1 * torch.randn(START_BATCH // 2, 3, generator=generator).to(device)
                places = torch.cat([neutral[rows] + noise, places[: START_BATCH // 2]])
                target = torch.as_tensor(known(places.cpu().double().numpy())).to(places).clamp(-0.9, 0.9)
            F.mse_loss(head.distance(weights, places), target).backward()
            weights.step()
            weights.zero_grad()
        return {name: weights[name].detach() for name in names}


def grid_about(neutral: Tensor, config: GHAConfig, device: str, *, finer: int = 1) -> TetGrid:
    """A grid about the (V, 3) neutral mesh, ``finer`` times as fine as configured."""
    points = neutral.detach().cpu().double().numpy()
    low, high = points.min(0) - MARGIN, points.max(0) + MARGIN
    return tet_grid(low, high, spacing_for(low, high, config.grid_vertices) / finer, device)


def roughness(vertices: Tensor, faces: Tensor) -> Tensor:
    """Mean squared component of the uniform Laplacian: how far vertices are from the mean of their neighbours."""
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    # Along each edge of a closed surface two triangles run, in opposite directions, so one direction will do.
    start, stop = ends.unbind(1)
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
    values = torch.from_numpy(np.array(image, copy=True)).to(device).float().div_(255)
    if values.shape[:2] == (height, width):
        return values
    planes = F.interpolate(values.permute(2, 0, 1)[None], (height, width), mode="area")
    return planes[0].permute(1, 2, 0).contiguous()


def _tracked_distance(scene: Scene, neutral: Tensor) -> TangentDistance:
    head = scene.clip.head
    inner = [head.regions[name] for name in INNER_PARTS if name in head.regions]
    keep = np.setdiff1d(np.arange(len(neutral)), np.concatenate([*inner, np.empty(0, np.int64)]))
    return TangentDistance(neutral.cpu().double().numpy(), np.asarray(head.faces), keep)

"""The mesh stage as a step of its own: its result is kept until the avatar is whole, so that a kill loses none of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from ...bench.contracts import Budget, Progress
from ..shared.checkpoint import load_checkpoint, save_checkpoint
from ..shared.loop import CHECKPOINT, train
from ..shared.schedule import ShuffledEpochs
from .mesh_head import MeshHead
from .mesh_training import MeshTraining, Scene

FOLDER, RESULT_FILE = "mesh", "mesh.safetensors"


class MeshResult(NamedTuple):
    """What the mesh stage leaves: its tensors by name, iterations done, and seconds spent, those of its start included."""

    tensors: Mapping[str, Tensor]
    iterations: int
    seconds: float


def mesh_stage(
    scene: Scene,
    head: MeshHead,
    budget: Budget,
    out: Path,
    run: str,
    progress: Progress,
    clock: Callable[[], float] = time.monotonic,
) -> MeshResult:
    """Train the mesh head, continue its training, or read what a finished one left under ``out``."""
    folder = out / FOLDER
    stored = load_checkpoint(folder / RESULT_FILE, run, scene.device)
    if stored is None:
        stored = _trained(scene, head, budget, folder, run, progress, clock)
        save_checkpoint(folder / RESULT_FILE, run, stored)
        (folder / CHECKPOINT).unlink(missing_ok=True)
    return MeshResult(stored["tensors"], stored["iterations"], stored["seconds"])


def remove_mesh_stage(out: Path) -> None:
    """Take away what the mesh stage left; the avatar no longer needs it."""
    folder = out / FOLDER
    for name in (RESULT_FILE, CHECKPOINT):
        (folder / name).unlink(missing_ok=True)
    if folder.exists():
        folder.rmdir()


def _trained(
    scene: Scene,
    head: MeshHead,
    budget: Budget,
    folder: Path,
    run: str,
    progress: Progress,
    clock: Callable[[], float],
) -> dict[str, Any]:
    began = clock()
    training = MeshTraining(scene, head, fitted=not (folder / CHECKPOINT).exists())
    config = head.config
    outcome = train(
        training,
        ShuffledEpochs(len(scene.keys), scene.seed),
        published_length=max(1, round(config.schedule_length * config.mesh_fraction)),
        budget=budget,
        folder=folder,
        run=run,
        device=scene.device,
        progress=progress,
        checkpoint_every_s=config.checkpoint_every_s,
        clock=clock,
        began=began,
    )
    names = [*(name for network in head.networks for name in network.shapes()), "landmarks"]
    tensors = {name: training.optimiser[name].detach() for name in names}
    return {"tensors": tensors, "iterations": outcome.iterations, "seconds": outcome.seconds}

"""``headbench bench head``: time of a forward pass, beside smplx in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ....bench.contracts import Progress
from ....bench.errors import UnavailableError
from ....bench.specs import Findings
from ....datasets.head.model import HeadModel
from .sized import FLAME_SIZES, sized_head
from .smplx_flame import smplx_forward

BATCHES = (1, 16)
THREADS = 2
FLOORS = {1: 3.0, 16: 2.0}
"""Times as fast as smplx's FLAME, by batch size, that the fast path is held to."""

CLOSE = 1e-5
"""Metres; the largest difference between any two ways."""

_ROUNDS, _QUICK_ROUNDS = 200, 40
OURS = "fast path, identity blended once"


def measure(quick: bool, progress: Progress) -> Findings:
    """Time all ways in turn, so that a busy machine slows them alike; the least of many runs counts.

    Passed where they agree and the fast path is as much faster than smplx's FLAME as `FLOORS` say.
    """
    head = sized_head("2023", *FLAME_SIZES)
    model = HeadModel(head)
    rounds = _QUICK_ROUNDS if quick else _ROUNDS
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    passed = True
    with torch.no_grad(), _threads(THREADS):
        for batch in BATCHES:
            shape, pose = _arguments(model, batch)
            ways = _ways(model, shape, pose, notes)
            vertices = {name: way() for name, way in ways.items()}
            difference = max(float((value - vertices[OURS]).abs().max()) for value in vertices.values())
            seconds = _least(ways, rounds, partial(progress, total=rounds, note=f"batch {batch}"))
            factor = seconds.get("smplx FLAME", np.nan) / seconds[OURS]
            passed &= difference < CLOSE and not factor < FLOORS[batch]
            for name, value in seconds.items():
                share = value / seconds[OURS]
                rows.append(
                    {"batch": batch, "way": name, "ms_per_frame": 1e3 * value / batch, "ratio": share}
                )
            rows[-1]["largest_difference_m"] = difference
    sizes = f"{model.vertex_count} vertices, {FLAME_SIZES[0]} + {FLAME_SIZES[1]} directions"
    lines = [
        f"Forward pass without gradients, {sizes}, float32, {THREADS} threads; least of {rounds} runs by the clock.",
        f"{'batch':>5}  {'way':36}  {'ms per frame':>12}  {'times ours':>10}",
        *(f"{r['batch']:>5}  {r['way']:36}  {r['ms_per_frame']:>12.3f}  {r['ratio']:>10.2f}" for r in rows),
        *sorted({*notes}),
    ]
    return Findings("\n".join(lines), {"rows": rows, "notes": sorted({*notes})}, passed)


def _ways(
    model: HeadModel, shape: Tensor, pose: Mapping[str, Tensor], notes: list[str]
) -> dict[str, Callable[[], Tensor]]:
    canonical = model.canonical(shape)
    neutral, expression = canonical.expand(len(pose["jaw"]), -1, -1), pose["expression"]
    angles = torch.cat([pose[name] for name in ("rotation", "neck", "jaw", "eyes")], 1).unflatten(1, (-1, 3))
    every = shape.expand(len(expression), -1)
    ways: dict[str, Callable[[], Tensor]] = {
        OURS: lambda: model(canonical=canonical, **pose),
        "fast path, identity blended each time": lambda: model(shape=every, **pose),
        "readable path, identity blended once": lambda: model._pose(
            neutral, expression, angles, pose["translation"]
        ),
    }
    try:
        theirs = smplx_forward(sized_head("2023", *FLAME_SIZES))
    except UnavailableError as error:
        notes.append(str(error))
        return ways
    ways["smplx FLAME"] = lambda: theirs.model(every, pose)
    ways["smplx lbs alone"] = lambda: theirs.skinning(every, pose)
    return ways


def _least(
    ways: Mapping[str, Callable[[], Tensor]], rounds: int, report: Callable[..., None]
) -> dict[str, float]:
    """Seconds of each way, the least over the rounds; every round runs all of them."""
    best: dict[str, float] = dict.fromkeys(ways, np.inf)
    for done in range(rounds):
        for name, way in ways.items():
            start = time.perf_counter()
            way()
            best[name] = min(best[name], time.perf_counter() - start)
        report(done + 1)
    return best


def _arguments(model: HeadModel, batch: int) -> tuple[Tensor, dict[str, Tensor]]:
    """Identity (1, S) and a batch of poses in which every joint turns."""
    generator = torch.Generator().manual_seed(batch)

    def draw(size: int, scale: float, rows: int = batch) -> Tensor:
        return scale * torch.randn(rows, size, generator=generator)

    sizes: Sequence[tuple[str, int]] = (("rotation", 3), ("neck", 3), ("jaw", 3), ("eyes", 6))
    pose = {name: draw(size, 0.2) for name, size in sizes}
    pose |= {"expression": draw(model.expression_size, 1.0), "translation": draw(3, 0.01)}
    return draw(model.shape_size, 1.0, 1), pose


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)

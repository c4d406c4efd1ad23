"""The embedded head with bases of any size, for measurements: as large as a licensed model's, licensed by nobody."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ....bench.contracts import FloatArray, Progress
from ....bench.errors import UnavailableError
from ....bench.specs import Findings
from ....datasets.head.arrays import HeadArrays
from ....datasets.head.model import HeadModel
from ....datasets.head.procedural.model import procedural_head
from ..timing import seconds_of, take_turns, torch_threads

FLAME_SIZES = (300, 100)
"""Identity and expression directions of FLAME."""

_WAVES = 3
_COARSE, _FINE = 20.0, 160.0  # radians per metre: bumps from the size of a cheek to that of a lip
_IDENTITY, _EXPRESSION = 0.004, 0.003  # metres: root mean square of the first direction
_CORRECTIVE = 0.002  # metres per unit entry of R - I


def sized_head(version: str, shape_size: int, expression_size: int) -> HeadArrays:
    """The procedural head's surface and rig with smooth random bases, dense as those of a scanned model.

    Directions are sums of plane waves, later ones finer and smaller; expressions act where the procedural head's
    do. All 36 pose correctives act. Versions differ in their bases alone.

    Parameters
    ----------
    version : of the procedural head, "2020" or "2023"; seeds the bases too.
    shape_size, expression_size : how many directions.
    """
    head = procedural_head(version)
    rng = np.random.default_rng([int(version[-4:]), shape_size, expression_size])
    points = np.asarray(head.template, dtype=np.float64)
    mobility = np.linalg.norm(head.expression_basis.reshape(len(points), -1), axis=1)
    mobility = np.sqrt(mobility / mobility.max())
    eyeballs = np.concatenate([head.regions["left_eyeball"], head.regions["right_eyeball"]])
    identity = _IDENTITY * _waves(points, shape_size, rng)
    identity[eyeballs] = identity[eyeballs].mean(axis=0)
    return replace(
        head,
        version=f"{head.version}-{shape_size}-{expression_size}",
        shape_basis=identity.astype(np.float32),
        expression_basis=(
            _EXPRESSION * mobility[:, None, None] * _waves(points, expression_size, rng)
        ).astype(np.float32),
        pose_basis=(
            _CORRECTIVE * mobility[:, None, None] * _waves(points, head.pose_basis.shape[2], rng)
        ).astype(np.float32),
    )


def _waves(points: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """(V, 3, count) smooth fields, the first ones of unit root mean square, falling with the index."""
    fineness = np.geomspace(_COARSE, _FINE, count)
    axes = rng.normal(size=(3, _WAVES * 3 * count))
    axes /= np.linalg.norm(axes, axis=0)
    phases = points @ axes * np.repeat(fineness, 3 * _WAVES) + rng.uniform(0, 2 * np.pi, axes.shape[1])
    fields = np.sin(phases).reshape(len(points), count, 3, _WAVES).sum(axis=3)
    fields /= np.sqrt(np.square(fields).mean(axis=(0, 2), keepdims=True))
    return (fields / np.sqrt(1 + np.arange(count))[:, None]).transpose(0, 2, 1)


Forward = Callable[[Tensor, Mapping[str, Tensor]], Tensor]


class SmplxForward(NamedTuple):
    """Two ways through smplx, each from identity (B, S) and pose arguments to vertices (B, V, 3)."""

    model: Forward
    """Its FLAME class, as one uses it: landmarks and bookkeeping included."""
    skinning: Forward
    """Its function ``lbs`` alone, with both bases joined beforehand."""


def smplx_forward(head: HeadArrays) -> SmplxForward:
    """Make smplx's FLAME from a head.

    Raises
    ------
    UnavailableError
        Where smplx is not installed.
    """
    try:
        import smplx
        from smplx.lbs import lbs
    except ImportError as error:
        raise UnavailableError("The package smplx is not installed.", "pip install smplx") from error
    parents = head.parents.astype(np.int64)
    content = {
        "v_template": head.template,
        "f": head.faces.astype(np.uint32),
        "shapedirs": np.concatenate([head.shape_basis, head.expression_basis], axis=2),
        "posedirs": head.pose_basis,
        "J_regressor": head.joint_regressor,
        "kintree_table": np.stack([parents, np.arange(len(parents))]),
        "weights": head.skinning_weights,
    }
    landmarks = {"lmk_face_idx": np.zeros(51, np.int64), "lmk_b_coords": np.full((51, 3), 1 / 3)}
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "FLAME_NEUTRAL.pkl").write_bytes(pickle.dumps(content))
        (Path(folder) / "flame_static_embedding.pkl").write_bytes(pickle.dumps(landmarks))
        sizes = {
            "num_betas": head.shape_basis.shape[2],
            "num_expression_coeffs": head.expression_basis.shape[2],
        }
        flame = smplx.FLAME(folder, **sizes, batch_size=1)
    directions = torch.cat([flame.shapedirs, flame.expr_dirs], dim=-1)

    def model(shape: Tensor, pose: Mapping[str, Tensor]) -> Tensor:
        vertices: Tensor = flame(
            betas=shape,
            expression=pose["expression"],
            global_orient=pose["rotation"],
            neck_pose=pose["neck"],
            jaw_pose=pose["jaw"],
            leye_pose=pose["eyes"][:, :3],
            reye_pose=pose["eyes"][:, 3:],
            transl=pose["translation"],
        ).vertices
        return vertices

    def skinning(shape: Tensor, pose: Mapping[str, Tensor]) -> Tensor:
        angles = torch.cat([pose[name] for name in ("rotation", "neck", "jaw", "eyes")], dim=1)
        template = flame.v_template.expand(len(shape), -1, -1)
        arguments = (flame.posedirs, flame.J_regressor, flame.parents, flame.lbs_weights)
        vertices: Tensor = lbs(
            torch.cat([shape, pose["expression"]], 1), angles, template, directions, *arguments
        )[0]
        return vertices + pose["translation"][:, None]

    return SmplxForward(model, skinning)


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
    with torch.no_grad(), torch_threads(THREADS):
        for batch in BATCHES:
            shape, pose = _arguments(model, batch)
            ways = _ways(model, shape, pose, notes)
            vertices = {name: way() for name, way in ways.items()}
            difference = max(float((value - vertices[OURS]).abs().max()) for value in vertices.values())
            progress(BATCHES.index(batch), len(BATCHES), f"batch {batch}")
            taken = take_turns(
                {name: seconds_of(way) for name, way in ways.items()}, budget=0.0, least_runs=rounds
            )
            seconds = {name: min(each) for name, each in taken.items()}
            factor = seconds.get("smplx FLAME", np.nan) / seconds[OURS]
            passed &= difference < CLOSE and not factor < FLOORS[batch]
            for name, value in seconds.items():
                share = value / seconds[OURS]
                rows.append(
                    {"batch": batch, "way": name, "ms_per_frame": 1e3 * value / batch, "ratio": share}
                )
            rows[-1]["largest_difference_m"] = difference
    sizes = f"{len(model.template)} vertices, {FLAME_SIZES[0]} + {FLAME_SIZES[1]} directions"
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


def _arguments(model: HeadModel, batch: int) -> tuple[Tensor, dict[str, Tensor]]:
    """Identity (1, S) and a batch of poses in which every joint turns."""
    generator = torch.Generator().manual_seed(batch)

    def draw(size: int, scale: float, rows: int = batch) -> Tensor:
        return scale * torch.randn(rows, size, generator=generator)

    sizes: Sequence[tuple[str, int]] = (("rotation", 3), ("neck", 3), ("jaw", 3), ("eyes", 6))
    pose = {name: draw(size, 0.2) for name, size in sizes}
    pose |= {"expression": draw(model.expression_size, 1.0), "translation": draw(3, 0.01)}
    return draw(model.shape_size, 1.0, 1), pose

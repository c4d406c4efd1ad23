"""The head model: time of its forward pass (``headbench doctor bench head``) and extremes (``headbench doctor stress head``).

Measured on a head with random bases of any size: as large as a licensed model's, without a licence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...bench.benchmarks import Row, findings, table, take_turns
from ...bench.contracts import FloatArray, Progress
from ...bench.specs import CommandResult
from ..head.arrays import HeadArrays
from ..head.model import HeadModel
from ..head.procedural.model import procedural_head

FLAME_SIZES = (300, 100)
"""Identity and expression directions of FLAME."""

_WAVES = 3
_COARSE, _FINE = 20.0, 160.0  # radians per metre: bumps from the size of a cheek to that of a lip
_IDENTITY, _EXPRESSION = 0.004, 0.003  # metres: root mean square of the first direction
_CORRECTIVE = 0.002  # metres per unit entry of R - I

Arguments = Mapping[str, Tensor]


def sized_head(version: str, shape_size: int, expression_size: int) -> HeadArrays:
    """The procedural head's surface and rig with smooth random bases, dense as those of a scanned model.

    Directions are sums of plane waves, later ones finer and smaller; expressions act where the procedural head's
    do. All 36 pose correctives act. Versions differ in their bases alone.

    Parameters
    ----------
    version : str
        Version of the procedural head, "2020" or "2023"; seeds the bases too.
    shape_size, expression_size : int
        Number of directions.
    """
    head = procedural_head(version)
    rng = np.random.default_rng([int(version[-4:]), shape_size, expression_size])
    points = np.asarray(head.template, dtype=np.float64)
    mobility = np.linalg.norm(head.expression_basis.reshape(len(points), -1), axis=1)
    mobility = np.sqrt(mobility / mobility.max())[:, None, None]
    eyeballs = np.concatenate([head.regions["left_eyeball"], head.regions["right_eyeball"]])
    identity = _IDENTITY * _waves(points, shape_size, rng)
    identity[eyeballs] = identity[eyeballs].mean(axis=0)
    expression = _EXPRESSION * mobility * _waves(points, expression_size, rng)
    corrective = _CORRECTIVE * mobility * _waves(points, head.pose_basis.shape[2], rng)
    return replace(
        head,
        version=f"{head.version}-{shape_size}-{expression_size}",
        shape_basis=identity.astype(np.float32),
        expression_basis=expression.astype(np.float32),
        pose_basis=corrective.astype(np.float32),
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


BATCHES = (1, 16)
CLOSE = 1e-5
"""Metres; the largest difference between any two ways."""
ROUNDS, QUICK_ROUNDS = 200, 40
ONCE = "identity blended once"


def speed(quick: bool, progress: Progress) -> CommandResult:
    """Time poses of one identity, blended once and at each call, in turns; passed where both agree."""
    model = HeadModel(sized_head("2023", *FLAME_SIZES))
    rows: list[Row] = []
    with torch.no_grad():
        for number, batch in enumerate(BATCHES):
            progress(number, len(BATCHES), f"batch {batch}")
            ways = _ways(model, batch)
            vertices = {name: way() for name, way in ways.items()}
            seconds = take_turns(ways, QUICK_ROUNDS if quick else ROUNDS)
            for name, values in seconds.items():
                row = {"batch": batch, "way": name, "ms a frame": 1e3 * min(values) / batch}
                row["times as fast"] = min(seconds[ONCE]) / min(values)
                row["differs by m"] = float((vertices[name] - vertices[ONCE]).abs().max())
                rows.append(row)
    note = (
        f"{len(model.template)} vertices, {FLAME_SIZES[0]} + {FLAME_SIZES[1]} directions, float32, {torch.get_num_threads()} "
        "threads; the least of runs by the clock."
    )
    faults = [f"{row['way']}: differs by too much" for row in rows if not row["differs by m"] < CLOSE]
    return findings({"Forward pass without gradients": rows}, note, faults)


def _ways(model: HeadModel, batch: int) -> dict[str, Callable[[], Tensor]]:
    """Ways to the vertices (B, V, 3) of a batch of poses of one identity."""
    pose = _arguments(model, batch, torch.float32)
    shape = pose.pop("shape")[:1]
    pose.pop("eyelids", None)
    canonical = model.canonical(shape)
    return {
        ONCE: lambda: model(canonical=canonical, **pose),
        "identity blended at each call": lambda: model(shape=shape.expand(batch, -1), **pose),
    }


ANGLES = ("rotation", "neck", "jaw", "eyes")
FLOAT32 = 1e-6
"""Largest error of float32 vertices as a part of the mesh's extent, including coefficients of ten deviations."""


@dataclass(frozen=True)
class HeadExtreme:
    """One extreme: the arguments that it changes, and the head."""

    name: str
    change: Callable[[Arguments], Arguments] = lambda arguments: {}
    head: Callable[[HeadArrays], HeadArrays] = lambda head: head


def _turned(name: str, *vector: float) -> Callable[[Arguments], Arguments]:
    return lambda a: {
        name: torch.tensor(vector * (a[name].shape[1] // 3), dtype=a[name].dtype).expand_as(a[name])
    }


def _scaled(factor: float, *names: str) -> Callable[[Arguments], Arguments]:
    return lambda a: {name: factor * torch.sign(a[name]) for name in names}


def _collapsed(head: HeadArrays) -> HeadArrays:
    """Every tenth triangle to a point, every tenth to a line."""
    template = head.template.copy()
    points, lines = head.faces[::10], head.faces[5::10]
    template[points[:, 1:]] = template[points[:, :1]]
    template[lines[:, 2]] = 0.5 * (template[lines[:, 0]] + template[lines[:, 1]])
    return replace(head, template=template)


HEAD_EXTREMES = (
    HeadExtreme("all rotations zero", lambda a: {name: torch.zeros_like(a[name]) for name in ANGLES}),
    *(HeadExtreme(f"{name} turned by pi", _turned(name, np.pi, 0.0, 0.0)) for name in ANGLES),
    HeadExtreme("rotation by pi about a diagonal", _turned("rotation", *(np.pi / 3**0.5,) * 3)),
    HeadExtreme("rotation by two pi", _turned("rotation", 0.0, 2 * np.pi, 0.0)),
    HeadExtreme("rotations of 1e-20", lambda a: {name: 1e-20 * a[name] for name in ("jaw", "neck")}),
    HeadExtreme("rotations of 1e-4", _turned("jaw", 1e-4, -1e-4, 1e-4)),
    HeadExtreme("expression at ten deviations", _scaled(10.0, "expression")),
    HeadExtreme("identity at ten deviations", _scaled(10.0, "shape")),
    HeadExtreme("both at ten deviations", _scaled(10.0, "shape", "expression")),
    HeadExtreme("100 m away", lambda a: {"translation": a["translation"] + 100.0}),
    HeadExtreme("triangles without area", head=_collapsed),
)


def stress(quick: bool, progress: Progress) -> CommandResult:
    """Try every case; ``quick`` tries the same, it takes seconds."""
    rows = []
    for done, case in enumerate(HEAD_EXTREMES):
        progress(done, len(HEAD_EXTREMES), case.name)
        rows.append(try_extreme(case))
    sound = sum(row["verdict"] == "ok" for row in rows)
    text = (
        "Vertices in float32 against float64, as parts of the extent; gradients relative.\n\n"
        f"{table(rows)}\n\n{sound} of {len(rows)} behave as expected."
    )
    return CommandResult(text, {"verdicts": rows}, passed=sound == len(rows))


def try_extreme(case: HeadExtreme, head: HeadArrays | None = None) -> Row:
    """Pose a head as the case says, in both precisions, with gradients of all arguments."""
    asset = case.head(procedural_head("2020") if head is None else head)
    exact, single = HeadModel(asset, dtype=torch.float64), HeadModel(asset)
    given = _arguments(exact, 2, torch.float64)
    # Both start from what float32 can hold, so that the error is that of the computation.
    narrow = {name: value.float() for name, value in {**given, **case.change(given)}.items()}
    wide = {name: value.double() for name, value in narrow.items()}
    truth, wanted = _with_gradients(exact, wide)
    drawn, gradients = _with_gradients(single, narrow)
    error = float((drawn.double() - truth).abs().max() / truth.abs().max())
    relative = max(
        float((gradients[name].double() - value).norm() / value.norm().clamp_min(1e-12))
        for name, value in wanted.items()
    )
    finite = all(bool(torch.isfinite(value).all()) for value in (drawn, *gradients.values()))
    bounds = {
        "not finite": finite,
        f"float32 error over {FLOAT32:.0e}": error <= FLOAT32,
        "gradients differ": relative <= 1e-3,
    }
    verdict = next((complaint for complaint, kept in bounds.items() if not kept), "ok")
    return {"case": case.name, "float32": error, "gradient": relative, "verdict": verdict}


def _arguments(model: HeadModel, batch: int, dtype: torch.dtype) -> dict[str, Tensor]:
    """Identities and poses in which every joint turns, (B, size) each."""
    generator = torch.Generator().manual_seed(3)
    sizes = {
        "shape": (model.shape_size, 1.0),
        "expression": (model.expression_size, 1.0),
        "rotation": (3, 0.3),
        "neck": (3, 0.2),
        "jaw": (3, 0.2),
        "eyes": (6, 0.2),
        "translation": (3, 0.1),
        **({} if model.eyelid_matrix is None else {"eyelids": (2, 0.3)}),
    }
    return {
        name: (scale * torch.randn(batch, size, generator=generator, dtype=torch.float64)).to(dtype)
        for name, (size, scale) in sizes.items()
    }


def _with_gradients(model: HeadModel, arguments: Arguments) -> tuple[Tensor, dict[str, Tensor]]:
    """Vertices and the gradients of a fixed weighted sum of them, by every argument."""
    leaves = {name: value.clone().requires_grad_() for name, value in arguments.items()}
    vertices = model(**leaves)
    # Positive weights: sums that cancel would show the sums' rounding and not the model's.
    weights = 1.5 + torch.linspace(0, 40, vertices.numel(), dtype=torch.float64).cos()
    gradients = torch.autograd.grad(
        (vertices * weights.to(vertices).view_as(vertices)).sum(), list(leaves.values())
    )
    return vertices.detach(), dict(zip(leaves, gradients, strict=True))

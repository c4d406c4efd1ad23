"""How tracked faces move: displacement of the face between timesteps, and by the expression alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...bench.contracts import FloatArray
from .evidence import Evidence

_BATCH = 32


def face_steps(evidence: Evidence) -> dict[str, tuple[list[int], FloatArray]]:
    """By sequence folder: timesteps that have a pose, (n,), and the mean distance in metres that the face's
    vertices move from each to the next, (n - 1,)."""
    if evidence.subject is None:
        return {}
    face = evidence.subject.head.regions.get("face", np.arange(len(evidence.subject.head.template)))
    steps = {}
    for folder, timesteps in evidence.sequences.items():
        posed = [t for t in timesteps if evidence.parameters[t].pose is not None]
        steps[folder] = (posed, _steps(evidence, posed, face))
    return steps


def _steps(evidence: Evidence, timesteps: Sequence[int], face: np.ndarray) -> FloatArray:
    assert evidence.subject is not None
    found: list[float] = []
    last: FloatArray | None = None
    for start in range(0, len(timesteps), _BATCH):
        poses = [evidence.parameters[t].pose for t in timesteps[start : start + _BATCH]]
        points = evidence.subject.vertices([pose for pose in poses if pose is not None])[:, face]
        chain = points if last is None else np.concatenate([last, points])
        found += np.linalg.norm(np.diff(chain, axis=0), axis=2).mean(axis=1).tolist()
        last = points[-1:]
    return np.array(found)


def expression_reach(evidence: Evidence) -> dict[int, float]:
    """Farthest that a vertex moves by the expression coefficients alone, metres, by timestep."""
    if evidence.subject is None:
        return {}
    basis = evidence.subject.head.expression_basis
    matrix = np.asarray(basis, dtype=np.float64).reshape(-1, basis.shape[2])
    poses = {t: p.pose for t, p in evidence.parameters.items() if p.pose is not None}
    reach = {}
    for timestep, pose in poses.items():
        moved = (matrix @ pose.expression.astype(np.float64)).reshape(-1, 3)
        reach[timestep] = float(np.linalg.norm(moved, axis=1).max())
    return reach

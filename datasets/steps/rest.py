"""A rest expression other than zero, as of trackers whose coefficients at rest depend on the person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...bench.contracts import Clip, FloatArray
from ...bench.engine.config import RunConfig
from ...bench.errors import InputError
from ..clip import CaptureClip, as_capture
from ..head.arrays import faces_in_region


def with_rest_expression(clip: Clip, config: RunConfig, *, millimetres: float, seed: int = 0) -> CaptureClip:
    """A clip whose expressions are all changed by the same coefficients, which the static offset makes up for.

    Images and posed meshes are unchanged: only the mesh with zero expression is another one, and with it whatever a method derives
    from the distance to that mesh.

    Parameters
    ----------
    millimetres : float
        Median displacement of the face's vertices by these coefficients. They are drawn from normal distributions with the
        deviations of the training poses.
    """
    source = as_capture(clip)
    if not millimetres > 0:
        raise InputError("conditions", "millimetres", "a number above 0", repr(millimetres))
    training = sorted({key.timestep for key in source.splits["train"]})
    spread = np.std([source.poses[timestep].expression for timestep in training], axis=0)
    drawn = np.random.default_rng(seed).normal(size=len(spread)) * spread
    basis = np.asarray(source.head.expression_basis, np.float64)[:, :, : len(drawn)]
    if not drawn.any():
        raise InputError(
            f"clip of {clip.subject}", "poses", "expressions that change", "one constant expression"
        )
    rest = drawn * millimetres / (1000 * face_displacement(source, basis @ drawn))
    poses = {
        timestep: replace(pose, expression=np.asarray(pose.expression + rest, np.float32))
        for timestep, pose in source.poses.items()
    }
    offset = np.asarray(source.static_offset - basis @ rest, np.float32)
    return source.derive(
        "with_rest_expression", {"millimetres": millimetres, "seed": seed}, poses=poses, static_offset=offset
    )


def face_displacement(clip: Clip, displacements: FloatArray) -> float:
    """Median length over the vertices of the face of (V, 3) displacements, in their unit."""
    vertices = np.unique(np.asarray(clip.head.faces)[faces_in_region(clip.head, "face")])
    return float(np.median(np.linalg.norm(displacements[vertices], axis=1)))

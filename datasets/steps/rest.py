"""A rest expression other than zero, as of trackers whose coefficients at rest depend on the person.

A chart for head models without texture coordinates, for methods that place splats on a chart. Rotation of the neck
moved into the rigid motion of the head, as trackers without a neck joint describe a head.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ...bench.contracts import Clip, FloatArray, HeadPose, IntArray
from ...bench.engine.config import RunConfig
from ...bench.errors import InputError
from ..clip import CaptureClip, as_capture
from ..head.arrays import faces_in_region
from ..head.model import PosedSubject


def as_rigid_head(clip: Clip, config: RunConfig) -> CaptureClip:
    """A clip whose poses have no rotation of the neck: root and translation make up the motion of the head. Vertices
    that fully follow the neck do not move; those below it follow the head. Images are unchanged."""
    source = as_capture(clip)
    subject = PosedSubject.of(source)
    poses = list(source.poses.values())
    motions = subject.motions(poses)
    turned = [_turned(pose, motion) for pose, motion in zip(poses, motions)]
    translations = subject.translations(turned, motions).astype(np.float32)
    moved = [replace(pose, translation=each) for pose, each in zip(turned, translations)]
    return source.derive("as_rigid_head", {}, poses=dict(zip(source.poses, moved)))


def _turned(pose: HeadPose, motion: FloatArray) -> HeadPose:
    """The pose with the rotation of a (4, 4) motion of the head, without neck and translation."""
    rotation = Rotation.from_matrix(np.asarray(motion)[:3, :3]).as_rotvec().astype(np.float32)
    zero = np.zeros(3, np.float32)
    return replace(pose, rotation=rotation, neck=zero, translation=zero)


SHEAR = np.tan(np.radians(18))
"""Shear of the triangles, so that the directions along the two coordinates are 18 degrees from orthogonal, the median in FLAME's
chart."""
MARGIN = 0.05
"""Fraction of a cell left free around the largest triangle."""


def with_packed_chart(clip: Clip, config: RunConfig) -> CaptureClip:
    """A clip whose head model has texture coordinates: its own, or those of `packed_chart`."""
    source = as_capture(clip)
    if source.head.uv is not None:
        return source
    uv = packed_chart(np.asarray(source.head.template), np.asarray(source.head.faces))
    return source.derive("with_packed_chart", {}, head=replace(source.head, uv=uv))


def packed_chart(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(F, 3, 2) texture coordinates in [0, 1], in which every triangle has a cell of a square grid.

    Triangles have the same scale and are sheared by `SHEAR`, so that areas in the chart are proportional to those on the mesh.

    ``vertices``, ``faces``: (V, 3) metres, (F, 3).
    """
    v0, v1, v2 = np.moveaxis(np.asarray(vertices, np.float64)[faces], 1, 0)
    # A triangle without area stays one: no division by 0.
    base = np.maximum(np.linalg.norm(v1 - v0, axis=1), np.finfo(np.float64).tiny)
    along = ((v2 - v0) * (v1 - v0)).sum(1) / base
    height = np.linalg.norm(np.cross(v1 - v0, v2 - v0), axis=1) / base
    flat = np.zeros((len(faces), 3, 2))
    flat[:, 1, 0] = base
    flat[:, 2] = np.column_stack([along + SHEAR * height, height])
    flat -= flat.min(1, keepdims=True)
    flat *= (1 - 2 * MARGIN) / flat.max()
    across = int(np.ceil(np.sqrt(len(faces))))
    row, column = np.divmod(np.arange(len(faces)), across)
    return ((flat + MARGIN + np.column_stack([column, row])[:, None]) / across).astype(np.float32)


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

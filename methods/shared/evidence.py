"""Motion of the face that training pictures confirm.

Tracked coefficients contain the tracker's noise. A tracker of single frames has an error that changes with every timestep,
one of videos an error that lasts for a sequence, so coefficients alone do not distinguish noise from motion; images do.

The mesh is posed with the mean expression and jaw of the training timesteps and the tracked motion of the head. Where the face
deforms, a picture differs there from the mean of the other timesteps' pictures. One step of photometric alignment (Lucas and
Kanade 1981, on the mesh and in all cameras at once) turns this difference into coefficients, without the tracked ones. If these
are motion, they agree with those of the pictures at the same timesteps; if they are noise, they agree no better than with those of
other timesteps. Only frames of the training split are read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ...bench.contracts import Clip, FloatArray, FrameKey, HeadPose, IntArray
from ...bench.protocol import evenly_with_ends
from ...datasets.head.geometry import rigid_alignment
from ...datasets.tracking.rig import FrameStack, Occlusion, Views
from .subject_mesh import SubjectMesh

TIMESTEPS, CAMERAS, POINTS = 64, 8, 1500
"""Maximum number of training timesteps and cameras that are read, and of vertices, each evenly spaced."""
LEAST_TIMESTEPS = 20
"""With fewer there are too few shifts to compare with."""
BLUR = 5e-3
"""Standard deviation of the pictures' blur, metres: alignment by gradients reaches about this far."""
RIDGE = 0.1
"""Weight of the coefficients' squares relative to the mean weight that the pictures give them."""
FLOOR = 0.2
"""Tracked coefficients that move the face by less than this fraction of the largest motion get less weight."""
CONFIRMED = 2.0
"""Standard deviations above chance from which motion is confirmed (docs/explanation/methods/ours.md, "Planned sizes")."""
JAW = slice(-3, None)
"""Columns of the jaw's rotation; those of the expression come before."""
_STEP = 0.02  # radians, of the finite differences by jaw rotation


@dataclass(frozen=True)
class PictureMotion:
    """Deviations of expression and jaw from their means at T training timesteps, from tracking and from images.

    Attributes
    ----------
    tracked, pictured : FloatArray
        (T, E + 3) root mean square displacement of the face, pixels, by each expression coefficient and each component of the
        jaw's rotation.
    """

    tracked: FloatArray
    pictured: FloatArray

    def agreement(self, columns: slice) -> float:
        """Agreement of tracked and image-based coefficients, in standard deviations above chance.

        Chance is their agreement after a cyclic shift of one of them in time, which preserves temporal correlation. 0 for
        constant coefficients and for images without contrast.
        """
        tracked, pictured = self.tracked[:, columns], self.pictured[:, columns]
        spread, other = tracked.std(axis=0), pictured.std(axis=0)
        if not spread.size or spread.max() < 1e-6:
            return 0.0
        tracked = tracked / np.maximum(spread, FLOOR * spread.max())
        pictured = pictured / np.maximum(other, 1e-12)
        count = len(tracked)
        shifts = np.arange(3, count - 2)
        by_chance = [float((np.roll(pictured, shift, axis=0) * tracked).sum()) for shift in shifts]
        spread_by_chance = float(np.std(by_chance))
        above = float((pictured * tracked).sum() - np.mean(by_chance))
        return above / spread_by_chance if spread_by_chance > 0 else 0.0


def picture_motion(clip: Clip, mesh: SubjectMesh, pixel: float) -> PictureMotion | None:
    """Compare tracking and training pictures; None if there are fewer than `LEAST_TIMESTEPS`.

    Parameters
    ----------
    pixel : float
        Size of a pixel on the head, metres.
    """
    rows: dict[int, list[FrameKey]] = {}
    for key in sorted(clip.splits["train"], key=lambda key: (key.timestep, key.camera)):
        rows.setdefault(key.timestep, []).append(key)
    timesteps = evenly_with_ends(sorted(rows), TIMESTEPS)
    if len(timesteps) < LEAST_TIMESTEPS:
        return None
    poses = [clip.poses[timestep] for timestep in timesteps]
    expression, jaw = (
        np.mean([getattr(pose, name) for pose in poses], axis=0) for name in ("expression", "jaw")
    )
    means = [replace(pose, expression=expression, jaw=jaw) for pose in poses]
    rest, columns = _columns(mesh, means[0])
    face = _face(clip)
    columns = columns[face] / pixel
    scale = np.sqrt((columns**2).sum(axis=1).mean(axis=0))
    columns = columns / np.maximum(scale, 1e-12)
    used = evenly_with_ends(sorted({key.camera for timestep in timesteps for key in rows[timestep]}), CAMERAS)
    samples = _Samples(clip, mesh, used, rest, face, pixel)
    for timestep, pose in zip(timesteps, means):
        samples.add(pose, [key for key in rows[timestep] if key.camera in used])
    tracked = (
        np.array([np.concatenate([pose.expression, pose.jaw]) for pose in poses], dtype=np.float64) * scale
    )
    unknowns = np.concatenate([columns, _rigid(rest[face] / pixel)], axis=2)
    pictured = samples.solve(unknowns)[:, : columns.shape[2]]
    return PictureMotion(tracked - tracked.mean(axis=0), pictured - pictured.mean(axis=0))


class _Samples:
    """Grey values and gradients at points of the face, in every picture."""

    def __init__(
        self,
        clip: Clip,
        mesh: SubjectMesh,
        cameras: Sequence[str],
        rest: FloatArray,
        face: IntArray,
        pixel: float,
    ):
        self._clip, self._mesh, self._rest, self._face, self._pixel = clip, mesh, rest, face, pixel
        self._cameras = list(cameras)
        self._views = Views([clip.cameras[name] for name in self._cameras])
        self._occlusion = Occlusion(clip.head, rest, self._views)
        self._values: list[FloatArray] = []
        self._gradients: list[FloatArray] = []

    def add(self, pose: HeadPose, keys: Sequence[FrameKey]) -> None:
        """Sample the pictures of one timestep; values (C, P) are not a number where a point is not seen."""
        posed = _vertices(self._mesh, pose)
        turn = rigid_alignment(self._rest[self._face], posed[self._face])[:3, :3]
        seen = self._occlusion.visible(posed, self._face) > 0
        places = self._views.project(posed[self._face])
        values = np.full(seen.shape, np.nan, np.float32)
        gradients = np.zeros((*seen.shape, 3), np.float32)
        stack = FrameStack([self._clip.image(key) for key in keys])
        stack.filter(BLUR / self._pixel)
        for number, key in enumerate(keys):
            row = self._cameras.index(key.camera)
            at = np.flatnonzero(seen[row])
            colours, slopes = stack.sample(np.full(len(at), number), places.pixels[row, at])
            values[row, at] = colours.mean(axis=1)
            by_point = slopes.mean(axis=1)[:, None, :] @ places.derivative[row, at]
            gradients[row, at] = self._pixel * (by_point @ turn)[:, 0]
        self._values.append(values)
        self._gradients.append(gradients)

    def solve(self, unknowns: FloatArray) -> FloatArray:
        """(T, n) coefficients of displacements (P, 3, n), in pixels, that align each picture with the mean of the others."""
        values = np.stack(self._values)
        count = np.isfinite(values).sum(axis=0)
        mean = np.nansum(values, axis=0) / np.maximum(count, 1)
        often = 2 * count >= len(values)
        found = []
        for picture, gradient in zip(values, self._gradients):
            used = often & np.isfinite(picture)
            # The mean without this picture.
            residual = ((picture - mean) * count / np.maximum(count - 1, 1))[used]
            rows = np.einsum("sx,sxn->sn", gradient[used], unknowns[np.nonzero(used)[1]])
            normal = rows.T @ rows
            size = len(normal)
            normal += (RIDGE * np.trace(normal) / size + 1e-12) * np.eye(size)
            found.append(np.linalg.solve(normal, -rows.T @ residual))
        return np.array(found)


def _face(clip: Clip) -> IntArray:
    """Vertices of the face without the eyeballs, or of the whole mesh if the head has no such region."""
    regions = clip.head.regions
    face = np.asarray(regions.get("face", np.arange(len(clip.head.template))))
    for name in ("left_eyeball", "right_eyeball"):
        face = np.setdiff1d(face, np.asarray(regions.get(name, ()), dtype=face.dtype))
    return np.array(evenly_with_ends(list(face), POINTS))


def _columns(mesh: SubjectMesh, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
    """(V, 3) mesh of a pose without motion of the head, and (V, 3, E + 3) its derivatives by expression and jaw, metres."""
    still = replace(pose, rotation=np.zeros(3), neck=np.zeros(3), translation=np.zeros(3))
    rest = _vertices(mesh, still)
    moved = [replace(still, expression=still.expression + unit) for unit in np.eye(len(still.expression))]
    turned = [replace(still, jaw=still.jaw + _STEP * axis) for axis in np.eye(3)]
    columns = [_vertices(mesh, each) - rest for each in moved]
    columns += [(_vertices(mesh, each) - rest) / _STEP for each in turned]
    return rest, np.stack(columns, axis=2)


def _rigid(points: FloatArray) -> FloatArray:
    """(P, 3, 6) displacements by rotations and translations, so that errors of the head's motion are not taken for expressions."""
    arms = points - points.mean(axis=0)
    turns = np.stack([np.cross(axis, arms) for axis in np.eye(3)], axis=2)
    turns /= np.sqrt((turns**2).sum(axis=1).mean(axis=0))
    return np.concatenate([turns, np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)


@torch.no_grad()
def _vertices(mesh: SubjectMesh, pose: HeadPose) -> FloatArray:
    return mesh.posed(mesh.arguments([pose])).cpu().numpy().astype(np.float64)

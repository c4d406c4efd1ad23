"""The fit of blocks of timesteps, and what is kept of them on disk."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ....bench.contracts import FloatArray, HeadPose
from ....bench.errors import InputError
from ....bench.io.arrays import MAX_MAGNITUDE, TEXT, Member, read_arrays
from ....bench.io.files import atomic_path, digest
from ...clip import CaptureClip
from ..arrays import HeadArrays
from .identity import EYEBALLS, FACE, Matching
from .problem import FitProblem
from .report import FrameResidual, RefitReport
from .settings import RefitSettings
from .solve import angle_bounds, solve_frame
from .subject import Subject
from .turns import axis_angles, matrices

_FORMAT = 1  # of the blocks on disk; counts up when the fit changes
_MILLIMETRES = 1e3

PER_TIMESTEP = (
    *("coefficients", "angles", "rotation", "neck", "translation"),
    *("mean_mm", "p95_mm", "max_mm", "eyeballs_mm", "evaluations"),
)


_BLOCK = {
    "mark": TEXT,
    "coefficients": Member("f", ("T", "C"), MAX_MAGNITUDE),
    "angles": Member("f", ("T", 9), MAX_MAGNITUDE),
    **dict.fromkeys(("rotation", "neck", "translation"), Member("f", ("T", 3), MAX_MAGNITUDE)),
    **dict.fromkeys(("mean_mm", "p95_mm", "max_mm", "eyeballs_mm"), Member("f", ("T",))),
    "evaluations": Member("iu", ("T",)),
    "vertex_sums": Member("f", ("n",)),
}
_log = logging.getLogger(__name__)


class BlockFitter:
    """Everything that stays the same over the timesteps of a refit."""

    def __init__(
        self,
        clip: CaptureClip,
        target: HeadArrays,
        matching: Matching,
        offset: FloatArray,
        settings: RefitSettings,
    ):
        self.target, self.matching, self.settings = target, matching, settings
        self._source = Subject(clip.head, clip.shape, clip.static_offset)
        self._subject = Subject(target, matching.shape, offset)
        self._problem = FitProblem(
            target, self._subject.neutral, matching.vertices, matching.weights, settings
        )
        self._to_source = np.linalg.inv(matching.alignment)
        eyeballs = [target.regions[name] for name in EYEBALLS if name in target.regions]
        self._eyeball = np.isin(matching.vertices, np.concatenate(eyeballs)) if eyeballs else None
        self._face = np.isin(matching.vertices, target.regions[FACE])
        self._input = digest(
            *(clip.head.fingerprint(), target.fingerprint(), self._source.neutral, offset),
            *(matching.shape, settings.record(), _FORMAT),
        )

    def fit(self, poses: Sequence[HeadPose]) -> dict[str, FloatArray]:
        """Fit a block; arrays by the names in `PER_TIMESTEP`, and the residuals' sums by vertex, (n,)."""
        counterparts = self._on_surface(self._source.meshes(poses))
        motions = self._source.motions(poses) @ self._to_source
        local = np.einsum("tni,tij->tnj", counterparts - motions[:, None, :3, 3], motions[:, :3, :3])
        necks = self._necks(poses)
        frames = self._problem.frames(local, matrices(necks))
        given = np.array([[*pose.jaw, *pose.eyes] for pose in poses], dtype=np.float64)
        solutions, start = [], given[0]
        for frame, own in zip(frames, given):
            solutions.append(solve_frame(self._problem, frame, start, own, self.settings))
            start = solutions[-1].angles
        columns: dict[str, FloatArray] = {
            "coefficients": np.stack([solution.coefficients for solution in solutions]),
            "angles": np.stack([solution.angles for solution in solutions]),
            "evaluations": np.array([solution.evaluations for solution in solutions]),
            "neck": necks,
            "rotation": axis_angles(motions[:, :3, :3] @ matrices(necks).transpose(0, 2, 1)),
            "translation": np.zeros((len(poses), 3)),
        }
        turned = [self.pose(pose, None, columns, row) for row, pose in enumerate(poses)]
        columns["translation"] = motions[:, :3, 3] - self._subject.motions(turned)[:, :3, 3]
        return columns | self._residuals(poses, columns, counterparts)

    def fit_once(self, poses: Sequence[HeadPose], folder: Path | None, index: int) -> dict[str, FloatArray]:
        """`fit`, or what an earlier call with the same input left in ``folder``."""
        if folder is None:
            return self.fit(poses)
        inputs = [[pose.expression, pose.rotation, pose.neck, pose.jaw, pose.eyes] for pose in poses]
        places = [[pose.translation, pose.eyelids] for pose in poses]
        mark = digest(self._input, inputs, places)
        path = folder / f"refit-{index:05d}.npz"
        if path.exists():
            try:
                sizes = {"T": len(poses), "C": len(self._problem.bound), "n": len(self.matching.vertices)}
                kept = read_arrays(path, _BLOCK, sizes)
                if str(kept.pop("mark")) == mark:
                    return kept
            except InputError as error:
                _log.warning("fitted again: %s", error)
        block = self.fit(poses)
        with atomic_path(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, allow_pickle=False, mark=np.array(mark), **block)
        return block

    def pose(
        self, pose: HeadPose, timestep: int | None, columns: dict[str, FloatArray], row: int
    ) -> HeadPose:
        """The refitted pose in a row of the columns."""
        size = self.target.expression_basis.shape[2]
        coefficients, angles = columns["coefficients"][row], columns["angles"][row]
        return HeadPose(
            head_model=self.target.version,
            expression=coefficients[:size],
            rotation=columns["rotation"][row],
            neck=columns["neck"][row],
            jaw=angles[:3],
            eyes=angles[3:],
            translation=columns["translation"][row],
            eyelids=None if self.target.eyelid_basis is None else coefficients[size:],
            subject=pose.subject,
            timestep=timestep,
        )

    def report(
        self, timesteps: Sequence[int], columns: dict[str, FloatArray], vertex_sums: FloatArray
    ) -> RefitReport:
        """Put the residuals of all timesteps together."""
        limits = np.concatenate([self._problem.bound, angle_bounds(self.settings)])
        size = self.target.expression_basis.shape[2]
        lids = len(self._problem.bound) - size
        names = [f"expression[{i}]" for i in range(size)] + [f"eyelids[{i}]" for i in range(lids)]
        names += [f"jaw[{i}]" for i in range(3)] + [f"eyes[{i}]" for i in range(6)]
        values = np.concatenate([columns["coefficients"], columns["angles"]], axis=1)
        bounded = np.abs(values) >= limits * (1 - 1e-9)
        bounded[:, -9:] &= self._problem.searched
        frames = [
            FrameResidual(
                timestep,
                mean_mm=float(columns["mean_mm"][row]),
                p95_mm=float(columns["p95_mm"][row]),
                max_mm=float(columns["max_mm"][row]),
                eyeballs_mm=float(columns["eyeballs_mm"][row]),
                at_bound=tuple(names[i] for i in np.flatnonzero(bounded[row])),
                evaluations=int(columns["evaluations"][row]),
            )
            for row, timestep in enumerate(timesteps)
        ]
        vertex_mm = np.full(len(self.target.template), np.nan)
        vertex_mm[self.matching.vertices] = vertex_sums / len(timesteps)
        neutral = self.matching.counterparts @ self._source.neutral
        aligned = neutral @ self.matching.alignment[:3, :3].T + self.matching.alignment[:3, 3]
        gaps = np.linalg.norm(aligned - self._subject.neutral[self.matching.vertices], axis=1)
        at_limit = np.abs(self.matching.shape) >= self.settings.coefficient_bound * (1 - 1e-9)
        return RefitReport(
            source=self._source.version,
            target=self.target.version,
            frames=frames,
            vertex_mm=vertex_mm,
            neutral_mm=_MILLIMETRES * float(gaps[self._face].mean()),
            shape_at_bound=tuple(f"shape[{i}]" for i in np.flatnonzero(at_limit)),
        )

    def _on_surface(self, meshes: FloatArray) -> FloatArray:
        """(T, n, 3) counterparts of the fitted vertices on meshes (T, V source, 3)."""
        count, vertices = meshes.shape[:2]
        by_vertex = np.ascontiguousarray(meshes.transpose(1, 0, 2)).reshape(vertices, -1)
        return (self.matching.counterparts @ by_vertex).reshape(-1, count, 3).transpose(1, 0, 2)

    def _necks(self, poses: Sequence[HeadPose]) -> FloatArray:
        """(T, 3) neck rotations of the refitted poses."""
        if self.settings.neck == "fold":
            return np.zeros((len(poses), 3))
        given = np.array([pose.neck for pose in poses], dtype=np.float64)
        return given @ self.matching.alignment[:3, :3].T

    def _residuals(
        self, poses: Sequence[HeadPose], columns: dict[str, FloatArray], counterparts: FloatArray
    ) -> dict[str, FloatArray]:
        """Distances of the finished meshes in the world, by the head model itself and not by the fit's algebra."""
        fitted = [self.pose(pose, None, columns, row) for row, pose in enumerate(poses)]
        meshes = self._subject.meshes(fitted)
        gaps = _MILLIMETRES * np.linalg.norm(meshes[:, self.matching.vertices] - counterparts, axis=2)
        face = gaps[:, self._face]
        eyeballs = np.zeros(len(gaps))
        if self._eyeball is not None and self._eyeball.any():
            eyeballs = gaps[:, self._eyeball].mean(axis=1)
        return {
            "mean_mm": face.mean(axis=1),
            "p95_mm": np.percentile(face, 95, axis=1),
            "max_mm": face.max(axis=1),
            "eyeballs_mm": eyeballs,
            "vertex_sums": gaps.sum(axis=0),
        }

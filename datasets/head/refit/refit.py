"""Refit the tracking of a clip to another head model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from ....bench.contracts import FloatArray, HeadPose, Progress, no_progress
from ....bench.errors import InputError
from ....bench.io.arrays import MAX_MAGNITUDE, Member, cached_arrays
from ....bench.io.files import digest
from ...clip import CaptureClip
from ..arrays import HeadArrays
from ..model import PosedSubject
from ..teeth import with_teeth
from .identity import EYEBALLS, FACE, Matching, match, same_topology
from .problem import FitProblem, angle_bounds, solve_frame
from .settings import RefitSettings

BLOCK = 64
"""Number of timesteps per block, which is fitted and stored together; the first one starts from the source's angles."""


class Refitted(NamedTuple):
    """A refitted clip and its residuals."""

    clip: CaptureClip
    report: RefitReport


# The number of threads affects the rounding of sums, and thus the stored blocks and the fingerprint of the refitted
# clip: continuing with another number would give another clip.
@threadpool_limits.wrap(limits=1)
def refit(
    clip: CaptureClip,
    target: HeadArrays,
    settings: RefitSettings | None = None,
    *,
    folder: Path | None = None,
    progress: Progress = no_progress,
) -> Refitted:
    """Fit identity, then every timestep's expression, jaw, eyes and eyelids, to the clip's own meshes; recorded as a step.

    "3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations" (CVPR 2025,
    arXiv 2504.14967), supplement, on comparing with monocular methods: vertex distance over the facial region
    only, identity from the neutral head. The rigid motion of the head is kept exactly.

    ``clip``: Clip tracked with any head model. ``target``: Head model to fit. If the clip's head has teeth of `with_teeth`
    and the target does not, they are added. ``folder``: Cache of finished blocks of timesteps; a second call with the same
    input continues.
    """
    settings = settings or RefitSettings()
    timesteps = sorted(clip.poses)
    _check_tracking(clip)
    target = _with_same_teeth(clip.head, target)
    if settings.static_offset == "residual" and not same_topology(clip.head, target):
        expected = "two head models with one topology, to keep a residual as static offset"
        remedy = "Set static_offset to zero."
        raise InputError(f"head model {target.version!r}", "faces", expected, "different ones", remedy)
    neutral = PosedSubject.of(clip).neutral
    matching = match(clip.head, neutral, target, settings)
    offset = np.zeros(target.template.shape, dtype=np.float32)
    if settings.static_offset == "residual":
        offset = (neutral - PosedSubject(target, matching.shape, offset).neutral).astype(np.float32)
    fitter = BlockFitter(clip, target, matching, offset, settings)

    blocks: list[dict[str, FloatArray]] = []
    for start in range(0, len(timesteps), BLOCK):
        part = timesteps[start : start + BLOCK]
        progress(start, len(timesteps), f"{clip.head.version} to {target.version}")
        blocks.append(fitter.fit_once([clip.poses[t] for t in part], folder, start // BLOCK))
    progress(len(timesteps), len(timesteps), f"{clip.head.version} to {target.version}")

    columns = {name: np.concatenate([block[name] for block in blocks]) for name in PER_TIMESTEP}
    poses = {t: fitter.pose(clip.poses[t], t, columns, row) for row, t in enumerate(timesteps)}
    report = fitter.report(timesteps, columns, np.sum([block["vertex_sums"] for block in blocks], axis=0))
    parameters = {
        "settings": asdict(settings),
        "target": target.version,
        "target_fingerprint": target.fingerprint(),
        "residual": report.summary(),
    }
    derived = clip.derive(
        "refit_head",
        parameters,
        head=target,
        shape=matching.shape,
        static_offset=offset,
        poses=poses,
    )
    return Refitted(derived, report)


def _check_tracking(clip: CaptureClip) -> None:
    where = f"tracking of {clip.subject or 'unnamed subject'}"
    if not clip.poses:
        raise InputError(where, "poses", "at least one timestep", "none")
    for name in ("shape", "static_offset"):
        if not np.isfinite(getattr(clip, name)).all():
            raise InputError(where, name, "finite numbers", "NaN or infinite ones")
    for timestep, pose in sorted(clip.poses.items()):
        for name in ("expression", "rotation", "neck", "jaw", "eyes", "translation", "eyelids"):
            values = getattr(pose, name)
            if values is not None and not np.isfinite(values).all():
                key = f"{name}, timestep {timestep}"
                raise InputError(where, key, "finite numbers", "NaN or infinite ones")


def _with_same_teeth(source: HeadArrays, target: HeadArrays) -> HeadArrays:
    """The target with teeth if the source has them and the topologies differ only by them."""
    teeth = len(source.regions.get("teeth", ()))
    if teeth and "teeth" not in target.regions and len(source.template) == len(target.template) + teeth:
        return with_teeth(target)
    return target


_FORMAT = 1  # format of the stored blocks; increased when the fit changes
_MILLIMETRES = 1e3

PER_TIMESTEP = (
    *("coefficients", "angles", "rotation", "neck", "translation"),
    *("mean_mm", "p95_mm", "max_mm", "eyeballs_mm", "evaluations"),
)


_BLOCK = {
    "coefficients": Member("f", ("T", "C"), MAX_MAGNITUDE),
    "angles": Member("f", ("T", 9), MAX_MAGNITUDE),
    **dict.fromkeys(("rotation", "neck", "translation"), Member("f", ("T", 3), MAX_MAGNITUDE)),
    **dict.fromkeys(("mean_mm", "p95_mm", "max_mm", "eyeballs_mm"), Member("f", ("T",))),
    "evaluations": Member("iu", ("T",)),
    "vertex_sums": Member("f", ("n",)),
}


class BlockFitter:
    """Data shared by all timesteps of a refit."""

    def __init__(
        self,
        clip: CaptureClip,
        target: HeadArrays,
        matching: Matching,
        offset: FloatArray,
        settings: RefitSettings,
    ):
        self.target, self.matching, self.settings = target, matching, settings
        self._source = PosedSubject.of(clip)
        self._subject = PosedSubject(target, matching.shape, offset)
        self._problem = FitProblem(
            target, self._subject.neutral, matching.vertices, matching.weights, settings
        )
        self._to_source = np.linalg.inv(matching.alignment)
        eyeballs = [target.regions[name] for name in EYEBALLS if name in target.regions]
        self._eyeball = np.isin(matching.vertices, np.concatenate(eyeballs)) if eyeballs else None
        self._face = np.isin(matching.vertices, target.regions[FACE])
        self._input = digest(
            *(clip.head.fingerprint(), target.fingerprint(), self._source.neutral, offset),
            *(matching.shape, asdict(settings), _FORMAT),
        )

    def fit(self, poses: Sequence[HeadPose]) -> dict[str, FloatArray]:
        """Fit a block; arrays by the names in `PER_TIMESTEP`, and the residuals' sums by vertex, (n,)."""
        counterparts = self._on_surface(self._source.meshes(poses))
        motions = self._source.motions(poses) @ self._to_source
        local = np.einsum("tni,tij->tnj", counterparts - motions[:, None, :3, 3], motions[:, :3, :3])
        necks = np.zeros((len(poses), 3))
        if self.settings.neck == "keep":
            given_necks = np.array([pose.neck for pose in poses], dtype=np.float64)
            necks = given_necks @ self.matching.alignment[:3, :3].T
        turns = Rotation.from_rotvec(necks).as_matrix()
        frames = self._problem.frames(local, turns)
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
            "rotation": Rotation.from_matrix(motions[:, :3, :3] @ turns.transpose(0, 2, 1)).as_rotvec(),
            "translation": np.zeros((len(poses), 3)),
        }
        turned = [self.pose(pose, None, columns, row) for row, pose in enumerate(poses)]
        columns["translation"] = self._subject.translations(turned, motions)
        return columns | self._residuals(poses, columns, counterparts)

    def fit_once(self, poses: Sequence[HeadPose], folder: Path | None, index: int) -> dict[str, FloatArray]:
        """`fit`, or the result stored in ``folder`` by an earlier call with the same input."""
        if folder is None:
            return self.fit(poses)
        inputs = [[pose.expression, pose.rotation, pose.neck, pose.jaw, pose.eyes] for pose in poses]
        places = [[pose.translation, pose.eyelids] for pose in poses]
        mark = digest(self._input, inputs, places)
        sizes = {"T": len(poses), "C": len(self._problem.bound), "n": len(self.matching.vertices)}
        path = folder / f"refit-{index:05d}.npz"
        return cached_arrays(path, mark, _BLOCK, lambda: self.fit(poses), sizes)

    def pose(
        self, pose: HeadPose, timestep: int | None, columns: dict[str, FloatArray], row: int
    ) -> HeadPose:
        """The refitted pose of a row of the columns."""
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
        """Combine the residuals of all timesteps."""
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
                **{
                    name: float(columns[name][row]) for name in ("mean_mm", "p95_mm", "max_mm", "eyeballs_mm")
                },
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

    def _residuals(
        self, poses: Sequence[HeadPose], columns: dict[str, FloatArray], counterparts: FloatArray
    ) -> dict[str, FloatArray]:
        """Distances of the final meshes in the world, computed by the head model independently of the fit."""
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


@dataclass(frozen=True)
class FrameResidual:
    """Distances between source and refitted mesh at one timestep, over the facial region, millimetres."""

    timestep: int
    mean_mm: float
    p95_mm: float
    max_mm: float
    eyeballs_mm: float
    """Mean over the eyeballs; 0 if they were not fitted."""
    at_bound: tuple[str, ...]
    """Parameters that ended at a bound, such as "expression[3]" or "jaw[0]"."""
    evaluations: int


@dataclass(frozen=True, eq=False)
class RefitReport:
    """Residuals of a whole clip."""

    source: str
    target: str
    """Versions of the head models."""
    frames: Sequence[FrameResidual]
    """One for each timestep, ascending."""
    vertex_mm: FloatArray
    """(V,) mean residual of the target's vertices over the timesteps; NaN for vertices that were not fitted."""
    neutral_mm: float
    """Mean distance of the neutral heads over the facial region."""
    shape_at_bound: tuple[str, ...]
    """Identity coefficients that ended at their bound."""

    def summary(self) -> dict[str, Any]:
        """Means over the timesteps and the worst one, as plain values."""
        worst = max(self.frames, key=lambda frame: frame.mean_mm)
        means = ("mean_mm", "p95_mm", "eyeballs_mm")
        return {
            "source": self.source,
            "target": self.target,
            "timesteps": len(self.frames),
            "neutral_mm": self.neutral_mm,
            **{name: float(np.mean([getattr(frame, name) for frame in self.frames])) for name in means},
            "worst_timestep": worst.timestep,
            "worst_mean_mm": worst.mean_mm,
            "worst_p95_mm": max(frame.p95_mm for frame in self.frames),
            "timesteps_at_bound": sum(bool(frame.at_bound) for frame in self.frames),
            "shape_at_bound": list(self.shape_at_bound),
        }

    def to_json(self) -> Mapping[str, Any]:
        """Summary and every timestep."""
        return {**self.summary(), "frames": [asdict(frame) for frame in self.frames]}

    def text(self) -> str:
        """A paragraph for a terminal."""
        s = self.summary()
        lines = [
            f"{s['source']} to {s['target']}, {s['timesteps']} timesteps; distances over the face, millimetres",
            f"  neutral head    mean {s['neutral_mm']:.3f}",
            f"  timesteps       mean {s['mean_mm']:.3f}   95th percentile {s['p95_mm']:.3f}",
            f"  worst timestep  mean {s['worst_mean_mm']:.3f}   95th percentile {s['worst_p95_mm']:.3f}",
            f"  eyeballs        mean {s['eyeballs_mm']:.3f}",
            f"  timesteps with a parameter at a bound: {s['timesteps_at_bound']}",
        ]
        if self.shape_at_bound:
            lines.append(f"  identity at a bound: {', '.join(self.shape_at_bound)}")
        return "\n".join(lines)

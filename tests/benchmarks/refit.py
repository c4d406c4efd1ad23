"""``headbench bench refit``: residuals and speed of the refit, beside a general solver in the same run."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from ...bench.contracts import FloatArray, FrameKey, HeadAsset, HeadPose, Progress
from ...bench.specs import Findings
from ...datasets.clip import CaptureClip, FrameFiles
from ...datasets.head.arrays import HeadArrays
from ...datasets.head.procedural.model import procedural_head
from ...datasets.head.refit.command import RefitSettings
from ...datasets.head.refit.identity import match
from ...datasets.head.refit.problem import FitProblem, FrameTerms, angle_bounds, solve_frame
from ...datasets.head.refit.refit import refit
from ...datasets.head.subject import PosedSubject, pose_in_head_frame
from ...datasets.images import ImageStore
from .head.speed import FLAME_SIZES, sized_head

TIMESTEPS, QUICK_TIMESTEPS = 192, 64
SCIPY_FRAMES, QUICK_SCIPY_FRAMES = 6, 2
EXACT_MEAN_MM, EXACT_P95_MM = 0.15, 0.40
"""Residuals allowed where the target's own model made the meshes."""
SMALL_RATE, LARGE_RATE = 40.0, 10.0
"""Timesteps a second demanded with the procedural head's bases and with FLAME's sizes."""


def measure(quick: bool, progress: Progress) -> Findings:
    """Refit four synthetic performances; passed where residuals and rates keep the bounds above.

    Rates count the processor seconds of all threads, with everything a refit does: the source's meshes, the fit,
    the residuals of the finished meshes.
    """
    timesteps = QUICK_TIMESTEPS if quick else TIMESTEPS
    large = {version: sized_head(version, *FLAME_SIZES) for version in ("2020", "2023")}
    cases = (
        ("procedural 2020, made by itself", procedural_head("2020"), procedural_head("2020"), True),
        ("procedural 2023 to 2020", procedural_head("2023"), procedural_head("2020"), False),
        ("300 + 100, made by itself", large["2020"], large["2020"], True),
        ("300 + 100, other random bases", large["2023"], large["2020"], False),
    )
    rows = []
    for done, (name, source, target, exact) in enumerate(cases):
        progress(done, len(cases), name)
        frames = QUICK_SCIPY_FRAMES if quick else SCIPY_FRAMES
        row = measure_case(source, target, timesteps, frames if exact else 0)
        rows.append({"case": name, "exact": exact, **row})
    progress(len(cases), len(cases), "")
    faults = [fault for row in rows for fault in _faults(row)]
    lines = [
        f"{timesteps} timesteps; torch threads: {torch.get_num_threads()}; rates by processor seconds.",
        _line(("case", "mean mm", "95 % mm", "worst", "per s", "evaluations", "solver", "scipy")),
        *(_line((row["case"], *(_cell(row, *column) for column in _COLUMNS))) for row in rows),
        "solver, scipy: timesteps a second of the search alone, here and by scipy.optimize.least_squares; one thread.",
        *faults,
    ]
    return Findings("\n".join(lines), {"timesteps": timesteps, "rows": rows}, passed=not faults)


def measure_case(source: HeadArrays, target: HeadArrays, timesteps: int, scipy_frames: int) -> dict[str, Any]:
    """Refit a performance of one head by another and, for some timesteps, solve the same problem with scipy."""
    source = replace(source, version=f"{source.version}-source")
    clip = performance(source, timesteps)
    settings = RefitSettings()
    start = time.process_time()
    report = refit(clip, target, settings).report
    seconds = time.process_time() - start
    row: dict[str, Any] = {
        **{name: report.summary()[name] for name in ("mean_mm", "p95_mm", "worst_mean_mm", "eyeballs_mm")},
        "vertices": len(target.template),
        "timesteps_per_second": timesteps / seconds,
        "evaluations": float(np.mean([frame.evaluations for frame in report.frames])),
    }
    if not scipy_frames:
        return row
    with threadpool_limits(1, user_api="blas"):
        return row | _against_scipy(clip, target, settings, scipy_frames)


def performance(head: HeadArrays, timesteps: int, *, seed: int = 0, strength: float = 1.0) -> CaptureClip:
    """A clip without images in which everything moves: smooth curves, the jaw between closed and wide open.

    Parameters
    ----------
    strength : of the expression; its coefficients' standard deviation.
    """
    rng = np.random.default_rng(seed)
    size = head.expression_basis.shape[2]
    clock = 0.1 * np.arange(timesteps)

    def curves(count: int) -> FloatArray:
        return np.sin(clock[:, None] * rng.uniform(0.4, 2.5, count) + rng.uniform(0, 2 * np.pi, count))

    # Six motions that many coefficients share, as a face's do.
    expression = strength * np.sqrt(1 / 3) * curves(6) @ rng.normal(size=(6, size))
    jaw = np.column_stack([0.22 * (1 + curves(1)), 0.04 * curves(2)])
    rotation, neck, eyes, place = 0.3 * curves(3), 0.1 * curves(3), 0.25 * curves(6), 0.02 * curves(3)
    lids = 0.5 * (1 + curves(2))
    poses = {
        t: HeadPose(
            head_model=head.version,
            expression=expression[t],
            rotation=rotation[t],
            neck=neck[t],
            jaw=jaw[t],
            eyes=eyes[t],
            translation=place[t],
            eyelids=None if head.eyelid_basis is None else lids[t],
            timestep=t,
        )
        for t in range(timesteps)
    }
    keys = tuple(FrameKey("subject", "EMO", t, "camera") for t in range(timesteps))
    return CaptureClip(
        subject="subject",
        shape=np.asarray(0.8 * rng.normal(size=head.shape_basis.shape[2])),
        splits={"train": keys, "novel_view": (), "self_reenactment": ()},
        files={key: FrameFiles(Path("none"), None) for key in keys},
        **without_images(head, poses),
    )


def without_images(head: HeadAsset, poses: dict[int, HeadPose]) -> dict[str, Any]:
    """What is the same of every clip of poses alone."""
    return {
        "head": head,
        "static_offset": np.zeros(head.template.shape),
        "poses": poses,
        "cameras": {},
        "excluded": {},
        "background": np.ones(3),
        "steps": (),
        "source_fingerprint": "",
        "store": ImageStore(),
    }


def _against_scipy(
    clip: CaptureClip, target: HeadArrays, settings: RefitSettings, count: int
) -> dict[str, float]:
    """The same problem, start and bounds for both solvers, in one run; targets are the true meshes, head at rest."""
    subject = PosedSubject(clip.head, clip.shape, clip.static_offset)
    matching = match(clip.head, subject.neutral, target, settings)
    neutral = PosedSubject(target, matching.shape, np.zeros(target.template.shape)).neutral
    problem = FitProblem(target, neutral, matching.vertices, matching.weights, settings)
    poses = [pose_in_head_frame(clip.poses[t]) for t in sorted(clip.poses)[: count + 1]]
    targets = subject.meshes(poses)[:, matching.vertices]
    frames = problem.frames(targets, np.tile(np.eye(3), (count + 1, 1, 1)))
    before = solve_frame(problem, frames[0], np.zeros(9), np.zeros(9), settings)
    ours = theirs = 0.0
    difference = 0.0
    for frame, wanted in zip(frames[1:], targets[1:]):
        start = time.process_time()
        found = solve_frame(problem, frame, before.angles, np.zeros(9), settings)
        ours += time.process_time() - start
        start = time.process_time()
        values = solve_dense(problem, frame, wanted, matching.weights, before, settings)
        theirs += time.process_time() - start
        meshes = [
            problem.fitted(frame, angles, coefficients)
            for angles, coefficients in ((found.angles, found.coefficients), (values[:9], values[9:]))
        ]
        difference = max(difference, float(np.abs(meshes[0] - meshes[1]).max()))
        before = found
    return {
        "solver_per_second": count / ours,
        "scipy_per_second": count / theirs,
        "scipy_difference_mm": 1e3 * difference,
    }


def solve_dense(
    problem: FitProblem,
    frame: FrameTerms,
    wanted: FloatArray,
    weights: FloatArray,
    start: Any,
    settings: RefitSettings,
) -> FloatArray:
    """(9 + E + L,) angles and coefficients by `scipy.optimize.least_squares` on all residuals.

    Its Jacobian is exact in the coefficients and taken by differences in the nine angles.
    """
    root = np.sqrt(weights / weights.sum())[:, None] * 1e3
    size = len(problem.bound)
    prior = settings.prior_mm * np.eye(size)

    def residuals(values: FloatArray) -> FloatArray:
        gaps = root * (problem.fitted(frame, values[:9], values[9:]) - wanted)
        return np.concatenate([gaps.ravel(), settings.prior_mm * values[9:]])

    def jacobian(values: FloatArray) -> FloatArray:
        columns = root[..., None] * problem.directions(frame, values[:9])
        rows = np.concatenate([columns.reshape(-1, size), prior])
        steps = 1e-6 * np.eye(len(values))[:9]
        angles = [(residuals(values + step) - residuals(values - step)) / 2e-6 for step in steps]
        return np.column_stack([*angles, rows])

    bound = np.concatenate([angle_bounds(settings), problem.bound])
    first = np.concatenate([start.angles, start.coefficients])
    first = np.clip(first, -0.999 * bound, 0.999 * bound)
    found = least_squares(residuals, first, jacobian, bounds=(-bound, bound), x_scale="jac")
    return np.asarray(found.x)


_COLUMNS = (
    *(("mean_mm", 4), ("p95_mm", 4), ("worst_mean_mm", 4), ("timesteps_per_second", 1), ("evaluations", 1)),
    *(("solver_per_second", 1), ("scipy_per_second", 1)),
)


def _cell(row: dict[str, Any], name: str, digits: int) -> str:
    return f"{row[name]:.{digits}f}" if name in row else "-"


def _line(cells: Sequence[str]) -> str:
    return f"{cells[0]:34}" + "".join(f"{cell:>12}" for cell in cells[1:])


def _faults(row: dict[str, Any]) -> list[str]:
    """What of a row breaks its bounds, one line each."""
    demanded = LARGE_RATE if row["case"].startswith("300") else SMALL_RATE
    found = []
    if row["exact"] and not (row["mean_mm"] <= EXACT_MEAN_MM and row["p95_mm"] <= EXACT_P95_MM):
        found.append(f"{row['case']}: residual over {EXACT_MEAN_MM} mm mean, {EXACT_P95_MM} mm at 95 %")
    if not row["timesteps_per_second"] >= demanded:
        found.append(f"{row['case']}: fewer than {demanded:g} timesteps a second")
    return found

"""``headbench doctor bench refit``: what remains after a refit to another head model, and how fast it is."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ...bench.benchmarks import Row, findings
from ...bench.contracts import FloatArray, FrameKey, HeadPose, Progress
from ...bench.specs import CommandResult
from ..clip import CaptureClip, FrameFiles, without_images
from ..head.arrays import HeadArrays
from ..head.procedural.model import procedural_head
from ..head.refit.refit import refit
from ..head.refit.settings import RefitSettings
from .head import FLAME_SIZES, sized_head

TIMESTEPS, QUICK_TIMESTEPS = 192, 64
EXACT_MEAN_MM, EXACT_P95_MM = 0.15, 0.40
"""Residuals allowed where the target's own model made the meshes."""
SMALL_RATE, LARGE_RATE = 40.0, 10.0
"""Timesteps a second demanded with the procedural head's bases and with FLAME's sizes."""
CASES = (
    ("procedural 2020, made by itself", "2020", "2020", False),
    ("procedural 2023 to 2020", "2023", "2020", False),
    ("300 + 100, made by itself", "2020", "2020", True),
    ("300 + 100, other random bases", "2023", "2020", True),
)
"""Name, versions of source and target, whether their bases have FLAME's sizes."""


def speed(quick: bool, progress: Progress) -> CommandResult:
    """Refit four synthetic performances; passed where residuals and rates keep their bounds."""
    rows: list[Row] = []
    faults = []
    for done, (name, source, target, large) in enumerate(CASES):
        progress(done, len(CASES), name)
        heads = [sized_head(v, *FLAME_SIZES) if large else procedural_head(v) for v in (source, target)]
        demanded = LARGE_RATE if large else SMALL_RATE
        row = measure_case(heads[0], heads[1], QUICK_TIMESTEPS if quick else TIMESTEPS)
        rows.append({"case": name, **row})
        if source == target and not (row["mean mm"] <= EXACT_MEAN_MM and row["95 % mm"] <= EXACT_P95_MM):
            faults.append(f"{name}: residual over {EXACT_MEAN_MM} mm mean, {EXACT_P95_MM} mm at 95 %")
        if not row["timesteps/s"] >= demanded:
            faults.append(f"{name}: fewer than {demanded:g} timesteps a second")
    note = (
        f"{QUICK_TIMESTEPS if quick else TIMESTEPS} timesteps, {torch.get_num_threads()} threads. Rates count the processor "
        "seconds of all threads, with everything a refit\ndoes: the source's meshes, the fit, the residuals of the finished "
        "meshes."
    )
    return findings({"Refits": rows}, note, faults)


def measure_case(source: HeadArrays, target: HeadArrays, timesteps: int) -> Row:
    """Refit a performance of one head by another."""
    clip = performance(replace(source, version=f"{source.version}-source"), timesteps)
    start = time.process_time()
    report = refit(clip, target, RefitSettings()).report
    seconds = time.process_time() - start
    residuals = report.summary()
    return {
        "mean mm": residuals["mean_mm"],
        "95 % mm": residuals["p95_mm"],
        "worst frame mm": residuals["worst_mean_mm"],
        "timesteps/s": timesteps / seconds,
        "evaluations": float(np.mean([frame.evaluations for frame in report.frames])),
    }


def performance(head: HeadArrays, timesteps: int, *, seed: int = 0, strength: float = 1.0) -> CaptureClip:
    """A clip without images in which everything moves: smooth curves, the jaw between closed and wide open.

    Parameters
    ----------
    strength : float
        Standard deviation of the expression coefficients.
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

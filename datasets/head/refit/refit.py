"""Refit the tracking of a clip to another head model."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from ....bench.contracts import FloatArray, Progress, no_progress
from ....bench.errors import InputError
from ...clip import CaptureClip
from ..arrays import HeadArrays
from ..teeth import with_teeth
from .block import PER_TIMESTEP, BlockFitter
from .identity import Matching, match, same_topology
from .report import RefitReport
from .settings import RefitSettings
from .subject import Subject

BLOCK = 64
"""Timesteps that are fitted, and kept on disk, together; the first of each starts from the source's angles."""


class Refitted(NamedTuple):
    """A refitted clip and how well it fits."""

    clip: CaptureClip
    report: RefitReport


def refit_clip(
    clip: CaptureClip,
    target: HeadArrays,
    settings: RefitSettings | None = None,
    *,
    folder: Path | None = None,
    progress: Progress = no_progress,
) -> CaptureClip:
    """Carry a clip's tracking over to the head model ``target``; a recorded step. See `refit`."""
    return refit(clip, target, settings, folder=folder, progress=progress).clip


# The number of threads decides how sums are rounded, and by that whether blocks kept earlier fit and what the
# refitted clip's fingerprint is: a run that continues with another number would find another clip.
@threadpool_limits.wrap(limits=1)
def refit(
    clip: CaptureClip,
    target: HeadArrays,
    settings: RefitSettings | None = None,
    *,
    folder: Path | None = None,
    progress: Progress = no_progress,
) -> Refitted:
    """Fit identity, then every timestep's expression, jaw, eyes and eyelids, to the clip's own meshes.

    "3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations" (CVPR 2025,
    arXiv 2504.14967), supplement, on comparing with monocular methods: vertex distance over the facial region
    only, identity from the neutral head. The rigid motion of the head is carried over exactly.

    Parameters
    ----------
    clip : tracked with any head model.
    target : head model to fit. Where the clip's has teeth of `with_teeth` and the target none, they are added.
    folder : where finished blocks of timesteps are kept, so that a second call with the same input continues.

    Raises
    ------
    InputError
        Where there is no timestep, the tracking holds numbers that are not finite, or the models do not go
        together (see `match`).
    """
    settings = settings or RefitSettings()
    timesteps = sorted(clip.poses)
    _check_tracking(clip)
    target = _with_same_teeth(clip.head, target)
    if settings.static_offset == "residual" and not same_topology(clip.head, target):
        expected = "two head models over one topology, to keep a residual as static offset"
        remedy = "Set static_offset to zero."
        raise InputError(f"head model {target.version!r}", "faces", expected, "different ones", remedy)
    neutral = Subject(clip.head, clip.shape, clip.static_offset).neutral
    matching = match(clip.head, neutral, target, settings)
    offset = _static_offset(neutral, target, matching, settings)
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
        "settings": settings.record(),
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
                raise InputError(
                    where, f"{name}, timestep {timestep}", "finite numbers", "NaN or infinite ones"
                )


def _with_same_teeth(source: HeadArrays, target: HeadArrays) -> HeadArrays:
    """The target with teeth where the source has them and they are all that the topologies differ in."""
    teeth = len(source.regions.get("teeth", ()))
    if teeth and "teeth" not in target.regions and len(source.template) == len(target.template) + teeth:
        return with_teeth(target)
    return target


def _static_offset(
    neutral: FloatArray,
    target: HeadArrays,
    matching: Matching,
    settings: RefitSettings,
) -> FloatArray:
    """(V, 3) float32, what the identity leaves of the neutral head, or zeros."""
    zero = np.zeros(target.template.shape, dtype=np.float32)
    if settings.static_offset == "zero":
        return zero
    return (neutral - Subject(target, matching.shape, zero).neutral).astype(np.float32)

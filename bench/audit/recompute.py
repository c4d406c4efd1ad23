"""Trains the methods of a bundle again from seeds and settings, and compares the results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd

from ..contracts import Progress, no_progress
from ..engine.captures import open_run_clips
from ..engine.config import RunOptions, resolve_methods
from ..engine.run import run
from ..engine.store import RunFolder
from ..errors import InputError
from ..executors.settings import Execution
from ..manifest import Manifest
from ..rows import ALL, Rows
from ..specs import MetricSpec
from .verify import KEY, captured_again

MOST_PIXELS = 2 * 10**10
"""Maximum pixels of captures that are regenerated for a training; those of the suite have a hundredth."""
TOLERANCES = {"psnr": 0.25, "ssim": 0.002, "lpips": 0.002}
"""Maximum difference of a method's mean with the same seed on another machine.

Repeated trainings on one machine are bit-identical. Across instruction sets, means of the demo differed by up to 0.20 dB of
PSNR
and 0.001 of SSIM, those of a run of 150 iterations with and without vector instructions by up to 0.05 dB, 0.0009 of SSIM and
0.0002 of LPIPS.
"""
STORAGE_TOLERANCE = 0.01
"""Maximum relative difference of storage; in the same trials it differed by up to 0.001."""


@dataclass(frozen=True)
class Agreement:
    """Agreement of a metric, over all methods of a bundle, with another training.

    Attributes
    ----------
    value, mean : float
        Largest difference of a single value, and of the mean of a method in a task; infinite where values exist on one side only.
    tolerance : float
        Largest allowed difference of means.
    """

    metric: str
    value: float
    mean: float
    tolerance: float

    @property
    def agrees(self) -> bool:
        """Whether means differ by no more than the tolerance."""
        return self.mean <= self.tolerance

    def __str__(self) -> str:
        verdict = "" if self.agrees else ", which is more"
        return (
            f"{self.metric}: a single value differs by at most {self.value:.3g}, a mean by {self.mean:.3g} "
            f"(tolerance {self.tolerance:.3g}{verdict})"
        )


def train_again(
    folder: RunFolder,
    out: Path,
    options: RunOptions,
    execution: Execution | None = None,
    progress: Progress = no_progress,
) -> RunFolder:
    """Run the configuration of an unpacked bundle into ``out``, on regenerated captures; continue if it was interrupted.

    Raises
    ------
    InputError
        Nothing was trained for the bundle; its captures cannot be regenerated or differ; or it names modules or programs,
        which require `RunOptions.trust`.
    """
    manifest = folder.read_manifest()
    config = manifest.configuration
    if config.source or not all(method.implementation for method in manifest.methods):
        raise InputError(folder.manifest, "methods", "methods that were trained", "images or derived avatars")
    if options.data is None:
        capture = captured_again(manifest, out / "capture", MOST_PIXELS, progress)
        options = replace(options, data=str(capture))
    config, clips = open_run_clips(folder.root, options, out=out / "run")
    for method in resolve_methods(config):
        if not (method.spec.native or options.trust):
            expected = "methods that run no program which the bundle names"
            remedy = "Give --trust to run it, if you trust who made the bundle."
            raise InputError(folder.manifest, "configuration.methods", expected, method.spec.name, remedy)
    run(config, execution, clips=clips, reports=False)
    return RunFolder(out / "run")


def agreements(rows: Rows, again: Rows, metrics: Mapping[str, MetricSpec]) -> list[Agreement]:
    """Compare rows with those of another training by metric, except metrics that depend on the machine."""
    tables = []
    for each in (rows, again):
        table = each.select(method=ALL, condition=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
        tables.append(table[table["status"] == "ok"].set_index(KEY)["value"])
    both = pd.concat(tables, axis=1, keys=("claimed", "again"))
    found = []
    for name, table in both.groupby("metric"):
        spec = metrics.get(str(name))
        if spec is None or spec.machine_bound:
            continue
        means = table.groupby(["method", "condition", "task", "region"]).mean()
        apart = (means["claimed"] - means["again"]).abs()
        tolerance = TOLERANCES.get(str(name), 10.0**-spec.digits)
        if str(name).startswith("storage"):
            tolerance = STORAGE_TOLERANCE * float(means["again"].max())
        values = (table["claimed"] - table["again"]).abs()
        complete = bool(values.notna().all())
        found.append(
            Agreement(
                *(str(name), float(values.max()) if complete else float("inf")),
                *(float(apart.max()) if complete else float("inf"), tolerance),
            )
        )
    return found


def results_again(out: Path, manifest: Manifest) -> Rows | None:
    """Rows of a finished training of `train_again` into ``out``; None if there is none.

    Raises `InputError` for a damaged run, and for one with other settings, frames or captures than the bundle.
    """
    folder = RunFolder(out / "run")
    if not folder.manifest.is_file():
        return None
    again = folder.read_manifest()
    if again.status != "done" or [m.label for m in again.methods] != [m.label for m in manifest.methods]:
        return None
    claimed, made = ({t: record.hash for t, record in m.protocols.items()} for m in (manifest, again))
    if made != claimed:
        task = min(task for task in {*claimed, *made} if claimed.get(task) != made.get(task))
        hashes = (str(each.get(task, "none")) for each in (claimed, made))
        raise InputError(folder.manifest, f"protocol of {task}", *hashes)
    for claim, trained in zip(manifest.methods, again.methods, strict=True):
        for name in ("config", "budget"):
            values = str(getattr(claim, name)), str(getattr(trained, name))
            if values[0] != values[1]:
                raise InputError(folder.manifest, f"methods.{claim.label}.{name}", *values)
    return folder.rows_by_condition(again)

"""``headbench run extremes`` and ``headbench run reenact``: tests of a run's avatars beyond its test frames."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from ..condition import Condition, Named
from ..contracts import Progress, no_progress
from ..engine.config import RunOptions, with_methods
from ..engine.plan import trained
from ..engine.run import run
from ..engine.store import RunFolder
from ..executors.settings import ExecutionOptions, check_executor
from ..io.files import check_kind, output_inside, write_json
from ..io.lock import locked
from ..registry import get, resolve
from ..rows import ALL, Rows
from ..specs import CommandResult, command


@dataclass(frozen=True)
class ExtremesSettings(RunOptions, ExecutionOptions):
    """Render a run's avatars in new views and in random poses of expression and jaw; exit code 1 if a limit is exceeded.
    Synthetic captures have a path-traced ground truth for every pose and view."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write; default: `extremes` in the folder of the run."""

    methods: tuple[str, ...] = ()
    """Methods to test; default: all but the trivial baselines."""

    views: int = 16
    """Views of the turntable, in even steps."""

    beyond: float = 30.0
    """Angle of the turntable beyond the outermost training cameras, degrees."""

    dimensions: int = 8
    """Principal components of expression and jaw in training."""

    samples: int = 24
    """Number of random poses along all components, each rendered in two views."""

    sigmas: float = 3.0
    """Largest distance along a component, in standard deviations; never beyond the range of training."""

    path: int = 12
    """Frames of a sequence through two of the poses, for flicker; 0: none."""

    def __post_init__(self) -> None:
        for name, least in (("views", 1), ("dimensions", 1), ("samples", 1), ("path", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; at least {least}")
        if not 0.0 <= self.beyond < 180.0:
            raise ValueError(f"beyond is {self.beyond}; from 0 to less than 180 degrees")
        if not 0.0 < self.sigmas <= 10.0:
            raise ValueError(f"sigmas is {self.sigmas}; above 0, at most 10")

    @property
    def parameters(self) -> dict[str, Any]:
        """Of the registered change "extremes"."""
        names = ("views", "beyond", "dimensions", "samples", "sigmas", "path")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class ReenactSettings(RunOptions, ExecutionOptions):
    """Drive a run's avatars with another subject's expressions (cross-reenactment); exit code 1 if a limit
    is exceeded."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write; default: `cross_reenactment` in the folder of the run."""

    source: str | None = None
    """Driving capture (or folder of several); default: every other subject of the run."""

    methods: tuple[str, ...] = ()
    """Methods to drive; default: all but the trivial baselines."""

    camera: str | None = None
    """Camera of the target to render; default: the first held out, or else the first of training."""

    frames: int | None = None
    """Maximum number of rendered timesteps of each source, evenly spaced; default: all."""

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 1:
            raise ValueError(f"frames is {self.frames}; at least 1")

    @property
    def parameters(self) -> dict[str, Any]:
        """Of the registered change "reenact"."""
        return {"source": self.source, "camera": self.camera, "frames": self.frames}


RECORD_FILE = "record.json"
"""File with settings, limits, protocols and results of each avatar."""


@command("run extremes", group="compare")
def extremes_run(settings: ExtremesSettings, progress: Progress = no_progress) -> CommandResult:
    """Render views and poses beyond training; check against ground truth and stability limits.

    Does not pass if a limit is broken or an avatar failed. A restart keeps finished work. Raises `InputError`
    for a folder that is not a finished run, and for a capture that is not the run's.
    """
    return _run(settings, "extremes", "extremes")


@command("run reenact", group="compare")
def reenact_run(settings: ReenactSettings, progress: Progress = no_progress) -> CommandResult:
    """Drive avatars with another subject's expressions; check stability limits.

    Does not pass if a limit is broken or an avatar failed. A restart keeps finished work. Raises `InputError`
    for a folder that is not a finished run, without another subject, and for a source tracked with another
    head model.
    """
    return _run(settings, "reenact", "cross_reenactment")


def _run(settings: ExtremesSettings | ReenactSettings, drive: str, task: str) -> CommandResult:
    """Run the plan in the folder of the task; write the record and the report."""
    execution, source = settings.execution, RunFolder(Path(settings.run))
    source.read_manifest()  # before a folder is created
    out = Path(settings.out) if settings.out else source.root / task
    check_kind(out, "a run")
    with nullcontext() if settings.out else output_inside(source.root), locked(out):
        config, jobs = trained(source.root, settings.methods, settings, out)
        check_executor(execution, config.device)
        config = replace(
            with_methods(config, {job.method.spec.name for job in jobs}),
            regions=(),
            conditions=(Condition(drive=Named(drive, settings.parameters)),),
            source=settings.run,
        )
        clips = list({job.clip.subject: job.clip for job in jobs}.values())
        rows = run(config, execution, clips=clips, is_locked=True, reports=False).rows
        _write_record(out, drive, rows, settings.others)
        shown: CommandResult = resolve(get("reports", "robustness").implementation)(out)
        return shown


def _write_record(out: Path, drive: str, rows: Rows, settings: dict[str, Any]) -> None:
    """Write the results of each avatar, in the order of the run, or the reason of a failure."""
    folder = RunFolder(out)
    manifest = folder.read_manifest()
    table = rows.select(method=ALL, condition=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    without = table[(table["timestep"] < 0) & (table["task"] != "")].drop_duplicates(
        ["subject", "method", "seed"]
    )
    failed = without[["subject", "method", "seed", "reason"]].to_dict("records")
    places = {(each["subject"], each["method"], each["seed"]) for each in failed}
    avatars: list[dict[str, Any]] = []
    for clip in manifest.clips:
        for method in manifest.methods:
            for seed in manifest.configuration.seeds:
                details = folder.cell(clip.subject, method.label, seed).record.get("details", {})
                if (clip.subject, method.name, seed) not in places and drive in details:
                    avatars += details[drive]["avatars"]
    record = {
        "settings": settings,
        "limits": resolve(get("conditions", drive).implementation.partition(":")[0] + ":LIMITS"),
        "protocols": [
            asdict(each) for each in sorted(manifest.protocols.values(), key=lambda each: each.hash)
        ],
        "avatars": avatars,
        **({"failed": failed} if failed else {}),
    }
    write_json(out / RECORD_FILE, record)

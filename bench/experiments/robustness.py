"""``headbench run extremes`` and ``headbench run reenact``: tests of a run's avatars beyond its test frames."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from ..condition import Condition, Named
from ..contracts import Progress, no_progress
from ..engine.config import with_methods
from ..engine.plan import trained
from ..engine.run import run
from ..engine.store import RunFolder
from ..executors.settings import check_executor
from ..io.files import check_kind, output_inside, write_json
from ..io.lock import locked
from ..registry import get, resolve
from ..rows import ALL, Rows
from ..specs import CommandResult, command
from .robustness_settings import ExtremesSettings, ReenactSettings

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

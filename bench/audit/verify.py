"""``headbench verify``: scores the stored frames of runs again and compares the values with the rows."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from ..condition import Condition, Named
from ..contracts import Progress, no_progress
from ..engine.captures import open_run_clips
from ..engine.cell import measure, render
from ..engine.config import CODED_VARIANT, RunOptions, resolve_cells, resolve_metrics
from ..engine.plan import Job, make_jobs
from ..engine.store import Cell, RunFolder
from ..errors import ExitCode, InputError
from ..io.images import read_png
from ..manifest import ProtocolRecord
from ..progress import counted
from ..protocol import run_protocols
from ..rows import ALL, FRAME, Rows
from ..specs import CommandResult, MetricSpec, command
from .evaluate import NoAvatar, images_method

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class VerifySettings(RunOptions):
    """Score the stored frames of runs again and compare the values with those of the runs.

    Captures, protocols, frames and avatars are compared with the run's record, too. The last line of a run names what was not
    verified. Exit code 0: everything that was verified is as recorded; 1: something differs; 2: wrong usage; 3: a run or its
    capture is missing or invalid.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs, or of `headbench evaluate`."""

    render: bool = False
    """Also render the stored avatars again and compare the frames, which may differ by one level of 8 bits."""

    def __post_init__(self) -> None:
        """Refuse to verify nothing."""
        if not self.runs:
            raise InputError("command line", "RUNS", "a run", "none")


KEY = ["method", "condition", "seed", "task", *FRAME, "region", "metric"]
SHOWN = 20
LEVELS = 1
"""Maximum difference of a pixel that is rendered again, in 8-bit levels: processors round differently."""


@dataclass
class Findings:
    """Differences between a run and its record, the number of values compared, and reasons why items were not, by name."""

    mismatches: list[str] = field(default_factory=list)
    values: int = 0
    unverified: dict[str, str] = field(default_factory=dict)

    def differ(self, place: object, expected: object, found: object) -> None:
        """Add a difference."""
        self.mismatches.append(f"{place}: expected {expected}, found {found}")

    def text(self, name: str) -> str:
        """The findings in words."""
        count = len(self.mismatches)
        compared = counted(self.values, "value")
        wrong = "1 mismatch" if count == 1 else f"{count} mismatches"
        verdict = f"{wrong}: {compared} compared" if count else f"{compared} as recorded"
        lines = [f"{name}: {verdict}.", *(f"  {mismatch}" for mismatch in self.mismatches[:SHOWN])]
        lines += [f"  and {count - SHOWN} more"] if count > SHOWN else []
        reasons: dict[str, list[str]] = {}
        for item, reason in self.unverified.items():
            reasons.setdefault(reason, []).append(item)
        parts = [f"{', '.join(items)} ({reason})" for reason, items in reasons.items()]
        return "\n".join([*lines, *([f"Not verified: {'; '.join(parts)}."] if parts else [])])


@command("verify", group="validate")
def verify_runs(settings: VerifySettings, progress: Progress = no_progress) -> CommandResult:
    """Score a run's stored frames again and report values that differ.

    A folder that is not a finished run, or a capture that cannot be opened, is a finding with exit code 3.
    """
    texts, data, codes = [], [], []
    for name in settings.runs:
        try:
            findings = verify(Path(name), settings, progress)
        except InputError as error:
            texts.append(f"{name}: Verify: missing or invalid: {error}")
            data.append({"run": name, "error": str(error)})
            codes.append(ExitCode.NO_VERDICT)
            continue
        texts.append(findings.text(name))
        data.append({"run": name, **asdict(findings)})
        codes.append(ExitCode.NEGATIVE if findings.mismatches else ExitCode.OK)
    code = max(codes, key=(ExitCode.OK, ExitCode.NO_VERDICT, ExitCode.NEGATIVE).index)
    return CommandResult("\n".join(texts), {"runs": data}, code == ExitCode.OK, code)


def verify(run: Path, settings: VerifySettings, progress: Progress = no_progress) -> Findings:
    """Compare captures, protocols, avatars and values of a run with its record."""
    folder, findings = RunFolder(run), Findings()
    manifest = folder.read_manifest()
    manifest.check_done(folder.manifest)
    if drive := manifest.configuration.drive:
        answer = f"those of {drive.name}, which are rendered and scored at once"
        raise InputError(folder.manifest, "configuration.conditions", "frames of a capture", answer)
    trained = any(method.implementation for method in manifest.methods)  # otherwise images, of `evaluate`
    used: Any = ("methods", "metrics") if trained else ("metrics",)
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        config, clips = open_run_clips(run, settings, out=scratch, altered=True, use_cache=False, used=used)
        fingerprints = {clip.subject: clip.fingerprint for clip in clips}
        for clip in manifest.clips:
            now = fingerprints.get(clip.subject, "no such capture")
            if now != clip.fingerprint:
                findings.differ(f"{folder.manifest}, fingerprint of {clip.subject}", clip.fingerprint, now)
        protocols = run_protocols(config.tasks, clips, config.frames_per_task)
        for task in sorted({*protocols, *manifest.protocols}):
            recorded = manifest.protocols.get(task)
            planned = ProtocolRecord.of(protocols[task]) if task in protocols else None
            if planned != recorded:
                wanted, answer = (each.hash if each else "none" for each in (planned, recorded))
                answer = "other frames or rules of this hash" if wanted == answer else answer
                findings.differ(f"{folder.manifest}, protocol of {task}", wanted, answer)
        if findings.mismatches:
            return findings
        folder.read_rows(manifest)
        rows = Rows.read(folder.rows)
        rows.check_protocols(folder.rows, {task: protocol.hash for task, protocol in protocols.items()})
        images = [(images_method(m.name, m.version), Condition(m.condition)) for m in manifest.methods]
        cells = resolve_cells(config) if trained else images
        jobs = make_jobs(config, cells, clips, protocols, folder, scratch)
        names = {metric.name for metric in manifest.metrics}
        metrics = [metric for metric in resolve_metrics(config) if metric.name in names]
        for index, job in enumerate(jobs):
            _verify_cell(job, job.rows_of(rows), metrics, settings.render, findings)
            progress(index + 1, len(jobs), job.name)
    return findings


def _verify_cell(
    job: Job, rows: pd.DataFrame, metrics: Sequence[MetricSpec], render_again: bool, found: Findings
) -> None:
    """Add the findings of one cell, whose recorded values are ``rows``."""
    if len(rows) and (rows["status"] == "failed").all():
        found.unverified[f"the failure of {job.name}"] = "as it was recorded"
        return
    # Methods read coded variants like their own avatars, others not.
    stored = bool(job.method.spec.implementation) and job.condition.derive in (Named(), CODED_VARIANT)
    made_from = job.cell.record.get("fingerprint")
    if job.method.spec.implementation and made_from != job.fit_fingerprint:
        answer = "none" if made_from is None else "one of other settings, data or version"
        found.differ(job.cell.file, f"the avatar of {job.name}", answer)
    unreadable = [path for path in job.frame_paths if not _can_be_scored(job, path)]
    for path in unreadable:
        found.differ(path, "a frame of its size", "one that is damaged" if path.exists() else "no such file")
    if unreadable:
        return
    avatar = job.load() if stored else NoAvatar()
    again = []
    for metric in metrics:
        if metric.per_frame or (stored and metric.kind != "training" and not metric.machine_bound):
            again.append(metric)
        else:
            found.unverified[metric.name] = "of the training, the machine or an avatar that is not stored"
    with tempfile.TemporaryDirectory() as name:
        drawn, scored = (replace(job, cell=Cell(Path(name) / part)) for part in ("drawn", "scored"))
        if render_again and stored:
            render(drawn, avatar)
            for path, copy in zip(job.frame_paths, drawn.frame_paths):
                most = int(np.abs(read_png(path).astype(int) - read_png(copy)).max())
                if most > LEVELS:
                    found.differ(path, "the frame that the avatar renders", f"one that differs by {most}")
        scored.cell.folder.mkdir()
        (scored.cell.folder / "renders").symlink_to((job.cell.folder / "renders").resolve())
        measured = measure(scored, avatar, again)
    new = measured.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL, condition=ALL)
    recorded, now = ({*table.loc[table["status"] == "ok", "metric"]} for table in (rows, new))
    lost = new[new["metric"].isin(recorded - now)].groupby("metric")["reason"].first()
    found.unverified |= {str(name): str(reason) for name, reason in lost.items()}
    known = [metric for metric in again if metric.name not in lost]
    _compare(job.run / "rows.parquet", rows, new, known, found)


def _can_be_scored(job: Job, path: Path) -> bool:
    camera = job.clip.cameras[job.frame_paths[path][1].camera]
    try:
        return read_png(path).shape == (camera.height, camera.width, 3)
    except InputError:
        return False


def _compare(
    file: Path, rows: pd.DataFrame, again: pd.DataFrame, metrics: Sequence[MetricSpec], found: Findings
) -> None:
    """Compare the recorded values of a cell with those measured again; NaN where there is none.

    Values may differ by a tenth of the last displayed digit, since networks round differently on other machines.
    """
    import pandas as pd

    digits = {metric.name: metric.digits for metric in metrics}
    rows = rows[rows["metric"].isin(digits.keys())]
    if rows.duplicated(KEY).any():
        found.differ(
            f"{file}, {_place(rows[rows.duplicated(KEY)][KEY].iloc[0].tolist())}", "one row", "several"
        )
        return
    both = pd.concat([again.set_index(KEY)["value"], rows.set_index(KEY)["value"]], axis=1)
    for key, *values in both.dropna(how="all").itertuples(name=None):
        if not abs(values[0] - values[1]) <= 10.0 ** -(digits[key[-1]] + 1):
            shown = ("no value" if np.isnan(value) else f"{value:.9g}" for value in values)
            found.differ(f"{file}, {_place(key)}", *shown)
    found.values += int(rows["value"].notna().sum())


def _place(key: Sequence[Any]) -> str:
    parts = dict(zip(KEY, key))
    frame = f"{parts['sequence']} {parts['timestep']} {parts['camera']}" if parts["task"] else "avatar"
    return f"{parts['metric']} ({parts['region']}) of {parts['method']}, {parts['subject']} {frame}"

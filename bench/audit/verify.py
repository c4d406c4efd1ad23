"""``headbench verify``."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import pandas as pd

from ..condition import Condition
from ..contracts import Avatar, Clip, FrameKey, Progress, no_progress
from ..engine.captures import Plugins, open_run_clips, synthesis_arguments
from ..engine.config import resolve_cells, resolve_metrics
from ..engine.jobs import load, make_jobs
from ..engine.steps import DIGESTS, Job, measure, recorded_frames
from ..engine.store import Cell, RunFolder
from ..errors import ExitCode, HeadbenchError, InputError
from ..executors.remote import run_as_task
from ..io.files import digest, digest_file
from ..io.images import read_png
from ..manifest import Manifest, ProtocolRecord
from ..protocol import Protocol, make_protocols
from ..registry import get, resolve
from ..rows import ALL, FRAME, Rows
from ..specs import CommandResult, MetricSpec
from .bundle import read_bundle
from .evaluate import NoAvatar, images_method
from .settings import VerifySettings

KEY = ["method", "condition", "seed", "task", *FRAME, "region", "metric"]
SHOWN = 20
PIXELS_PER_BYTE = 100
"""Of the captures that are made again for a bundle; its renders have about one of a byte, a run scores a tenth of them at
least."""


@dataclass(frozen=True)
class Mismatch:
    """A file or value that differs from its record."""

    file: Path
    key: str
    expected: str
    found: str

    def __str__(self) -> str:
        where = f"{self.file}, {self.key}" if self.key else str(self.file)
        return f"{where}: expected {self.expected}, found {self.found}"


@dataclass
class _Report:
    """Checks and findings."""

    mismatches: list[Mismatch]
    files: int = 0
    values: int = 0
    unverified: int = 0


def verify_run(settings: VerifySettings, progress: Progress = no_progress) -> CommandResult:
    """Verify a run; not passed if anything differs.

    Recomputed: fingerprints of the captures, hashes of the protocols, fingerprint of each avatar's inputs,
    digests of frames and avatar files, every metric of frames and those of avatars that are not bound to a machine.
    A value may differ by a tenth of the last digit that tables show, for networks that round otherwise elsewhere.

    A folder that is not a finished run, or a capture that cannot be opened, is a finding with exit code 3.
    """
    if settings.execution.executor != "inline":
        run = Path(settings.run)
        place = run.with_name(f"{run.name}-verify-task")
        return run_as_task(f"{__name__}:verify_run", settings, place, "cpu")
    try:
        with tempfile.TemporaryDirectory() as scratch:
            if Path(settings.run).is_file():
                return _verify_bundle(settings, Path(scratch), progress)
            return _verify(settings, Path(scratch), progress)
    except InputError as error:
        text = f"Verify: missing or invalid: {error}"
        return CommandResult(text, {"error": str(error)}, False, ExitCode.NO_VERDICT)


def _verify_bundle(settings: VerifySettings, scratch: Path, progress: Progress) -> CommandResult:
    """Check a bundle's digests and records; recompute the metrics of its renders if it has them."""
    file, folder = Path(settings.run), RunFolder(scratch / "run")
    bundle = read_bundle(file, folder.root)
    manifest = folder.read_manifest()
    manifest.check_done(folder.manifest)
    rows = folder.read_rows(manifest)
    rows.check()
    rows.check_protocols(file, {task: protocol.hash for task, protocol in manifest.protocols.items()})
    if not bundle.renders:
        report = _Report([], len(bundle.files), unverified=len(rows))
        text = (
            f"{file}: {report.files} files as listed, rows of one protocol for each task. No value was recomputed: the "
            "bundle has no renders (`headbench bundle --renders`)."
        )
        return CommandResult(text, asdict(report))
    if settings.data is None:
        limit = PIXELS_PER_BYTE * file.stat().st_size
        settings = replace(
            settings, data=str(_captured_again(manifest, scratch / "capture", limit, progress))
        )
    return _verify(replace(settings, run=str(folder.root)), scratch, progress, shown=file)


def _captured_again(manifest: Manifest, out: Path, limit: int, progress: Progress) -> Path:
    """Regenerate the synthetic captures of a run from their clips; ``limit`` bounds their pixels.

    Raises `InputError` for a capture that is not synthetic, not of the procedural head, or larger.
    """
    make = resolve(get("datasets", "synthetic").implementation)
    captures = {}
    for clip in manifest.clips:
        arguments = synthesis_arguments(clip.steps, clip.subject)
        captures[digest(arguments)] = f"capture of {clip.subject}", arguments
    total = 0
    for where, arguments in captures.values():
        factors = (*arguments["size"], *(arguments[name] for name in ("cameras", "timesteps", "subjects")))
        total += math.prod(factors)
        if total > limit or min(factors) < 1:
            expected = f"at most {limit} pixels in all for a bundle of this size"
            found = " x ".join(map(str, factors))
            raise InputError(where, "", expected, found, "Name the folder of the capture with --data.")
    for _, arguments in captures.values():
        make(out, **arguments, progress=progress)
    return out


def _verify(
    settings: VerifySettings, scratch: Path, progress: Progress, shown: Path | None = None
) -> CommandResult:
    """Verify a run folder; ``shown``: the bundle that it was unpacked from, which holds no avatars."""
    folder = RunFolder(Path(settings.run))
    manifest = folder.read_manifest()
    manifest.check_done(folder.manifest)
    # Otherwise there are images alone, of a bundle or scored by `evaluate`.
    avatars = shown is None and any(method.implementation for method in manifest.methods)
    used: tuple[Plugins, ...] = ("methods", "metrics") if avatars else ("metrics",)
    config, clips = open_run_clips(
        folder.root, settings, out=scratch, altered=True, use_cache=False, used=used
    )
    folder.read_rows(manifest)
    rows = folder.rows_by_condition(manifest)
    images = [(images_method(m.name, m.version), Condition(m.condition)) for m in manifest.methods]
    cells = resolve_cells(config) if avatars else images
    metrics = [metric for metric in resolve_metrics(config) if metric.per_frame or avatars]
    protocols = make_protocols(config.tasks, clips, config.frames_per_task)
    report = _Report([*_clips(folder, manifest, clips), *_protocols(folder, manifest, protocols)])
    if not report.mismatches:
        rows.check_protocols(folder.rows, {task: protocol.hash for task, protocol in protocols.items()})
        jobs = make_jobs(config, cells, clips, protocols, folder, scratch)
        for index, job in enumerate(jobs):
            _verify_cell(job, metrics, rows, folder.rows, report)
            progress(index + 1, len(jobs), job.name)
    lines = [f"  {mismatch}" for mismatch in report.mismatches[:SHOWN]]
    if len(report.mismatches) > SHOWN:
        lines.append(f"  and {len(report.mismatches) - SHOWN} more")
    verdict = f"{len(report.mismatches)} mismatches" if report.mismatches else "as recorded"
    looked = f"{report.files} files and {report.values} values recomputed"
    left = f"; {report.unverified} values bound to a machine or absent are not recomputed"
    left = left if report.unverified else ""
    text = "\n".join([f"{shown or folder.root}: {verdict}: {looked}{left}.", *lines])
    return CommandResult(text, asdict(report), not report.mismatches)


def _clips(folder: RunFolder, manifest: Manifest, clips: Sequence[Clip]) -> Iterator[Mismatch]:
    found = {clip.subject: clip.fingerprint for clip in clips}
    for entry in manifest.clips:
        subject, expected = entry.subject, entry.fingerprint
        if found.get(subject) != expected:
            there = found.get(subject, "no such capture")
            yield Mismatch(folder.manifest, f"clips, fingerprint of {subject}", expected[:12], there[:12])


def _protocols(
    folder: RunFolder, manifest: Manifest, protocols: Mapping[str, Protocol]
) -> Iterator[Mismatch]:
    """Compare the recorded protocols, field by field, with those from captures and settings."""
    for task, protocol in protocols.items():
        wanted, recorded = ProtocolRecord.of(protocol), manifest.protocols.get(task)
        for name in (field.name for field in fields(wanted)):
            value, found = getattr(wanted, name), getattr(recorded, name, None)
            if found != value:
                yield Mismatch(folder.manifest, f"protocols.{task}.{name}", _short(value), _short(found))


def _verify_cell(job: Job, metrics: Sequence[MetricSpec], rows: Rows, file: Path, report: _Report) -> None:
    method = job.method.spec
    own = rows.select(
        method=method.name,
        condition=job.condition.name,
        metric=ALL,
        task=ALL,
        region=ALL,
        seeds=(job.seed,),
        subject=job.clip.subject,
    )
    if len(own) and (own["status"] == "failed").all():
        report.unverified += len(own)
        return  # recorded as failed: no results to check
    state = job.cell.step("fit")
    trained = state is not None and method.implementation
    digests = {**(state.get("files", {}) if state and trained else {}), **recorded_frames(job)}
    found = list(_files(job, digests, report))
    report.mismatches += found
    if not method.implementation or job.condition.derive:
        avatar: Avatar = NoAvatar()
    else:
        made_of = "none" if state is None else state["fingerprint"]
        if made_of != job.fit_fingerprint:
            record = job.cell.folder / "fit.json"
            report.mismatches.append(Mismatch(record, "fingerprint", job.fit_fingerprint[:12], made_of[:12]))
        avatar = load(job)
        names = [job.cell.name(path) for path in avatar.files() if path.is_relative_to(job.cell.folder)]
        unknown = [name for name in names if name not in digests]
        report.mismatches += [
            Mismatch(job.cell.folder / "fit.json", f"files, {name}", "a digest", "none") for name in unknown
        ]
    changed = {mismatch.file for mismatch in found}
    for path, (_, key) in job.frame_paths.items():
        suspect = path in changed or job.cell.name(path) not in digests
        if suspect and not _can_be_scored(job, path, key):
            return  # reported above
    report.mismatches += _values(_measure_again(job, avatar, metrics), own, metrics, file, report)


def _files(job: Job, digests: Mapping[str, str], report: _Report) -> Iterator[Mismatch]:
    """Digests of frames and avatar files; every scored frame has to have one."""
    record = job.cell.folder / f"{DIGESTS}.json"
    for path in job.frame_paths:
        if job.cell.name(path) not in digests:
            yield Mismatch(record, f"files, {job.cell.name(path)}", "a digest", "none")
    for name, expected in digests.items():
        path = job.cell.folder / name
        if not path.is_file():
            yield Mismatch(path, "", f"a file of digest {expected[:12]}", "no such file")
            continue
        report.files += 1
        found = digest_file(path)
        if found != expected:
            yield Mismatch(path, "digest", expected[:12], found[:12])


def _can_be_scored(job: Job, path: Path, key: FrameKey) -> bool:
    camera = job.clip.cameras[key.camera]
    try:
        return read_png(path).shape == (camera.height, camera.width, 3)
    except InputError:
        return False


def _measure_again(job: Job, avatar: Avatar, metrics: Sequence[MetricSpec]) -> pd.DataFrame:
    """Evaluate the stored frames again, in a separate folder."""
    stable = [metric for metric in metrics if not metric.machine_bound]
    with tempfile.TemporaryDirectory() as name:
        scratch = Cell(Path(name))
        (scratch.folder / "renders").symlink_to((job.cell.folder / "renders").resolve())
        rows = measure(replace(job, cell=scratch), avatar, stable)
    return rows.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)


def _values(
    again: pd.DataFrame, own: pd.DataFrame, metrics: Sequence[MetricSpec], file: Path, report: _Report
) -> Iterator[Mismatch]:
    recorded, found = _by_place(own), _by_place(again)
    if len(recorded) != len(own):
        twice = own[own.duplicated(KEY)][KEY].iloc[0].tolist()
        yield Mismatch(file, _place(twice), "one row", "several")
        return
    tolerances = {metric.name: 10.0 ** -(metric.digits + 1) for metric in metrics}
    bound = {metric.name for metric in metrics if metric.machine_bound}
    for place, (status, value, _) in recorded.items():
        metric = str(place[-1])
        new = found.pop(place, None)
        if metric in bound or metric not in tolerances or status == "missing":
            report.unverified += 1
        elif new is None:
            yield Mismatch(file, _place(place), "no row: nothing asks for it", f"{value:.9g}")
        elif new[0] != "ok":
            raise HeadbenchError(f"{_place(place)} was measured, and cannot be now: {new[2]}")
        else:
            report.values += 1
            if not abs(new[1] - value) <= tolerances[metric]:
                yield Mismatch(file, _place(place), f"{new[1]:.9g}", f"{value:.9g}")
    for place, (status, value, _) in found.items():
        if status == "ok":
            yield Mismatch(file, _place(place), f"a row with {value:.9g}", "none")


def _by_place(rows: pd.DataFrame) -> dict[tuple[Any, ...], tuple[str, float, str]]:
    """Status, value and reason of each row, by its key."""
    places = rows[KEY].itertuples(index=False, name=None)
    content = rows[["status", "value", "reason"]].itertuples(index=False, name=None)
    return {place: (str(s), float(v), str(r)) for place, (s, v, r) in zip(places, content)}


def _place(key: Sequence[Any]) -> str:
    parts = dict(zip(KEY, key))
    frame = f"{parts['sequence']} {parts['timestep']} {parts['camera']}" if parts["task"] else "avatar"
    return f"{parts['metric']} ({parts['region']}) of {parts['method']}, {parts['subject']} {frame}"


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."

"""``headbench verify``."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from functools import lru_cache
from itertools import combinations, product
from pathlib import Path
from typing import Any, Self

import pandas as pd

from ..condition import Condition
from ..contracts import Avatar, Clip, FrameKey, Progress, no_progress
from ..engine.captures import Plugins, open_run_clips, synthesis_arguments
from ..engine.config import CODED_VARIANT, RunOptions, resolve_cells
from ..engine.job import DIGESTS, Job, recorded_frames
from ..engine.jobs import load, make_jobs
from ..engine.measuring import measure
from ..engine.store import Cell, RunFolder
from ..errors import ExitCode, HeadbenchError, InputError
from ..executors.schedule import Schedule
from ..executors.settings import Execution, check_executor
from ..executors.task import TASK_LOG, Task
from ..io.documents import checked, read_json
from ..io.files import digest, digest_file, write_json
from ..io.images import read_png
from ..manifest import Manifest, ProtocolRecord
from ..protocol import Protocol, make_protocols
from ..registry import get, resolve
from ..rows import ALL, FRAME, Rows
from ..specs import CommandResult, MetricSpec
from .bundle import Bundle, check_results, read_bundle
from .definitions import Mismatch, contradictions, known_methods, known_metrics, method_of
from .evaluate import NoAvatar, images_method
from .settings import VerifySettings

KEY = ["method", "condition", "seed", "task", *FRAME, "region", "metric"]
SHOWN = 20
PIXELS_PER_BYTE = 100
"""Maximum pixels of regenerated captures per byte of a bundle; its renders have about one per byte, and a run scores at
least a tenth of the captured pixels."""
TRAINING = "settings, budget, seeds, versions, processor time and memory of the training"
"""Claims that only a repeated training can confirm."""
FINDINGS = "findings.json"
TEMPORARY_FILES = "temporary"


@dataclass
class Findings:
    """Results of a verification.

    Attributes
    ----------
    mismatches : list[Mismatch]
        Differences from the record or from the registry.
    files, values : int
        Number of digests and values that were recomputed.
    recomputed : list[str]
        Frame metrics whose values were recomputed.
    unverified : dict[str, str]
        Reasons why items could not be checked, by name.
    """

    mismatches: list[Mismatch] = field(default_factory=list)
    files: int = 0
    values: int = 0
    recomputed: list[str] = field(default_factory=list)
    unverified: dict[str, str] = field(default_factory=dict)

    def add(self, other: Findings) -> None:
        """Add the findings of a part."""
        self.mismatches += other.mismatches
        self.files += other.files
        self.values += other.values
        self.recomputed += [name for name in other.recomputed if name not in self.recomputed]
        self.unverified |= other.unverified

    @property
    def not_verified(self) -> str:
        """A sentence that lists everything that was not verified, by reason; "" if there is nothing."""
        reasons: dict[str, list[str]] = {}
        for name, reason in self.unverified.items():
            reasons.setdefault(reason, []).append(name)
        parts = [f"{', '.join(names)} ({reason})" for reason, names in reasons.items()]
        return f"Not verified: {'; '.join(parts)}." if parts else ""

    def text(self, name: str) -> str:
        """The findings in words."""
        checked = f"{self.files} files and {self.values} values"
        verdict = f"{checked} as recorded." if checked and not self.mismatches else ""
        if self.mismatches:
            verdict = f"{len(self.mismatches)} mismatches: {checked} recomputed."
        elif not self.values:
            verdict = f"{self.files} files as listed. No value was recomputed."
        lines = [f"  {mismatch}" for mismatch in self.mismatches[:SHOWN]]
        if len(self.mismatches) > SHOWN:
            lines.append(f"  and {len(self.mismatches) - SHOWN} more")
        return "\n".join(filter(None, [f"{name}: {verdict}", *lines, self.not_verified]))


Renders = Mapping[str, Mapping[str, str]]
"""Digests of rendered frames by subject and path, for each name: label and seed of a method."""


def verify_run(settings: VerifySettings, progress: Progress = no_progress) -> CommandResult:
    """Verify runs and bundles; not passed if anything differs.

    Recomputed: fingerprints of the captures, hashes of the protocols, fingerprint of each avatar's inputs,
    digests of frames and avatar files, every frame metric, and avatar metrics that do not depend on the machine.
    Definitions of registered metrics and methods are compared with the registry.
    Values may differ by a tenth of the last displayed digit, since networks round differently on other machines.

    A folder that is not a finished run, or a capture that cannot be opened, is a finding with exit code 3.
    """
    check_executor(settings.execution, "cpu")
    texts, data, codes = [], [], []
    renders: dict[str, Mapping[str, str]] = {}
    with _scratch_folder(settings.out) as scratch:
        for index, name in enumerate(settings.runs):
            folder = scratch / str(index)
            folder.mkdir()
            try:
                bundle = read_bundle(Path(name), folder / "run") if Path(name).is_file() else None
                run = Path(name) if bundle is None else folder / "run"
                verified = verify(run, bundle, settings, folder, settings.execution, progress)
            except InputError as error:
                texts.append(f"{name}: Verify: missing or invalid: {error}".replace(f"{folder / 'run'}/", ""))
                data.append({"run": name, "error": str(error)})
                codes.append(ExitCode.NO_VERDICT)
                continue
            texts.append(verified.findings.text(name))
            data.append({"run": name, **asdict(verified.findings)})
            codes.append(ExitCode.NEGATIVE if verified.findings.mismatches else ExitCode.OK)
            renders |= {f"{name}: {label}": digests for label, digests in verified.renders.items()}
    equal = list(equal_renders(renders))
    code = max(codes, key=(ExitCode.OK, ExitCode.NO_VERDICT, ExitCode.NEGATIVE).index)
    found = {"runs": data, "equal_renders": equal}
    if settings.out is not None:
        write_json(Path(settings.out) / "verify.json", found)
    return CommandResult("\n".join([*texts, *equal]), found, code == ExitCode.OK, code)


@contextmanager
def _scratch_folder(out: str | None) -> Iterator[Path]:
    """An empty folder for temporary files, in ``out`` if given; leftovers of killed processes are removed.

    The command has locked ``out``.
    """
    if out is None:
        with tempfile.TemporaryDirectory() as name:
            yield Path(name)
        return
    folder = Path(out) / TEMPORARY_FILES
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


@dataclass(frozen=True)
class Verified:
    """A run or an unpacked bundle with its findings and the digests of its renders."""

    folder: RunFolder
    manifest: Manifest
    findings: Findings
    renders: Renders


def verify(
    run: Path,
    bundle: Bundle | None,
    options: RunOptions,
    scratch: Path,
    execution: Execution | None = None,
    progress: Progress = no_progress,
) -> Verified:
    """Verify the folder of a run, or of an unpacked ``bundle``; temporary files are written into and beside ``scratch``.

    Raises `InputError` if it is not a finished run or bundle, or its capture cannot be opened.
    """
    findings, folder = Findings(), RunFolder(run)
    manifest = folder.read_manifest()
    manifest.check_done(folder.manifest)
    known, methods = known_metrics(), known_methods()
    findings.mismatches += contradictions(manifest, folder.manifest, known, methods)
    if bundle is not None:
        findings.unverified |= dict.fromkeys(("author", "link", "comment"), "the author's statement")
    if bundle is not None and not bundle.renders:
        findings.files = len(bundle.files)
        lacking = lacking_frames(check_results(folder, manifest), manifest)
        findings.mismatches += [Mismatch(str(folder.rows), *lack) for lack in lacking]
        reason = "the bundle has no renders, see `headbench bundle --renders`"
        findings.unverified |= dict.fromkeys((metric.name for metric in manifest.metrics), reason)
    else:
        if bundle is not None and options.data is None:
            limit = PIXELS_PER_BYTE * sum(path.stat().st_size for path in folder.root.rglob("*.png"))
            capture = captured_again(manifest, scratch.parent / "captures", limit, progress)
            options = replace(options, data=str(capture))
        findings.add(_verified(folder, options, scratch, bundle is not None, execution, progress))
    nothing = "nothing was trained again"
    findings.unverified |= {TRAINING: nothing, "machine": "as it was recorded"}
    for record in manifest.methods:
        spec = method_of(record.name, methods)
        if spec is None:
            findings.unverified[f"method {record.label}"] = "not registered here"
        elif record.version != spec.version:
            findings.unverified[f"version {record.version} of {record.label}"] = (
                f"version {spec.version} is here"
            )
    if bundle is not None:  # its temporary path is not informative
        root = f"{folder.root}/"
        findings.mismatches = [replace(m, file=m.file.removeprefix(root)) for m in findings.mismatches]
    return Verified(folder, manifest, findings, _renders(folder, manifest))


def _renders(folder: RunFolder, manifest: Manifest) -> Renders:
    """Digests of the frames of every method and seed: of their pixels, or the recorded ones for missing files."""
    found: dict[str, dict[str, str]] = {}
    known, seeds = known_methods(), manifest.configuration.seeds
    for method, seed, clip in product(manifest.methods, seeds, manifest.clips):
        spec = method_of(method.name, known)
        if spec is not None and spec.trivial and seed != seeds[0]:
            continue  # frames of baselines do not depend on the seed
        cell = folder.cell(clip.subject, method.label, seed)
        state = cell.step(DIGESTS)
        files = {} if state is None else state.get("files", {})
        own = found.setdefault(f"{method.label} seed {seed}", {})
        own |= {
            f"{clip.subject}/{name}": _pixels(cell.folder / name) or value for name, value in files.items()
        }
    return found


def _pixels(path: Path) -> str:
    """Digest of an image's pixels, independent of the file's compression; "" if there is no image."""
    try:
        return digest(read_png(path))
    except InputError:
        return ""


def equal_renders(renders: Renders) -> dict[str, tuple[str, ...]]:
    """Sentences on equal frames, each with the names of the renders that have them."""
    same: dict[frozenset[tuple[str, str]], list[str]] = {}
    for name, digests in renders.items():
        if digests:
            same.setdefault(frozenset(digests.items()), []).append(name)
    found = {
        f"All {len(digests)} frames are equal in {', '.join(names[:-1])} and {names[-1]}.": tuple(names)
        for digests, names in same.items()
        if len(names) > 1
    }
    for (own, (first, *_)), (others, (second, *_)) in combinations(same.items(), 2):
        if count := len(own & others):
            found[f"{count} of {len(own)} frames of {first} equal those of {second}."] = (first, second)
    return found


def lacking_frames(rows: Rows, manifest: Manifest) -> list[tuple[str, str, str]]:
    """Values missing in the rows for frames of their protocols: location, expected and found number.

    Every method has a value or a reason for each frame, seed and metric; one row without a frame stands for all frames of a
    failed method.
    """
    lacking = []
    per_frame = [metric.name for metric in manifest.metrics if metric.per_frame]
    for method, metric in product(manifest.methods, per_frame):
        for task, record in manifest.protocols.items():
            own = rows.select(
                method=method.name,
                condition=method.condition,
                metric=metric,
                task=task,
                region="full",
                seeds=ALL,
            )
            whole = own[(own["timestep"] < 0) & (own["status"] == "failed")]
            places = set(own[["seed", *FRAME]].itertuples(index=False, name=None))
            failed = set(whole[["seed", "subject"]].itertuples(index=False, name=None))
            wanted = {
                (seed, *key)
                for seed, key in product(manifest.configuration.seeds, record.keys)
                if (seed, key.subject) not in failed
            }
            if missing := wanted - places:
                where = f"{metric} of {method.label}, {task}"
                lacking.append((where, f"{len(wanted)} frames", f"{len(wanted) - len(missing)}"))
    return lacking


def captured_again(manifest: Manifest, out: Path, limit: int, progress: Progress) -> Path:
    """Regenerate the synthetic captures of a run once, in a folder below ``out``, with at most ``limit`` pixels.

    Raises `InputError` for a capture that is not synthetic, not of the procedural head, or larger.
    """
    make = resolve(get("datasets", "synthetic").implementation)
    captures = {}
    for clip in manifest.clips:
        arguments = synthesis_arguments(clip.steps, clip.subject)
        captures[digest(arguments)] = f"capture of {clip.subject}", arguments
    total = 0
    for where, arguments in captures.values():
        factors = (*arguments["size"], *(arguments[name] for name in ("cameras", "timesteps")))
        total += math.prod(factors)
        if total > limit or min(factors) < 1:
            expected = f"at most {limit} pixels in all for a bundle of this size"
            found = " x ".join(map(str, factors))
            raise InputError(where, "", expected, found, "Name the folder of the capture with --data.")
    folder = out / digest(sorted(captures))[:12]
    done = folder.with_suffix(".done")
    if not done.exists():
        for _, arguments in captures.values():
            make(folder, **arguments, progress=progress)
        done.touch()
    return folder


@dataclass(frozen=True)
class _Opened:
    """A run with the cells of some of its captures, ready to be verified."""

    folder: RunFolder
    manifest: Manifest
    rows: Rows
    clips: Sequence[Clip]
    protocols: Mapping[str, Protocol]
    jobs: Sequence[Job]
    metrics: Sequence[MetricSpec]

    @classmethod
    def read(
        cls, run: Path, options: RunOptions, scratch: Path, *, images: bool, only: int | None = None
    ) -> Self:
        """Open the captures of a run; ``images``: it is a bundle, which holds no avatars."""
        folder = RunFolder(run)
        manifest = folder.read_manifest()
        # Otherwise there are only images, of a bundle or scored by `evaluate`.
        avatars = not images and any(method.implementation for method in manifest.methods)
        used: tuple[Plugins, ...] = ("methods", "metrics") if avatars else ("metrics",)
        config, clips = open_run_clips(
            run, options, out=scratch, altered=True, use_cache=False, only=only, used=used
        )
        of_images = [(images_method(m.name, m.version), Condition(m.condition)) for m in manifest.methods]
        known = known_metrics(config)
        named = [known[metric.name] for metric in manifest.metrics if metric.name in known]
        if only is None:
            protocols = make_protocols(config.tasks, clips, config.frames_per_task)
        else:  # compared by the process that opened all captures
            protocols = {
                task: record.protocol(folder.manifest) for task, record in manifest.protocols.items()
            }
        cells = resolve_cells(config) if avatars else of_images
        jobs = make_jobs(config, cells, clips, protocols, folder, scratch)
        metrics = [metric for metric in named if metric.per_frame or avatars]
        rows = folder.rows_by_condition(manifest)
        return cls(folder, manifest, rows, clips, protocols, jobs, metrics)


def _verified(
    folder: RunFolder,
    options: RunOptions,
    scratch: Path,
    images: bool,
    execution: Execution | None,
    progress: Progress,
) -> Findings:
    """Verify the captures, protocols and cells of a run."""
    opened = _Opened.read(folder.root, options, scratch, images=images)
    found = Findings([*_clips(opened), *_protocols(opened)])
    if found.mismatches:
        return found
    folder.read_rows(opened.manifest)
    hashes = {task: protocol.hash for task, protocol in opened.protocols.items()}
    opened.rows.check_protocols(folder.rows, hashes)
    named = {metric.name for metric in opened.metrics}
    known = known_metrics()
    for metric in opened.manifest.metrics:
        if metric.name not in named:
            reason = "a bundle holds no avatars" if metric.name in known else "not registered here"
            found.unverified[metric.name] = reason
    if execution is None or execution.executor == "inline":
        for index, job in enumerate(opened.jobs):
            found.add(_verify_cell(job, opened))
            progress(index + 1, len(opened.jobs), job.name)
    else:
        for each in _by_executor(opened, options, scratch, images, execution):
            found.add(each)
    return found


def _by_executor(
    opened: _Opened, options: RunOptions, scratch: Path, images: bool, execution: Execution
) -> Iterator[Findings]:
    """Findings of every cell, each verified by a task. Raises `HeadbenchError` if one failed."""
    root = scratch / "cells"
    root.mkdir()
    subjects = list(dict.fromkeys(job.clip.subject for job in opened.jobs))
    tasks = [
        Task.of(
            root,
            job.cell.folder.relative_to(opened.folder.root).as_posix(),
            f"{__name__}:verify_cell",
            run=str(opened.folder.root.resolve()),
            options={name: _absolute(getattr(options, name)) for name in ("data", "head", "trust")},
            images=images,
            capture=subjects.index(job.clip.subject),
            label=job.label,
            seed=job.seed,
        )
        for job in opened.jobs
    ]
    schedule = Schedule("cells", lambda task: (task.folder / FINDINGS).is_file(), execution)
    for place, reason in schedule.run_all(tasks).items():
        log = (root / place / TASK_LOG).read_text(encoding="utf-8", errors="replace")
        raise HeadbenchError(f"Cell {place} was not verified: {reason} Its log ends with: {log[-1000:]}")
    for task in tasks:
        path = task.folder / FINDINGS
        yield checked(read_json(path), Findings, path)


def _absolute(value: Any) -> Any:
    return str(Path(value).absolute()) if isinstance(value, str) else value


def verify_cell(task: Task, report: Any) -> None:
    """Verify a cell as a task of an executor, and write its findings as JSON into the folder of the task."""
    given = task.arguments
    opened = _open_capture(
        given["run"], tuple(given["options"].items()), given["images"], given["capture"], task.root
    )
    (job,) = (job for job in opened.jobs if (job.label, job.seed) == (given["label"], given["seed"]))
    write_json(task.folder / FINDINGS, asdict(_verify_cell(job, opened)))


@lru_cache(maxsize=1)
def _open_capture(
    run: str, options: tuple[tuple[str, Any], ...], images: bool, capture: int, root: str
) -> _Opened:
    """One capture of a run, cached, since a process verifies the cells of a capture in succession."""
    scratch = Path(tempfile.mkdtemp(prefix="adapted-", dir=root))
    return _Opened.read(Path(run), RunOptions(**dict(options)), scratch, images=images, only=capture)


def _clips(opened: _Opened) -> Iterator[Mismatch]:
    found = {clip.subject: clip.fingerprint for clip in opened.clips}
    for entry in opened.manifest.clips:
        subject, expected = entry.subject, entry.fingerprint
        if found.get(subject) != expected:
            there = found.get(subject, "no such capture")
            file = str(opened.folder.manifest)
            yield Mismatch(file, f"clips, fingerprint of {subject}", expected[:12], there[:12])


def _protocols(opened: _Opened) -> Iterator[Mismatch]:
    """Compare the recorded protocols, field by field, with those from captures and settings."""
    file, recorded = str(opened.folder.manifest), opened.manifest.protocols
    for task, protocol in opened.protocols.items():
        wanted, own = ProtocolRecord.of(protocol), recorded.get(task)
        for name in (each.name for each in fields(wanted)):
            value, found = getattr(wanted, name), getattr(own, name, None)
            if found != value:
                yield Mismatch(file, f"protocols.{task}.{name}", _short(value), _short(found))
    for task in recorded.keys() - opened.protocols.keys():
        yield Mismatch(file, f"protocols.{task}", "none: the settings do not ask for it", recorded[task].hash)


def _verify_cell(job: Job, opened: _Opened) -> Findings:
    method, found = job.method.spec, Findings()
    own = job.rows_of(opened.rows)
    if len(own) and (own["status"] == "failed").all():
        found.unverified[f"the failure of {job.name}"] = "as it was recorded"
        return found
    state = job.cell.step("fit")
    trained = state is not None and method.implementation
    digests = {**(state.get("files", {}) if state and trained else {}), **recorded_frames(job)}
    changed = list(_files(job, digests, found))
    found.mismatches += changed
    coded = job.condition.derive == CODED_VARIANT  # which methods read like their own avatars
    if not method.implementation or (job.condition.derive and not coded):
        avatar: Avatar = NoAvatar()
    else:
        made_of = "none" if state is None else state["fingerprint"]
        record = str(job.cell.folder / "fit.json")
        if made_of != job.fit_fingerprint:
            found.mismatches.append(Mismatch(record, "fingerprint", job.fit_fingerprint[:12], made_of[:12]))
        avatar = job.create().load(job.cell.avatar, device=job.device) if coded else load(job)
        names = [job.cell.name(path) for path in avatar.files() if path.is_relative_to(job.cell.folder)]
        unknown = [name for name in names if name not in digests]
        found.mismatches += [Mismatch(record, f"files, {name}", "a digest", "none") for name in unknown]
    files = {mismatch.file for mismatch in changed}
    for path, (_, key) in job.frame_paths.items():
        suspect = str(path) in files or not path.is_file() or job.cell.name(path) not in digests
        if suspect and not _can_be_scored(job, path, key):
            return found  # reported above
    found.mismatches += _values(job, _measure_again(job, avatar, opened.metrics), own, opened, found)
    return found


def _files(job: Job, digests: Mapping[str, str], found: Findings) -> Iterator[Mismatch]:
    """Check digests of frames and avatar files; every scored frame must have one."""
    record = str(job.cell.folder / f"{DIGESTS}.json")
    for path in job.frame_paths:
        if job.cell.name(path) not in digests:
            yield Mismatch(record, f"files, {job.cell.name(path)}", "a digest", "none")
    frames = recorded_frames(job)
    cleaned = frames and not any((job.cell.folder / name).exists() for name in frames)
    if cleaned:
        there = "none: they were deleted, as `headbench status --clean renders` does. Start the run again to render them"
        yield Mismatch(str(job.cell.folder / "renders"), "", f"the {len(frames)} frames of {record}", there)
    for name, expected in digests.items():
        path = job.cell.folder / name
        if not path.is_file():
            if not (cleaned and name in frames):
                yield Mismatch(str(path), "", f"a file of digest {expected[:12]}", "no such file")
            continue
        found.files += 1
        now = digest_file(path)
        if now != expected:
            yield Mismatch(str(path), "digest", expected[:12], now[:12])


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
    return rows.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL, condition=ALL)


def _values(
    job: Job, again: pd.DataFrame, own: pd.DataFrame, opened: _Opened, found: Findings
) -> Iterator[Mismatch]:
    """Compare the rows of a cell with newly measured rows."""
    file = str(opened.folder.rows)
    recorded, new_rows = _by_place(own), _by_place(again)
    if len(recorded) != len(own):
        twice = own[own.duplicated(KEY)][KEY].iloc[0].tolist()
        yield Mismatch(file, _place(twice), "one row", "several")
        return
    for version in sorted(set(map(str, own["version"])) - {job.method.spec.version}):
        yield Mismatch(file, f"version of {job.label}", job.method.spec.version, version)
    stable = {metric.name: metric for metric in opened.metrics if not metric.machine_bound}
    for metric in opened.metrics:
        if metric.machine_bound:
            found.unverified[metric.name] = "depends on the machine"
    for name, table in again.groupby("metric"):
        if (table["status"] == "ok").any():
            found.recomputed.append(str(name))
        else:  # in no region here; a value that single frames cannot have is a mismatch
            reason = str(table["reason"].iloc[0]).rstrip(".") or "not measured here"
            found.unverified[str(name)] = reason
            stable.pop(str(name))
    for place, (status, value, _) in recorded.items():
        metric_name = str(place[-1])
        new = new_rows.pop(place, None)
        if metric_name not in stable:
            continue
        shown = f"{value:.9g}" if status == "ok" else status
        if new is None:
            yield Mismatch(file, _place(place), "no row: nothing asks for it", shown)
        elif (new[0], status) == ("ok", "ok"):
            found.values += 1
            if not abs(new[1] - value) <= 10.0 ** -(stable[metric_name].digits + 1):
                yield Mismatch(file, _place(place), f"{new[1]:.9g}", shown)
        elif new[0] == "ok":
            yield Mismatch(file, _place(place), f"a value, {new[1]:.9g}", shown)
        elif status == "ok":
            yield Mismatch(file, _place(place), f"no value: {new[2]}", shown)
    for place, (status, value, _) in new_rows.items():
        if status == "ok" and place[-1] in stable:
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

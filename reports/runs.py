"""Reads and checks run folders for reports: rows, metrics, methods, protocols, renders, images."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import chain, combinations, product
from operator import attrgetter
from pathlib import Path
from typing import Any, Self

from ..bench.contracts import ByteArray, Clip, FrameKey
from ..bench.engine.config import RunOptions
from ..bench.engine.store import FinishedRun, RunFolder
from ..bench.errors import InputError
from ..bench.manifest import ClipRecord, Manifest, MethodRecord, cut_of
from ..bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS, joined_protocol, missing_tasks
from ..bench.registry import is_outside
from ..bench.rows import ALL, FULL, Rows
from ..bench.specs import MetricSpec
from .aggregate import AVERAGED, check_codecs, with_coded

SPLIT_TASK = "self_reenactment"
"""Scored at all cameras, of which most have training frames. Values at those and at held-out cameras differ by several dB, so
tables show them separately."""


def synthetic_settings(clip: ClipRecord) -> dict[str, Any]:
    """Settings of a clip's capture if it is synthetic; otherwise empty."""
    first = clip.steps[0] if clip.steps else {}
    return dict(first.get("parameters", {}).get("synthetic", {}))


@dataclass(frozen=True)
class RunData:
    """A loaded finished run; names are in the order of its configuration. Images are read on demand."""

    folder: RunFolder
    manifest: Manifest
    rows: Rows
    clips: Mapping[str, Clip] | None = field(default=None, repr=False, compare=False)

    @classmethod
    def read(cls, run: str | Path | FinishedRun) -> RunData:
        """Read a run folder, unless the run is in memory. Raises `InputError` naming what is missing or malformed."""
        if isinstance(run, FinishedRun):
            return cls(run.folder, run.manifest, run.rows.labelled(), run.clips)
        folder = RunFolder(Path(run))
        manifest = folder.read_manifest()
        return cls(folder, manifest, folder.read_rows(manifest))

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods."""
        return tuple(method.label for method in self.manifest.methods)

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of the tasks."""
        return tuple(self.manifest.protocols)

    @property
    def machine(self) -> str:
        """The processor used to measure speed, and the device if it differs."""
        processor = str(self.manifest.machine.get("processor", ""))
        device = self.manifest.configuration.device
        return processor if device == "cpu" else f"{device}, {processor}"

    def keys(self, task: str) -> Sequence[FrameKey]:
        """Frames of a task, sorted; empty for a task that was not scored."""
        return sorted(self.manifest.protocols[task].keys) if task in self.manifest.protocols else []

    @property
    def seed(self) -> int:
        """The seed whose images are shown: the first configured."""
        return self.manifest.configuration.seeds[0]

    def render_path(self, method: str, task: str, key: FrameKey) -> Path | None:
        """Path of that seed's render of a frame, or None if it is missing."""
        path = self.folder.cell(key.subject, method, self.seed).render(task, key)
        return path if path.is_file() else None

    def render(self, method: str, task: str, key: FrameKey) -> ByteArray | None:
        """Read that render, (H, W, 3) 8-bit, or return None if it is missing."""
        from ..bench.io.images import read_png

        path = self.render_path(method, task, key)
        return None if path is None else read_png(path)

    def ground_truth(self, key: FrameKey) -> ByteArray:
        """Read the captured image of a frame, (H, W, 3) 8-bit, from the capture the run was made from."""
        return self._clips[key.subject].image(key)

    def reason(self, method: str, task: str, key: FrameKey) -> str:
        """Reason why a method has no render of a frame, if recorded in the rows."""
        seeds, subject = (self.seed,), key.subject
        rows = self.rows.select(
            method=method, metric=ALL, task=task, region=FULL, seeds=seeds, subject=subject
        )
        failed = rows[rows["status"] == "failed"]
        return "not rendered" if failed.empty else str(failed.iloc[0]["reason"])

    def value(self, metric: str, method: str, task: str, key: FrameKey) -> float | None:
        """Return a metric of the displayed whole image, or None if it was not measured."""
        return self._by_frame.get((metric, method, task, *key))

    @property
    def image_size(self) -> str:
        """Size of the scored images, "width x height", or the range if they differ."""
        texts = ", ".join(protocol.resolution for protocol in self.manifest.protocols.values())
        sizes = {(int(w), int(h)) for w, h in re.findall(r"(\d+)x(\d+)", texts)}
        return " to ".join(dict.fromkeys(f"{w} x {h}" for w, h in (min(sizes), max(sizes)))) if sizes else ""

    @cached_property
    def _by_frame(self) -> dict[tuple[Any, ...], float]:
        rows = self.rows.select(method=ALL, metric=ALL, task=ALL, region=FULL, seeds=(self.seed,))
        rows = rows[(rows["status"] == "ok") & (rows["timestep"] >= 0)]
        places = rows[["metric", "method", "task", *FrameKey._fields]].itertuples(index=False, name=None)
        return dict(zip(places, rows["value"].astype(float)))

    @cached_property
    def _clips(self) -> Mapping[str, Clip]:
        if self.clips is not None:
            return self.clips
        from ..bench.engine.captures import open_run_clips  # who shows no pictures opens no capture

        config, opened = open_run_clips(self.folder.root, RunOptions(trust=True))
        clips = {clip.subject: clip for clip in opened}
        for entry in self.manifest.clips:
            if entry.subject not in clips:
                raise InputError(config.data, f"capture of {entry.subject}", "a capture", "none")
        return clips


LONGEST_DIFFERENCE = 48
"""Maximum characters of settings in a label; otherwise the label has the run's folder."""


@dataclass(frozen=True)
class FrameSelection:
    """A part of the frames: one region of the head instead of the whole frame, and some sequences (empty: all)."""

    region: str = FULL
    sequences: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """Description; "" for whole frames of all sequences."""
        sentences = [f"Region: {self.region}."] if self.region != FULL else []
        sentences += [f"Sequences: {', '.join(self.sequences)}."] if self.sequences else []
        return " ".join(sentences)


WHOLE = FrameSelection()


@dataclass(frozen=True)
class RunSet:
    """Runs on the same frames, in the order given. The methods in their ``rows`` are named by labels."""

    runs: tuple[RunData, ...]
    rows: Rows
    metrics: tuple[MetricSpec, ...]
    tasks: tuple[str, ...]
    records: Mapping[str, MethodRecord]  # entries of the manifests, by label
    trivial: tuple[str, ...]  # labels of trivial baselines
    keys: Mapping[str, frozenset[FrameKey]]  # frames of each task in the protocol, also those without values
    pictured: Mapping[str, tuple[RunData, str]]  # run and name there of its renders, by label
    part: str = ""  # description of the part of the frames, "" for all
    cameras: str = ""  # sentence on seen and unseen cameras, "" before `by_camera`
    protocol: str = ""  # by which rows were chosen, see `protocols.under`
    averaged: str = AVERAGED  # over what values are means

    @classmethod
    def read(cls, folders: Sequence[Path | FinishedRun], part: FrameSelection = WHOLE) -> RunSet:
        """Read runs, or a part of their frames.

        Runs of other subjects are joined: their protocols may differ in clips alone. Seeds and subjects of the same method
        with the same settings are merged. A method with other settings is a separate one, named after the settings that
        differ ("ours (dynamic=opacity)"), or after the folders if that is too long.
        """
        if not folders:
            raise InputError("runs", "", "at least one folder", "none")
        return cls.joined(tuple(RunData.read(folder) for folder in folders)).of(part)

    @classmethod
    def joined(cls, runs: tuple[RunData, ...]) -> RunSet:
        """Combine loaded runs, with one protocol and new labels; see `read`.

        Coded avatars are columns of their methods, see `with_coded`.
        """
        runs = _with_one_protocol(runs)
        labels = training_labels(runs)
        if runs:
            check_codecs([run.manifest for run in runs], runs[0].folder.manifest)
        coded = [with_coded(run.manifest, run.rows) for run in runs]
        runs = tuple(replace(run, manifest=m, rows=rows) for run, (m, rows) in zip(runs, coded))
        rows = Rows.joined([run.rows.renamed(names) for run, names in zip(runs, labels)])
        rows.check()
        trained = [(run, names[m.label], m) for run, names in zip(runs, labels) for m in run.manifest.methods]
        records = {label: record for _, label, record in trained}
        tasks = tuple(dict.fromkeys(task for run in runs for task in run.tasks))
        trivial = tuple(label for label, record in records.items() if record.trivial)
        keys = {task: frozenset(key for run in runs for key in run.keys(task)) for task in tasks}
        pictured: dict[str, tuple[RunData, str]] = {}
        for run, label, record in trained:
            pictured.setdefault(label, (run, record.label))
        return cls(runs, rows, _metrics(runs), tasks, records, trivial, keys, pictured)

    def of(self, part: FrameSelection) -> RunSet:
        """Select a part of the frames of completely loaded runs."""
        if part == WHOLE:
            return self
        rows, file = self.rows, self.runs[0].folder.rows
        for key, names, valid in (
            ("region", {part.region}, rows.regions),
            ("sequences", {*part.sequences}, rows.sequences),
        ):
            if unknown := names - valid:
                raise InputError(file, key, f"one of {', '.join(sorted(valid))}", ", ".join(sorted(unknown)))
        rows = rows.of_part(part.region, part.sequences, FULL)
        tasks = tuple(task for task in self.tasks if task in rows.tasks)
        metrics = tuple(spec for spec in self.metrics if spec.name in rows.metrics)
        chosen = {
            task: frozenset(k for k in keys if not part.sequences or k.sequence in part.sequences)
            for task, keys in self.keys.items()
        }
        return replace(self, rows=rows, tasks=tasks, metrics=metrics, keys=chosen, part=part.text)

    @cached_property
    def by_camera(self) -> Self:
        """Split self-reenactment into seen and unseen cameras as two tasks, unless they are unknown or a protocol applies."""
        if SPLIT_TASK not in self.tasks or self.protocol:
            return self
        keys = self.keys[SPLIT_TASK]
        unseen, reason = unseen_cameras([run.manifest for run in self.runs], keys)
        if not unseen:
            return replace(self, cameras=reason)
        inside = frozenset(key for key in keys if (key.subject, key.camera) in unseen)
        parts = {SEEN_CAMERAS: keys - inside, UNSEEN_CAMERAS: inside}
        index = self.tasks.index(SPLIT_TASK)
        return replace(
            self,
            rows=self.rows.split_by_camera(SPLIT_TASK, unseen, UNSEEN_CAMERAS, SEEN_CAMERAS),
            tasks=(*self.tasks[:index], *parts, *self.tasks[index + 1 :]),
            keys={task: frames for task, frames in self.keys.items() if task != SPLIT_TASK} | parts,
            cameras=explained(keys, unseen),
        )

    @property
    def shared(self) -> Self:
        """Restrict the runs to subjects for which every label has rows."""
        by_label = self.rows.subjects_of(self.methods)
        common = frozenset.intersection(*by_label.values()) if by_label else frozenset()
        scored = {key.subject for keys in self.keys.values() for key in keys}
        if all(subjects == common for subjects in (*by_label.values(), scored)):
            return self
        keys = {task: frozenset(k for k in keys if k.subject in common) for task, keys in self.keys.items()}
        return replace(self, rows=self.rows.of_subjects(common), keys=keys)

    @property
    def without_conditions(self) -> Self:
        """The same runs, with methods under conditions ranked as separate methods."""
        records = {label: replace(record, condition="") for label, record in self.records.items()}
        return replace(self, records=records)

    def listing(self, labels: Sequence[str]) -> Self:
        """The same runs, whose tables list only these methods and rank them all."""
        records = {label: replace(self.records[label], condition="") for label in labels}
        return replace(self, records=records, trivial=())

    def only(self, labels: Sequence[str]) -> RunSet:
        """Restrict the runs to some of their methods."""
        records = {label: record for label, record in self.records.items() if label in labels}
        trivial = tuple(label for label in self.trivial if label in records)
        return replace(self, rows=self.rows.of_methods(labels), records=records, trivial=trivial)

    @property
    def methods(self) -> tuple[str, ...]:
        """Labels, in order."""
        return tuple(self.records)

    @property
    def ranked(self) -> tuple[str, ...]:
        """Labels of methods that are neither trivial baselines nor under a condition, in order."""
        return tuple(label for label in self.records if label not in (*self.trivial, *self.changed))

    @property
    def changed(self) -> tuple[str, ...]:
        """Labels of methods under a condition; empty if all methods are, as in a curve."""
        labels = tuple(label for label, record in self.records.items() if record.condition)
        return labels if {*labels, *self.trivial} < {*self.records} else ()

    @property
    def protocol_ids(self) -> dict[str, str]:
        """Readable name of each task's protocol; the parts of a task have the protocol of the whole."""
        ids = {task: protocol.id for run in self.runs for task, protocol in run.manifest.protocols.items()}
        return ids | dict.fromkeys((SEEN_CAMERAS, UNSEEN_CAMERAS), ids.get(SPLIT_TASK, ""))

    @property
    def with_refit(self) -> tuple[str, ...]:
        """Labels under conditions that score frames from other views than those of the capture's tracking."""
        names = {c.name for run in self.runs for c in run.manifest.configuration.conditions if c.views}
        return tuple(label for label, record in self.records.items() if record.condition in names)

    @property
    def missing(self) -> tuple[str, ...]:
        """A sentence for each requested task that no run could measure."""
        measured = {task for run in self.runs for task in run.tasks}
        requested = dict.fromkeys(task for run in self.runs for task in run.manifest.configuration.tasks)
        return tuple(missing_tasks([*requested], measured).values())

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on methods of this package whose code, but not version, changed between the runs, on captures that were
        not searched for errors, and on `with_refit`."""
        codes: dict[str, set[str]] = {}
        for record in (record for run in self.runs for record in run.manifest.methods):
            if record.code and not is_outside(record.implementation):
                codes.setdefault(f"{record.name} (version {record.version})", set()).add(record.code)
        remarks = []
        if changed := [name for name, digests in codes.items() if len(digests) > 1]:
            what = "Files of these methods changed between the runs, although their version did not"
            remarks.append(f"{what}: {', '.join(changed)}.")
        if any(run.manifest.unchecked for run in self.runs):
            remarks.append("The captures were not searched for errors before the run (--unchecked).")
        if refitted := ", ".join(self.with_refit):
            how = "each scored frame was fitted to its own picture (camera, jaw, expression) with the avatar frozen"
            remarks.append(f"{refitted}: {how}; not comparable with values of tracked frames.")
        return tuple(remarks)

    @property
    def cut(self) -> str:
        """What was replaced by background in the images of the captures, for captions."""
        cuts = {cut_of(clip.steps) for run in self.runs for clip in run.manifest.clips}
        words = {
            "bust-line": "cut below the bust line",
            "parsing": "clothes cut by a face parsing",
            "": "not cut",
        }
        return "; ".join(words[cut] for cut in sorted(cuts)) if cuts != {""} else ""

    @property
    def image_size(self) -> str:
        """Sizes of the rendered images."""
        return "; ".join(dict.fromkeys(run.image_size for run in self.runs if run.image_size))

    @property
    def machine(self) -> str:
        """Machines used to measure speed."""
        return "; ".join(dict.fromkeys(run.machine for run in self.runs))


def explained(keys: Collection[FrameKey], unseen: Collection[tuple[str, str]]) -> str:
    """Describe seen and unseen cameras of the frames ``keys``, with their number if it is equal for every subject."""
    cameras = {(key.subject, key.camera) for key in keys}
    subjects = {subject for subject, _ in cameras}
    counts = {
        tuple(sum(name == subject for name, _ in group) for group in (cameras - {*unseen}, unseen))
        for subject in subjects
    }
    seen, held_out = (f" ({count} scored)" for count in counts.pop()) if len(counts) == 1 else ("", "")
    return f"Seen cameras{seen} have training frames in the capture, of other timesteps; unseen cameras{held_out} have none."


def unseen_cameras(
    manifests: Sequence[Manifest], keys: Collection[FrameKey]
) -> tuple[frozenset[tuple[str, str]], str]:
    """The (subject, camera) pairs of self-reenactment without training frames; none and a reason, one sentence, if
    they are all, none, or not the same in all runs."""
    unseen, why = set(), ""
    cameras = {(key.subject, key.camera) for key in keys}
    for subject in {key.subject for key in keys}:
        clips = (clip for manifest in manifests for clip in manifest.clips if clip.subject == subject)
        scored = {camera for name, camera in cameras if name == subject}
        seen = {frozenset(scored & {*clip.training_cameras}) for clip in clips}
        if len(seen) != 1:
            why = "the runs differ in which cameras were trained on"
            break
        unseen |= {(subject, camera) for camera in scored.difference(*seen)}
    else:
        if len(unseen) in (0, len(cameras)):
            why = f"methods are trained on {'none' if unseen else 'all'} of its cameras" if keys else ""
        else:
            return frozenset(unseen), ""
    return frozenset(), f"Self-reenactment is not split into seen and unseen cameras: {why}." if why else ""


def _with_one_protocol(runs: tuple[RunData, ...]) -> tuple[RunData, ...]:
    """The runs, with rows under the joint protocol of all subjects; see `joined_protocol`."""
    joined: dict[str, str] = {}
    for task in dict.fromkeys(task for run in runs for task in run.tasks):
        scored = [run for run in runs if task in run.tasks]
        if len({run.manifest.protocols[task].hash for run in scored}) == 1:
            continue
        for earlier, run in combinations(scored, 2):
            if not {*_subjects(run, task)}.isdisjoint(_subjects(earlier, task)):
                check_same_protocol(earlier, run, task)
        protocols = [run.manifest.protocols[task].protocol(run.folder.manifest) for run in scored]
        joined |= dict.fromkeys((protocol.hash for protocol in protocols), joined_protocol(protocols).hash)
    return tuple(replace(run, rows=run.rows.of_protocols(joined)) for run in runs) if joined else runs


def joined_subjects(runs: Sequence[RunData]) -> list[RunData]:
    """Join runs of different subjects into one, returned in a list; the runs are unchanged if two share a subject."""
    subjects = [subject for run in runs for subject in run.rows.subjects]
    if len(runs) < 2 or len(set(subjects)) < len(subjects):
        return list(runs)
    expected = f"the methods and settings of {runs[0].folder.root}"
    for run, labels in zip(runs, training_labels(runs)):
        if {*run.methods} != {*runs[0].methods}:
            raise InputError(run.folder.manifest, "methods", expected, ", ".join(run.methods))
        if changed := [label for name, label in labels.items() if label != name]:
            raise InputError(run.folder.manifest, "methods", expected, changed[0])
    _metrics(runs)
    rows = Rows.joined([run.rows for run in _with_one_protocol(tuple(runs))])
    return [replace(runs[0], rows=rows)]


def _subjects(run: RunData, task: str) -> list[str]:
    return [subject for subject, _ in run.manifest.protocols[task].clips]


def check_same_protocol(first: RunData, run: RunData, task: str) -> None:
    """Raise `InputError` if two runs score different frames of a task or use different protocols."""
    one, other = first.manifest.protocols[task], run.manifest.protocols[task]
    if one.hash != other.hash:
        expected = f"protocol {one.hash}, that of {first.folder.root}"
        remedy = "Score the same frames."
        if one.design == other.design:
            remedy = (
                "The frames are the same, but the files of the captures differ in content (images, masks, parameters, "
                "cameras, head model), or the settings of their reader: use one capture for both runs."
            )
        raise InputError(run.folder.root, f"protocol of {task}", expected, other.hash, remedy)


def _metrics(runs: Sequence[RunData]) -> tuple[MetricSpec, ...]:
    # Definition of comparable values of a metric; its texts and digits may differ.
    meaning = attrgetter("unit", "higher_is_better", "implementation", "detail")
    metrics: dict[str, MetricSpec] = {}
    for run in runs:
        for spec in run.manifest.metrics:
            if meaning(metrics.setdefault(spec.name, spec)) != meaning(spec):
                expected = f"{spec.name} as in {runs[0].folder.root}"
                raise InputError(run.folder.manifest, "metrics", expected, "another definition")
    return tuple(metrics.values())


@dataclass
class _Training:
    """A method with its settings, the indices of its runs, and its subjects and seeds there."""

    record: MethodRecord
    runs: list[int]
    cells: set[tuple[str, int]]


def _same_training(one: MethodRecord, other: MethodRecord) -> bool:
    """Whether two records are of the same training; for methods of this package, the version identifies the code."""
    native = not is_outside(one.implementation)
    return one == (replace(other, code=one.code) if native else other)


def training_labels(runs: Sequence[RunData]) -> list[dict[str, str]]:
    """Label of each run's methods, by name."""
    trainings: dict[str, list[_Training]] = {}
    for index, run in enumerate(runs):
        for record in run.manifest.methods:
            cells = {*product(sorted(run.rows.subjects), run.rows.seeds(record.label))}
            of_label = trainings.setdefault(record.label, [])
            same = (t for t in of_label if _same_training(t.record, record) and not t.cells & cells)
            if training := next(same, None):
                training.runs.append(index)
                training.cells |= cells
            else:
                of_label.append(_Training(record, [index], cells))
    labels: list[dict[str, str]] = [{} for _ in runs]
    for name, of_label in trainings.items():
        folders = [runs[training.runs[0]].folder.root for training in of_label]
        for training, label in zip(of_label, _names(name, [t.record for t in of_label], folders)):
            for index in training.runs:
                labels[index][name] = label
    return labels


def _names(name: str, records: Sequence[MethodRecord], folders: Sequence[Path]) -> list[str]:
    """A name for each training of a method, from differing settings or from folders."""
    if len(records) == 1:
        return [name]
    flat = [_flat(asdict(record)) for record in records]
    keys = [k for k in dict.fromkeys(chain(*flat)) if len({f.get(k, "") for f in flat}) > 1]
    settings = [", ".join(f"{key.rpartition('.')[2]}={f.get(key, 'none')}" for key in keys) for f in flat]
    choices = [[folder.name for folder in folders], [folder.as_posix() for folder in folders]]
    if max(map(len, settings)) <= LONGEST_DIFFERENCE:
        choices.insert(0, settings)
    for texts in choices:
        if len(set(texts)) == len(texts):
            return [f"{name} ({text})" for text in texts]
    raise InputError(folders[0], f"method {name}", "each training once", "the same run twice")


def _flat(value: Any, prefix: str = "") -> dict[str, str]:
    """Settings by dotted key, as text."""
    if isinstance(value, Mapping):
        return dict(chain(*(_flat(entry, f"{prefix}.{name}").items() for name, entry in value.items())))
    return {prefix: "+".join(map(str, value)) if isinstance(value, list) else str(value)}

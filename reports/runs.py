"""Reads what reports show from a run folder, checked: rows, metrics, methods, protocols, renders and truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from ..bench.contracts import ByteArray, Clip, FrameKey
from ..bench.errors import InputError
from ..bench.io.images import probe_image, read_png
from ..bench.manifest import Derived, Manifest, MethodRecord
from ..bench.rows import ALL, Rows
from ..bench.runner.captures import open_run_clips
from ..bench.runner.config import RunOptions
from ..bench.runner.scoring import FULL
from ..bench.runner.store import RunFolder
from ..bench.specs import MetricSpec

Item = TypeVar("Item")


@dataclass(frozen=True)
class RunData:
    """A finished run, read. Images are read when asked for.

    Attributes
    ----------
    folder : where it lies.
    manifest : content of ``run.json``.
    rows : one per value.
    """

    folder: RunFolder
    manifest: Manifest
    rows: Rows

    @classmethod
    def read(cls, root: Path) -> RunData:
        """Read a run folder. Raises `InputError` naming what is missing or malformed."""
        folder = RunFolder(root)
        manifest = folder.read_manifest()
        return cls(folder, manifest, folder.read_rows(manifest))

    @property
    def metrics(self) -> tuple[MetricSpec, ...]:
        """In the order of the configuration."""
        return self.manifest.metrics

    @property
    def methods(self) -> tuple[str, ...]:
        """Names, in the order of the configuration."""
        return tuple(method.name for method in self.manifest.methods)

    @property
    def trivial(self) -> tuple[str, ...]:
        """Names of the methods that are trivial baselines."""
        return tuple(method.name for method in self.manifest.methods if method.trivial)

    @property
    def tasks(self) -> tuple[str, ...]:
        """In the order of the configuration."""
        return tuple(self.manifest.protocols)

    @property
    def derived(self) -> dict[str, Derived]:
        """Of methods whose avatars were derived from trained ones: from which, the variant, what was changed."""
        return {method.name: method.derived for method in self.manifest.methods if method.derived}

    @property
    def protocol_ids(self) -> dict[str, str]:
        """Readable name of each task's protocol."""
        return {task: protocol.id for task, protocol in self.manifest.protocols.items()}

    @property
    def machine(self) -> str:
        """The processor that speed was measured on, and the device if it was another."""
        processor = str(self.manifest.machine.get("processor", ""))
        device = self.manifest.configuration.device
        return processor if device == "cpu" else f"{device}, {processor}"

    def keys(self, task: str) -> Sequence[FrameKey]:
        """Frames of a task, sorted."""
        return sorted(self.manifest.protocols[task].keys)

    @property
    def seed(self) -> int:
        """The seed whose images are shown: the first configured."""
        return self.manifest.configuration.seeds[0]

    def render_path(self, method: str, task: str, key: FrameKey) -> Path | None:
        """Where that seed's render of a frame lies, or None where there is none."""
        path = self.folder.cell(key.subject, method, self.seed).render(task, key)
        return path if path.is_file() else None

    def render(self, method: str, task: str, key: FrameKey) -> ByteArray | None:
        """Read that render, (H, W, 3) 8-bit, or return None where there is none."""
        path = self.render_path(method, task, key)
        return None if path is None else read_png(path)

    def truth(self, key: FrameKey) -> ByteArray:
        """Read the captured image of a frame, (H, W, 3) 8-bit, from the capture the run was made from."""
        return self._clips[key.subject].image(key)

    def reason(self, method: str, task: str, key: FrameKey) -> str:
        """Why a method has no render of a frame, as far as the rows know."""
        seeds = (self.seed,)
        own = self.rows.select(
            method=method, metric=ALL, task=task, region=FULL, seeds=seeds, subject=key.subject
        )
        failed = own[own["status"] == "failed"]
        return "not rendered" if failed.empty else str(failed.iloc[0]["reason"])

    def value(self, metric: str, method: str, task: str, key: FrameKey) -> float | None:
        """Return a metric of the whole image shown, or None where it was not measured."""
        return self._by_frame.get((metric, method, task, *key))

    @property
    def image_size(self) -> str:
        """Size of the rendered images, "width x height", or the range where they differ; "" without renders."""
        first_of_camera = {
            (task, key.subject, key.camera): key for task in self.tasks for key in reversed(self.keys(task))
        }
        sizes = set()
        for (task, _, _), key in first_of_camera.items():
            paths = (self.render_path(method, task, key) for method in self.methods)
            if path := next((path for path in paths if path), None):
                info = probe_image(path)
                sizes.add((info.width, info.height))
        return " to ".join(dict.fromkeys(f"{w} x {h}" for w, h in (min(sizes), max(sizes)))) if sizes else ""

    @cached_property
    def _by_frame(self) -> dict[tuple[Any, ...], float]:
        rows = self.rows.select(method=ALL, metric=ALL, task=ALL, region=FULL, seeds=(self.seed,))
        shown = rows[(rows["status"] == "ok") & (rows["timestep"] >= 0)]
        places = shown[["metric", "method", "task", *FrameKey._fields]].itertuples(index=False, name=None)
        return dict(zip(places, shown["value"].astype(float)))

    @cached_property
    def _clips(self) -> dict[str, Clip]:
        # Pictures are drawn by the run itself, in the process that loaded its plug-ins.
        config, opened = open_run_clips(self.folder.root, RunOptions(trust=True))
        clips = {clip.subject: clip for clip in opened}
        for entry in self.manifest.clips:
            if entry.subject not in clips:
                raise InputError(config.data, f"capture of {entry.subject}", "a capture", "none")
        return clips


LONGEST_DIFFERENCE = 48
"""Characters of settings in a label; more than that and the run's folder names the method."""


@dataclass(frozen=True)
class RunSet:
    """Runs on the same frames.

    Attributes
    ----------
    runs : in the order given.
    rows : of all, their methods named by labels.
    metrics, tasks : those of all runs, in their order.
    records : by label, in order: what the method was, as in the manifest (name, version, config, budget).
    trivial : labels of trivial baselines.
    """

    runs: tuple[RunData, ...]
    rows: Rows
    metrics: tuple[MetricSpec, ...]
    tasks: tuple[str, ...]
    records: Mapping[str, MethodRecord]
    trivial: tuple[str, ...]

    @classmethod
    def read(cls, folders: Sequence[Path]) -> RunSet:
        """Read runs. The same method with the same settings and other seeds is one method with more seeds.

        With other settings it is another, named after the settings that differ ("ours (dynamic=opacity)"), or after
        the folders where that would be too long.

        Raises
        ------
        InputError : runs that do not score the same frames by the same protocol, define a metric differently, or hold
            the same training twice; faulty rows.
        """
        if not folders:
            raise InputError("runs", "", "at least one folder", "none")
        runs = tuple(RunData.read(folder) for folder in folders)
        _check_protocols(runs)
        labels = _labels(runs)
        rows = Rows.joined(
            [
                run.rows.renamed({name: label for (i, name), label in labels.items() if i == index})
                for index, run in enumerate(runs)
            ]
        )
        rows.check()
        records = {
            labels[i, method.name]: method for i, run in enumerate(runs) for method in run.manifest.methods
        }
        return cls(
            runs,
            rows,
            _metrics(runs),
            tuple(dict.fromkeys(task for run in runs for task in run.tasks)),
            records,
            tuple(label for label, record in records.items() if record.trivial),
        )

    @property
    def methods(self) -> tuple[str, ...]:
        """Labels, in order."""
        return tuple(self.records)

    @property
    def ranked(self) -> tuple[str, ...]:
        """Labels of methods that are no trivial baselines, in order."""
        return tuple(label for label in self.records if label not in self.trivial)

    @property
    def protocol_ids(self) -> dict[str, str]:
        """Readable name of each task's protocol."""
        return {task: identifier for run in self.runs for task, identifier in run.protocol_ids.items()}

    @property
    def image_size(self) -> str:
        """Sizes of the rendered images."""
        return "; ".join(dict.fromkeys(run.image_size for run in self.runs if run.image_size))

    @property
    def machine(self) -> str:
        """Machines that speed was measured on."""
        return "; ".join(dict.fromkeys(run.machine for run in self.runs))


def _check_protocols(runs: Sequence[RunData]) -> None:
    first: dict[str, RunData] = {}
    for run in runs:
        for task in run.tasks:
            other = first.setdefault(task, run)
            expected, found = (r.manifest.protocols[task].hash for r in (other, run))
            if expected != found:
                known = f"protocol {expected}, that of {other.folder.root}"
                raise InputError(
                    run.folder.root, f"protocol of {task}", known, found, "Score the same frames."
                )


def _metrics(runs: Sequence[RunData]) -> tuple[MetricSpec, ...]:
    metrics: dict[str, MetricSpec] = {}
    for run in runs:
        for spec in run.metrics:
            if _meaning(metrics.setdefault(spec.name, spec)) != _meaning(spec):
                known = f"{spec.name} as in {runs[0].folder.root}"
                raise InputError(run.folder.manifest, "metrics", known, "another definition")
    return tuple(metrics.values())


def _meaning(spec: MetricSpec) -> tuple[str, bool, str, str]:
    """Return what makes values of a metric comparable; its words and digits may change."""
    return spec.unit, spec.higher_is_better, spec.implementation, spec.detail


def _labels(runs: Sequence[RunData]) -> dict[tuple[int, str], str]:
    """Label of each run's methods, by index of the run and name."""
    variants: dict[str, list[tuple[MethodRecord, list[int], set[int]]]] = {}
    for index, run in enumerate(runs):
        for record in run.manifest.methods:
            name = record.name
            seeds = run.rows.seeds(name)
            known = variants.setdefault(name, [])
            same = next((v for v in known if v[0] == record and not v[2] & seeds), None)
            if same is None:
                known.append((record, [index], seeds))
            else:
                same[1].append(index)
                same[2].update(seeds)
    labels = {}
    for name, known in variants.items():
        folders = [[runs[index].folder.root for index in indices] for _, indices, _ in known]
        for (_, indices, _), label in zip(known, _names(name, [v[0] for v in known], folders)):
            labels.update({(index, name): label for index in indices})
    return labels


def _names(name: str, records: Sequence[MethodRecord], folders: Sequence[Sequence[Path]]) -> list[str]:
    """Tell variants of a method apart: by what differs in their settings, else by their folders."""
    if len(records) == 1:
        return [name]
    flat = [_flat(asdict(record)) for record in records]
    keys = [k for k in dict.fromkeys(k for f in flat for k in f) if len({f.get(k, "") for f in flat}) > 1]
    told = [", ".join(f"{key.rpartition('.')[2]}={f.get(key, 'none')}" for key in keys) for f in flat]
    if len(set(told)) == len(told) and max(map(len, told)) <= LONGEST_DIFFERENCE:
        return [f"{name} ({text})" for text in told]
    for told in ([f[0].name for f in folders], [f[0].as_posix() for f in folders]):
        if len(set(told)) == len(told):
            return [f"{name} ({text})" for text in told]
    raise InputError(folders[0][0], f"method {name}", "each training once", "the same run twice")


def _flat(value: Any, prefix: str = "") -> dict[str, str]:
    """Settings by dotted key, as text."""
    if isinstance(value, Mapping):
        return {
            key: text for name, part in value.items() for key, text in _flat(part, f"{prefix}.{name}").items()
        }
    return {prefix: "+".join(map(str, value)) if isinstance(value, list) else str(value)}


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """At most ``count`` items, each in the middle of its equal share of the sequence."""
    count = min(count, len(items))
    return [items[(2 * i + 1) * len(items) // (2 * count)] for i in range(count)]

"""Several finished runs as one: seeds of one method joined, settings of one method told apart by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..bench.errors import InputError
from ..bench.manifest import MethodRecord
from ..bench.rows import Rows
from ..bench.specs import MetricSpec
from .run_data import RunData

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
    trivial : labels of floors.
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
        """Labels of methods that are no floors, in order."""
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

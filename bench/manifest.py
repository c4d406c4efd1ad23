"""``run.json``: everything that determined the values of a run. Written by the run, and read by reports and checks.

Protocols are referenced by hash; each is in a separate file, ``protocols/<hash>.json`` in the run folder.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from .condition import label_of
from .contracts import FrameKey
from .engine.config import RunConfig
from .errors import InputError
from .io.documents import checked, read_json, shown
from .io.files import digest, to_jsonable, write_json, write_text
from .progress import counted
from .protocol import Protocol
from .specs import MetricSpec

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class MethodRecord:
    """Record of a method under a condition; see `ResolvedMethod.record`.

    ``needs`` are those not met by the clip itself. ``code`` is the digest of its code, see `registry.code_digest`; None for a folder of
    images, which has none. ``codec`` is that of the measured avatars (`CodedAvatar`), "" for files as trained, several
    separated by semicolons; None before an avatar is measured, and in runs that did not record it.
    """

    name: str
    version: str
    implementation: str
    trivial: bool
    config: dict[str, Any] | None
    budget: dict[str, Any]
    needs: dict[str, Any] | None = None
    code: str | None = None
    condition: str = ""
    codec: str | None = field(default=None, compare=False)

    @property
    def label(self) -> str:
        """Name in tables and folders."""
        return label_of(self.name, self.condition)


CUTS = {"mask_below_neck": "bust-line", "mask_clothes": "parsing"}
"""Steps that replace a part of the person by background."""


def cut_of(steps: Iterable[Mapping[str, Any]]) -> str:
    """What was last cut from the images of a clip, by the records of its steps: a value of `CUTS`, or "" for nothing."""
    cuts = [CUTS.get(step["name"]) or step["parameters"].get("cut", "") for step in steps]
    return next(filter(None, reversed(cuts)), "")


@dataclass(frozen=True)
class ClipRecord:
    """Record of a capture: its fingerprint, the steps that made it, frames of each split, excluded frames, and the
    cameras of the training split (none in old records)."""

    subject: str
    fingerprint: str
    steps: list[dict[str, Any]]
    splits: dict[str, int]
    excluded: dict[str, str]
    training_cameras: tuple[str, ...] = ()


@dataclass(frozen=True)
class AdaptedRecord:
    """The steps that adapted a clip to a method, and the resulting fingerprint."""

    subject: str
    method: str
    fingerprint: str
    steps: list[dict[str, Any]]


@dataclass(frozen=True)
class ProtocolRecord:
    """A `Protocol` with its id and hash."""

    id: str
    hash: str
    task: str
    keys: tuple[FrameKey, ...]
    excluded: tuple[tuple[FrameKey, str], ...]
    clips: tuple[tuple[str, str], ...]
    resolution: str
    background: tuple[float, float, float]
    quantisation: str
    metric_profile: str
    conditions: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(cls, protocol: Protocol) -> ProtocolRecord:
        """Record a protocol."""
        values = {f.name: getattr(protocol, f.name) for f in fields(protocol)}
        return cls(protocol.id, protocol.hash, **values)

    def protocol(self, source: Path) -> Protocol:
        """The protocol recorded in the file ``source``."""
        protocol = Protocol(**{f.name: getattr(self, f.name) for f in fields(Protocol)})
        if protocol.hash != self.hash:
            raise InputError(source, f"protocols.{self.task}", self.hash, protocol.hash)
        return protocol

    @property
    def design(self) -> str:
        """Digest of all but the fingerprints of the captures."""
        record = asdict(self)
        del record["hash"], record["clips"]
        return digest(record)[:12]


PROTOCOLS = "protocols"
"""Folder of a run's protocols."""


def protocol_path(folder: Path, protocol: str) -> Path:
    """The file of the protocol with a hash, in a run folder."""
    return folder / PROTOCOLS / f"{protocol}.json"


def _read_protocol(run: Path, task: str, name: str) -> ProtocolRecord:
    """Read the protocol with the hash ``name``."""
    path = protocol_path(run.parent, name)
    if not path.exists():
        expected = f"the protocol of {task} that {run.name} names"
        raise InputError(path, "", expected, "no such file", "Copy it from where the run was made.")
    record = checked(read_json(path), ProtocolRecord, path)
    if (record.task, record.hash) != (task.partition("@")[0], name):
        raise InputError(path, "task, hash", f"{task}, {name}", f"{record.task}, {record.hash}")
    return record


ELSEWHERE = ("out", "data", "heads", "settings")
"""Entries of a configuration that are compared by what they lead to: fingerprints of captures, settings of methods."""
UNCHANGED = (
    "A run does not change: choose another --out. Tables, comparisons and reports take several runs, and `headbench run --from "
    "RUN --metrics NAMES` measures more of the same avatars."
)
OLD = "The folder is of an earlier version of headbench; make the run again, in another folder."


def differences(then: Any, now: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """Dotted key and both values, as text, of each value that differs between nested mappings; "none" where there is none."""
    then, now = _plain(then), _plain(now)
    if isinstance(then, dict) and isinstance(now, dict):
        for name in dict.fromkeys((*now, *then)):
            yield from differences(then.get(name), now.get(name), f"{key}.{name}" if key else name)
    elif then != now:
        yield key, _text(then), _text(now)


def identity_differences(
    record: Mapping[str, Any], identity: Mapping[str, Any], key: str
) -> list[tuple[str, str, str]]:
    """`differences` of a method's record from a `ResolvedMethod.identity`, which lacks the record's paths on this machine."""
    then = {name: record.get(name) for name in identity}
    if identity.get("config") and then["config"]:
        then["config"] = {name: then["config"].get(name) for name in identity["config"]}
    return [*differences(then, identity, key)]


def _plain(value: Any) -> Any:
    """A value as in a JSON file; named entries of a list by their name."""
    value = json.loads(json.dumps(value, default=to_jsonable))
    if (
        isinstance(value, list)
        and value
        and all(isinstance(entry, dict) and "name" in entry for entry in value)
    ):
        return {entry["name"]: entry for entry in value}
    return value


def _text(value: Any) -> str:
    if isinstance(value, dict):
        texts = ((name, _text(entry)) for name, entry in value.items() if entry)
        return ", ".join(f"{name} {text}" for name, text in texts if text)
    return (
        ", ".join(map(str, value))
        if isinstance(value, list)
        else "none"
        if value is None
        else str(value) or "none"
    )


@dataclass(frozen=True)
class Manifest:
    """Everything that determined the values of a run."""

    configuration: RunConfig
    methods: tuple[MethodRecord, ...]
    metrics: tuple[MetricSpec, ...]
    clips: tuple[ClipRecord, ...]
    protocols: dict[str, ProtocolRecord]
    """``metrics``, ``methods``, ``protocols``: In the order of the configuration; protocols by task, in files of
    their own."""
    machine: dict[str, Any]
    """Processor, cores, memory in bytes, system, package versions and accelerators; for a run on a CUDA device, also
    the device, CUDA's version and whether TF32 was enabled. See `machine_record`."""
    status: Literal["started", "done"] = "started"
    adapted: tuple[AdaptedRecord, ...] = ()
    """Clips that were adapted to a method."""
    seconds: float | None = None
    peak_memory_bytes: int | None = None
    """``seconds``, ``peak_memory_bytes``: Of the last start of the run; None until it has ended."""
    capture_seconds: float | None = None
    """Time that the demo took to make its capture."""
    unchecked: bool | None = None
    """True if the captures were not searched for errors that change results: `headbench run --unchecked`."""
    format: Literal[3] = 3

    @classmethod
    def read(cls, path: Path) -> Manifest:
        """Read ``run.json`` and its protocols."""
        record = read_json(path)
        if record.get("format") != 3:
            raise InputError(path, "format", "3", shown(record.get("format")), OLD)
        hashes = checked(record.get(PROTOCOLS), dict[str, str], path, PROTOCOLS)
        manifest = checked({**record, PROTOCOLS: {}}, cls, path)
        return replace(
            manifest, protocols={task: _read_protocol(path, task, name) for task, name in hashes.items()}
        )

    def write(self, path: Path) -> None:
        """Write the protocols and ``run.json``, each file atomically."""
        for protocol in self.protocols.values():
            file = protocol_path(path.parent, protocol.hash)
            write_text(file, json.dumps(asdict(protocol), separators=(",", ":")) + "\n")
        without = replace(self, protocols={})
        record = {name: value for name, value in asdict(without).items() if value is not None}
        record[PROTOCOLS] = {task: protocol.hash for task, protocol in self.protocols.items()}
        for method in record["methods"]:
            for name in ("needs", "code", "condition"):
                if not method[name]:
                    del method[name]
            if method["codec"] is None:
                del method["codec"]
        for condition in record["configuration"]["conditions"]:
            if not condition["as_tracked"]:
                del condition["as_tracked"]
            if not condition["views"]["name"]:
                del condition["views"]
        for clip in record["clips"]:
            if not clip["training_cameras"]:
                del clip["training_cameras"]
        for metric in record["metrics"]:
            del metric["default"], metric["needs"], metric["suspect_above"]
        write_json(path, record)

    def check_same(self, earlier: Manifest, methods: Mapping[str, Mapping[str, Any]], path: Path) -> None:
        """Raise `InputError` if the run in the file ``path``, ``earlier``, is another than this one.

        ``methods`` has what decides the results of each method, by label, see `ResolvedMethod.identity`. Where the files
        lie is no difference: the fingerprints of the captures tell. Changed code of a method of this package is a warning.
        """
        settings, results = zip(*(each._compared for each in (earlier, self)))
        changes = [*differences(*settings)]
        if not changes:
            changes = [*differences(*results)]
            for record in earlier.methods:
                if current := methods.get(record.label):  # "methods" names a label that is missing
                    changes += identity_differences(vars(record), current, f"methods.{record.label}")
        if changes:
            keys, before, wanted = ([each[place] for each in changes[:3]] for place in range(3))
            more = f" and {counted(len(changes) - 3, 'other difference')}" if changes[3:] else ""
            expected = f"{'; '.join(before)}, as in this run"
            raise InputError(path, ", ".join(keys) + more, expected, "; ".join(wanted), UNCHANGED)
        codes = {method.label: method.code for method in self.methods}
        for record in earlier.methods:
            if codes[record.label] != record.code:
                log.warning(
                    "The code of %s has changed since this run was begun; its avatars are kept because the version is still %s.",
                    *(record.label, record.version),
                )

    @property
    def _compared(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """What was asked for, and what it led to."""
        settings = {key: value for key, value in asdict(self.configuration).items() if key not in ELSEWHERE}
        settings["reader_settings"] = {
            key: value
            for key, value in settings["reader_settings"].items()
            if not (isinstance(value, str) and Path(value).is_absolute())
        }
        return {"configuration": settings}, {
            "methods": [method.label for method in self.methods],
            "metrics": {metric.name: metric.implementation for metric in self.metrics},
            "captures": {clip.subject: clip.fingerprint for clip in self.clips},
            "protocols": {task: protocol.hash for task, protocol in self.protocols.items()},
        }

    def check_done(self, path: Path) -> None:
        """Raise `InputError` for an unfinished run."""
        if self.status != "done":
            remedy = "Start the run again; it continues."
            raise InputError(path, "status", "'done'", repr(self.status), remedy)

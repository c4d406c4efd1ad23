"""One cell (a subject, a method, a seed) with its inputs, and the fingerprints of its results."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

from ..condition import PLAIN, Condition, label_of
from ..contracts import CheckedMethod, Clip, FrameKey, Progress
from ..errors import InputError
from ..io.documents import read_json
from ..io.files import digest, refuse_links, to_jsonable
from ..progress import RunProgress, duration, progress
from ..protocol import Protocol
from ..rows import ALL, Rows
from ..source import is_outside
from .adaptation import AdaptedClip
from .config import ResolvedMethod, RunConfig
from .guard import TrainingView
from .store import Cell, StepState
from .stored import AVATAR_FILE

log = logging.getLogger(__name__)
RESULT_FORMAT = 1  # raise when the output of a step changes
TRAINING, RENDERING, MEASURING_AVATAR = "training", "rendering", "measuring the avatar"
DIGESTS = "digests"


@dataclass(frozen=True)
class Job:
    """One cell with its inputs.

    ``clip`` is the ground truth of every metric. ``adapted`` is the clip adapted to this method and
    condition, None if that is the clip itself. ``regions`` are evaluated besides the whole frame. ``source``
    is the cell whose avatar is used instead of training. ``config`` is that of the run. ``kept`` is a cache
    shared by the cells of a run. ``line`` shows the progress of the run.
    """

    clip: Clip
    method: ResolvedMethod
    seed: int
    device: str
    cell: Cell
    protocols: Mapping[str, Protocol]
    adapted: AdaptedClip | None = None
    regions: tuple[str, ...] = ()
    condition: Condition = PLAIN
    source: Cell | None = None
    config: RunConfig | None = None
    line: RunProgress | None = None
    created: list[Any] = field(default_factory=list, repr=False, compare=False)
    kept: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def create(self) -> Any:
        """The `Method` of this cell, created on first use."""
        if not self.created:
            self.created.append(self.method.create())
        return self.created[0]

    def rows_of(self, rows: Rows) -> pd.DataFrame:
        """Select the rows of this cell from those of a run."""
        return rows.select(
            method=self.method.spec.name,
            condition=self.condition.name,
            metric=ALL,
            task=ALL,
            region=ALL,
            seeds=(self.seed,),
            subject=self.clip.subject,
        )

    def progress(self, step: str) -> AbstractContextManager[Progress]:
        """Progress of a step: part of the run's if the cell belongs to one, otherwise separate."""
        return self.line.step(self.name, step) if self.line else progress(f"{self.name}: {step}")

    @property
    def form(self) -> AdaptedClip:
        """The clip adapted to the method."""
        return self.adapted or AdaptedClip(self.clip)

    @property
    def name(self) -> str:
        return f"{self.label}, subject {self.clip.subject}, seed {self.seed}"

    @property
    def run(self) -> Path:
        """Folder of the run."""
        return self.cell.folder.parents[2]

    @property
    def follows(self) -> bool:
        """Whether its avatar is derived from that of another cell of the same run, which runs first."""
        return self.source is not None and self.source.folder.parents[2] == self.run

    @property
    def label(self) -> str:
        """Label of the method and its condition in tables and folder names."""
        return label_of(self.method.spec.name, self.condition.name)

    @property
    def fit_fingerprint(self) -> str:
        """Digest of everything the trained avatar depends on."""
        made_of = {**self.method.identity(), "name": self.label}
        derived = [asdict(change) for change in (self.condition.derive, self.condition.views) if change]
        return digest(RESULT_FORMAT, made_of, self.seed, self.device, self.form.clip.fingerprint, *derived)

    @property
    def frame_paths(self) -> dict[Path, tuple[Protocol, FrameKey]]:
        """The frames to score, by the path of their renders."""
        return {
            self.cell.render(protocol.task, key): (protocol, key)
            for protocol in self.protocols.values()
            for key in protocol.keys
            if key.subject == self.clip.subject
        }

    def check(self) -> None:
        """Refuse a folder with an avatar from other inputs or other code, or with links that point outside of it.

        Damaged records of steps are removed, with a warning.
        """
        refuse_links(self.cell.folder)
        self.cell.drop_damaged_records()
        if self.source is not None and not self.follows:
            source_digest(self)
        state = self.cell.step("fit")
        if state is None or state.get("fingerprint") == self.fit_fingerprint:
            return
        file, remedy = self.cell.folder / "fit.json", f"Choose another --out, or delete {self.cell.folder}."
        code, earlier = (record.get("code") for record in (self.method.record(), state.get("method", {})))
        if is_outside(self.method.spec.implementation) and "method" in state and code != earlier:
            expected = f"{code}, the digest of the code of {self.method.spec.implementation}"
            changed = (
                "the code of the plug-in, all Python files of its folder, has changed since its training"
            )
            found = f"{earlier}: {changed} {trained_ago(state)}"
            raise InputError(file, "method, code", expected, found, remedy)
        decides = json.loads(json.dumps(self.method.identity(), default=to_jsonable))
        both = ((path, value, _at(state.get("method"), path)) for path, value in _leaves(decides))
        other = [(".".join(path), value, old) for path, value, old in both if old != value][:3]
        wanted = "".join(f", {name} {value}" for name, value, _ in other)
        there = "".join(f", {name} {old}" for name, _, old in other)
        what = "settings" if other else "data, device, condition or format"
        raise InputError(
            file,
            "fingerprint",
            f"the avatar of this run's settings and data{wanted}",
            f"one of other {what}{there}",
            remedy,
        )

    def check_method(self) -> None:
        """Let a method check that it can train and render, unless all steps are done."""
        method = self.create() if self.method.spec.implementation else None
        if isinstance(method, CheckedMethod) and not self.cell.is_done("measure", self.fit_fingerprint):
            method.check(TrainingView(self.form.clip), self.method.budget)


def source_digest(job: Job) -> str:
    """Digest of the trained avatar of the job's ``source``.

    Raises `InputError` where there is none, and for one that was trained with other settings or on another capture.
    """
    assert job.source is not None
    state, path = job.source.step("fit"), job.source.folder / "fit.json"
    if state is None or state["status"] != "done":
        found = "none" if state is None else "one whose training did not end"
        raise InputError(path, "", "a trained avatar", found, "Start the run again.")
    own = json.loads(json.dumps(job.method.record()["config"]))
    if "config" in state.get("method", {}) and state["method"]["config"] != own:
        expected = "an avatar of the settings of this run"
        raise InputError(
            path, "method.config", expected, "one of other settings", "Give the settings of the source."
        )
    record = job.source.avatar / AVATAR_FILE
    capture = read_json(record).get("origin", {}).get("capture") if record.is_file() else None
    if capture not in (None, job.form.clip.fingerprint):
        raise InputError(record, "origin.capture", "an avatar of this capture", "one of another")
    return digest(state["fingerprint"], state.get("files"))


def source_now(job: Job) -> str:
    """`source_digest`; "" if the source is a cell of this run that has no avatar yet."""
    try:
        return source_digest(job)
    except InputError:
        if not job.follows:
            raise
        return ""


def trained_ago(state: StepState) -> str:
    """How long ago a training ended; records of unfinished trainings have no time."""
    if "finished_at" not in state:
        return "in an earlier run"
    return f"{duration(max(0.0, datetime.now(UTC).timestamp() - state['finished_at']))} ago"


def warn_of_damage(job: Job, damaged: Mapping[str, str], remedy: str) -> None:
    """Log the damaged files of a cell, and how they are handled."""
    first, *more = (f"{job.cell.folder / name} {why}" for name, why in damaged.items())
    log.warning("%s: %s%s; %s", job.name, first, f", {len(more)} more are damaged" if more else "", remedy)


def recorded_frames(job: Job) -> dict[str, str]:
    """SHA-256 of the rendered frames, by their path in the cell's folder."""
    state = job.cell.step(DIGESTS)
    return {} if state is None else state.get("files", {})


def trained_files(job: Job) -> Mapping[str, str]:
    """SHA-256 of the files of a cell's avatar, by their path in the cell's folder."""
    return avatar_record(job)[1]


def avatar_record(job: Job) -> tuple[str, Mapping[str, str]]:
    """Data that distinguishes avatars trained with the same settings."""
    state = job.cell.step("fit")
    return ("", {}) if state is None else (state.get("derived_from", ""), state.get("files", {}))


def _leaves(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Values of nested mappings and their paths, such as ("budget", "iterations")."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, (*path, key))
    else:
        yield path, value


def _at(value: Any, path: Sequence[str]) -> Any:
    """The value at a path in nested mappings; "none" if there is none."""
    for key in path:
        if not isinstance(value, Mapping) or key not in value:
            return "none"
        value = value[key]
    return value

"""Rows: one measured value for each method, seed, frame, region and metric, and the query on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from enum import Enum
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from .condition import label_of
from .contracts import FloatArray, IntArray
from .errors import InputError, shortened
from .io.files import atomic_path, open_regular, reading

if TYPE_CHECKING:
    import pandas as pd  # slow to import: commands import it when they have rows
FRAME = ["subject", "sequence", "timestep", "camera"]
"""Columns that name a frame."""
FULL = "full"
"""The region over which every metric is computed: the whole frame."""
SUSPECT = "suspect: "
"""Prefix of the reason of a measured value that is suspiciously good, see `MetricSpec.suspect_above`."""


@dataclass(frozen=True)
class Row:
    """One measured value, or the reason why it is missing. Per-avatar values have no task, timestep -1 and no
    camera.

    ``condition`` names the changes from the plain comparison, see `bench.condition.Condition`; "" for none.

    ``machine``, ``threads`` and ``other_cores`` are recorded for times only, see `machine.ProcessorLoad`;
    elsewhere they are "", 0 and NaN.
    """

    method: str
    version: str
    seed: int
    task: str
    subject: str
    sequence: str
    timestep: int
    camera: str
    region: str
    metric: str
    value: float
    protocol: str
    status: str = "ok"  # ok | missing | failed
    reason: str = ""
    machine: str = ""
    threads: int = 0
    other_cores: float = math.nan
    condition: str = ""


LEFT_OUT = "left out: "
"""Prefix of the reason of a missing value that is left out, see `LeftOutError`."""

COLUMNS = tuple(f.name for f in fields(Row))
TYPES = {
    "seed": "int64",
    "timestep": "int64",
    "value": "float64",
    "threads": "int64",
    "other_cores": "float64",
}

ROWS = "a Parquet file of rows"
JOINED_AT_ONCE = 64
"""Number of tables concatenated at a time: many small tables take many times the memory of their content."""
MAX_REASON = 4_000
"""Maximum characters of a reason; longer ones are shortened in the middle."""


class All(Enum):
    """Selects every method, metric, task, region or seed, so that a query states it explicitly."""

    ALL = "all"


ALL: Final = All.ALL
"""Selects every value of an argument of `Rows.select`."""


def batch_means(values: FloatArray, count: int, *, decibels: bool) -> FloatArray:
    """Means of (N,) values over batches of ``count`` consecutive ones; of decibels those of the mean squared error."""
    batch = np.arange(len(values)) // count
    means: FloatArray = np.bincount(batch, 10 ** (-values / 10) if decibels else values) / np.bincount(batch)
    return -10 * np.log10(means) if decibels else means


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of one or several runs. Values are read only by `select`.

    A frame has a row for each region, metric, task, seed and method. An average over rows that differ in one
    of these by mistake is wrong, so a query names them all.
    """

    _table: pd.DataFrame

    @classmethod
    def of(cls, rows: Iterable[Row]) -> Rows:
        """Build rows from measured values; long reasons are shortened."""
        import pandas as pd

        records = ({**asdict(row), "reason": shortened(row.reason, MAX_REASON)} for row in rows)
        return cls(pd.DataFrame(records, columns=list(COLUMNS)).astype(TYPES))

    @classmethod
    def joined(cls, parts: Iterable[Rows]) -> Rows:
        """Concatenate rows, in order."""
        import pandas as pd

        tables = (part._table for part in parts)
        whole = []
        while batch := list(islice(tables, JOINED_AT_ONCE)):
            table = pd.concat(batch)
            # Concatenated text columns keep one chunk per table; `take` copies them into one.
            whole.append(table.take(np.arange(len(table))))
        return cls(pd.concat(whole, ignore_index=True)) if whole else cls.of([])

    @classmethod
    def read(cls, path: Path) -> Rows:
        """Read rows that `write` wrote."""
        import pandas as pd

        if not path.exists():
            raise InputError(path, "", "the rows of a finished run", "no such file", "Start the run again.")
        with open_regular(path, ROWS) as stream, reading(path, ROWS):
            table = pd.read_parquet(stream)
            if lacking := sorted({*COLUMNS} - {*table.columns}):
                raise InputError(path, "columns", ", ".join(COLUMNS), f"no {', '.join(lacking)}")
            return cls(table[[*COLUMNS]].astype(TYPES))

    def write(self, path: Path) -> None:
        """Write the rows as Parquet, atomically."""
        repeated = [name for name in COLUMNS if name != "value"]
        with atomic_path(path) as temporary:
            # Encodings and a compression that every reader of Parquet has had since 2013; `value` is PLAIN.
            self._table.to_parquet(temporary, index=False, use_dictionary=repeated, compression="gzip")

    def __len__(self) -> int:
        return len(self._table)

    def select(
        self,
        *,
        method: str | All,
        metric: str | All,
        task: str | All,
        region: str | All,
        seeds: Collection[int] | All,
        subject: str | All = ALL,
        condition: str | All = "",
    ) -> pd.DataFrame:
        """Return the rows that match all arguments, as a table with the columns of `Row`.

        ``task`` "" is for metrics of the avatar as a whole, whose region is the full image. ``condition`` "" is the plain
        comparison.
        """
        wanted = {"method": method, "metric": metric, "task": task, "region": region, "condition": condition}
        table = self._table
        if ALL not in wanted.values():
            # The groups are computed once: a report makes thousands of queries.
            table = table.take(self._places.get(tuple(wanted.values()), np.empty(0, int)))
            wanted = {}
        wanted["subject"] = subject
        chosen = np.ones(len(table), dtype=bool)
        for column, value in wanted.items():
            if value is not ALL:
                chosen &= (table[column] == value).to_numpy()
        if seeds is not ALL:
            chosen &= table["seed"].isin(list(seeds)).to_numpy()
        return table if chosen.all() else table[chosen]

    @cached_property
    def _places(self) -> dict[tuple[Any, ...], IntArray]:
        """Row indices by method, metric, task, region and condition."""
        columns = ["method", "metric", "task", "region", "condition"]
        return self._table.groupby(columns, sort=False).indices if len(self._table) else {}  # type: ignore[return-value]

    @property
    def failed(self) -> list[str]:
        """Labels of methods and conditions that have a failed row, sorted."""
        failed = self._table.loc[self._table["status"] == "failed", ["method", "condition"]].drop_duplicates()
        return sorted(label_of(str(method), str(condition)) for method, condition in failed.to_numpy())

    @property
    def tasks(self) -> set[str]:
        """Tasks of the rows; "" is left out."""
        return set(self._table["task"].unique()) - {""}

    @property
    def methods(self) -> set[str]:
        """Methods of the rows."""
        return set(self._table["method"].unique())

    @property
    def metrics(self) -> set[str]:
        """Metrics of the rows."""
        return set(self._table["metric"].unique())

    @property
    def subjects(self) -> set[str]:
        """Subjects of the rows."""
        return set(self._table["subject"].unique())

    def subjects_of(self, methods: Collection[str]) -> dict[str, frozenset[str]]:
        """Subjects of each method's rows."""
        pairs = self._table[["method", "subject"]].drop_duplicates()
        return {name: frozenset(map(str, pairs.loc[pairs["method"] == name, "subject"])) for name in methods}

    def seeds(self, method: str | All) -> set[int]:
        """Seeds of a method."""
        seeds = self._seeds
        return set().union(*seeds.values()) if method is ALL else set(seeds.get(str(method), ()))

    @cached_property
    def _seeds(self) -> dict[str, set[int]]:
        seeds = self._table.groupby("method")["seed"].unique()
        return {str(method): set(map(int, each)) for method, each in seeds.items()}

    def versions(self, method: str) -> list[str]:
        """Versions of a method, sorted."""
        return sorted(map(str, self._of(method)["version"].unique()))

    def protocols(self, task: str) -> list[str]:
        """Hashes of the protocols with which a task was scored, sorted."""
        return sorted(map(str, self._table.loc[self._table["task"] == task, "protocol"].unique()))

    def frames(self, task: str, region: str) -> set[tuple[str, str, int, str]]:
        """Frames of a task for which any method has a row in a region."""
        return set(self._frames.get((task, region), ()))

    @cached_property
    def _frames(self) -> dict[tuple[str, str], list[tuple[str, str, int, str]]]:
        table = self._table[self._table["timestep"] >= 0]
        groups = table[["task", "region", *FRAME]].drop_duplicates().groupby(["task", "region"])[FRAME]
        return {place: list(group.itertuples(index=False, name=None)) for place, group in groups}  # type: ignore[misc]

    def renamed(self, labels: Mapping[str, str]) -> Rows:
        """Return the rows with methods renamed."""
        return Rows(self._table.assign(method=_mapped(self._table["method"], labels.__getitem__)))

    def of_protocols(self, hashes: Mapping[str, str]) -> Rows:
        """Return the rows with protocol hashes replaced; hashes that are not in ``hashes`` stay."""
        protocol = _mapped(self._table["protocol"], lambda found: hashes.get(found, found))
        return Rows(self._table.assign(protocol=protocol))

    def labelled(self) -> Rows:
        """Return the rows with the label of method and condition (`label_of`) as the method, as in tables."""
        table = self._table
        pairs = table["method"] + "\n" + table["condition"]
        return Rows(
            table.assign(method=_mapped(pairs, lambda pair: label_of(*pair.split("\n"))), condition="")
        )

    def in_single_precision(self) -> Rows:
        """Return the rows with values rounded to float32 (7 digits, more than tables show), which halves the file."""
        return Rows(self._table.assign(value=self._table["value"].astype(np.float32).astype(np.float64)))

    def of_part(self, region: str, sequences: Collection[str], full: str) -> Rows:
        """Rows of frames in one region, relabelled as ``full``, of some sequences (default: all).

        Rows of avatars as a whole are kept. So are rows that stand for all frames of a task because a method failed, for
        every task and metric with frames in the part.
        """
        table = self._table
        avatar = table["task"] == ""
        chosen = table["region"] == region
        if sequences:
            chosen &= table["sequence"].isin(list(sequences))
        chosen &= ~avatar & (table["timestep"] >= 0)
        places = table.set_index(["task", "metric"]).index
        failed = (table["timestep"] < 0) & places.isin(places[chosen])
        return Rows(table[avatar | chosen | failed].assign(region=full))

    def split_by_camera(
        self, task: str, chosen: Collection[tuple[str, str]], inside: str, outside: str
    ) -> Rows:
        """Return the rows with ``task`` split in two: ``inside`` for the ``chosen`` (subject, camera), else ``outside``.

        Rows that stand for all frames of the task because a method failed are in both.
        """
        import pandas as pd

        table = self._table
        whole = (table["task"] == task) & (table["timestep"] < 0)
        frames = (table["task"] == task) & ~whole
        cameras = table[frames].set_index(["subject", "camera"]).index
        names = table.loc[~whole, "task"].mask(frames[~whole], outside)
        names[frames[frames].index[cameras.isin(list(chosen))]] = inside
        parts = [table[~whole].assign(task=names.astype("str"))]
        parts += [table[whole].assign(task=name) for name in (inside, outside)]
        return Rows(pd.concat(parts, ignore_index=True))

    @property
    def regions(self) -> set[str]:
        """Regions of the rows of frames."""
        return set(self._table.loc[self._table["task"] != "", "region"].unique())

    @property
    def sequences(self) -> set[str]:
        """Sequences of the frames."""
        return set(self._table.loc[self._table["task"] != "", "sequence"].unique())

    def of_methods(self, names: Collection[str]) -> Rows:
        """The rows of some methods."""
        return Rows(self._table[self._table["method"].isin(list(names))])

    def of_subjects(self, names: Collection[str]) -> Rows:
        """The rows of some subjects."""
        return Rows(self._table[self._table["subject"].isin(list(names))])

    def of_metrics(self, names: Sequence[str]) -> Rows:
        """The rows of some metrics, in the order of ``names``."""
        metric = self._table["metric"]
        # One table: concatenating thousands of small parts takes thirty times the memory of their content.
        places = np.concatenate([np.empty(0, int), *(np.flatnonzero(metric == name) for name in names)])
        return Rows(self._table.take(places).reset_index(drop=True))

    def with_metrics(self, names: Mapping[str, str]) -> Rows:
        """Return the rows of some metrics, renamed."""
        table = self._table[self._table["metric"].isin(list(names))]
        return Rows(table.assign(metric=_mapped(table["metric"], names.__getitem__)))

    def of_frames(self, tasks: Mapping[str, Collection[tuple[str, str, int, str]]]) -> Rows:
        """The rows of some frames of some tasks, and those of avatars as a whole.

        Rows that stand for all frames of one of the tasks because a method failed are kept.
        """
        table = self._table
        kept, keys = table["task"] == "", table.set_index(FRAME).index
        for task, frames in tasks.items():
            kept |= (table["task"] == task) & (keys.isin(list(frames)) | (table["timestep"] < 0))
        return Rows(table[kept])

    def as_one_sequence(self) -> Rows:
        """Return the rows with all frames of a subject and task in one sequence, so that every frame has the same weight.

        Timesteps are numbered from 0, sorted by sequence and timestep.
        """
        table = self._table
        of_frames = (table["task"] != "") & (table["timestep"] >= 0)
        place = table.loc[of_frames].groupby(["task", "subject"])[["sequence", "timestep"]]
        numbers = table["timestep"].copy()
        for _, group in place:
            order = group.set_index(["sequence", "timestep"]).index
            numbers[group.index] = order.unique().sort_values().get_indexer(order)
        sequence = table["sequence"].mask(of_frames, "").astype("str")
        return Rows(table.assign(sequence=sequence, timestep=numbers))

    def pooled(self, count: int, decibels: Collection[str]) -> Rows:
        """Return the rows with values averaged over batches of ``count`` consecutive frames.

        Every frame gets the value of its batch: the mean or, for metrics in ``decibels`` (peak signal-to-noise ratios), that of
        the mean squared error. Values of an incomplete last batch are scaled, so that all batches have the same weight.
        Batches are formed per method, seed, task, subject and metric; rows without a value are unchanged.
        """
        table = self._table
        frames = table[(table["task"] != "") & (table["timestep"] >= 0) & (table["status"] == "ok")]
        values = table["value"].copy()
        groups = ["method", "condition", "seed", "task", "subject", "metric", "region"]
        for key, group in frames.sort_values(FRAME).groupby(groups, sort=False):
            numbers = group["value"].to_numpy()
            means = batch_means(numbers, count, decibels=key[5] in decibels)  # type: ignore[index]
            batch = np.arange(len(numbers)) // count
            sizes = np.bincount(batch)
            values[group.index] = (means * len(numbers) / (len(sizes) * sizes))[batch]
        return Rows(table.assign(value=values))

    def check(self) -> None:
        """Raise `InputError` for rows that repeat a frame, and for a method of several versions."""
        rows = self._table
        identity = ["method", "condition", "version", "seed", "task", *FRAME, "region", "metric"]
        repeated = rows[rows.duplicated(identity)]
        if len(repeated):
            where = " ".join(str(repeated.iloc[0][column]) for column in identity)
            raise InputError("rows", where, "each frame measured once", "a row that repeats it")
        versions = rows.groupby("method")["version"].nunique()
        mixed = versions[versions > 1]
        if len(mixed):
            found = ", ".join(self.versions(str(mixed.index[0])))
            raise InputError("rows", f"version of {mixed.index[0]}", "one version of each method", found)

    def check_protocols(self, source: Path | str, expected: Mapping[str, str] | None = None) -> None:
        """Raise `InputError` if rows of one task have several protocols, or a protocol other than ``expected``.

        Numbers of different protocols are not comparable. ``expected`` holds the hash of each task's
        protocol.
        """
        for task in sorted(self.tasks):
            found = self.protocols(task)
            if len(found) > 1:
                wanted = "one protocol: values of different protocols are not comparable"
                remedy = "Use the rows of each protocol separately."
                raise InputError(source, f"protocol of {task}", wanted, ", ".join(found), remedy)
            if expected is not None and found != [expected.get(task)]:
                raise InputError(source, f"protocol of {task}", str(expected.get(task)), found[0])

    def _of(self, method: str | All) -> pd.DataFrame:
        return self.select(method=method, condition=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)


def _mapped(words: pd.Series[str], change: Callable[[str], str]) -> pd.Series[str]:
    """Apply ``change`` to every word, once for each distinct word."""
    return words.map({word: change(word) for word in words.unique()}).astype("str")

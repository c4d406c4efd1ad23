"""The leaderboard: bundles grouped by protocol, with one table per group."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from ...bench.audit.verify import equal_renders
from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.executors.settings import check_executor
from ...bench.io.files import entries, write_text
from ...bench.progress import counted
from ...bench.specs import CommandResult
from ..runs import RunSet
from ..table_report import table_of
from ..tables import RowGroup, Table
from ..writers import escape_markdown, render_page, to_markdown
from .settings import LeaderboardSettings
from .submissions import RANKED, STATES, Submission, placeless, qualified, read_submission, verified

HEADS = ("Bundle", "By", "State", "Methods", "Comment", "headbench", "Machine", "SHA-256")
RECOMPUTED = "recomputed"
"""Folder of repeated trainings, below that of the page."""


@dataclass(frozen=True)
class Board:
    """Submissions with the same protocols, and their table."""

    title: str
    table: Table
    submissions: tuple[Submission, ...]

    @property
    def equal(self) -> dict[str, tuple[str, ...]]:
        """Sentences on equal renders, each with the names of what has them, which begin with that of a bundle."""
        return equal_renders(
            {
                f"{each.file.name}: {label}": digests
                for each in self.submissions
                for label, digests in each.renders.items()
            }
        )

    @property
    def lines(self) -> list[tuple[str, ...]]:
        """Fields of the submissions, in the order of `HEADS`."""
        alike = {name.rpartition(": ")[0] for names in self.equal.values() for name in names}
        return [
            (
                each.file.name,
                each.bundle.by,
                each.state + (", equal renders" if each.file.name in alike else ""),
                ", ".join(each.run.methods),
                each.bundle.comment,
                each.bundle.headbench,
                str(each.manifest.machine.get("processor", "")),
                each.digest[:12],
            )
            for each in self.submissions
        ]

    @property
    def remarks(self) -> list[str]:
        """Sentences on equal renders, differences, and unverified values."""
        files: dict[str, list[str]] = {}
        for each in self.submissions:
            for remark in each.remarks:
                files.setdefault(remark, []).append(each.file.name)
        return [*self.equal, *(f"{', '.join(names)}: {remark}" for remark, names in files.items())]


def build(settings: LeaderboardSettings, progress: Progress = no_progress) -> CommandResult:
    """Write ``leaderboard.md`` and ``leaderboard.html``.

    Invalid bundles are in no table, and the page gives the reason. Raises `InputError` for a folder without
    valid bundles, and for unknown names of --recompute.
    """
    folder, out, execution = Path(settings.folder), Path(settings.out), settings.execution
    check_executor(execution, "cpu")
    files = entries(folder, "*.zip")
    if not files:
        raise InputError(folder, "", "bundles (*.zip) of `headbench bundle`", "none")
    for name in settings.recompute:
        if name not in [file.name for file in files]:
            raise InputError("command line", "--recompute", ", ".join(file.name for file in files), name)
    submissions: list[Submission] = []
    errors: list[InputError] = []
    refused: list[str] = []
    with tempfile.TemporaryDirectory(dir=out) as scratch:
        for number, file in enumerate(files):
            own = Path(scratch) / str(number)
            try:
                read = read_submission(file, own / "run")
            except InputError as error:
                errors.append(error)
                refused.append(f"{file.name}: {placeless(error, own / 'run')}")
                continue
            again = file.name in settings.recompute
            kept = out / RECOMPUTED
            submissions.append(verified(read, settings, own, kept, again, execution, progress))
            progress(number + 1, len(files), file.name)
        if not submissions:
            raise errors[0]
        boards = _boards(submissions)
        content = {"title": settings.title, "boards": boards, "heads": HEADS, "refused": refused}
        content["summary"] = _summary(submissions, boards)
        write_text(out / "leaderboard.md", _markdown(boards, settings.title, refused))
        write_text(out / "leaderboard.html", render_page("leaderboard.html", **content))
    text = f"{counted(len(files), 'bundle')}, {counted(len(boards), 'table')}: {out / 'leaderboard.md'}, {out / 'leaderboard.html'}"
    data = {
        "out": out,
        "tables": [asdict(board.table) for board in boards],
        "bundles": [
            {"file": each.file.name, "state": each.state, "remarks": each.remarks} for each in submissions
        ],
        "refused": refused,
    }
    return CommandResult(text, data)


def _summary(submissions: Sequence[Submission], boards: Sequence[Board]) -> str:
    """A sentence with the number of bundles and tables, and the support for their values."""
    states = [f"{n} {state.lower()}" for state, n in Counter(each.state for each in submissions).items()]
    bundles, tables = counted(len(submissions), "bundle"), counted(len(boards), "table")
    return f"{bundles} in {tables}, one for each set of frames: {', '.join(states)}."


def _boards(submissions: Sequence[Submission]) -> list[Board]:
    """A table for each set of protocols, those with the most submissions first."""
    groups: dict[tuple[tuple[str, str], ...], list[Submission]] = {}
    for submission in submissions:
        groups.setdefault(submission.measured, []).append(submission)
    boards = []
    for group in sorted(groups.values(), key=len, reverse=True):
        labels = qualified(group)
        runs = RunSet.of_runs(tuple(each.run for each in group), labels)
        apart = [
            RowGroup(
                title,
                frozenset(n for e, own in zip(group, labels) if e.state == state for n in own.values()),
                state in RANKED,
            )
            for state, title in STATES.items()
        ]
        claimed = {
            (label, metric.name)
            for each, own in zip(group, labels)
            for label in own.values()
            for metric in runs.metrics
            if metric.name not in each.supported
        }
        subjects = sorted({clip.subject for submission in group for clip in submission.manifest.clips})
        table = table_of(runs, apart=apart, claimed=claimed)
        boards.append(Board(f"Subjects {', '.join(subjects)}", table, tuple(group)))
    return boards


def _markdown(boards: Sequence[Board], title: str, refused: Sequence[str]) -> str:
    parts = [f"# {escape_markdown(title)}"]
    for board in boards:
        rows = [f"| {' | '.join(HEADS)} |", "|" + " --- |" * len(HEADS)]
        for submission, line in zip(board.submissions, board.lines):
            file, by, *others = map(escape_markdown, line)
            link = submission.bundle.link
            rows.append(f"| {' | '.join([file, f'[{by}]({link})' if link else by, *others])} |")
        parts += [f"## {escape_markdown(board.title)}", to_markdown(board.table).strip(), "\n".join(rows)]
        parts.append("\n".join(f"- {escape_markdown(remark)}" for remark in board.remarks))
    if refused:
        parts += ["## In no table", "\n".join(f"- {escape_markdown(text)}" for text in refused)]
    return "\n\n".join(parts) + "\n"

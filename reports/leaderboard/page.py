"""The leaderboard: bundles grouped by protocol, with one table per group."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from ...bench.audit.bundle import Bundle, read_bundle
from ...bench.contracts import Progress
from ...bench.engine.store import RunFolder
from ...bench.errors import InputError
from ...bench.io.files import digest_file, entries, write_text
from ...bench.manifest import Manifest
from ...bench.specs import CommandResult
from ..runs import RunSet
from ..table_report import table_of
from ..tables import Table
from ..writers import escape_markdown, render_page, to_markdown

HEADS = ("Bundle", "By", "Methods", "Comment", "headbench", "Machine", "Renders", "SHA-256")


@dataclass(frozen=True)
class Submission:
    """A bundle, unpacked, and the SHA-256 of its file."""

    file: Path
    bundle: Bundle
    folder: RunFolder
    manifest: Manifest
    digest: str

    @property
    def measured(self) -> tuple[tuple[str, str], ...]:
        """The protocol's hash of each task; results in one table have equal hashes."""
        return tuple(sorted((task, record.hash) for task, record in self.manifest.protocols.items()))

    @property
    def line(self) -> tuple[str, ...]:
        """Fields of the list of submissions, in the order of `HEADS`."""
        return (
            self.file.name,
            self.bundle.by,
            ", ".join(method.label for method in self.manifest.methods),
            self.bundle.comment,
            self.bundle.headbench,
            str(self.manifest.machine.get("processor", "")),
            "yes" if self.bundle.renders else "no",
            self.digest[:12],
        )


@dataclass(frozen=True)
class Board:
    """Submissions that measured the same, and their table."""

    title: str
    table: Table
    submissions: tuple[Submission, ...]


def build(folder: Path, out: Path, title: str, progress: Progress) -> CommandResult:
    """Write ``leaderboard.md`` and ``leaderboard.html``.

    Raises `InputError` for a folder without bundles, and for a bundle that is not as it lists itself.
    """
    files = entries(folder, "*.zip")
    if not files:
        raise InputError(folder, "", "bundles (*.zip) of `headbench bundle`", "none")
    with tempfile.TemporaryDirectory() as scratch:
        submissions = []
        for number, file in enumerate(files):
            submissions.append(_read(file, Path(scratch) / file.stem))
            progress(number + 1, len(files), file.name)
        boards = _boards(submissions)
    write_text(out / "leaderboard.md", _markdown(boards, title))
    page = render_page("leaderboard.html", title=title, boards=boards, heads=HEADS)
    write_text(out / "leaderboard.html", page)
    text = f"{len(files)} bundles, {len(boards)} tables: {out / 'leaderboard.md'}, {out / 'leaderboard.html'}"
    return CommandResult(text, {"out": out, "tables": [asdict(board.table) for board in boards]})


def _read(file: Path, into: Path) -> Submission:
    bundle, folder = read_bundle(file, into), RunFolder(into)
    manifest = folder.read_manifest()
    manifest.check_done(folder.manifest)
    return Submission(file, bundle, folder, manifest, digest_file(file))


def _boards(submissions: Sequence[Submission]) -> list[Board]:
    """A table for each set of protocols, those with most submissions first."""
    groups: dict[tuple[tuple[str, str], ...], list[Submission]] = {}
    for submission in submissions:
        groups.setdefault(submission.measured, []).append(submission)
    boards = []
    for group in sorted(groups.values(), key=len, reverse=True):
        runs = RunSet.read([submission.folder.root for submission in group])
        subjects = sorted({clip.subject for submission in group for clip in submission.manifest.clips})
        boards.append(Board(f"Subjects {', '.join(subjects)}", table_of(runs), tuple(group)))
    return boards


def _markdown(boards: Sequence[Board], title: str) -> str:
    parts = [f"# {escape_markdown(title)}"]
    for board in boards:
        rows = [f"| {' | '.join(HEADS)} |", "|" + " --- |" * len(HEADS)]
        for submission in board.submissions:
            file, by, *others = map(escape_markdown, submission.line)
            link = submission.bundle.link
            rows.append(f"| {' | '.join([file, f'[{by}]({link})' if link else by, *others])} |")
        parts += [f"## {escape_markdown(board.title)}", to_markdown(board.table).strip(), "\n".join(rows)]
    return "\n\n".join(parts) + "\n"

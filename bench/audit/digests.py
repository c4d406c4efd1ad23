"""Digests of the files that a cell left, taken when they were measured."""

from __future__ import annotations

from pathlib import Path

from ..contracts import Avatar
from ..files import digest_file
from ..stages import Job

STAGE = "digests"


def record_digests(job: Job, avatar: Avatar) -> None:
    """Record the SHA-256 of every scored frame and of the avatar's files.

    What was recorded before stays, so that a run started again does not make a frame that was changed since into one
    that was measured.
    """
    state = job.cell.stage(STAGE) or {}
    known = dict(state.get("files", {})) if state.get("fingerprint") == job.fit_fingerprint else {}
    paths = [*frame_paths(job), *map(Path, avatar.files())]
    root = job.cell.folder
    for path in paths:
        name = path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
        if name not in known and path.is_file():
            known[name] = digest_file(path)
    job.cell.finish(STAGE, job.fit_fingerprint, files=dict(sorted(known.items())))


def frame_paths(job: Job) -> list[Path]:
    """Where the scored frames of a cell lie."""
    return [
        job.cell.render(task, key)
        for task, protocol in job.protocols.items()
        for key in protocol.keys
        if key.subject == job.clip.subject
    ]

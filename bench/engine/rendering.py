"""Renders of a cell's avatar."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Mapping, Sequence

from ..contracts import Avatar, Camera, Frame, FrameKey, HeadPose, ListedFrames, Progress
from ..errors import InputError
from ..io.files import digest
from ..io.images import quantise, write_png
from ..protocol import Protocol
from .config import resolve_change
from .guard import check_frame
from .job import DIGESTS, RENDERING, Job, avatar_record, warn_of_damage

RECORD_EVERY_S = 10.0
"""Seconds between records of rendered frames; after a kill, frames since the last record are rendered again."""


def render(job: Job, avatar: Avatar) -> None:
    """Render every frame of every protocol to 8-bit PNG of the protocol's size.

    Frames of this avatar are kept if they match their recorded digests. Damaged frames are rendered again,
    with a warning, as are frames without a record after an interruption.
    """
    cell, form = job.cell, job.form
    made_of = digest(job.fit_fingerprint, avatar_record(job))
    state = cell.step(DIGESTS)
    known = {} if state is None or state["fingerprint"] != made_of else dict(state.get("files", {}))
    wanted = {cell.name(path): frame for path, frame in job.frame_paths.items()}
    damaged = cell.damage({name: known[name] for name in wanted if name in known})
    if damaged:
        warn_of_damage(job, damaged, "rendered again")
        known = {name: known[name] for name in known.keys() - damaged.keys()}
    missing = {name: frame for name, frame in wanted.items() if name not in known}
    if not missing and cell.is_done(DIGESTS, made_of):
        return
    recorded = time.monotonic()
    with job.progress(RENDERING) as report:
        for index, (name, frame) in enumerate(_drawn(job, avatar, missing, report)):
            protocol, key = missing[name]
            camera = form.clip.cameras[form.key(key).camera]
            check_frame(frame, (camera.height, camera.width), job.name, key)
            written = write_png(cell.folder / name, quantise(form.restore(key, frame.rgb)))
            known[name] = hashlib.sha256(written).hexdigest()
            if time.monotonic() - recorded > RECORD_EVERY_S:
                cell.begin(DIGESTS, made_of, files=known)
                recorded = time.monotonic()
            report(index + 1, len(missing), protocol.task)
        lacking = missing.keys() - known.keys()
        if lacking:
            first = missing[min(lacking)][1]
            raise InputError(job.name, str(first), "a render", f"none of it and {len(lacking) - 1} more")
        cell.finish(DIGESTS, made_of, files=dict(sorted(known.items())))


def _drawn(
    job: Job, avatar: Avatar, missing: Mapping[str, tuple[Protocol, FrameKey]], report: Progress
) -> Iterator[tuple[str, Frame]]:
    """Path and frame of each render; for avatars that render lists, a whole task at a time."""
    clip, change = job.form.clip, resolve_change(job.condition.views, "views")
    views: dict[str, dict[FrameKey, tuple[str, tuple[Camera, HeadPose], Sequence[float]]]] = {}
    for name, (protocol, key) in missing.items():
        seen = job.form.key(key)
        view = clip.cameras[seen.camera], clip.poses[seen.timestep]
        if job.condition.views:
            camera, pose = change(avatar, clip, seen, protocol.background)
            yield name, avatar.render(camera, pose, protocol.background)
        elif isinstance(avatar, ListedFrames):
            views.setdefault(protocol.task, {})[seen] = (name, view, protocol.background)
        else:
            yield name, avatar.render(*view, protocol.background)
    before = 0
    for task, listed in views.items():
        assert isinstance(avatar, ListedFrames)
        background = next(iter(listed.values()))[2]
        asked = {key: view for key, (_, view, _) in listed.items()}

        def drawing(done: int, total: int, note: str = "", task: str = task, before: int = before) -> None:
            report(before, len(missing), f"{task}, {done} of {total} drawn {note}")  # none read back yet

        for key, frame in avatar.render_listed(asked, background, drawing):
            yield listed[key][0], frame
        before += len(listed)

"""Named evaluation protocols of papers and benchmarks, as data: one file each in `protocols`.

A run scores all frames of its captures, with every requested definition and region. A named protocol selects some of these
rows; nothing is rendered again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, cast

from .configuration import build_folder, build_named
from .contracts import Clip, TaskName
from .errors import InputError

FOLDER = Path(__file__).with_name("protocols")


@dataclass(frozen=True)
class TaskFrames:
    """The frames of a task that a protocol scores.

    Attributes
    ----------
    cameras : Literal['all', 'seen', 'unseen']
        All cameras, or those with or without training frames in the capture.
    sequences : tuple[str, ...]
        Prefixes of sequence names, such as "FREE"; () selects all held-out sequences.
    last : int | None
        Only this many timesteps at the end of each sequence.
    """

    cameras: Literal["all", "seen", "unseen"] = "all"
    sequences: tuple[str, ...] = ()
    last: int | None = None

    def __post_init__(self) -> None:
        """Refuse a number of timesteps below 1."""
        if self.last is not None and self.last < 1:
            raise ValueError(f"last: at least 1, or null for all; found {self.last}")


@dataclass(frozen=True)
class NamedProtocol:
    """The evaluation protocol of a paper or benchmark.

    ``tasks``, ``region``, ``profile``, ``average`` and ``pooled`` select and combine values; the other fields describe how the
    published values were obtained, and tables list how a run differs.

    Attributes
    ----------
    title, source : str
        Paper or benchmark, and where its protocol was read.
    tasks : Mapping[str, TaskFrames]
        Scored frames by task: novel_view, self_reenactment.
    region : str
        Pixels for PSNR and SSIM: "full", "foreground", "face" or another region of the captures.
    profile : str
        Metric profile, see ``headbench list profiles``.
    average : Literal['sequences', 'frames']
        Whether every sequence of a subject has the same weight, or every frame.
    pooled : int | None
        Number of frames per value, with one mean squared error for PSNR; None for single frames.
    subjects, training, test : str
        Subjects, and the training and held-out sequences.
    size : str
        WIDTHxHEIGHT of the images, "" if it varies.
    iterations : int | None
        Training iterations of the paper's own method.
    tracker, head_model : str
        Tracker and head model of the driving signal.
    test_refit : bool | None
        Whether scored frames are fitted to their own pictures first, as under the condition test-refit; None if unknown.
    """

    title: str
    source: str
    tasks: Mapping[str, TaskFrames]
    region: str = "full"
    profile: str = "canonical"
    average: Literal["sequences", "frames"] = "frames"
    pooled: int | None = None
    subjects: str = ""
    training: str = ""
    test: str = ""
    size: str = ""
    iterations: int | None = None
    tracker: str = ""
    head_model: str = ""
    test_refit: bool | None = None

    def __post_init__(self) -> None:
        """Refuse unknown tasks, none, and batches of less than one frame."""
        for task in self.tasks:
            if task not in ("novel_view", "self_reenactment"):
                raise ValueError(f"tasks: novel_view or self_reenactment; found {task}")
        if not self.tasks:
            raise ValueError("tasks: at least one; found none")
        if self.pooled is not None and self.pooled < 1:
            raise ValueError(f"pooled: at least 1, or null; found {self.pooled}")


@cache
def named_protocols() -> dict[str, NamedProtocol]:
    """All protocols by name."""
    return build_folder(NamedProtocol, FOLDER)


@cache
def protocol_named(name: str) -> NamedProtocol:
    """Look up a protocol. Raises `InputError` for an unknown one."""
    return build_named(NamedProtocol, FOLDER, name, "--protocol")


def needed(names: Sequence[str], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a run that measures everything protocols select: their tasks, profiles and regions besides the usual ones.

    Given ``settings`` take precedence. Raises `InputError` for one that excludes what a protocol needs, and for
    an unknown protocol.
    """
    wanted: dict[str, list[str]] = {"tasks": [], "metric_profiles": ["canonical"], "regions": []}
    for name in names:
        protocol = protocol_named(name)
        wanted["tasks"] += protocol.tasks
        wanted["metric_profiles"].append(protocol.profile)
        wanted["regions"] += [] if protocol.region == "full" else ["face", protocol.region]
    found: dict[str, Any] = {}
    for key, values in wanted.items():
        given = settings.get(key)
        if given is None:
            found |= {key: tuple(dict.fromkeys(values))} if values else {}
        elif lacking := {*values} - {*given} - {"canonical", "face"}:
            expected = f"{', '.join(sorted(lacking))}, by protocol {' or '.join(names)}"
            raise InputError("settings", key, expected, ", ".join(given))
    return found


def check_capture(names: Sequence[str], clip: Clip) -> None:
    """Raise `InputError` if a capture has no frames of a task of a protocol, or none of its cameras or sequences."""
    for name, (task, wanted) in ((n, each) for n in names for each in protocol_named(n).tasks.items()):
        keys = clip.splits.get(cast(TaskName, task), ())
        trained = {key.camera for key in clip.splits["train"]}
        seen = {key.camera in trained for key in keys}
        sequences = sorted({key.sequence for key in keys})
        place = f"clip {clip.subject}"
        if not keys:
            raise InputError(place, f"splits.{task}", f"at least one frame, by protocol {name}", "none")
        if wanted.cameras != "all" and (wanted.cameras == "seen") not in seen:
            expected = f"{wanted.cameras} cameras in {task}, by protocol {name}"
            raise InputError(place, "cameras", expected, ", ".join(sorted({key.camera for key in keys})))
        if wanted.sequences and not any(each.startswith(wanted.sequences) for each in sequences):
            expected = f"{' or '.join(wanted.sequences)} in {task}, by protocol {name}"
            raise InputError(place, "sequences", expected, ", ".join(sequences))

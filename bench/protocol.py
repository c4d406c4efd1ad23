"""The protocol of a comparison: the frames and how they are rendered and scored. It has an id and a hash.

The task selects the protocol, never the method. Every row has its hash; rows with different hashes are never
compared.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import numpy as np

from .configuration import build_folder, build_named
from .contracts import Clip, FrameKey, TaskName
from .errors import InputError
from .io.files import digest

FOLDER = Path(__file__).with_name("protocols")


@dataclass(frozen=True)
class TaskFrames:
    """The frames of a task that a protocol scores."""

    cameras: Literal["all", "seen", "unseen"] = "all"
    """All cameras, or those with or without training frames in the capture."""
    sequences: tuple[str, ...] = ()
    """Prefixes of sequence names, such as "FREE"; () selects all held-out sequences."""
    last: int | None = None
    """Only this many timesteps at the end of each sequence."""
    share: float | None = None
    """Share of all frames that a capture holds out for the task, to within one frame."""

    def __post_init__(self) -> None:
        """Refuse a number of timesteps below 1, and a share that is not between 0 and 1."""
        if self.last is not None and self.last < 1:
            raise ValueError(f"last: at least 1, or null for all; found {self.last}")
        if self.share is not None and not 0 < self.share < 1:
            raise ValueError(f"share: between 0 and 1, or null; found {self.share}")

    def check_share(self, held_out: int, trained: int, place: str, name: str) -> None:
        """Raise `InputError` if a capture holds out another share of its frames than protocol ``name``."""
        if self.share is None or abs(held_out - (wanted := self.share * (held_out + trained))) < 1:
            return
        expected = f"{round(wanted)} of {held_out + trained} frames held out, by protocol {name}"
        remedy = f"For a video: --set reader_settings.held_out_frames={round(wanted)}"
        raise InputError(place, "splits", expected, str(held_out), remedy)


@dataclass(frozen=True)
class NamedProtocol:
    """The evaluation protocol of a paper or benchmark.

    ``tasks``, ``region``, ``profile``, ``metrics``, ``average`` and ``pooled`` select and combine values; the other fields describe
    how the published values were obtained, and tables list how a run differs.
    """

    title: str
    source: str
    """``title``, ``source``: Paper or benchmark, and where its protocol was read."""
    tasks: Mapping[str, TaskFrames]
    """Scored frames by task: novel_view, self_reenactment; or cross_reenactment, whose frames have no ground truth."""
    region: str = "full"
    """Pixels for PSNR and SSIM: "full", "foreground", "face" or another region of the captures."""
    profile: str = "canonical"
    """Metric profile, see ``headbench list profiles``."""
    metrics: tuple[str, ...] = ()
    """Metrics of images; () for PSNR, SSIM and LPIPS of the profile. In cross_reenactment they compare with the driving frame."""
    source_metrics: tuple[str, ...] = ()
    """Metrics that compare with the source picture, in cross_reenactment."""
    average: Literal["sequences", "frames"] = "frames"
    """Whether every sequence of a subject has the same weight, or every frame."""
    pooled: int | None = None
    """Number of frames per value, with one mean squared error for PSNR; None for single frames."""
    subjects: str = ""
    training: str = ""
    test: str = ""
    """``subjects``, ``training``, ``test``: Subjects, and the training and held-out sequences."""
    size: str = ""
    """WIDTHxHEIGHT of the images, "" if it varies."""
    iterations: int | None = None
    """Training iterations of the paper's own method."""
    tracker: str = ""
    head_model: str = ""
    """``tracker``, ``head_model``: Tracker and head model of the driving signal."""
    test_refit: bool | None = None
    """Whether scored frames are fitted to their own pictures first, as under the condition test-refit; None if unknown."""
    pictures: tuple[int, ...] = ()
    """Numbers of input pictures of methods that learn from other people; () for methods that train on a capture."""
    pairs: str = ""
    crop: str = ""
    background: str = ""
    """``pairs``, ``crop``, ``background``: Source and driver, crop of both images, and colour behind the person."""
    grade: Literal["", "A", "B", "C"] = ""
    """How it was read, as for published tables; "" for protocols that predate the grades."""
    unknown: tuple[str, ...] = ()
    """What the sources do not state, or state differently."""

    def __post_init__(self) -> None:
        """Refuse unknown tasks, none, metrics that need a missing ground truth, and batches of less than one frame."""
        for task in self.tasks:
            if task not in TASKS:
                raise ValueError(f"tasks: {', '.join(TASKS[:-1])} or {TASKS[-1]}; found {task}")
        if not self.tasks:
            raise ValueError("tasks: at least one; found none")
        self.check_metrics(self.compared)
        if self.pooled is not None and self.pooled < 1:
            raise ValueError(f"pooled: at least 1, or null; found {self.pooled}")

    @property
    def compared(self) -> tuple[str, ...]:
        """Names of the metrics that compare with the true frame or, in cross_reenactment, the driving frame."""
        suffix = "" if self.profile == "canonical" else f"@{self.profile}"
        return self.metrics or tuple(f"{name}{suffix}" for name in ("psnr", "ssim", "lpips"))

    def check_metrics(self, names: Iterable[str]) -> None:
        """Raise `ValueError` for metrics of pixels, if frames have no ground truth."""
        for name in names:
            if "cross_reenactment" in self.tasks and name.partition("-")[0] not in WITHOUT_TRUTH:
                expected = " or ".join(each.upper() for each in WITHOUT_TRUTH)
                raise ValueError(
                    f"metrics: {expected}, as frames of another person have no ground truth; found {name}"
                )


TASKS = ("novel_view", "self_reenactment", "cross_reenactment")
WITHOUT_TRUTH = ("csim", "aed", "apd", "akd")
"""Metrics of frames without ground truth, by the first part of their names."""


@cache
def named_protocols() -> dict[str, NamedProtocol]:
    """All protocols by name."""
    return build_folder(NamedProtocol, FOLDER)


@cache
def protocol_named(name: str) -> NamedProtocol:
    """Look up a protocol."""
    return build_named(NamedProtocol, FOLDER, name, "--protocol")


def needed(names: Sequence[str], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a run that measures everything protocols select: their tasks, profiles and regions besides the usual ones.

    Given ``settings`` take precedence.
    """
    wanted: dict[str, list[str]] = {"tasks": [], "metric_profiles": ["canonical"], "regions": []}
    for name in names:
        protocol = protocol_named(name)
        check_trained(name, protocol, "command line")
        wanted["tasks"] += protocol.tasks
        wanted["metric_profiles"].append(protocol.profile)
        wanted["regions"] += [] if protocol.region == "full" else ["face", protocol.region]
    values_needed: dict[str, Any] = {}
    for key, values in wanted.items():
        given = settings.get(key)
        if given is None:
            values_needed |= {key: tuple(dict.fromkeys(values))} if values else {}
        elif lacking := {*values} - {*given} - {"canonical", "face"}:
            expected = f"{', '.join(sorted(lacking))}, by protocol {' or '.join(names)}"
            raise InputError("settings", key, expected, ", ".join(given))
    return values_needed


def check_trained(name: str, protocol: NamedProtocol, place: str | Path) -> None:
    """Raise `InputError` for a protocol of methods that do not train on a capture, which no run follows."""
    if protocol.pictures:
        expected = "a protocol of methods that train on a capture"
        noun = "picture" if protocol.pictures == (1,) else "pictures"
        found = f"{name}, whose methods are given {' or '.join(map(str, protocol.pictures))} {noun}"
        remedy = f"Score their images with `headbench evaluate RENDERS --truth TRUTH --protocol {name}`."
        raise InputError(place, "--protocol", expected, found, remedy)


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
        wanted.check_share(len(keys), len(clip.splits["train"]), place, name)


Item = TypeVar("Item")

SEEN_CAMERAS, UNSEEN_CAMERAS = "self_reenactment_seen", "self_reenactment_unseen"
"""Parts of self-reenactment in tables and tests: frames at training cameras, and at held-out cameras."""

TASK_TITLES: Mapping[str, str] = {
    "novel_view": "Novel view",
    "self_reenactment": "Self-reenactment",
    SEEN_CAMERAS: "Self-reenactment at seen cameras",
    UNSEEN_CAMERAS: "Self-reenactment at unseen cameras",
    "cross_reenactment": "Cross-reenactment",
    "extremes": "Extremes",
}

TaskWithoutTruth = Literal["cross_reenactment", "extremes"]
"""Tasks without recorded ground truth, which measure the stability of an avatar and the preservation of its appearance. For
extremes of synthetic captures, the ground truth is rendered."""


@dataclass(frozen=True)
class Protocol:
    """Definition of a measurement. Everything that affects values is a field and thus part of the hash."""

    task: TaskName | TaskWithoutTruth
    """The split whose frames are scored, or a task without ground truth."""
    keys: tuple[FrameKey, ...]
    """The scored frames, sorted. Every method renders exactly these."""
    excluded: tuple[tuple[FrameKey, str], ...]
    """Frames that are left out, with the reason."""
    clips: tuple[tuple[str, str], ...]
    """Fingerprint of each subject's clip (images, cameras and driving signal)."""
    resolution: str
    """Image sizes of the truth at which metrics are computed, WIDTHxHEIGHT."""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Colour on which renders and ground truth are composited."""
    quantisation: str = "round-to-8-bit"
    """Conversion of float renders to 8-bit frames."""
    metric_profile: str = "canonical"
    """The named set of metric definitions."""
    conditions: tuple[tuple[str, str], ...] = ()
    """Further conditions that affect the numbers, by name: for tasks without ground truth, what is rendered and the
    limits."""

    @property
    def id(self) -> str:
        """Readable name."""
        return f"{self.task}/{self.metric_profile}/1"

    @cached_property
    def hash(self) -> str:
        """First 12 hex digits of the digest of all fields, cached because every row uses it."""
        fields = asdict(self)
        if not self.conditions:
            del fields["conditions"]  # so that older protocols without conditions keep their hashes
        return digest(self.id, fields)[:12]


def make_protocol(task: TaskName, clips: Sequence[Clip], max_frames: int | None = None) -> Protocol:
    """Make the protocol of ``task`` over some clips.

    Parameters
    ----------
    max_frames : int | None
        Maximum number of scored frames of each clip, evenly spaced over the sorted keys; None means
        all.
    """
    keys: list[FrameKey] = []
    sizes: set[tuple[int, int]] = set()
    excluded: list[tuple[FrameKey, str]] = []
    for clip in clips:
        frames = sorted(clip.splits.get(task, ()))
        if not frames:
            raise InputError(f"clip {clip.subject}", f"splits.{task}", "at least one frame", "none")
        leaked = set(frames) & set(clip.splits["train"])
        if leaked:
            raise InputError(
                f"clip {clip.subject}",
                f"splits.{task}",
                "no frame of the training split",
                f"{len(leaked)} shared, the first {min(leaked)}",
            )
        chosen = evenly(frames, max_frames)
        keys += chosen
        sizes |= {(camera.width, camera.height) for camera in {clip.cameras[key.camera] for key in chosen}}
        excluded += sorted(clip.excluded.items())
    return Protocol(
        task=task,
        keys=tuple(keys),
        excluded=tuple(excluded),
        clips=tuple(sorted((clip.subject, clip.fingerprint) for clip in clips)),
        resolution=_resolution(sizes),
        background=_background(clips),
    )


def make_protocols(
    tasks: Sequence[TaskName], clips: Sequence[Clip], max_frames: int | None
) -> dict[str, Protocol]:
    """The protocol of each possible task, see `make_protocol`.

    A task without frames in any clip is left out if another task has frames: monocular videos have no novel
    view.
    """
    done = [task for task in tasks if any(clip.splits.get(task) for clip in clips)] or tasks
    return {task: make_protocol(task, clips, max_frames) for task in done}


def run_protocols(
    tasks: Sequence[TaskName], clips: Sequence[Clip], max_frames: int | None
) -> dict[str, Protocol]:
    """As `make_protocols`; none if no clip holds out frames, as training data of hidden tests do not."""
    held_out = (keys for clip in clips for split, keys in clip.splits.items() if split != "train")
    return make_protocols(tasks, clips, max_frames) if any(held_out) else {}


def joined_protocol(protocols: Sequence[Protocol]) -> Protocol:
    """Join the protocols of one task: the protocol of one run that scored all of their clips.

    A subject in two of them must have the same frames and capture in both.
    """
    first = protocols[0]
    for protocol in protocols:
        if _without_clips(protocol) != _without_clips(first):
            expected = f"the same task, size, background, quantisation and metric profile as {first.hash}"
            raise InputError("protocols", first.task, expected, protocol.hash)
    return replace(
        first,
        keys=tuple(sorted({key for protocol in protocols for key in protocol.keys})),
        excluded=tuple(sorted({each for protocol in protocols for each in protocol.excluded})),
        clips=tuple(sorted({clip for protocol in protocols for clip in protocol.clips})),
    )


def _without_clips(protocol: Protocol) -> Protocol:
    return replace(protocol, keys=(), excluded=(), clips=())


def missing_tasks(tasks: Sequence[str], done: Container[str]) -> dict[str, str]:
    """Reasons why requested tasks are not measured, by task, for tables and the run's log."""
    reasons = {"novel_view": "the captures hold out no camera, as videos of one camera cannot"}
    return {
        task: f"{TASK_TITLES.get(task, task)} is missing: {reasons.get(task, 'the captures hold out no frames for it')}."
        for task in tasks
        if task not in done
    }


def protocol_name(task: str, needs: Any = None) -> str:
    """Name of a protocol in a run: the task, with a digest of the methods' needs if there are any.

    Parameters
    ----------
    needs : MethodNeeds, optional
        For tasks whose frames depend on the needs of the methods.
    """
    return task if needs is None or needs == type(needs)() else f"{task}@{digest(asdict(needs))[:12]}"


def make_protocol_without_truth(
    task: TaskWithoutTruth,
    clips: Sequence[Clip],
    keys: Iterable[FrameKey],
    sizes: Iterable[tuple[int, int]],
    conditions: Mapping[str, str],
) -> Protocol:
    """Make the protocol of a task without ground truth: frames of ``sizes`` (width, height), rendered as conditions describe."""
    return Protocol(
        task=task,
        keys=tuple(sorted(set(keys))),
        excluded=(),
        clips=tuple(sorted({(clip.subject, clip.fingerprint) for clip in clips})),
        resolution=_resolution(set(sizes)),
        background=_background(clips),
        conditions=tuple(sorted(conditions.items())),
    )


def _resolution(sizes: Iterable[tuple[int, int]]) -> str:
    return ", ".join(f"{width}x{height}" for width, height in sorted(sizes))


def _background(clips: Sequence[Clip]) -> tuple[float, float, float]:
    backgrounds = {tuple(float(v) for v in clip.background) for clip in clips}
    if len(backgrounds) != 1:
        raise InputError("clips", "background", "one colour for all clips", f"{sorted(backgrounds)}")
    red, green, blue = backgrounds.pop()
    return red, green, blue


def evenly(frames: Sequence[Item], count: int | None) -> list[Item]:
    """At most ``count`` items, from the middles of equal intervals; None: all."""
    if count is None or count >= len(frames):
        return list(frames)
    return [frames[(2 * i + 1) * len(frames) // (2 * count)] for i in range(count)]


def evenly_with_ends(items: Sequence[Item], most: int) -> list[Item]:
    """Evenly spaced items, up to a maximum number, including the first and the last if there are two or more."""
    return [
        items[place] for place in np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)
    ]

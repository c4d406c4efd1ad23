"""Selects the frames of a page, the first one shown among them, and encodes them: WebP in data URIs, with a maximum total size."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from itertools import groupby, product, zip_longest
from threading import Lock
from typing import NamedTuple

import cv2

from ...bench.contracts import ByteArray, Clip, FrameKey, Progress
from ...bench.engine.captures import open_run_clips
from ...bench.engine.config import RunOptions
from ...bench.errors import HeadbenchError, InputError
from ...bench.io.images import encode_image
from ...bench.specs import MetricSpec
from ..runs import RunSet

WORST = 5
"""Timesteps of each method and task whose frames are always shown."""
LOSSLESS, LOSSY = 101, 90
"""Qualities of OpenCV's WebP encoder; above 100 it keeps every pixel."""
BATCH = 32
"""Number of frames encoded at a time before their bytes are counted."""


class ShownFrame(NamedTuple):
    """A frame of a task."""

    task: str
    key: FrameKey

    @property
    def group(self) -> tuple[str, ...]:
        """Task, subject, sequence and camera."""
        return self.task, self.key.subject, self.key.sequence, self.key.camera


@dataclass
class Pictures:
    """Images of frames: for each frame the ground truth, then each method, as a base64 WebP or a reason."""

    shown: dict[ShownFrame, list[str | None]] = field(default_factory=dict)
    reasons: dict[ShownFrame, list[str]] = field(default_factory=dict)
    lossless: set[ShownFrame] = field(default_factory=set)
    first_cameras_lossless: bool = True
    truth: str = ""  # the reason why the ground truth is missing, or ""
    bytes: int = 0


def frame_values(runs: RunSet, metrics: Sequence[MetricSpec]) -> dict[tuple[str, str, ShownFrame], float]:
    """Values of the displayed whole images, by metric, label and frame."""
    return {
        (spec.name, label, ShownFrame(task, key)): value
        for task in runs.tasks
        for key in runs.keys[task]
        for label, (run, name) in runs.pictured.items()
        for spec in metrics
        if (value := run.value(spec.name, name, task, key)) is not None
    }


def worst_frames(
    values: Mapping[tuple[str, str, ShownFrame], float], runs: RunSet, spec: MetricSpec, count: int = WORST
) -> list[ShownFrame]:
    """The worst frames by a metric of each task and method, one per timestep.

    Trivial baselines are skipped unless there are no other methods.
    """
    worst: dict[ShownFrame, None] = {}
    sign = 1 if spec.higher_is_better else -1
    for place in product((spec.name,), runs.ranked or runs.methods, runs.tasks):
        scores = [(sign * v, f) for (m, n, f), v in values.items() if (m, n, f.task) == place]
        moments: dict[tuple[str, str, int], ShownFrame] = {}
        for _, frame in sorted(scores):
            moments.setdefault(frame.key[:3], frame)
        worst.update(dict.fromkeys([*moments.values()][:count]))
    return [*worst]


def spread(frames: Sequence[ShownFrame]) -> Iterator[ShownFrame]:
    """Frames in the order in which they are added: tasks, subjects, sequences and cameras in turn, evenly over time and
    finer with every round."""
    ordered = sorted(frames, key=lambda f: (f.group, f.key.timestep))
    groups = [_refined([*members]) for _, members in groupby(ordered, key=lambda f: f.group)]
    return (frame for turn in zip_longest(*groups) for frame in turn if frame is not None)


def _refined(items: Sequence[ShownFrame]) -> list[ShownFrame]:
    """First and last, then the middle of the longest gaps, level by level."""
    order = dict.fromkeys([0, len(items) - 1])
    parts = 2
    while len(order) < len(items):
        order.update(dict.fromkeys(round(i * (len(items) - 1) / parts) for i in range(parts + 1)))
        parts *= 2
    return [items[index] for index in order]


def without_folders(text: str) -> str:
    """One line with absolute paths shortened to their last part, since pages are shared."""
    return re.sub(r"(?<![\w./])(?:/[^\s/:,'\"]+)+/([^\s/:,'\"]+)", r"\1", " ".join(text.split()))


def open_truth(runs: RunSet, options: RunOptions) -> tuple[dict[str, Clip], str]:
    """The captures, by subject, of the first run whose captures can be opened, or the reason if there is none."""
    reasons = []
    for run in runs.runs:
        if run.clips is not None:
            return dict(run.clips), ""
        try:
            return {c.subject: c for c in open_run_clips(run.folder.root, options, used=())[1]}, ""
        except (HeadbenchError, OSError) as error:
            reasons.append(without_folders(str(error)))
    return {}, reasons[0]


def encode(image: ByteArray, quality: int) -> str:
    """An (H, W, 3) image as the base64 of a WebP."""
    data = encode_image(image, ".webp", (cv2.IMWRITE_WEBP_QUALITY, quality), place="report")
    return base64.b64encode(data).decode("ascii")


def choose_pictures(
    runs: RunSet, worst: Sequence[ShownFrame], budget: int, options: RunOptions, progress: Progress
) -> Pictures:
    """Encode the worst frames, which have to fit in ``budget`` bytes of base64, then others as long as they fit."""
    clips, why = open_truth(runs, options)
    pictures = Pictures(truth=why)
    source = _Source(runs, clips, why)
    every = [ShownFrame(task, key) for task in runs.tasks for key in runs.keys[task]]
    first_cameras = {task: min((k.camera for k in runs.keys[task]), default="") for task in runs.tasks}
    rest = [frame for frame in spread(every) if frame not in set(worst)]
    done = 0

    with ThreadPoolExecutor() as pool:

        def add(frames: Sequence[ShownFrame], qualities: Sequence[int], limit: int) -> bool:
            nonlocal done
            for start in range(0, len(frames), BATCH):
                batch, of_batch = frames[start : start + BATCH], qualities[start : start + BATCH]
                read = pool.map(source.read, batch, of_batch)
                for frame, quality, (images, reasons) in zip(batch, of_batch, read):
                    size = sum(len(image) + 3 for image in images if image is not None)
                    if pictures.bytes + size > limit:
                        return False
                    pictures.shown[frame], pictures.reasons[frame] = images, reasons
                    pictures.bytes += size
                    if quality == LOSSLESS:
                        pictures.lossless.add(frame)
                done += len(batch)
                progress(done, len(every), "pictures")
            return True

        if not add(worst, [LOSSLESS] * len(worst), budget // 2):
            pictures = Pictures(truth=why, first_cameras_lossless=False)
            done = 0
            if not add(worst, [LOSSY] * len(worst), budget):
                fit = f"{len(pictures.shown)} of {len(worst)} fit"
                raise InputError("command line", "--max-mb", f"room for the {len(worst)} worst frames", fit)
        elif worst:
            others = sum(frame.key.camera == first_cameras[frame.task] for frame in rest)
            pictures.first_cameras_lossless = pictures.bytes * (1 + others / len(worst)) <= budget / 2
        exact = {f for f in rest if pictures.first_cameras_lossless and f.key.camera == first_cameras[f.task]}
        add(rest, [LOSSLESS if frame in exact else LOSSY for frame in rest], budget)
    progress(len(every), len(every), "pictures")
    return pictures


@dataclass
class _Source:
    """Reads and encodes a frame's images; thread-safe."""

    runs: RunSet
    clips: Mapping[str, Clip]
    why: str
    lock: Lock = field(default_factory=Lock)

    def __post_init__(self) -> None:
        self.reason = cache(self._reason)

    def read(self, frame: ShownFrame, quality: int) -> tuple[list[str | None], list[str]]:
        truth, reason = self._truth(frame.key)
        images: list[ByteArray | None] = [truth]
        reasons = [reason]
        for label in self.runs.methods:
            image, reason = self._render(label, frame)
            if image is not None and truth is not None and image.shape != truth.shape:
                size = " x ".join(map(str, image.shape[1::-1]))
                image, reason = None, f"of another size than the ground truth ({size})"
            images.append(image)
            reasons.append(reason)
        return [None if image is None else encode(image, quality) for image in images], reasons

    def _truth(self, key: FrameKey) -> tuple[ByteArray | None, str]:
        if key.subject not in self.clips:
            return None, self.why or "no capture of this subject"
        try:
            with self.lock:  # a clip caches decoded frames and is not thread-safe
                return self.clips[key.subject].image(key), ""
        except (HeadbenchError, OSError) as error:
            return None, without_folders(str(error))

    def _render(self, label: str, frame: ShownFrame) -> tuple[ByteArray | None, str]:
        run, name = self.runs.pictured[label]
        try:
            image = run.render(name, frame.task, frame.key)
        except HeadbenchError as error:
            return None, without_folders(str(error))
        if image is not None:
            return image, ""
        with self.lock:
            return None, self.reason(label, frame.task, frame.key.subject)

    def _reason(self, label: str, task: str, subject: str) -> str:
        run, name = self.runs.pictured[label]
        return " ".join(run.reason(name, task, FrameKey(subject, "", 0, "")).split())


TILES = 3
"""Number of methods next to the ground truth, so that four images fill a window."""


@dataclass(frozen=True)
class Opening:
    """Labels of the methods shown, best first, and the frame."""

    methods: tuple[str, ...]
    frame: ShownFrame | None


def opening(
    runs: RunSet,
    best: Sequence[str],
    metrics: Sequence[MetricSpec],
    values: Mapping[tuple[str, str, ShownFrame], float],
    pictures: Pictures,
) -> Opening:
    """Choose from the images of a page.

    ``best`` are the ranked methods, best first. The frame is that of the first task, with images of all displayed methods, in
    which values of the first metric differ most; if there is none, the first frame with any image.
    """
    place = {label: index + 1 for index, label in enumerate(runs.methods)}
    drawn = {label for label, i in place.items() if any(images[i] for images in pictures.shown.values())}
    offered = [label for label in (*best, *runs.ranked, *runs.methods) if label in drawn]
    chosen = tuple(dict.fromkeys(offered))[:TILES] or (*best, *runs.methods)[:TILES]
    spreads: dict[ShownFrame, float] = {}
    for frame, images in sorted(pictures.shown.items()):
        scores = [values.get((metrics[0].name, label, frame)) for label in chosen] if metrics else []
        present = [value for value in scores if value is not None]
        complete = all(images[index] is not None for index in (0, *(place[label] for label in chosen)))
        if complete and present and len(present) == len(chosen) and frame.task == runs.tasks[0]:
            spreads[frame] = max(present) - min(present)
    if spreads:
        return Opening(chosen, max(spreads, key=lambda frame: spreads[frame]))
    first = (f for f in sorted(pictures.shown) if any(image is not None for image in pictures.shown[f]))
    return Opening(chosen, next(first, None))

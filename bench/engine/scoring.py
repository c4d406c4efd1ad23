"""Scores frames against the ground truth. Each frame is read once, by one thread pool, with bounded memory."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..contracts import ByteArray, Clip, Frame, FrameKey, HeadAsset, Progress, RegionalClip, no_progress
from ..errors import HeadbenchError, InputError, LeftOutError, UnavailableError
from ..io.files import check_name
from ..machine import processor_count
from ..registry import resolve
from ..rows import FULL, LEFT_OUT
from ..specs import MetricSpec

HEAD = tuple(name for name in vars(HeadAsset) if not name.startswith("_"))
SHARED = ("shape", "static_offset", "background", "cameras", "poses")
"""Attributes of a clip that all methods share."""
FACE = "face"
"""The region that is evaluated by default, and by metrics of kind "face"."""
SLACK = 1e-3
"""How far colours and coverage may exceed [0, 1]: rounding in float32, below a quarter of an 8-bit step."""


class TrainingView:
    """A read-only `Clip` with images and masks of training frames only.

    Cameras and driving signals of held-out frames stay visible: they do not reveal the ground truth images.
    """

    def __init__(self, clip: Clip):
        freeze(clip)
        allowed = frozenset(clip.splits["train"])
        self.subject, self.head, self.shape = clip.subject, clip.head, clip.shape
        self.static_offset, self.background = clip.static_offset, clip.background
        self.cameras, self.poses = MappingProxyType(clip.cameras), MappingProxyType(clip.poses)
        self.splits, self.excluded = MappingProxyType(clip.splits), MappingProxyType(clip.excluded)
        self.steps, self.fingerprint = tuple(clip.steps), clip.fingerprint

        def image(key: FrameKey) -> ByteArray:
            """(H, W, 3) 8-bit sRGB of a training frame."""
            return _copied(clip.image(_checked(key)))

        def mask(key: FrameKey) -> ByteArray | None:
            """(H, W) 8-bit coverage of a training frame."""
            found = clip.mask(_checked(key))
            return None if found is None else _copied(found)

        def _checked(key: FrameKey) -> FrameKey:
            if key not in allowed:
                raise HeadbenchError(f"the method read {key}, which is not a training frame")
            return key

        self.image, self.mask = image, mask


def _copied(image: ByteArray) -> ByteArray:
    """A copy that cannot be made writable; the reader may reuse the original array in the next call."""
    return np.frombuffer(image.tobytes(), image.dtype).reshape(image.shape)


def freeze(clip: Clip) -> None:
    """Make the arrays of a clip read-only, in place: those of its head model, cameras, poses, shape and background."""
    for array in _arrays(clip):
        array.flags.writeable = False


def check_frame(frame: Frame, size: tuple[int, int], name: str, key: FrameKey) -> None:
    """Raise `InputError` unless a frame has (height, width) ``size`` and finite values in [0, 1]."""
    for part, shape in (("rgb", (*size, 3)), ("alpha", size)):
        values = np.asarray(getattr(frame, part))
        if values.shape != shape:
            raise InputError(name, f"{part} of {key}", f"shape {shape}", f"{values.shape}")
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
        if not (low >= -SLACK and high <= 1 + SLACK):  # written so that NaN is refused, too
            raise InputError(
                name, f"{part} of {key}", "finite values from 0 to 1", f"values from {low:g} to {high:g}"
            )


def _arrays(clip: Clip) -> Iterator[np.ndarray[Any, Any]]:
    """The arrays that all methods share, in an order that depends on the clip alone."""
    for name in HEAD:
        yield from _within(getattr(clip.head, name, None))
    for name in SHARED:
        yield from _within(getattr(clip, name))


def _within(value: Any) -> Iterator[np.ndarray[Any, Any]]:
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, Mapping):
        for _, each in sorted(value.items()):
            yield from _within(each)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _within(getattr(value, field.name))


_AHEAD = 8
"""Frames decoded ahead of a metric that processes them in order."""


class Score(NamedTuple):
    """One metric of one frame over one region, or the reason why it is "missing" (value NaN)."""

    metric: str
    key: FrameKey
    region: str
    value: float
    status: str = "ok"
    reason: str = ""


class TruthImages(Protocol):
    """Images of a `Clip`, or others; it may be a `RegionalClip`."""

    def image(self, key: FrameKey) -> ByteArray:
        """(H, W, 3) 8-bit sRGB."""


class ScoredFrames(NamedTuple):
    """Source of the frames to score."""

    render: Callable[[FrameKey], ByteArray]
    """Reads a stored frame, (H, W, 3) 8-bit."""
    clip: TruthImages
    """Provides the ground truth, and the requested regions."""

    def pair(self, key: FrameKey) -> tuple[ByteArray, ByteArray]:
        """A stored frame and its ground truth."""
        return self.render(key), self.clip.image(key)


def make_metric(spec: MetricSpec, device: str = "cpu") -> Any:
    """Import the object that a spec names; a class is instantiated without arguments.

    Uses a CUDA device if it is available and the metric supports it; results from another machine are
    evaluated on the CPU.
    """
    implementation = resolve(spec.implementation)
    metric = implementation() if isinstance(implementation, type) else implementation
    usable = device.startswith("cuda") and hasattr(metric, "on") and resolve("torch:cuda").is_available()
    return metric.on(device) if usable else metric


def check_regions(clip: Clip, wanted: Sequence[str] | None) -> tuple[str, ...]:
    """Names of the regions to evaluate besides the whole frame; None requests the face if the clip has it."""
    known = tuple(clip.region_names) if isinstance(clip, RegionalClip) else ()
    if wanted is None:
        return (FACE,) if FACE in known else ()
    names = tuple(name for name in dict.fromkeys(wanted) if name != FULL)
    for name in names:
        if name not in known:
            expected = f"one of {', '.join((FULL, *known))}, which clip {clip.subject} knows"
            raise InputError("regions", name, expected, "no such region")
        check_name(name, f"clip {clip.subject}", "region")
    return names


def score_frames(
    keys: Sequence[FrameKey],
    frames: ScoredFrames,
    specs: Sequence[MetricSpec],
    regions: Sequence[str] = (),
    progress: Progress = no_progress,
    device: str = "cpu",
) -> dict[str, list[Score]]:
    """Score frames by per-frame metrics; return each metric's scores, in the order of ``keys``.

    Parameters
    ----------
    regions : Sequence[str]
        Regions besides the whole frame, for metrics that support them. A frame in which a region has
        no pixels has no score there. Regions come from the ground truth, so that such scores are
        missing for every method alike.
    device : str
        Device of the run; see `make_metric`.
    """
    scored: dict[str, list[Score]] = {}
    metrics = {spec.name: make_metric(spec, device) for spec in specs}
    at_once = [
        spec for spec in specs if spec.kind not in STREAMS and not hasattr(metrics[spec.name], "batched")
    ]
    rest = [spec for spec in specs if spec not in at_once]
    total, done = (bool(at_once) + len(rest)) * len(keys), 0
    with ThreadPoolExecutor(processor_count()) as pool:
        if at_once:
            scorer = partial(_score_frame, frames, [(spec, metrics[spec.name]) for spec in at_once], regions)
            scored.update({spec.name: [] for spec in at_once})
            for scores in pool.map(scorer, keys):
                for score in scores:
                    scored[score.metric].append(score)
                done += 1
                progress(done, total, "frames")
        for spec in rest:
            stream = STREAMS.get(spec.kind, _batched)
            scored[spec.name] = []
            for score in stream(keys, frames, spec, metrics[spec.name], pool):
                scored[spec.name].append(score)
                done += 1
                progress(done, total, spec.label)
    for scores in scored.values():
        for score in scores:
            if score.status == "ok" and not math.isfinite(score.value):
                found = f"{score.metric} of {score.key} is {score.value}"
                raise HeadbenchError(f"{found}; a metric must be finite")
    return scored


def _score_frame(
    frames: ScoredFrames, metrics: Sequence[tuple[MetricSpec, Any]], regions: Sequence[str], key: FrameKey
) -> list[Score]:
    """All metrics of single frames, so that each frame is decoded once."""
    image, truth = frames.render(key), frames.clip.image(key)
    masks: Mapping[str, Any] = {}
    if regions and any(spec.kind == "regional" for spec, _ in metrics):
        assert isinstance(frames.clip, RegionalClip)
        masks = frames.clip.region_masks(key, regions)
    scores = []
    for spec, metric in metrics:
        try:
            scores.append(Score(spec.name, key, FULL, float(metric(image, truth))))
            if spec.kind == "regional" and masks:
                values = metric.in_regions(image, truth, masks)
                scores += [Score(spec.name, key, name, float(value)) for name, value in values.items()]
        except LeftOutError as error:
            scores.append(_missing(spec, key, f"{LEFT_OUT}{error}"))
        except UnavailableError as error:
            scores.append(_missing(spec, key, error.note))
    return scores


def _batched(
    keys: Sequence[FrameKey], frames: ScoredFrames, spec: MetricSpec, metric: Any, pool: ThreadPoolExecutor
) -> Iterator[Score]:
    """Scores of a metric that processes many frames in one pass, in order."""

    try:
        values = metric.batched(_ahead(pool, frames.pair, keys))
        for key, value in zip(keys, values, strict=True):
            yield Score(spec.name, key, FULL, float(value))
    except UnavailableError as error:
        yield from (_missing(spec, key, error.note) for key in keys)


def _faces(
    keys: Sequence[FrameKey], frames: ScoredFrames, spec: MetricSpec, metric: Any, pool: ThreadPoolExecutor
) -> Iterator[Score]:
    """Scores of a metric of the visible face, which the clip locates."""
    clip = frames.clip
    if not isinstance(clip, RegionalClip) or FACE not in clip.region_names:
        yield from (_missing(spec, key, "The reader does not locate the face.") for key in keys)
        return

    def read(key: FrameKey) -> tuple[Any, ...]:
        return frames.render(key), frames.clip.image(key), clip.region_masks(key, [FACE])[FACE]

    for key, images in zip(keys, _ahead(pool, read, keys), strict=True):
        try:
            yield Score(spec.name, key, FULL, float(metric(*images)))
        except LeftOutError as error:
            yield _missing(spec, key, f"{LEFT_OUT}{error}")
        except UnavailableError as error:
            yield _missing(spec, key, error.note)


def _temporal(
    keys: Sequence[FrameKey], frames: ScoredFrames, spec: MetricSpec, metric: Any, pool: ThreadPoolExecutor
) -> Iterator[Score]:
    """Scores of a metric that compares the change between a frame and the preceding one.

    The first frame after a gap uses the following one, so that every frame has a value.
    """
    present = set(keys)

    def score(key: FrameKey) -> Score:
        beside = (key._replace(timestep=key.timestep + step) for step in (-1, 1))
        neighbour = next((other for other in beside if other in present), None)
        if neighbour is None:
            return _missing(
                spec, key, f"{spec.label} needs neighbouring timesteps; here frames are left out."
            )
        images = [frames.render(key), frames.clip.image(key)]
        images += [frames.render(neighbour), frames.clip.image(neighbour)]
        try:
            return Score(spec.name, key, FULL, float(metric(*images)))
        except UnavailableError as error:
            return _missing(spec, key, error.note)

    yield from _ahead(pool, score, keys)


def _sequences(
    keys: Sequence[FrameKey], frames: ScoredFrames, spec: MetricSpec, metric: Any, pool: ThreadPoolExecutor
) -> Iterator[Score]:
    """Scores of a metric that compares whole sequences of one camera; each frame gets the value of its sequence."""
    values: dict[tuple[str, str, str], float | str] = {}
    for key in keys:
        place = key.subject, key.sequence, key.camera
        if place not in values:
            sequence = sorted(
                other for other in keys if (other.subject, other.sequence, other.camera) == place
            )
            images, truths = (
                list(_ahead(pool, frames.render, sequence)),
                list(_ahead(pool, frames.clip.image, sequence)),
            )
            try:
                values[place] = float(metric(images, truths))
            except UnavailableError as error:
                values[place] = error.note
        value = values[place]
        yield _missing(spec, key, value) if isinstance(value, str) else Score(spec.name, key, FULL, value)


def _set(
    keys: Sequence[FrameKey], frames: ScoredFrames, spec: MetricSpec, metric: Any, pool: ThreadPoolExecutor
) -> Iterator[Score]:
    """Scores of a metric of all frames together; each frame gets its value."""
    try:
        value = float(metric(_ahead(pool, frames.pair, keys)))
        yield from (Score(spec.name, key, FULL, value) for key in keys)
    except UnavailableError as error:
        yield from (_missing(spec, key, error.note) for key in keys)


STREAMS = {"face": _faces, "temporal": _temporal, "sequence": _sequences, "set": _set}
"""Scoring functions of metrics that need more than an image and its ground truth, by kind."""


def compared_over_time(metric: Any, kind: str) -> Callable[[ByteArray, ByteArray], float]:
    """Wrap a frame metric of any kind for single images, with an error-free neighbour, a static sequence, a face that fills
    the frame, or a set with the mirrored images."""
    if kind == "face":
        return lambda image, truth: metric(image, truth, np.ones(truth.shape[:2], np.bool_))
    if kind == "temporal":
        return lambda image, truth: metric(image, truth, np.roll(truth, 1, axis=1), np.roll(truth, 1, axis=1))
    if kind == "sequence":
        return lambda image, truth: metric([image], [truth])
    if kind == "set":
        return lambda image, truth: metric([(image, truth), (image[:, ::-1], truth[:, ::-1])])
    return metric  # type: ignore[no-any-return]


def _ahead(
    pool: ThreadPoolExecutor, function: Callable[[FrameKey], Any], keys: Iterable[FrameKey]
) -> Iterator[Any]:
    """Results of ``function`` in order, computed by the pool a bounded number of frames ahead."""
    waiting: deque[Future[Any]] = deque()
    for key in keys:
        waiting.append(pool.submit(function, key))
        if len(waiting) > _AHEAD:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def _missing(spec: MetricSpec, key: FrameKey, reason: str) -> Score:
    return Score(spec.name, key, FULL, math.nan, "missing", reason)

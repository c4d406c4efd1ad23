"""Clips with training frames held out, and with fewer training cameras or timesteps: registered changes of clips."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..condition import part_of_text
from ..contracts import (
    BoolArray,
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    FrameKey,
    HeadAsset,
    HeadPose,
    RegionalClip,
    StepRecord,
    TaskName,
)
from ..engine.captures import open_clips, synthesis_arguments
from ..engine.config import RunConfig
from ..errors import HeadbenchError, InputError
from ..io.files import digest
from ..progress import progress
from ..protocol import evenly


def tracking_error(steps: Sequence[Mapping[str, Any]]) -> float | None:
    """Tracking error level of a synthetic capture, from the steps of its clip; None for a recording."""
    settings = steps[0].get("parameters", {}).get("synthetic") if steps else None
    return float(settings.get("tracking_error", 0.0)) if settings else None


def with_tracking_error(clip: Clip, config: RunConfig, *, level: float) -> Clip:
    """The clip of a capture with the same images and another level of tracking error, which is made in ``config.out``."""
    steps = [asdict(step) for step in clip.steps]
    if tracking_error(steps) is None:
        expected = "a synthetic capture, to track with other errors"
        raise InputError(config.data, "--over", expected, "a recording")
    data = Path(config.data)
    pictures = (
        data if (data / "synthesis.json").is_file() else data.parent
    )  # folder of one subject, or of all
    capture = Path(config.out) / f"capture-tracking-{level:g}"
    arguments = {**synthesis_arguments(steps, clip.subject), "tracking_error": level}
    from ...datasets.synthetic.capture import synthesize  # imports torch

    with progress(f"tracking with error {level:g}") as report:
        synthesize(capture, **arguments, pictures=pictures, progress=report)
    place = capture if pictures == data else capture / data.name
    return next(c for c in open_clips(replace(config, data=str(place))) if c.subject == clip.subject)


CAMERA: TaskName = "novel_view"
TIMESTEPS: TaskName = "self_reenactment"


@dataclass(frozen=True, eq=False)
class HeldOutClip:
    """A `Clip` whose splits are parts of another clip's training split; other frames cannot be read.

    "novel_view" has the frames of the held-out camera, "self_reenactment" those of the held-out timesteps in all
    training cameras.
    """

    source: Clip
    subject: str
    head: HeadAsset
    shape: FloatArray
    static_offset: FloatArray
    cameras: Mapping[str, Camera]
    poses: Mapping[int, HeadPose]
    splits: Mapping[str, tuple[FrameKey, ...]]
    excluded: Mapping[FrameKey, str]
    background: FloatArray
    steps: Sequence[StepRecord]
    fingerprint: str

    def image(self, key: FrameKey) -> ByteArray:
        """(H, W, 3) 8-bit sRGB."""
        return self.source.image(self._checked(key))

    def mask(self, key: FrameKey) -> ByteArray | None:
        """(H, W) 8-bit coverage or None."""
        return self.source.mask(self._checked(key))

    @property
    def region_names(self) -> Sequence[str]:
        """Regions of the source; none if it has none."""
        return self.source.region_names if isinstance(self.source, RegionalClip) else ()

    def region_masks(self, key: FrameKey, names: Sequence[str]) -> Mapping[str, BoolArray]:
        """(H, W) masks of the regions."""
        assert isinstance(self.source, RegionalClip)
        return self.source.region_masks(self._checked(key), names)

    @cached_property
    def _readable(self) -> frozenset[FrameKey]:
        return frozenset(key for keys in self.splits.values() for key in keys)

    def _checked(self, key: FrameKey) -> FrameKey:
        if key not in self._readable:
            raise HeadbenchError(f"{key} was to be read, which is no training frame of the capture")
        return key


def hold_out(
    clip: Clip, config: RunConfig | None = None, *, camera: str = "", every: int = 8, test: bool = False
) -> HeldOutClip:
    """Hold out a camera and every n-th timestep of a clip's training split, so that no test frame is used.

    Parameters
    ----------
    camera : str
        Name of the camera; "" selects the training camera nearest to the mean position, or none if
        there is only one.
    every : int
        The middle one of each group of ``every`` consecutive training timesteps is held out.
    test : bool
        Hold out nothing, and score the capture's own test frames.
    """
    if test:
        training = _training(clip.splits["train"])
        step = StepRecord("hold_out", {"camera": "", "timesteps": [], "training": training}, clip.fingerprint)
        fingerprint = digest(clip.fingerprint, "hold_out", "test")
        return replace(_as_held_out(clip), steps=(*clip.steps, step), fingerprint=fingerprint)
    train = clip.splits["train"]
    where = f"clip {clip.subject}"
    if every < 2:
        raise InputError(where, "every", "a whole number from 2", str(every))
    cameras = sorted({key.camera for key in train})
    if camera and camera not in cameras:
        raise InputError(where, "camera", f"a training camera: {', '.join(cameras)}", repr(camera))
    if not camera and len(cameras) > 1:
        centers = np.array([clip.cameras[name].center for name in cameras])
        camera = cameras[int(np.linalg.norm(centers - centers.mean(0), axis=1).argmin())]
    timesteps = sorted({key.timestep for key in train})
    held = timesteps[min(every, len(timesteps)) // 2 :: every] if len(timesteps) > 1 else []
    splits: dict[str, list[FrameKey]] = {"train": [], CAMERA: [], TIMESTEPS: []}
    for key in train:
        name = TIMESTEPS if key.timestep in held else CAMERA if key.camera == camera else "train"
        splits[name].append(key)
    if not splits["train"] or not splits[CAMERA] + splits[TIMESTEPS]:
        found = f"{len(cameras)} cameras and {len(timesteps)} timesteps"
        expected = "frames to train with and others to hold out"
        raise InputError(where, "splits.train", expected, found)
    parameters = {"camera": camera, "timesteps": held, "training": _training(splits["train"])}
    step = StepRecord("hold_out", parameters, clip.fingerprint)
    return replace(
        _as_held_out(clip),
        splits={name: tuple(keys) for name, keys in splits.items() if keys},
        steps=(*clip.steps, step),
        fingerprint=digest(clip.fingerprint, "hold_out", camera, held),
    )


def _training(keys: Iterable[FrameKey]) -> dict[str, list[Any]]:
    """Cameras and timesteps of frames."""
    names = ("cameras", "timesteps")
    return {name: sorted({getattr(key, name.removesuffix("s")) for key in keys}) for name in names}


def fewer_cameras(clip: Clip, config: RunConfig | None = None, *, part: str) -> Clip:
    """A clip with a fraction of its training cameras, at least one.

    The first is the camera nearest to the mean position, each further one that farthest from those already selected (Gonzalez,
    "Clustering to minimize the maximum intercluster distance", 1985), so that smaller selections are subsets of larger ones.
    """
    names = _spread(clip.cameras, sorted({key.camera for key in clip.splits["train"]}))
    return _reduced(clip, "cameras", names[: count_of(len(names), part)])


def fewer_timesteps(clip: Clip, config: RunConfig | None = None, *, part: str) -> Clip:
    """A clip with a fraction of its training timesteps, at least one, evenly spaced."""
    timesteps = sorted({key.timestep for key in clip.splits["train"]})
    return _reduced(clip, "timesteps", evenly(timesteps, count_of(len(timesteps), part)))


def fewer_pictures(clip: Clip, config: RunConfig | None = None, *, count: int) -> Clip:
    """A clip with a number of its training frames: timesteps evenly spaced, cameras in turn, ordered as in `fewer_cameras`."""
    train = clip.splits["train"]
    if not isinstance(count, int) or count < 1:
        raise InputError("conditions", "count", "a whole number from 1", repr(count))
    cameras = _spread(clip.cameras, sorted({key.camera for key in train}))
    left: dict[int, list[FrameKey]] = {timestep: [] for timestep in sorted({key.timestep for key in train})}
    for key in train:
        left[key.timestep].append(key)
    chosen: list[FrameKey] = []
    while len(chosen) < min(count, len(train)):
        # One frame of each timestep before a second frame of any timestep.
        open_ones = [timestep for timestep, keys in left.items() if keys]
        for timestep in evenly(open_ones, min(count - len(chosen), len(open_ones))):
            wanted = cameras[len(chosen) % len(cameras) :] + cameras[: len(chosen) % len(cameras)]
            key = min(left[timestep], key=lambda key: wanted.index(key.camera))
            left[timestep].remove(key)
            chosen.append(key)
    named = {"pictures": sorted(map(str, chosen)), "cameras": sorted({key.camera for key in chosen})}
    return _with_frames(
        clip,
        sorted(chosen, key=train.index),
        {**named, "timesteps": sorted({key.timestep for key in chosen})},
    )


def count_of(whole: int, part: str) -> int:
    """Number of items in a fraction of a total, at least one."""
    try:
        return max(1, round(whole * part_of_text(part, "part")))
    except ValueError as error:
        raise InputError("conditions", "part", "a part above 0 and at most 1", str(error)) from error


def _reduced(clip: Clip, what: str, chosen: Sequence[Any]) -> Clip:
    """A clip with the training frames of some cameras or timesteps; held-out frames are unchanged."""
    train = clip.splits["train"]
    keys = [key for key in train if getattr(key, what.removesuffix("s")) in chosen]
    return _with_frames(clip, keys, {what: list(chosen)})


def _with_frames(clip: Clip, keys: Sequence[FrameKey], chosen: dict[str, list[Any]]) -> Clip:
    """A clip with only these training frames; ``chosen`` is the record, whose first entry identifies them."""
    if len(keys) == len(clip.splits["train"]):
        return clip
    step = StepRecord("reduce_training", {**chosen, "count": len(keys)}, clip.fingerprint)
    what, names = next(iter(chosen.items()))
    return replace(
        clip if isinstance(clip, HeldOutClip) else _as_held_out(clip),
        splits={**clip.splits, "train": tuple(keys)},
        steps=(*clip.steps, step),
        fingerprint=digest(clip.fingerprint, what, names),
    )


def _as_held_out(clip: Clip) -> HeldOutClip:
    """A clip that allows reading only the frames of its splits."""
    values = {f.name: getattr(clip, f.name) for f in fields(HeldOutClip) if f.name != "source"}
    return HeldOutClip(source=clip, **values)


def _spread(cameras: Mapping[str, Camera], names: Sequence[str]) -> list[str]:
    """Names of cameras in farthest-point order."""
    centers = np.array([cameras[name].center for name in names])
    order = [int(np.linalg.norm(centers - centers.mean(0), axis=1).argmin())]
    distances = np.full(len(names), np.inf)
    while len(order) < len(names):
        distances = np.minimum(distances, np.linalg.norm(centers - centers[order[-1]], axis=1))
        distances[order] = -1.0
        order.append(int(distances.argmax()))
    return [names[index] for index in order]

"""Scores images or videos against others with the same names, without a capture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from statistics import fmean
from threading import Lock
from typing import Literal, NamedTuple

import numpy as np
from PIL import Image

from ..contracts import BoolArray, ByteArray, FrameKey, Progress
from ..engine.config import default_names
from ..engine.scoring import FACE, Score, ScoredFrames, score_frames
from ..errors import ExitCode, InputError
from ..io.files import check_writable, entries, natural_order, write_text
from ..io.images import UPRIGHT, orientation_of, probe_image, read_pixels, read_png
from ..io.videos import SUFFIXES, video_frames
from ..machine import processor_count
from ..progress import counted, some
from ..protocol import NamedProtocol, protocol_named
from ..registry import get
from ..rows import FULL, batch_means
from ..specs import CommandResult, MetricSpec
from ..terminal import table
from .frames import csv_text

Resize = Literal["area", "bicubic"]
FILTERS = {"area": Image.Resampling.BOX, "bicubic": Image.Resampling.BICUBIC}
"""Pillow's filters; where they reduce an image, they take all of its pixels (antialiasing)."""
IMAGES = (".png", ".jpg", ".jpeg")
MASK = "mask"
"""Region of the pixels inside the masks."""
SOLID = 128
"""Least level of a mask's pixels that are inside."""
MOST_ROWS = 30
"""Number of sequences above which the table shows their means only."""
NAMED = 3
"""Number of names that an error shows."""


class Pair(NamedTuple):
    """A render and its ground truth: two images, or two frames of videos."""

    key: FrameKey
    """Sequence (the video, or the folder that the image is in) and place in it."""
    name: str
    render: Path
    truth: Path
    mask: Path | None
    frame: int | None
    """Number of the frame in the videos; None for images."""
    size: tuple[int, int]
    """(width, height) of the ground truth."""


class Extent(NamedTuple):
    """Size of an image or a video."""

    width: int
    height: int
    frames: int | None
    """None for an image."""

    def __str__(self) -> str:
        return f"{self.width}x{self.height} pixels" + (
            "" if self.frames is None else f", {counted(self.frames, 'frame')}"
        )


def find_pairs(
    renders: Path, truth: Path, masks: Path | None, resize: Resize | None, progress: Progress
) -> list[Pair]:
    """Pair files by their names, and check their sizes. Raises `InputError` for names without a partner."""
    folders = [renders, truth, *([] if masks is None else [masks])]
    found = [_files(folder, renders.stem) for folder in folders]
    for folder, files in zip(folders, found):
        for other, theirs in list(zip(folders, found))[:2]:
            if missing := [name for name in theirs if name not in files]:
                expected = f"a file for each of the {len(theirs)} in {other}, of the same name without suffix"
                raise InputError(folder, "", expected, f"none for {some(missing, NAMED)}")
    pairs: list[Pair] = []
    places: Counter[str] = Counter()
    for number, name in enumerate(found[0], 1):
        paths = [files[name] for files in found]
        extent = _check_extents(paths, resize)
        sequence = name if extent.frames is not None else name.rpartition("/")[0]
        for frame in range(extent.frames or 1):
            key = FrameKey("", sequence, places[sequence], "")
            places[sequence] += 1
            mask = paths[2] if masks is not None else None
            if extent.frames is None:
                pairs.append(Pair(key, name, paths[0], paths[1], mask, None, extent[:2]))
            else:
                pairs.append(Pair(key, f"{name}/{frame:05d}", paths[0], paths[1], mask, frame, extent[:2]))
        progress(number, len(found[0]), "checking sizes")
    return sorted(pairs, key=lambda pair: pair.key)


def _files(root: Path, name: str) -> dict[str, Path]:
    """Images and videos of a folder by relative name without suffix, in the order of the numbers in it; of a file, itself by ``name``."""
    if root.is_file():
        return {name: root}
    if not root.is_dir():
        raise InputError(root, "", "a folder of images or videos, or a video", "no such file or folder")
    files: dict[str, Path] = {}
    for path in entries(root, "**/*"):
        place = path.relative_to(root)
        hidden = any(part.startswith(".") for part in place.parts)
        if hidden or path.suffix.lower() not in (*IMAGES, *SUFFIXES) or not path.is_file():
            continue
        known = files.setdefault(place.with_suffix("").as_posix(), path)
        if known != path:
            raise InputError(path, "", "one file of this name", f"also {known.name}")
    if not files:
        suffixes = ", ".join((*IMAGES, *SUFFIXES))
        raise InputError(root, "", f"a folder with images or videos ({suffixes})", "none")
    return dict(sorted(files.items(), key=lambda item: natural_order(item[0])))


def _check_extents(paths: Sequence[Path], resize: Resize | None) -> Extent:
    """Size of the ground truth, the second path. Raises `InputError` unless the others fit it."""
    render, truth, *masks = (_extent(path) for path in paths)
    for path, found in zip(paths[2:], masks):
        if found != truth:
            raise InputError(path, "size", f"{truth}, as {paths[1]}", str(found))
    if render.frames != truth.frames:
        raise InputError(paths[0], "frames", f"{truth}, as {paths[1]}", str(render))
    if render != truth and resize is None:
        remedy = "Render at the size of the ground truth, or choose how to resize with --resize."
        raise InputError(paths[0], "size", f"{truth}, as {paths[1]}", str(render), remedy)
    if abs(render.width * truth.height - render.height * truth.width) > max(*render[:2], *truth[:2]):
        remedy = "Crop or pad the renders first."
        raise InputError(paths[0], "size", f"the ratio of {truth}, as {paths[1]}", str(render), remedy)
    return truth


def _extent(path: Path) -> Extent:
    if path.suffix.lower() in SUFFIXES:
        sizes = [frame.image.shape for frame in video_frames(path)]
        return Extent(sizes[0][1], sizes[0][0], len(sizes))
    info = probe_image(path)
    if info.has_alpha and read_pixels(path)[..., 3].min() < 255:
        remedy = "Composite it on the background of the other image."
        raise InputError(path, "alpha", "an opaque image", "transparent pixels", remedy)
    if info.format == "JPEG" and (orientation := orientation_of(path)) not in (0, UPRIGHT):
        remedy = "Save it upright, without the tag, which is not applied."
        raise InputError(path, "EXIF", "pixels stored upright", f"orientation {orientation}", remedy)
    return Extent(info.width, info.height, None)


class _Video:
    """Frames of a video by number. Those decoded last are kept for several threads that read in about the same order."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, Lock()
        self._frames = video_frames(path)
        self._kept: dict[int, ByteArray] = {}
        self._most = 2 * processor_count() + 16

    def frame(self, number: int) -> ByteArray:
        """(H, W, 3) RGB."""
        with self._lock:
            if self._kept and number < min(self._kept):
                self._frames = video_frames(self._path)
                self._kept.clear()
            while number not in self._kept:
                frame = next(self._frames)
                self._kept[frame.number] = frame.image
                self._kept.pop(frame.number - self._most, None)
            return self._kept[number]


def _highest_level(path: Path) -> int:
    """Highest level of a video."""
    return max(int(frame.image.max()) for frame in video_frames(path))


OPEN = 6
"""Number of videos that are open at a time."""


class PairedImages:
    """Renders, ground truth and regions of pairs by their keys, as `score_frames` reads them."""

    def __init__(self, pairs: Sequence[Pair], resize: Resize | None) -> None:
        self._pairs = {pair.key: pair for pair in pairs}
        self._resize = resize
        self._video = lru_cache(OPEN)(_Video)
        self._highest_level = lru_cache(_highest_level)
        self.region_names = (MASK, FACE) if pairs[0].mask is not None else ()

    def render(self, key: FrameKey) -> ByteArray:
        """(H, W, 3) 8-bit sRGB of the ground truth's size."""
        pair = self._pairs[key]
        image = self._read(pair.render, pair.frame)
        if self._resize is None or image.shape[1::-1] == pair.size:
            return image
        return np.asarray(Image.fromarray(image).resize(pair.size, FILTERS[self._resize]))

    def image(self, key: FrameKey) -> ByteArray:
        """(H, W, 3) 8-bit sRGB of the ground truth."""
        pair = self._pairs[key]
        return self._read(pair.truth, pair.frame)

    def region_masks(self, key: FrameKey, names: Sequence[str]) -> Mapping[str, BoolArray]:
        """The (H, W) mask of a pair, for any region."""
        pair = self._pairs[key]
        assert pair.mask is not None
        levels = self._read(pair.mask, pair.frame).max(axis=2)
        highest = int(levels.max())
        if 0 < highest < SOLID and pair.frame is not None:
            highest = self._highest_level(pair.mask)  # an empty frame of a lossy video is not quite black
        if 0 < highest < SOLID:
            expected = f"a mask with levels of {SOLID} to 255 inside"
            raise InputError(pair.mask, "", expected, f"levels up to {highest}")
        return dict.fromkeys(names, levels >= SOLID)

    def _read(self, path: Path, frame: int | None) -> ByteArray:
        return read_png(path) if frame is None else self._video(path).frame(frame)


def pair_metrics(names: Sequence[str], *, masks: bool) -> list[MetricSpec]:
    """Metrics by name, also ``NAME@PROFILE``; by default those of frames that a run measures."""
    specs: list[MetricSpec] = []
    default = [name for name in default_names("metrics") if get("metrics", name).per_frame]
    for name in dict.fromkeys(names or default):
        profile = name.partition("@")[2]
        of_profile = [m for m in get("profiles", profile).metrics if m.name == name] if profile else []
        spec = of_profile[0] if of_profile else get("metrics", name)
        if not spec.per_frame:
            expected = "metrics of images"
            remedy = "An avatar is measured with --avatar, or in a run."
            raise InputError("command line", "--metrics", expected, f"{name}, of kind {spec.kind}", remedy)
        if spec.kind == "face" and not masks:
            expected = "metrics of whole images"
            found = f"{name}, which needs to know the visible face"
            remedy = "Give its pixels with --masks FOLDER, or score against a capture."
            raise InputError("command line", "--metrics", expected, found, remedy)
        specs.append(spec)
    return specs


@dataclass(frozen=True)
class _Column:
    """Scores of a metric in a region, by key."""

    spec: MetricSpec
    region: str
    scores: Mapping[FrameKey, Score]

    @property
    def name(self) -> str:
        return self.spec.name if self.region == FULL else f"{self.spec.name}/{self.region}"

    @property
    def head(self) -> str:
        region = "" if self.region == FULL else f" {self.region}"
        unit = f" ({self.spec.unit})" if self.spec.unit else ""
        return f"{self.spec.label}{region}{unit} {'↑' if self.spec.higher_is_better else '↓'}"

    def values(self, pairs: Sequence[Pair]) -> list[float]:
        """Values of the pairs that have one."""
        scores = (self.scores.get(pair.key) for pair in pairs)
        return [score.value for score in scores if score is not None and score.status == "ok"]

    def mean(self, pairs: Sequence[Pair], *, whole: bool) -> float | None:
        """Mean of a sequence; a metric of all frames together has none, unless it is the ``whole``."""
        return None if self.spec.kind == "set" and not whole else _mean(self.values(pairs))

    def pooled_mean(self, pairs: Sequence[Pair], pooled: int | None) -> float | None:
        """Mean of all pairs; of a metric in dB over batches of ``pooled`` pairs, each with the mean of its errors."""
        values = self.values(pairs)
        if pooled is None or self.spec.unit != "dB":
            return _mean(values)
        return float(batch_means(np.array(values), pooled, decibels=True).mean()) if values else None

    def shown(self, value: float | None) -> str:
        return "–" if value is None else f"{value:.{self.spec.digits}f}"

    def missing(self, pairs: Sequence[Pair]) -> Counter[str]:
        """Numbers of values that are missing, by reason."""
        reasons = Counter(score.reason for score in self.scores.values() if score.status != "ok")
        if empty := sum(pair.key not in self.scores for pair in pairs):
            reasons[f"no pixels in the {self.region}"] = empty
        return reasons


def score_pairs(
    renders: Path,
    truth: Path,
    masks: Path | None,
    metrics: Sequence[str],
    protocols: Sequence[str],
    resize: Resize | None,
    out: Path | None,
    device: str,
    progress: Progress,
) -> CommandResult:
    """Score two folders or two videos; write a CSV file with a row for each pair to ``out``.

    The exit code is that of missing data if no metric has a value.
    """
    if renders.resolve() == truth.resolve():
        raise InputError("command line", "--truth", "another folder or file than the renders", str(truth))
    if out is not None:
        if out.suffix.lower() in (*IMAGES, *SUFFIXES):
            raise InputError("command line", "--out", "a CSV file to write", str(out))
        check_writable(out, "--out")
    protocol = _protocol(protocols, metrics)
    specs = pair_metrics(metrics or (protocol.compared if protocol else ()), masks=masks is not None)
    pairs = find_pairs(renders, truth, masks, resize, progress)
    images = PairedImages(pairs, resize)
    regions = (MASK,) if masks is not None else ()
    keys = [pair.key for pair in pairs]
    frames = ScoredFrames(images.render, images)
    score_frames(keys[:1], frames, specs, device=device)  # finds wrong files of networks before long work
    scores = score_frames(keys, frames, specs, regions, progress, device)
    columns = [
        _Column(spec, region, {s.key: s for s in scores[spec.name] if s.region == region})
        for spec in specs
        for region in (FULL, *(regions if spec.kind == "regional" else ()))
    ]
    notes = []
    if resize is not None:
        notes.append(f"Renders of another size are resized to that of the ground truth ({resize}).")
    if protocol is not None:
        width, height = pairs[0].size
        notes += _protocol_notes(protocols[0], protocol, f"{width}x{height}")
    if lossy := sum(pair.render.suffix.lower() != ".png" for pair in pairs):
        notes.append(f"The compression of {counted(lossy, 'render')} as JPEG or video is scored, too.")
    missing: dict[tuple[str, int], list[str]] = {}
    for column in columns:
        for why in column.missing(pairs).items():
            missing.setdefault(why, []).append(column.head[:-2])
    notes += [
        f"{reason.rstrip('.')} ({', '.join(heads)}, {count} of {counted(len(pairs), 'pair')})."
        for (reason, count), heads in missing.items()
    ]
    if out is not None:
        write_text(out, _csv(pairs, columns))
        notes.append(str(out))
    text, means = _means(pairs, columns, renders.name, protocol.pooled if protocol else None)
    about = f"{renders} against {truth}: {counted(len(pairs), 'pair')}."
    data = {"pairs": len(pairs), **means, "resize": resize, "out": out, "protocol": list(protocols)}
    scored = any(column.values(pairs) for column in columns)
    code = ExitCode.OK if scored else ExitCode.NO_VERDICT
    return CommandResult("\n\n".join([text, "\n".join([about, *notes])]), data, scored, code)


def _protocol(names: Sequence[str], metrics: Sequence[str]) -> NamedProtocol | None:
    """The named protocol, or None without a name. Raises `InputError` for several, and for metrics that it cannot have."""
    if len(names) > 1:
        raise InputError("command line", "--protocol", "one protocol with --truth", ", ".join(names))
    protocol = protocol_named(names[0]) if names else None
    if protocol is not None:
        try:
            protocol.check_metrics(metrics)
        except ValueError as error:
            expected, _, found = str(error).removeprefix("metrics: ").partition("; found ")
            raise InputError("command line", "--metrics", expected, found) from error
    return protocol


def _protocol_notes(name: str, protocol: NamedProtocol, size: str) -> list[str]:
    """Sentences on what a protocol asks besides its metrics."""
    notes = [f"Protocol {name}: {protocol.title}."]
    if protocol.size and size != protocol.size:
        notes.append(f"Pixels: {size}; in the protocol: {protocol.size}.")
    notes += [
        f"{title}, which is not done here: {text}."
        for title, text in (("Crop", protocol.crop), ("Background", protocol.background))
        if text
    ]
    if protocol.pooled is not None:
        notes.append(
            f"PSNR of all pairs: mean over batches of {protocol.pooled} pairs, each by its mean squared error."
        )
    if protocol.source_metrics:
        others = ",".join(protocol.source_metrics)
        notes.append(f"Against the source pictures as --truth: --metrics {others}.")
    return notes


def _means(
    pairs: Sequence[Pair], columns: Sequence[_Column], title: str, pooled: int | None
) -> tuple[str, dict[str, object]]:
    """Means of every sequence, of sequences and of pairs, as a table and by name.

    ``title`` is for pairs without a folder. PSNR of all pairs is that of batches of ``pooled`` pairs.
    """
    sequences = {name: list(of) for name, of in groupby(pairs, key=lambda pair: pair.key.sequence)}
    single = len(sequences) == 1
    means = {name: [column.mean(of, whole=single) for column in columns] for name, of in sequences.items()}
    over_sequences = [_mean([mean for mean in of if mean is not None]) for of in zip(*means.values())]
    over_pairs = [column.pooled_mean(pairs, pooled) for column in columns]
    rows = [
        (name or title, len(sequences[name]), over_pairs if single else values)
        for name, values in means.items()
    ]
    if not single:
        rows = rows if len(rows) <= MOST_ROWS else []
        rows.append((f"mean of {len(means)} sequences", len(pairs), over_sequences))
        rows.append(("mean of pairs", len(pairs), over_pairs))
    lines = [[name, str(n), *(c.shown(v) for c, v in zip(columns, values))] for name, n, values in rows]
    names = [column.name for column in columns]
    data = {
        "mean_of_pairs": dict(zip(names, over_pairs)),
        "mean_of_sequences": dict(zip(names, over_sequences)),
        "sequences": {name: dict(zip(names, values)) for name, values in means.items()},
    }
    return table(["Sequence", "Pairs", *(column.head for column in columns)], lines), data


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None


def _csv(pairs: Sequence[Pair], columns: Sequence[_Column]) -> str:
    lines: list[Sequence[object]] = [
        ["sequence", "name", "render", "truth", *(column.name for column in columns), "missing"]
    ]
    for pair in pairs:
        of_pair = [column.values([pair]) for column in columns]
        values = [repr(value[0]) if value else "" for value in of_pair]
        scores = (column.scores.get(pair.key) for column in columns)
        reasons = dict.fromkeys(score.reason for score in scores if score is not None and score.reason)
        lines.append([pair.key.sequence, pair.name, pair.render, pair.truth, *values, " ".join(reasons)])
    return csv_text(lines)

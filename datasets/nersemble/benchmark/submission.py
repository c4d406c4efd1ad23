"""Submissions to the NeRSemble benchmark: writing a zip of videos from frames, and checking it like the server does.

Videos that the NeRSemble benchmark requests: participants, sequences, size, rate and length. Source: the documentation
and constants of nersemble-benchmark (commit e15f204, 2026-04).

Formats read:

- FLAME tracking of the NeRSemble benchmark. Written by the authors of tobias-kirschstein/nersemble-benchmark@e15f204d,
  whose `src/nersemble_benchmark/data/benchmark_data.py` it follows. Not checked on a file of the program.
"""

from __future__ import annotations

import math
import re
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np

from ....bench.contracts import ByteArray, Progress
from ....bench.errors import InputError
from ....bench.io.arrays import Member, read_arrays
from ....bench.io.files import atomic_path, check_writable, reading
from ....bench.io.images import encode_h264, ffmpeg, probe_image, read_png
from ..sequence import open_video, probe_video

TrackName = Literal["nvs", "mono_flame_avatar"]
TRACKING_FILE = "flame2023_tracking_v2.npz"
"""File of the second version of the track; submissions by the first one, without ``_v2``, are no longer accepted."""
CRF = 14
"""Constant rate factor of H.264 that submissions are encoded with."""


class Video(NamedTuple):
    """A video of a submission; ``frames`` is None if the number is only in the benchmark's files."""

    participant: str
    sequence: str
    serial: str
    frames: int | None

    @property
    def name(self) -> str:
        """Its name in the zip."""
        return f"{self.participant}/{self.sequence}/cam_{self.serial}.mp4"


@dataclass(frozen=True)
class BenchmarkTrack:
    """A task of the benchmark."""

    name: TrackName
    """Name of the folder in the benchmark's data."""
    size: tuple[int, int]
    """(width, height) in pixels."""
    fps: float
    sequences: Mapping[str, Mapping[str, int | None]]
    """Sequences to render, by participant, with the number of frames if it is published."""
    serials: tuple[str, ...]
    totals: Mapping[str, int] | None = None
    """Published number of frames of all sequences of a participant together."""

    def videos(self, data: Path | None = None) -> Iterator[Video]:
        """All videos of a submission. ``data`` is the benchmark's folder; its tracking gives the number of frames if
        that is not published."""
        for participant, sequences in self.sequences.items():
            for sequence, frames in sequences.items():
                count = frames
                if count is None and data is not None:
                    count = tracked_frames(tracking_file(data, participant, sequence))
                for serial in self.serials:
                    yield Video(participant, sequence, serial, count)


_TEST_SEQUENCES = ("FREE", "EMO-1-shout+laugh", "SEN-09-frown_events_bad", "SEN-10-port_strong_smokey")
NVS = BenchmarkTrack(
    "nvs",
    (1100, 1604),
    73.0,
    {
        "388": {"GLASSES": 1118},
        "422": {"EXP-2-eyes": 517},
        "443": {"FREE": 1108},
        "445": {"EXP-6-tongue-1": 514},
        "475": {"HAIR": 259},
    },
    ("222200046", "222200037", "222200039"),
)
MONO = BenchmarkTrack(
    "mono_flame_avatar",
    (512, 512),
    24.3,
    {name: dict.fromkeys(_TEST_SEQUENCES) for name in ("393", "404", "461", "477", "486")},
    ("222200037", "222200046", "220700191", "222200039"),
    totals={"393": 816, "404": 665, "461": 486, "477": 530, "486": 608},
)
TRACKS: Mapping[TrackName, BenchmarkTrack] = {track.name: track for track in (NVS, MONO)}


def tracking_file(data: Path, participant: str, sequence: str) -> Path:
    """Tracking of a sequence in the benchmark's folder."""
    folder = data / "mono_flame_avatar" / participant / "sequences" / sequence / "tracking"
    path = folder / TRACKING_FILE
    if not path.is_file():
        old = (folder / TRACKING_FILE.replace("_v2", "")).is_file()
        found = "that of version 1, which is no longer taken" if old else "no such file"
        remedy = "Download it: nersemble-benchmark-download FOLDER mono_flame_avatar."
        raise InputError(path, "", "the tracking of version 2", found, remedy)
    return path


MEMBERS = {
    "shape": Member("f", (1, "shape")),
    "expression": Member("f", ("T", "expression")),
    "rotation": Member("f", ("T", 3)),
    "rotation_matrices": Member("f", ("T", 3, 3)),
    "translation": Member("f", ("T", 3)),
    "jaw": Member("f", ("T", 3)),
    "frames": Member("iuf", ("T",)),
    "scale": Member("f", (1, 1)),
    "neck": Member("f", ("T", 3)),
    "eyes": Member("f", ("T", 6)),
}
"""Arrays of a tracking file, all of one length T."""


def tracked_frames(path: Path) -> int:
    """Timesteps of a tracking file."""
    return len(read_arrays(path, MEMBERS)["expression"])


COMPARED = 24
"""Number of evenly spaced frames of a video that are compared with the encoded ones."""
_FRAME = re.compile(r"(?P<sequence>.+)_(?P<timestep>\d{5,})_(?P<camera>[^_]+)\.png")
_CODECS = {"avc1": "H.264", "h264": "H.264", "H264": "H.264"}


# Frames


def find_frames(
    folder: Path, track: BenchmarkTrack, method: str, data: Path | None
) -> dict[Video, list[Path]]:
    """Frames of every video of a submission, in order of time.

    They are ``<folder>/<participant>/<sequence>_<timestep>_<serial>.png``, or those of a run's method:
    ``<folder>/<participant>/<method>/seed-<n>/renders/<task>/...``.

    ``method``: Method to use from a run with several. ``data``: The benchmark's folder, which gives the number of frames of
    a sequence if that is not published.
    """
    files: dict[Video, list[Path]] = {}
    by_participant = {name: _by_camera(folder, name, method) for name in track.sequences}
    lacking = []
    for video in track.videos(data):
        frames = by_participant[video.participant].get((video.sequence, video.serial), {})
        if not frames:
            lacking.append(video.name.removesuffix(".mp4"))
            continue
        numbers = sorted(frames)
        where = folder / video.participant
        key = f"{video.sequence}, camera {video.serial}"
        if video.frames is not None and len(numbers) != video.frames:
            remedy = "Render every frame of the sequence, without leaving any out."
            raise InputError(where, key, f"{video.frames} frames", f"{len(numbers)}", remedy)
        if numbers[-1] - numbers[0] + 1 != len(numbers):
            gap = next(b for a, b in pairwise(numbers) if b != a + 1) - 1
            raise InputError(where, key, "timesteps without a gap", f"none of timestep {gap}")
        files[video] = [frames[number] for number in numbers]
    if lacking:
        expected = f"frames of {len(files) + len(lacking)} videos, such as {lacking[0]}"
        remedy = "Frames are PARTICIPANT/SEQUENCE_TIMESTEP_SERIAL.png, as `headbench submission render` writes them."
        raise InputError(folder, "", expected, f"none for {len(lacking)} of them", remedy)
    _check_lengths(folder, track, {video: len(frames) for video, frames in files.items()})
    for paths in files.values():
        for path in paths:
            info = probe_image(path)
            if (info.width, info.height) != track.size or info.channels != 3:
                size = "x".join(map(str, track.size))
                expected = f"RGB of {size} pixels, the size of this track"
                raise InputError(path, "", expected, f"{info.width}x{info.height}, {info.channels} channels")
    return files


def _by_camera(folder: Path, participant: str, method: str) -> dict[tuple[str, str], dict[int, Path]]:
    """Frames of a participant by sequence and camera, and timestep."""
    home = folder / participant
    places = [home]
    runs = sorted(home.glob("*/seed-*/renders")) if home.is_dir() else []
    if runs:
        chosen = [path for path in runs if method in ("", path.parent.parent.name)]
        if len(chosen) != 1:
            names = ", ".join(f"{path.parent.parent.name} {path.parent.name}" for path in runs)
            expected = (
                "one method and seed, named by --method" if method else "--method, one of those of the run"
            )
            raise InputError(home, "--method", expected, names)
        places = sorted(path for path in chosen[0].iterdir() if path.is_dir())
    files: dict[tuple[str, str], dict[int, Path]] = {}
    for place in places:
        for path in sorted(place.iterdir()) if place.is_dir() else ():
            if match := _FRAME.fullmatch(path.name):
                of = files.setdefault((match["sequence"], match["camera"]), {})
                of[int(match["timestep"])] = path
    return files


def _check_lengths(where: Path, track: BenchmarkTrack, counts: dict[Video, int]) -> None:
    """Check that cameras of a sequence have equal lengths, and sequences of a participant the published number of frames."""
    by_sequence: dict[tuple[str, str], set[int]] = {}
    for video, count in counts.items():
        by_sequence.setdefault((video.participant, video.sequence), set()).add(count)
    for (participant, sequence), lengths in by_sequence.items():
        if len(lengths) > 1:
            expected = "as many frames from every camera"
            raise InputError(
                where, f"{participant}, {sequence}", expected, ", ".join(map(str, sorted(lengths)))
            )
    for participant, total in (track.totals or {}).items():
        frames = sum(max(lengths) for (name, _), lengths in by_sequence.items() if name == participant)
        if frames != total:
            expected = f"{total} frames in all sequences together, as published"
            remedy = "Render every frame of every test sequence."
            raise InputError(where, participant, expected, f"{frames}", remedy)


# Writing


class Encoded(NamedTuple):
    """Encoding error of a video: mean squared error of some frames after decoding, of 255 squared."""

    video: Video
    frames: int
    size: int
    error: float


def write_submission(
    frames: dict[Video, list[Path]], track: BenchmarkTrack, out: Path, progress: Progress
) -> list[Encoded]:
    """Encode all videos and write the zip atomically; return the encoding errors."""
    ffmpeg()
    check_writable(out, "ZIP")
    done = []
    with (
        tempfile.TemporaryDirectory() as scratch,
        atomic_path(out) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive,
    ):
        for number, (video, paths) in enumerate(frames.items()):
            path = Path(scratch) / "video.mp4"
            encode_h264(path, (read_png(frame) for frame in paths), track.size, track.fps, CRF)
            error = _encoding_error(path, paths)
            entry = zipfile.ZipInfo(video.name, (1980, 1, 1, 0, 0, 0))  # equal frames give equal zips
            entry.external_attr = 0o644 << 16
            with path.open("rb") as source, archive.open(entry, "w", force_zip64=True) as target:
                shutil.copyfileobj(source, target, 1 << 20)
            done.append(Encoded(video, len(paths), path.stat().st_size, error))
            progress(number + 1, len(frames), video.name)
    return done


def _encoding_error(path: Path, frames: Sequence[Path]) -> float:
    """Mean squared error of some decoded frames; raises if a frame is missing."""
    chosen = {int(i) for i in np.linspace(0, len(frames) - 1, min(COMPARED, len(frames)))}
    errors = []
    count = 0
    for number, image in enumerate(_decoded(path)):
        count += 1
        if number in chosen:
            difference = image.astype(np.float32) - read_png(frames[number])
            errors.append(float(np.mean(difference**2)))
    if count != len(frames):
        raise InputError(path, "", f"{len(frames)} frames after encoding", f"{count}")
    return float(np.mean(errors))


def _decoded(path: Path) -> Iterator[ByteArray]:
    """RGB frames of a video, in order."""
    capture = open_video(path)
    try:
        while True:
            there, image = capture.read()
            if not there:
                return
            yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
    finally:
        capture.release()


def decibels(error: float) -> float:
    """PSNR of a mean squared error of 8-bit values; infinite for none."""
    return math.inf if error == 0 else 10 * math.log10(255**2 / error)


def after_encoding(psnr: float, error: float) -> float:
    """PSNR of renders of ``psnr`` after an encoding of that mean squared error, for uncorrelated errors."""
    return decibels(255**2 / 10 ** (psnr / 10) + error)


# Checking


@dataclass
class Issues:
    """Faults of a submission: those that the server refuses, and further ones to fix."""

    refused: list[str] = field(default_factory=list)
    noted: list[str] = field(default_factory=list)


def check_submission(
    file: Path, data: Path | None, name: str, progress: Progress
) -> tuple[BenchmarkTrack, Issues]:
    """Check a zip like the server does (files, frame counts, sizes), and also decode every frame and check codec and
    rate.

    ``data``: The benchmark's folder; without it, frames of the monocular track are only compared with the published totals.
    ``name``: Name of the track; "" takes the one with the most files in the zip.
    """
    issues = Issues()
    with reading(file, "the zip of a submission"):
        opened = zipfile.ZipFile(file)
    with opened as archive, tempfile.TemporaryDirectory() as scratch:
        entries = {entry.filename: entry for entry in archive.infolist()}
        track = TRACKS[name] if name else _track_of(entries)  # type: ignore[index]
        wanted = {video.name: video for video in track.videos(data)}
        issues.refused += [f"{missing}: missing." for missing in wanted if missing not in entries]
        issues.noted += [f"{extra}: not asked for." for extra in sorted(entries.keys() - wanted.keys())]
        counts: dict[Video, int] = {}
        present = [video for name, video in wanted.items() if name in entries]
        for number, video in enumerate(present):
            path = Path(scratch) / "video.mp4"
            _unpack(file, archive, entries[video.name], path)
            counts[video] = _check_video(path, video, track, issues)
            progress(number + 1, len(present), video.name)
        whole = len(present) == len(wanted) and all(counts.values())
        if whole and not any(video.frames for video in wanted.values()):
            try:
                _check_lengths(file, track, counts)
            except InputError as error:
                issues.refused.append(str(error))
    return track, issues


def _track_of(names: Sequence[str] | dict[str, zipfile.ZipInfo]) -> BenchmarkTrack:
    return max(TRACKS.values(), key=lambda track: sum(video.name in names for video in track.videos()))


def _unpack(file: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path) -> None:
    unpacking = reading(file, "an entry that unpacks", entry.filename)
    with unpacking, archive.open(entry) as source, path.open("wb") as target:
        shutil.copyfileobj(source, target, 1 << 20)


def _check_video(path: Path, video: Video, track: BenchmarkTrack, issues: Issues) -> int:
    """Decode a video; record its faults, return its number of frames."""
    try:
        declared, size = probe_video(path)
    except InputError as error:
        issues.refused.append(f"{video.name}: no video: expected {error.expected}, found {error.found}.")
        return 0
    if size != track.size:
        expected, found = ("x".join(map(str, pair)) for pair in (track.size, size))
        issues.refused.append(f"{video.name}: {found} pixels, {expected} are asked for.")
        return declared
    capture = open_video(path)
    fps, code = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FOURCC))
    capture.release()
    count = sum(1 for _ in _decoded(path))
    if video.frames is not None and count != video.frames:
        issues.refused.append(f"{video.name}: {count} frames, {video.frames} are asked for.")
    if count != declared:
        issues.refused.append(f"{video.name}: {count} frames can be decoded of {declared} that it declares.")
    name = code.to_bytes(4, "little").decode("ascii", errors="replace")
    if name not in _CODECS:
        issues.noted.append(f"{video.name}: codec {name!r}, the documentation names H.264.")
    if abs(fps - track.fps) > 0.01 * track.fps:
        issues.noted.append(
            f"{video.name}: {fps:g} frames per second, the documentation names {track.fps:g}."
        )
    return count

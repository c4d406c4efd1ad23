"""Videos that the NeRSemble benchmark requests: participants, sequences, size, rate and length.

Source: the documentation and constants of nersemble-benchmark (commit e15f204, 2026-04).

Formats read:

- FLAME tracking of the NeRSemble benchmark. Written by the authors of tobias-kirschstein/nersemble-benchmark@e15f204d,
  whose `src/nersemble_benchmark/data/benchmark_data.py` it follows. Not checked on a file of the program.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from ....bench.errors import InputError
from ....bench.io.arrays import Member, read_arrays

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
    """A task of the benchmark.

    Attributes
    ----------
    name : TrackName
        Name of the folder in the benchmark's data.
    size : tuple[int, int]
        (width, height) in pixels.
    sequences : Mapping[str, Mapping[str, int | None]]
        Sequences to render, by participant, with the number of frames if it is published.
    totals : Mapping[str, int] | None
        Published number of frames of all sequences of a participant together.
    """

    name: TrackName
    size: tuple[int, int]
    fps: float
    sequences: Mapping[str, Mapping[str, int | None]]
    serials: tuple[str, ...]
    totals: Mapping[str, int] | None = None

    def videos(self, data: Path | None = None) -> Iterator[Video]:
        """All videos of a submission.

        ``data`` is the benchmark's folder; its tracking gives the number of frames if that is not published.
        Raises `InputError` for tracking that is missing or damaged.
        """
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
    """Tracking of a sequence in the benchmark's folder. Raises `InputError` if it is missing or of version 1."""
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
    """Timesteps of a tracking file. Raises `InputError` for other files."""
    return len(read_arrays(path, MEMBERS)["expression"])

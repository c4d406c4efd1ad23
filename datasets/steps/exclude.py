"""Exclude labelled frames from every split, such as frames with the tongue, which FLAME lacks.

Labels are JSON ({"<timestep>": "<reason>"}), or the YAML of ``headbench prepare tongue``, which has the detector's
decisions with their reasons, and manual overrides. One file can have several subjects::

    format: headbench-exclusions-1
    subjects:
      '074':
        overrides: {57: keep, 91: hand before the mouth}
        threshold: 35.0
        ...
        frames:
          57: {sequence: FREE, score: 61.2, excluded: true, reason: '...'}

The section ``overrides`` has manual decisions: it takes precedence, and is kept when the detector rewrites the file.
``keep`` keeps a frame; any other text excludes it and is the reason.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import yaml
from pydantic import NonNegativeInt

from ...bench.contracts import Clip, FrameKey
from ...bench.errors import InputError
from ...bench.io.documents import checked, read_json, read_yaml
from ...bench.io.files import check_name, write_text

if TYPE_CHECKING:
    from ..clip import CaptureClip


def exclude_timesteps(
    clip: CaptureClip,
    reasons: Mapping[int, str],
    *,
    source: str | PathLike[str] = "excluded frames",
) -> CaptureClip:
    """Move the labelled timesteps of a clip from its splits to `excluded`, with their reasons. ``reasons``: Label by
    timestep, such as {57: "tongue out"}. ``source``: Source of the reasons, named in the error."""
    unknown = sorted(set(reasons) - set(clip.poses))
    if unknown:
        expected = f"timesteps of the clip, 0 to {max(clip.poses)}"
        raise InputError(source, "timestep", expected, ", ".join(map(str, unknown)))
    gone = {key: reasons[key.timestep] for key in clip.files if key.timestep in reasons}
    splits = {name: tuple(key for key in keys if key not in gone) for name, keys in clip.splits.items()}
    if not splits["train"]:
        raise InputError(source, "timestep", "training frames left", "none left")
    parameters = {"reasons": {str(t): reason for t, reason in sorted(reasons.items())}}
    excluded: dict[FrameKey, str] = {**clip.excluded, **gone}
    return clip.derive("exclude_timesteps", parameters, splits=splits, excluded=excluded)


def exclude_given(clip: Clip, exclude: Mapping[int, str] | str | Path | None) -> CaptureClip:
    """Exclude the timesteps of a reader's setting ``exclude`` from a clip of any reader. ``exclude``: Reason by
    timestep, or a file for `read_reasons`, such as the one that ``headbench prepare tongue`` writes."""
    from ..clip import as_capture  # slow to import

    clip = as_capture(clip)
    if isinstance(exclude, (str, Path)):
        return exclude_timesteps(clip, read_reasons(Path(exclude), clip), source=exclude)
    return exclude_timesteps(clip, exclude) if exclude else clip


def read_labels(path: Path) -> dict[int, str]:
    """Read frame labels: a JSON object {"<timestep>": "<reason>"}."""
    labels = {}
    for key, reason in read_json(path).items():
        if not (key.isascii() and key.isdigit() and isinstance(reason, str)):
            expected = "entries that map a timestep to a reason"
            raise InputError(path, key, expected, f"{key!r}: {reason!r}"[:80])
        labels[int(key)] = reason
    return labels


def read_reasons(path: Path, clip: CaptureClip) -> dict[int, str]:
    """Reasons by timestep for a clip: from the YAML of the module, or from JSON labels by the suffix."""
    if path.suffix.lower() == ".json":
        return read_labels(path)
    subjects = read_exclusions(path)
    if clip.subject not in subjects:
        found = ", ".join(subjects) or "no subjects"
        raise InputError(
            path, "subjects", clip.subject, found, "Run `headbench prepare tongue` on this capture too."
        )
    decided = subjects[clip.subject]
    sequences = {key.timestep: key.sequence for key in clip.files}
    for timestep, frame in decided.frames.items():
        if sequences.get(timestep, frame.sequence) != frame.sequence:
            raise InputError(
                path,
                f"subjects.{clip.subject}.frames.{timestep}.sequence",
                f"{sequences[timestep]}, as the capture has it",
                frame.sequence,
                "The file was made for a capture with another numbering of timesteps.",
            )
    return decided.reasons()


FORMAT = "headbench-exclusions-1"
KEEP = "keep"
UNIT = "mm2 of lip and chin that look covered"

_HEADER = """\
# Frames with the tongue out, found by `headbench prepare tongue`. Leave them out with
#   headbench run --set reader_settings.exclude=THIS_FILE
# Correct a decision under `overrides` of its subject, as "timestep: keep" or "timestep: reason to exclude";
# overrides win, and another run of the detector keeps them.
"""


@dataclass(frozen=True)
class FrameDecision:
    """Decision of the detector on one timestep; ``score`` is in `UNIT`."""

    sequence: str
    score: float
    excluded: bool
    reason: str


@dataclass(frozen=True, eq=False)
class Exclusions:
    """Decisions on one subject."""

    threshold: float
    """Minimum score of excluded frames."""
    basis: str
    """How the threshold was found."""
    cameras: tuple[str, ...]
    """Cameras that were evaluated."""
    frames: Mapping[int, FrameDecision]
    """Decision by timestep."""
    overrides: Mapping[int, str] = field(default_factory=dict)
    """Manual decision by timestep: "keep", or the reason to exclude the frame."""

    def reasons(self) -> dict[int, str]:
        """Reason by excluded timestep, with overrides applied."""
        found = {t: frame.reason for t, frame in self.frames.items() if frame.excluded}
        found |= {t: word for t, word in self.overrides.items() if word != KEEP}
        return {t: found[t] for t in sorted(found) if self.overrides.get(t) != KEEP}


def write_exclusions(path: Path, subjects: Mapping[str, Exclusions]) -> None:
    """Write the file, atomically."""
    content = {
        "format": FORMAT,
        "subjects": {
            subject: {
                "overrides": dict(sorted(decided.overrides.items())),
                "threshold": float(decided.threshold),
                "threshold_from": decided.basis,
                "unit": UNIT,
                "cameras": list(decided.cameras),
                "frames": {t: asdict(frame) for t, frame in sorted(decided.frames.items())},
            }
            for subject, decided in subjects.items()
        },
    }
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=1000, allow_unicode=True)
    write_text(path, _HEADER + text)


@dataclass(frozen=True)
class _Subject:
    """A subject's entry in the format of the file."""

    threshold: float
    frames: dict[NonNegativeInt, FrameDecision]
    overrides: dict[NonNegativeInt, str] | None = None  # if a user deleted the last line
    threshold_from: str = ""
    unit: str = UNIT
    cameras: tuple[str, ...] = ()


@dataclass(frozen=True)
class _File:
    format: Literal["headbench-exclusions-1"]
    subjects: dict[str, _Subject]


def read_exclusions(path: Path) -> dict[str, Exclusions]:
    """Read decisions by subject."""
    if not path.exists():
        remedy = "Create it with `headbench prepare tongue`."
        raise InputError(path, "", "a file of exclusions", "no such file", remedy)
    content = checked(read_yaml(path), _File, path)
    return {
        check_name(subject, path, "subjects"): Exclusions(
            entry.threshold,
            entry.threshold_from,
            entry.cameras,
            entry.frames,
            {t: _word(path, subject, t, word) for t, word in (entry.overrides or {}).items()},
        )
        for subject, entry in content.subjects.items()
    }


def _word(path: Path, subject: str, timestep: int, word: str) -> str:
    if not word.strip():
        key = f"subjects.{subject}.overrides.{timestep}"
        raise InputError(path, key, f'"{KEEP}" or the reason to leave the frame out', "nothing")
    return KEEP if word.strip().lower() == KEEP else word

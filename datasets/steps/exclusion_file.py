"""The YAML of frames to leave out: what a detector decided, why, and what people decided instead.

One file serves several subjects::

    format: headbench-exclusions-1
    subjects:
      '074':
        overrides: {57: keep, 91: hand before the mouth}
        threshold: 35.0
        ...
        frames:
          57: {sequence: FREE, score: 61.2, excluded: true, reason: '...'}

The section ``overrides`` is people's: it wins, and a detector that writes the file again keeps it. ``keep`` keeps
a frame; any other text leaves it out and is the reason.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from ...bench.errors import InputError
from ...bench.files import check_name, write_text

FORMAT = "headbench-exclusions-1"
KEEP = "keep"
UNIT = "mm2 of lip and chin that look covered"

_YAML_INTEGER = "tag:yaml.org,2002:int"
_DECIMAL = re.compile(r"-?(0|[1-9][0-9]*)")

_HEADER = """\
# Frames with the tongue out, found by `headbench tongue`. Leave them out with
#   headbench run --set reader_settings.exclude=THIS_FILE
# Correct a decision under `overrides` of its subject, as "timestep: keep" or "timestep: reason to exclude";
# overrides win, and another run of the detector keeps them.
"""


@dataclass(frozen=True)
class FrameDecision:
    """What the detector says of one timestep; ``score`` is in `UNIT`."""

    sequence: str
    score: float
    excluded: bool
    reason: str


@dataclass(frozen=True, eq=False)
class Exclusions:
    """Decisions on one subject.

    Attributes
    ----------
    threshold : score from which on a frame is left out.
    basis : how the threshold was found.
    cameras : that were looked at.
    frames : decision by timestep.
    overrides : people's word by timestep: "keep", or the reason to leave the frame out.
    """

    threshold: float
    basis: str
    cameras: tuple[str, ...]
    frames: Mapping[int, FrameDecision]
    overrides: Mapping[int, str] = field(default_factory=dict)

    def reasons(self) -> dict[int, str]:
        """Reason by timestep that is left out, overrides applied."""
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
                "frames": {t: _plain(frame) for t, frame in sorted(decided.frames.items())},
            }
            for subject, decided in subjects.items()
        },
    }
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=1000, allow_unicode=True)
    write_text(path, _HEADER + text)


def read_exclusions(path: Path) -> dict[str, Exclusions]:
    """Read the file: decisions by subject. Raises `InputError` for anything that is not one."""
    try:
        loader = yaml.SafeLoader(path.read_text(encoding="utf-8"))
        root = loader.get_single_node()
        _check_keys(path, root)
        content = None if root is None else loader.construct_document(root)
    except FileNotFoundError as error:
        remedy = "Make one with `headbench tongue`."
        raise InputError(path, "", "a file of exclusions", "no such file", remedy) from error
    except OSError as error:
        raise InputError(path, "", "a readable file", error.strerror or str(error)) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(path, "", "valid YAML", f"content that does not parse ({error})") from error
    top = _mapping(path, "", content)
    if top.get("format") != FORMAT:
        raise InputError(path, "format", FORMAT, repr(top.get("format"))[:80])
    subjects = _mapping(path, "subjects", top.get("subjects"))
    return {
        check_name(str(s), path, "subjects"): _subject(path, str(s), value) for s, value in subjects.items()
    }


def _check_keys(path: Path, root: yaml.Node | None) -> None:
    """Refuse keys that YAML takes otherwise than they look: 057 is 47 to it, 1:30 is 90, and of two equal keys
    the last one counts."""
    waiting, known = [root], set()
    while waiting:
        node = waiting.pop()
        if node is None or id(node) in known:
            continue
        known.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            waiting += node.value
        if isinstance(node, yaml.MappingNode):
            seen: set[tuple[str, str]] = set()
            for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
                line = f"line {key.start_mark.line + 1}"
                if key.tag == _YAML_INTEGER and not _DECIMAL.fullmatch(key.value):
                    expected = "numbers without leading zeros, other names in quotes"
                    raise InputError(path, line, expected, key.value[:80])
                if (key.tag, key.value) in seen:
                    raise InputError(path, line, "each key once", f"{key.value[:80]} again")
                seen.add((key.tag, key.value))
            waiting += [value for _, value in node.value]


def _subject(path: Path, subject: str, value: Any) -> Exclusions:
    where = f"subjects.{subject}"
    entry = _mapping(path, where, value)
    frames = _mapping(path, f"{where}.frames", entry.get("frames"))
    # An empty section, as someone leaves it who deletes the last line, means no overrides.
    overrides = _mapping(path, f"{where}.overrides", entry.get("overrides") or {})
    for t, word in overrides.items():
        if not (_is_timestep(t) and isinstance(word, str) and word.strip()):
            expected = f'a timestep with "{KEEP}" or the reason to leave it out'
            raise InputError(path, f"{where}.overrides", expected, f"{t!r}: {word!r}"[:80])
    cameras = entry.get("cameras", [])
    if not (isinstance(cameras, list) and all(isinstance(camera, str) for camera in cameras)):
        raise InputError(path, f"{where}.cameras", "a list of camera ids as text", repr(cameras)[:80])
    return Exclusions(
        _number(path, f"{where}.threshold", entry.get("threshold")),
        str(entry.get("threshold_from", "")),
        tuple(cameras),
        {t: _frame(path, f"{where}.frames", t, frame) for t, frame in frames.items()},
        {t: KEEP if word.strip().lower() == KEEP else word for t, word in overrides.items()},
    )


def _frame(path: Path, where: str, timestep: Any, value: Any) -> FrameDecision:
    if not _is_timestep(timestep):
        raise InputError(path, where, "timesteps, whole numbers from 0", repr(timestep)[:80])
    where = f"{where}.{timestep}"
    entry = _mapping(path, where, value)
    score = _number(path, f"{where}.score", entry.get("score"))
    kinds: dict[str, type] = {"sequence": str, "excluded": bool, "reason": str}
    for key, kind in kinds.items():
        if not isinstance(entry.get(key), kind):
            expected = "true or false" if kind is bool else "text"
            raise InputError(path, f"{where}.{key}", expected, repr(entry.get(key))[:80])
    return FrameDecision(entry["sequence"], score, entry["excluded"], entry["reason"])


def _mapping(path: Path, key: str, value: Any) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise InputError(path, key, "a mapping", f"{type(value).__name__}")
    return value


def _number(path: Path, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(path, key, "a finite number", repr(value)[:80])
    return float(value)


def _is_timestep(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _plain(frame: FrameDecision) -> dict[str, Any]:
    return {
        "sequence": str(frame.sequence),
        "score": float(frame.score),
        "excluded": bool(frame.excluded),
        "reason": frame.reason,
    }

"""Names in NeRSemble's folders: participants, sequences, serials, and what to match them by."""

from __future__ import annotations

import re
from collections.abc import Iterable
from os import PathLike

from ...bench.errors import InputError

FULL_SIZE = (2200, 3208)
"""Width and height that a calibration refers to where it does not say."""

FPS = 73.0
"""Frames per second of the released videos; what the container says is not reliable."""

BACKGROUND = "BACKGROUND"
TONGUE_SEQUENCES = ("EXP-6-tongue-1", "EXP-7-tongue-2")
SEQUENCES = (
    *("EMO-1-shout+laugh", "EMO-2-surprise+fear", "EMO-3-angry+sad", "EMO-4-disgust+happy"),
    *("EXP-1-head", "EXP-2-eyes", "EXP-3-cheeks+nose", "EXP-4-lips", "EXP-5-mouth"),
    *TONGUE_SEQUENCES,
    *("EXP-8-jaw-1", "EXP-9-jaw-2", "FREE", "GLASSES", "HAIR"),
    *("SEN-01-cramp_small_danger", "SEN-02-same_phrase_thirty_times", "SEN-03-pluck_bright_rose"),
    *("SEN-04-two_plus_seven", "SEN-05-glow_eyes_sweet_girl", "SEN-06-problems_wise_chief"),
    *("SEN-07-fond_note_fried", "SEN-08-clothes_and_lodging", "SEN-09-frown_events_bad"),
    "SEN-10-port_strong_smokey",
)
"""Names of all recorded sequences."""

_SUBJECT = re.compile(r"\d{3,}")
_SERIAL = re.compile(r"[0-9]+")


def is_subject(name: str) -> bool:
    """Whether a folder's name is a participant's: three digits or more."""
    return _SUBJECT.fullmatch(name) is not None


def serial_of(stem: str, prefix: str) -> str | None:
    """Serial of ``cam_222200037`` or ``image_222200037`` (its last ``_`` part); None for another name."""
    head, _, serial = stem.rpartition("_")
    return serial if head == prefix and _SERIAL.fullmatch(serial) else None


def numbered(stem: str) -> tuple[str, int] | None:
    """Serial and frame number of ``cam_222200037_000012``; the serial is "" in ``000012``."""
    rest, _, number = stem.rpartition("_")
    if not (number.isascii() and number.isdigit()):
        return None
    if not rest:
        return "", int(number)
    serial = serial_of(rest, "cam")
    return None if serial is None else (serial, int(number))


def match_sequence(file: str | PathLike[str], wanted: str, available: Iterable[str]) -> str:
    """The available sequence of that name, or the only one whose name starts so.

    A prefix that ends where a name has a hyphen goes before others: ``SEN-1`` would be ``SEN-1-...`` and not
    ``SEN-10-...``. Raises `InputError` where none or several fit.
    """
    names = sorted(set(available))
    if wanted in names:
        return wanted
    matches = [name for name in names if name.startswith(f"{wanted}-")]
    matches = matches or [name for name in names if wanted and name.startswith(wanted)]
    if len(matches) != 1:
        expected = f"the name, or a prefix, of one sequence out of {', '.join(names) or 'none'}"
        raise InputError(file, "sequence", expected, f"{wanted!r}, which fits {', '.join(matches) or 'none'}")
    return matches[0]

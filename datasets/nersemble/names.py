"""Names in NeRSemble's folders, and the usual subjects, sequences and cameras for evaluation.

Sources: "3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations"
(CVPR 2025), section 4 and supplement, for the subjects and the split by FREE; VHAP's union export for the ten
sequences and the rule that holds one of them out.
"""

from __future__ import annotations

import random
import re
from collections.abc import Iterable
from os import PathLike

from ...bench.errors import InputError

FULL_SIZE = (2200, 3208)
"""Default width and height of a calibration."""

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
    """The available sequence with that name or unique prefix.

    Prefixes that end before a hyphen are preferred: ``SEN-1`` is ``SEN-1-...`` and not ``SEN-10-...``. Raises
    `InputError` if none or several fit.
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


SUBJECTS = ("074", "104", "165", "175", "210", "218", "264", "302", "304")
"""The nine subjects of the paper's comparison."""

ABLATION_SUBJECT = "306"
"""Subject of the paper's Table 4; not one of the nine."""

SUBJECT_NAMES = {"paper": SUBJECTS, "ablation": (ABLATION_SUBJECT,)}
"""Names of groups of subjects."""

NOVEL_VIEW_CAMERA = "222200037"
"""The frontal camera, held out for novel views."""

FRONTAL_INDEX = 8
"""Its index in the rig, which identifies it in exports without serials."""

TEST_SEQUENCE = "FREE"
"""The unscripted performance, held out for self-reenactment."""

UNION10_SEQUENCES = (
    *("EMO-1-shout+laugh", "EMO-2-surprise+fear", "EMO-3-angry+sad", "EMO-4-disgust+happy"),
    *("EXP-2-eyes", "EXP-3-cheeks+nose", "EXP-4-lips", "EXP-5-mouth", "EXP-8-jaw-1", "EXP-9-jaw-2"),
)
"""The ten sequences of a UNION10 capture, in VHAP's order."""

PAPER_SEQUENCES = (*UNION10_SEQUENCES, TEST_SEQUENCE)
"""Training sequences and FREE: tongue, hair, glasses and head-turning sequences are usually left out."""


def union10_held_out(subject: str) -> str:
    """Held-out sequence of VHAP's union export of ten: drawn by Python's generator, seeded with the subject.

    ``subject`` is the id as text, leading zeros included.
    """
    return UNION10_SEQUENCES[random.Random(subject).randint(0, len(UNION10_SEQUENCES) - 1)]


def chosen_subjects(text: str) -> list[str]:
    """Subject ids of an option: ids separated by commas, ``paper`` (the nine) or ``ablation``.

    Numbers are padded to three digits, so 74 is 074. Raises `InputError` for anything else and for subjects named twice.
    """
    if text in SUBJECT_NAMES:
        return [*SUBJECT_NAMES[text]]
    ids = [part.strip() for part in text.split(",") if part.strip()]
    if not ids or not all(part.isascii() and part.isdigit() for part in ids):
        expected = 'numbers separated by commas, "paper" or "ablation"'
        raise InputError("command line", "--subjects", expected, repr(text))
    padded = [part.zfill(3) for part in ids]
    if len(set(padded)) != len(padded):
        raise InputError("command line", "--subjects", "every subject once", repr(text))
    return padded

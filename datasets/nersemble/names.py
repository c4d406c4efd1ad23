"""Names in NeRSemble's folders, and the usual subjects, sequences and cameras for evaluation.

Sources: "3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations"
(CVPR 2025), section 4 and supplement, for the subjects and the split by FREE; VHAP's union export for the ten
sequences and the rule that holds one of them out.

Settings of the conversion of NeRSemble recordings.
"""

from __future__ import annotations

import random
import re
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from typing import Literal

from ...bench.errors import InputError
from ...bench.options import DependentOptions


@dataclass(frozen=True)
class PrepareSettings:
    """Settings of the preparation."""

    root: str = ""
    """Folder with raw recordings: the one that holds the participants' folders."""
    out: str = "nersemble-captures"
    """Folder for the captures."""
    subjects: str = "paper"
    """Ids separated by commas, "paper" (the nine of the comparison) or "ablation" (306)."""
    sequences: str = "paper"
    """Names or unique prefixes separated by commas; "paper" (the ten of UNION10, and FREE); "all" (except the tongue and
    GLASSES)."""
    split: Literal["free", "union10"] = "free"
    """"free" holds out FREE for self-reenactment; "union10" holds out one of the ten sequences by VHAP's seeded
    rule. The frontal camera is held out for novel views either way."""
    tracking: str = ""
    """Folder with VHAP's results. Without it images and cameras are written; run again when tracking is available."""
    head: str = ""
    """Head model the tracking belongs to (flame2023.pkl, or npz): checked against it, never copied if FLAME's."""
    head_model: str = ""
    """Version of the head model the tracking belongs to; default: that of --head, or flame2023 without --head."""
    cameras: str = ""
    """Serials separated by commas; default: all in the calibration."""
    downscale: int = 4
    """Width and height are divided by this, averaging areas; 4 makes 550x802 of 2200x3208."""
    source: Literal["auto", "video", "images"] = "auto"
    """Source if a sequence has both; "auto" uses images if they have masks."""
    every: int = 0
    """Frame stride; 0 stands for 3 with the 73-per-second videos and 1 with VHAP's images."""
    colour: Literal["auto", "none"] = "auto"
    """"auto" corrects colours where the recording has a calibration for that; "none" never."""
    edges: Literal["unblend", "plain"] = "unblend"
    """Soft edges with masks: "unblend" removes the light of the BACKGROUND still, if there is one; "plain" multiplies
    by the mask, as VHAP does, which leaves fringes."""
    cut: bool = False
    """If cameras have different frames, keep the common ones instead of raising an error; tracking is cut accordingly."""
    workers: int = 0
    """Number of cameras processed at a time; 0 stands for one per processor core."""
    check: bool = False
    """Only check whether all required files exist."""
    union_root: str = ""
    """Instead of preparing, check captures exported elsewhere: a folder of UNION folders, such as GaussianAvatars'
    download. Only --subjects and --rejoin can be combined with it."""
    rejoin: bool = False
    """With --union-root, also write unions of the paper's split (FREE held out) beside them; copies nothing."""

    dependent = (
        DependentOptions(
            (
                *(
                    "out",
                    "sequences",
                    "split",
                    "tracking",
                    "head",
                    "head_model",
                    "cameras",
                    "downscale",
                    "source",
                ),
                *("every", "colour", "edges", "cut", "workers", "check"),
            ),
            "union_root",
            False,
        ),
        DependentOptions(("rejoin",), "union_root"),
    )


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
    """The available sequence with that name or unique prefix. Prefixes that end before a hyphen are preferred:
    ``SEN-1`` is ``SEN-1-...`` and not ``SEN-10-...``. Raises `InputError` if none or several fit."""
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
    ``subject`` is the id as text, leading zeros included."""
    return UNION10_SEQUENCES[random.Random(subject).randint(0, len(UNION10_SEQUENCES) - 1)]


def chosen_subjects(text: str, option: str = "--subjects") -> list[str]:
    """Subject ids of an option: ids separated by commas, ``paper`` (the nine) or ``ablation``. Numbers are padded to
    three digits, so 74 is 074."""
    if text in SUBJECT_NAMES:
        return [*SUBJECT_NAMES[text]]
    ids = [part.strip() for part in text.split(",") if part.strip()]
    if not ids or not all(part.isascii() and part.isdigit() for part in ids):
        expected = 'numbers separated by commas, "paper" or "ablation"'
        raise InputError("command line", option, expected, repr(text))
    padded = [part.zfill(3) for part in ids]
    if len(set(padded)) != len(padded):
        raise InputError("command line", option, "every subject once", repr(text))
    return padded

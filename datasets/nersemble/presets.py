"""Which subjects, sequences and cameras the field evaluates on, and what is held out.

Sources: "3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations"
(CVPR 2025), section 4 and supplement, for the subjects and the split by FREE; VHAP's union export for the ten
sequences and the rule that holds one of them out.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from ...bench.errors import InputError

SUBJECTS = ("074", "104", "165", "175", "210", "218", "264", "302", "304")
"""The nine subjects of the paper's comparison."""

ABLATION_SUBJECT = "306"
"""Subject of the paper's Table 4; not one of the nine."""

SUBJECT_NAMES = {"paper": SUBJECTS, "ablation": (ABLATION_SUBJECT,)}
"""What names stand for where subjects are asked for."""

NOVEL_VIEW_CAMERA = "222200037"
"""The frontal camera, held out for novel views."""

FRONTAL_INDEX = 8
"""Its index in the rig, by which exports without serials name it."""

TEST_SEQUENCE = "FREE"
"""The unscripted performance, held out for self-reenactment."""

UNION10_SEQUENCES = (
    *("EMO-1-shout+laugh", "EMO-2-surprise+fear", "EMO-3-angry+sad", "EMO-4-disgust+happy"),
    *("EXP-2-eyes", "EXP-3-cheeks+nose", "EXP-4-lips", "EXP-5-mouth", "EXP-8-jaw-1", "EXP-9-jaw-2"),
)
"""The ten sequences of a UNION10 capture, in VHAP's order."""

PAPER_SEQUENCES = (*UNION10_SEQUENCES, TEST_SEQUENCE)
"""Training sequences and FREE: tongue, hair, glasses and head-turning sequences are usually left out."""


def union10_held_out(subject: str, sequences: Sequence[str] = UNION10_SEQUENCES) -> str:
    """Sequence that VHAP's union export holds out of ten: drawn by Python's generator, seeded with the subject.

    ``subject`` is the id as text, leading zeros included.
    """
    return sequences[random.Random(subject).randint(0, len(sequences) - 1)]


def chosen_subjects(text: str, key: str = "--subjects") -> list[str]:
    """Subject ids of an option: ids separated by commas, ``paper`` (the nine) or ``ablation``.

    Numbers are padded to three digits, so 74 is 074. Raises `InputError` for anything else and for twins.
    """
    if text in SUBJECT_NAMES:
        return [*SUBJECT_NAMES[text]]
    ids = [part.strip() for part in text.split(",") if part.strip()]
    if not ids or not all(part.isascii() and part.isdigit() for part in ids):
        raise InputError(
            "command line", key, 'numbers separated by commas, "paper" or "ablation"', repr(text)
        )
    padded = [part.zfill(3) for part in ids]
    if len(set(padded)) != len(padded):
        raise InputError("command line", key, "every subject once", repr(text))
    return padded

"""Find participants, sequences, calibrations and stills in any of NeRSemble's raw layouts.

=============================  =================================  ======================================
second release                 first release, parts merged        the ten sequences of the 2023 paper
=============================  =================================  ======================================
``ID/calibration/camera_...``  ``camera_params/ID/camera_...``    ``ID/camera_params.json``
``ID/calibration/color_...``   ``color_correction/ID/SER.npy``    ``ID/annotations/SEQ/color_correction``
``ID/sequences/SEQ/images/``   ``ID/SEQ/``                        ``ID/sequences/SEQ/frame_%05d/``
=============================  =================================  ======================================

The benchmark toolkit's folders read as the second release. Parts of the first release that were not merged
(``sequence_SEQ_part-N/ID/SEQ``) are found too. Nothing is decoded here; `sequence` looks into the videos.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ...bench.errors import InputError
from ...bench.io.documents import read_json
from ...bench.io.files import check_name
from .colour import Correction, affine_correction, polynomial_correction
from .names import BACKGROUND, is_subject, match_sequence, serial_of

CAMERA_FILE = "camera_params.json"
COLOUR_FILE = "color_calibration.json"
SEQUENCES_FILE = "metadata_sequences.csv"
_AVAILABLE = ("x", "m")


@dataclass(frozen=True, eq=False)
class Participant:
    """One participant's folder in a recording.

    Attributes
    ----------
    subject : three-digit id.
    calibration_file : ``camera_params.json``.
    sequences : folder by full sequence name, ``BACKGROUND`` left out.
    backgrounds : still of the empty set by serial.
    listed : sequences that the release's metadata lists; empty where there is none.
    """

    subject: str
    calibration_file: Path
    sequences: Mapping[str, Path]
    backgrounds: Mapping[str, Path] = field(default_factory=dict)
    listed: tuple[str, ...] = ()
    colour_file: Path | None = None
    colour_folder: Path | None = None

    def match(self, wanted: str) -> str:
        """Full name of a sequence given by name or unique prefix. Raises `InputError` where none is there."""
        try:
            return match_sequence(self.calibration_file, wanted, self.sequences)
        except InputError as error:
            remedy = "Fetch it, or name the sequences to use with --sequences."
            recorded = [name for name in self.listed if name == wanted or name.startswith(wanted)]
            if recorded and not any(name in self.sequences for name in recorded):
                remedy = f"{SEQUENCES_FILE} lists {', '.join(recorded)}. {remedy}"
            raise InputError(error.file, error.key, error.expected, error.found, remedy) from None

    def corrections(self, sequence: str, serials: Iterable[str]) -> dict[str, Correction]:
        """Colour correction by serial; empty where the recording has no colour calibration.

        Raises `InputError` where there is one, but not for all of ``serials``.
        """
        if self.colour_file is not None:
            entries = read_json(self.colour_file)
            return {s: polynomial_correction(self.colour_file, s, entries.get(s)) for s in serials}
        folders = (
            self.colour_folder,
            self.calibration_file.parent / "annotations" / sequence / "color_correction",
        )
        for folder in folders:
            if folder is not None and folder.is_dir():
                return {serial: affine_correction(folder / f"{serial}.npy") for serial in serials}
        return {}


def participants(root: Path) -> dict[str, Participant]:
    """Participants under ``root`` by id. Raises `InputError` where there is none."""
    if not root.is_dir():
        raise InputError(root, "", "a folder with recordings", "a file" if root.exists() else "nothing")
    listed = _listed_sequences(root)
    ids = {path.name for path in root.iterdir() if path.is_dir() and is_subject(path.name)}
    parts = [part for part in sorted(root.glob("sequence_*_part-*")) if part.is_dir()]
    ids |= {path.name for part in parts for path in part.iterdir() if path.is_dir() and is_subject(path.name)}
    found = {name: _participant(root, parts, name, listed.get(name, ())) for name in sorted(ids)}
    if not found:
        expected = "folders named after participants (three digits), such as 074"
        names = ", ".join(sorted(path.name for path in root.iterdir())[:5]) or "an empty folder"
        raise InputError(root, "", expected, names, "Give the folder that holds the participants' folders.")
    return found


def participant(root: Path, subject: str) -> Participant:
    """One participant, with calibration. Raises `InputError` where the recording lacks either."""
    known = participants(root)
    if subject not in known:
        raise InputError(root, "subject", f"one out of {', '.join(known)}", subject)
    one = known[subject]
    if not one.calibration_file.exists():
        raise InputError(
            one.calibration_file,
            "",
            "the calibration of the cameras",
            "no such file",
            "Download calibrations.",
        )
    return one


def _participant(root: Path, parts: Iterable[Path], subject: str, listed: tuple[str, ...]) -> Participant:
    folder = root / subject
    sequences: dict[str, Path] = {}
    for parent in (folder / "sequences", folder, *(part / subject for part in parts)):
        if parent == folder and (folder / "sequences").is_dir():
            continue
        for path in sorted(parent.iterdir()) if parent.is_dir() else ():
            if path.is_dir() and path.name not in ("calibration", "annotations"):
                sequences.setdefault(check_name(path.name, parent, "sequence"), path)
    stills = sequences.pop(BACKGROUND, None)
    named = {serial_of(path.stem, "image"): path for path in stills.glob("image_*.*")} if stills else {}
    colour_file = folder / "calibration" / COLOUR_FILE
    return Participant(
        subject=subject,
        calibration_file=_calibration_file(root, subject),
        sequences=sequences,
        backgrounds={serial: path for serial, path in sorted(named.items(), key=str) if serial},
        listed=listed,
        colour_file=colour_file if colour_file.exists() else None,
        colour_folder=root / "color_correction" / subject,
    )


def _calibration_file(root: Path, subject: str) -> Path:
    choices = (
        root / subject / "calibration" / CAMERA_FILE,
        root / "camera_params" / subject / CAMERA_FILE,
        root / subject / CAMERA_FILE,
    )
    return next((path for path in choices if path.exists()), choices[0])


def _listed_sequences(root: Path) -> dict[str, tuple[str, ...]]:
    """Sequences that ``metadata_sequences.csv`` marks as available (``x`` or ``m``), by participant."""
    path = root / SEQUENCES_FILE
    if not path.exists():
        return {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = [*csv.DictReader(stream)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, "", "a CSV file in UTF-8", f"content that does not parse ({error})") from error
    if rows and "ID" not in rows[0]:
        raise InputError(
            path, "ID", "a column of participants", f"columns {', '.join(map(str, rows[0]))[:80]}"
        )
    return {
        str(row["ID"]).strip().zfill(3): tuple(
            name
            for name, cell in row.items()
            if name not in ("ID", "wears_glasses", None)
            and isinstance(cell, str)
            and cell.strip() in _AVAILABLE
        )
        for row in rows
    }

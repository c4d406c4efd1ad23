"""Which head is dressed: the procedural one or a file, with the translation that plays performances on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.io.arrays import read_npz
from ..head.arrays import HeadArrays
from ..head.ict import expression_names, ict_head, is_ict
from ..head.procedural.model import procedural_head
from .anatomy import Anatomy
from .controls import EXPRESSION_CONTROLS, Translation
from .mouth import MouthPart, procedural_parts, tongue
from .people import Person
from .translations import ict_targets, named_translation, procedural_translation

PROCEDURAL = ("procedural", "procedural2020", "procedural2023")


@dataclass(frozen=True, eq=False)
class Geometry:
    """A head model that can be performed and dressed.

    ``mouth(person, anatomy, shape)`` makes the parts in the mouth that the head model lacks.
    """

    head: HeadArrays
    translation: Translation
    mouth: Callable[[Person, Anatomy, FloatArray], Sequence[MouthPart]]
    source: str


def load_geometry(name: str) -> Geometry:
    """``procedural`` (or ``procedural2020``, ``procedural2023``), or the path of an ICT-FaceKit npz.

    Raises
    ------
    InputError
        Where the file is no ICT-FaceKit npz: other models' coefficients have no semantic translation here.
    """
    if name in PROCEDURAL:
        return _procedural(name.removeprefix("procedural") or "2023")
    path = Path(name)
    if not path.is_file():
        raise InputError("--head", "", f"{', '.join(PROCEDURAL)} or an existing file", name)
    content = read_npz(path)
    if not is_ict(content):
        raise InputError(
            path, "", "an ICT-FaceKit npz", f"{', '.join(sorted(content))}", "Or take the procedural head."
        )
    head = ict_head(path, content)
    targets = {control: dict.fromkeys(ict_targets(control), 1.0) for control in EXPRESSION_CONTROLS}
    translation = named_translation(head, expression_names(content), targets)

    def mouth(person: Person, anatomy: Anatomy, shape: FloatArray) -> Sequence[MouthPart]:
        return (tongue(person, anatomy, len(head.parents)),)

    return Geometry(head, translation, mouth, "ict-facekit")


def _procedural(version: str) -> Geometry:
    head = procedural_head(version)

    def mouth(person: Person, anatomy: Anatomy, shape: FloatArray) -> Sequence[MouthPart]:
        return procedural_parts(person, head, shape)

    return Geometry(head, procedural_translation(head), mouth, head.version)

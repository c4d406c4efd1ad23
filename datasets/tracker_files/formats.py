"""Supported trackers; add a new tracker as an entry of this table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ...bench.errors import InputError
from ...bench.io.arrays import Member
from . import metrical, pixel3dmm
from .frames import FOLDER, SUFFIX, Convert, frame_files, read_members
from .pictures import Layout


@dataclass(frozen=True)
class TrackerFormat:
    """A tracker's files.

    Attributes
    ----------
    name : str
        As in ``--format``.
    summary : str
        One line for help and messages.
    mark : str
        Name of an array that only files of this tracker have.
    members : Mapping[str, Member]
        Arrays of a file that are read.
    convert : Convert
        Makes a timestep of them.
    layout : Layout
        Locations of images and masks.
    """

    name: str
    summary: str
    mark: str
    members: Mapping[str, Member]
    convert: Convert
    layout: Layout


FORMATS = {
    one.name: one
    for one in (
        TrackerFormat(
            name="metrical",
            summary="Metrical Tracker's checkpoint/*.frame, also in the layout of FlashAvatar",
            mark="opencv.K",
            members=metrical.MEMBERS,
            convert=metrical.metrical_frame,
            layout=Layout(images={"imgs": 1, "input": 0, "images": None}, masks=("alpha", "mask")),
        ),
        TrackerFormat(
            name="pixel3dmm",
            summary="Pixel3DMM's checkpoint/*.frame",
            mark=pixel3dmm.MARK,
            members=pixel3dmm.MEMBERS,
            convert=pixel3dmm.pixel3dmm_frame,
            layout=Layout(images={"cropped": 0}, labels="seg_og", subject=(1, 18), resized=True),
        ),
    )
}


def recognise(root: Path, name: str = "") -> TrackerFormat:
    """The format ``name``, or the one of the files under ``root``.

    Raises `InputError` for an unknown name, a folder without such files, and files of no known tracker.
    """
    if name and name not in FORMATS:
        raise InputError("command line", "--format", ", ".join(FORMATS), repr(name))
    known = "; ".join(one.summary for one in FORMATS.values())
    first = next(iter(frame_files(root).values()), None)
    if first is None:
        expected = f"the output of a tracker: {known}"
        found = f"no {FOLDER}/*{SUFFIX}" if root.is_dir() else "no such folder"
        remedy = "Exports of VHAP need no import: `headbench lint` and `headbench run` read them."
        raise InputError(root, "", expected, found, remedy)
    if name:
        return FORMATS[name]
    names = read_members(first)
    fitting = [one for one in FORMATS.values() if one.mark in names]
    if len(fitting) != 1:
        found = f"a file with {', '.join(names)}"
        raise InputError(first, "", f"arrays of one of: {known}", found, "Name the format with --format.")
    return fitting[0]

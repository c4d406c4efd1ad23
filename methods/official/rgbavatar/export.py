"""Export of videos and lists of frames for RGBAvatar's loader, in the layout of Metrical Tracker and INSTA.

A folder of a subject has ``images/00000.png``, straight alpha, and ``checkpoint/00000.frame``, numbered alike without
gaps. Of a frame's file the loader reads coefficients, jaw, eyes and eyelids, the rotation and translation of the OpenCV
camera, and of frame 0 K and the image size too: all frames share them. It moves the head's motion into the neck joint.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ....bench.contracts import FloatArray, HeadAsset
from ....bench.errors import InputError
from ....bench.io.arrays import read_npy, read_npz
from ....bench.io.files import read_bytes, write_bytes, write_text
from ...shared.avatar_files import Subject
from ..checkout import Checkout
from ..ga.head_files import OfficialHead, SparseMatrix, pickled
from ..video import FlameSubject, at_rest, frame_name, image_name, write_torch
from ..workplace import Listed, Workplace, write_placeholder

DATA = Path("data/FLAME2020")
MODEL_FILE, CHART_FILE = DATA / "generic_model.pkl", DATA / "flame_uv.npz"
EYELID_FILES = (DATA / "l_eyelid.npy", DATA / "r_eyelid.npy")
CONFIG = Path("config/offline.yaml")


def has_their_topology(head: HeadAsset, checkout: Checkout) -> bool:
    """Whether a head without its teeth has as many vertices as an eyelid basis of a checkout."""
    return len(OfficialHead.numbered(head).order) == len(read_npy(checkout.folder / EYELID_FILES[0]))


def chart_of(head: HeadAsset) -> FloatArray:
    """(F, 3, 2) float64 texture coordinates of a head. Raises `InputError` if it has none."""
    uv = getattr(head, "uv", None)
    if uv is None:
        remedy = (
            "Refit the capture to FLAME 2020 (headbench prepare refit), or use the condition packed-chart."
        )
        expected = "texture coordinates, or FLAME's topology"
        raise InputError(f"head model {head.version!r}", "uv", expected, "none", remedy)
    return np.asarray(uv, np.float64)


def flame_subject(subject: Subject, head: HeadAsset, checkout: Checkout, *, own_chart: bool) -> FlameSubject:
    """The head model, with its teeth if its own chart is used, and one identity."""
    if own_chart:
        chart_of(head)
        return FlameSubject.whole(head, subject)
    lid = EYELID_FILES[0]
    found = FlameSubject.of(head, subject, len(read_npy(checkout.folder / lid)), lid)
    chart = read_npz(checkout.folder / CHART_FILE)
    triangles = np.asarray(chart.get("ft", ()))
    if triangles.shape != found.official.faces.shape:
        expected = f"{len(triangles)} triangles, as {CHART_FILE} has"
        count = str(len(found.official.faces))
        raise InputError(f"head model {head.version!r}", "faces", expected, count)
    return found


def write_program(identity: Subject, head: HeadAsset, work: Workplace, *, own_chart: bool) -> FlameSubject:
    """Write the files that the program opens relative to its working directory: head model, chart and eyelids.

    Returns the identity on the head model; raises the errors of `flame_subject`.
    """
    subject, folder = flame_subject(identity, head, work.checkout, own_chart=own_chart), work.program
    model = subject.model()
    sparse = SparseMatrix(model["J_regressor"])
    write_bytes(folder / MODEL_FILE, pickled({**model, "J_regressor": sparse}))
    subject.official.write_eyelids(*(folder / name for name in EYELID_FILES))
    if own_chart:
        uv = chart_of(head)
        corners = np.arange(3 * len(uv)).reshape(-1, 3)
        content = io.BytesIO()
        np.savez(content, vt=uv.reshape(-1, 2), ft=corners)
        write_bytes(folder / CHART_FILE, content.getvalue())
    else:
        chart = read_bytes(work.checkout.folder / CHART_FILE, "a texture chart")
        write_bytes(folder / CHART_FILE, chart)
    return subject


def write_config(path: Path, checkout: Checkout, changes: Mapping[str, Any]) -> None:
    """Write their published configuration with other values of some entries."""
    source = checkout.folder / CONFIG
    text = read_bytes(source, "a configuration").decode(errors="replace")
    for name, value in changes.items():
        text, count = re.subn(rf"^(\s*{name}:).*$", rf"\g<1> {value}", text, flags=re.MULTILINE)
        if count != 1:
            remedy = "Check out the commit that the adapter was written for."
            raise InputError(source, name, "one entry", f"{count}", remedy)
    write_text(path, text)


def write_list(frames: Sequence[Listed], subject: FlameSubject, folder: Path) -> None:
    """Write frames of one camera's intrinsics as a video.

    Images have one pixel: the renderer loads but does not use them, and takes the size from the first frame's file.
    """
    for index, frame in enumerate(at_rest(subject.posed, frames)):
        write_placeholder(folder / image_name(index))
        write_torch(folder / frame_name(index), subject.frame(frame.camera, frame.pose))

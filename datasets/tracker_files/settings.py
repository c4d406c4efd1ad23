"""Settings of ``headbench import tracking``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from ..options import Cut


@dataclass(frozen=True)
class ImportTrackingSettings:
    """Settings of ``headbench import tracking``."""

    source: Annotated[str, tyro.conf.Positional]
    """Output of a tracker: the folder with checkpoint/00000.frame, or checkpoint itself."""

    head: str
    """Head model that the tracker used: FLAME pickle or npz, or a version of the procedural head. Metrical Tracker uses FLAME
    2020."""

    out: str
    """Folder for the capture, import.json and overlay.png."""

    format: str = ""
    """metrical (Metrical Tracker, FlashAvatar) or pixel3dmm; default: recognised by the files."""

    images: str = ""
    """Folder of the images that were tracked, cropped and resized as the tracker read them, named by numbers; default: imgs,
    input or images (metrical), cropped (pixel3dmm), in the tracker's folder or beside it."""

    first_image: int | None = None
    """Number in the name of the image of frame 0; default: 0 in input and cropped, 1 in imgs as in FlashAvatar, else the
    lowest number in the folder."""

    masks: str = ""
    """Folder of masks named as the images; default: alpha or mask beside the images, times parsing/*_neckhead if there are
    any (metrical); seg_og (pixel3dmm); or the alpha channels of the images."""

    cut: Cut = "bust-line"
    """Part of the person that is replaced by background, since no head model explains it: all below a line through the front of
    the neck's lower end, as VHAP's export does, or nothing."""

    parsing: str = ""
    """Folder of label images (19 classes of CelebAMask-HQ) named as the images: clothes are cut by them instead."""

    subject: str = ""
    """Name of the subject; default: that of the folder."""

    held_out_frames: int | None = None
    """Number of last frames held out for self-reenactment; default: 350, or a quarter of fewer than 700."""

    @staticmethod
    def notes() -> str:
        """More text for the help."""
        return (
            "Exports of VHAP (videos of one camera or several) need no import: the reader ga reads them, and every command "
            "takes their folder. The files of INSTA's generate.sh are read by the reader monocular. SMIRK, DECA and EMOCA "
            "estimate expressions in crops without a camera, from which no capture can be made."
        )

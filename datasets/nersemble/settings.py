"""Options of the commands on NeRSemble recordings; light to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro


@dataclass(frozen=True)
class PrepareSettings:
    """What to prepare, from where, and how.

    Attributes
    ----------
    root : Folder with raw recordings: the one that holds the participants' folders.
    out : Folder for the captures.
    subjects : Ids separated by commas, "paper" (the nine of the comparison) or "ablation" (306).
    sequences : Names or unique prefixes separated by commas; "paper" (the ten of UNION10, and FREE), "all" (but
        the tongue and GLASSES).
    split : "free" holds out FREE for self-reenactment; "union10" holds out one of the ten sequences by VHAP's
        seeded rule. The frontal camera is held out for novel views either way.
    tracking : Folder with VHAP's results, or "" to write images and cameras only; call again once there are some.
    head : Head model the tracking belongs to (flame2023.pkl, or npz); checked against it, never copied if FLAME's.
    head_model : Version of that head model, where no head is given.
    cameras : Serials separated by commas; "" takes all the calibration has.
    downscale : Width and height are divided by this, averaging areas; 4 makes 802x550 of 3208x2200.
    source : Take "video" or "images" where a sequence has both; "auto" takes images where they come with mattes.
    every : Keep every so many frames; 0 takes 3 of the 73-per-second videos, 1 of VHAP's images.
    colour : "auto" corrects colours where the recording has a calibration for that; "none" never.
    cut : Keep the frames that all cameras have where their counts differ, instead of an error.
    workers : Cameras worked on at one time; 0 takes one per processor core.
    check : Only look whether everything needed is there.
    union_root : Instead of preparing, check captures exported elsewhere (a folder of UNION folders, such as
        GaussianAvatars' download).
    rejoin : With `union_root`, also write unions of the paper's split (FREE held out) beside them.
    """

    root: str = ""
    out: str = "nersemble-captures"
    subjects: str = "paper"
    sequences: str = "paper"
    split: Literal["free", "union10"] = "free"
    tracking: str = ""
    head: str = ""
    head_model: str = "flame2023"
    cameras: str = ""
    downscale: int = 4
    source: Literal["auto", "video", "images"] = "auto"
    every: int = 0
    colour: Literal["auto", "none"] = "auto"
    cut: bool = False
    workers: int = 0
    check: bool = False
    union_root: str = ""
    rejoin: bool = False


@dataclass(frozen=True)
class RecordSettings:
    """What to write as a raw recording.

    Attributes
    ----------
    capture : Synthetic capture: a UNION folder, as `headbench synth` writes them.
    out : Folder to write: ``recording`` goes to --root of `headbench prepare nersemble`, ``tracking`` to --tracking,
        ``head_model.npz`` to --head.
    release : Whose folders: of the second release, of the first, or of the 2023 paper.
    frames : "images" with mattes, as VHAP's preprocessing leaves them, or "video" without.
    """

    capture: tyro.conf.Positional[str]
    out: str
    release: Literal["v2", "v1", "paper2023"] = "v2"
    frames: Literal["images", "video"] = "images"

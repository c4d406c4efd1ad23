"""Settings of the conversion of NeRSemble recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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

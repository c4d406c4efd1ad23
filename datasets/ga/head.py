"""The head model that belongs to a capture."""

from __future__ import annotations

from pathlib import Path

from ...bench.errors import InputError
from ..head.arrays import HeadArrays
from ..head.loaders import load_head
from .layout import DECLARATION_FILE, HEAD_FILE, Declaration

FLAME_MASKS_FILE = "FLAME_masks.pkl"


def find_head(
    folder: Path,
    declaration: Declaration | None,
    head: HeadArrays | str | Path | None,
    *,
    masks: str | Path | None = None,
    regions: str | Path | None = None,
) -> HeadArrays:
    """Head model of a capture.

    Parameters
    ----------
    folder : of the capture.
    head : the head model or its file; None takes the file that ``headbench.json`` names, else the capture's
        ``head_model.npz``.
    masks, regions : see `load_head`. For a FLAME pickle a ``FLAME_masks.pkl`` beside it is used by itself.

    Raises
    ------
    InputError
        Where there is no such file, or its version is not the one the capture was tracked with.
    """
    if isinstance(head, HeadArrays):
        asset = head
    else:
        path = Path(head) if head else folder / (declaration.head_file if declaration else HEAD_FILE)
        asset = _load(path, masks, regions)
    if declaration and asset.version != declaration.head_model:
        raise InputError(
            folder / DECLARATION_FILE,
            "head_model",
            f"{asset.version}, the version of the head model given",
            declaration.head_model,
            "Coefficients of one head model mean nothing to another.",
        )
    return asset


def _load(path: Path, masks: str | Path | None, regions: str | Path | None) -> HeadArrays:
    if not path.exists():
        raise InputError(
            path,
            "",
            "the head model the capture was tracked with",
            "no such file",
            "Captures of NeRSemble subjects need flame2023.pkl (FLAME 2023, versions with jaw rotation) from "
            "https://flame.is.tue.mpg.de; give its path as head=. Synthetic captures hold their own.",
        )
    beside = path.with_name(FLAME_MASKS_FILE)
    if masks is None and path.suffix != ".npz" and beside.exists():
        masks = beside
    return load_head(path, masks=masks, regions=regions)

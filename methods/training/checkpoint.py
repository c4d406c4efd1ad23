"""Checkpoints: tensors and plain containers, written whole or not at all, read as data only."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch

from ...bench.errors import InputError
from ...bench.files import atomic_path

LAYOUT = 1


def save_checkpoint(path: Path, run: str, state: dict[str, Any]) -> None:
    """Write the state of a run.

    Parameters
    ----------
    run : digest of everything the run was started with; `load_checkpoint` refuses another run's file.
    state : nested dicts and lists of tensors, numbers and text.
    """
    with atomic_path(path) as temporary:
        torch.save({"layout": LAYOUT, "run": run, "state": state}, temporary)


def load_checkpoint(path: Path, run: str, device: str) -> dict[str, Any] | None:
    """Read the state of a run, or None where there is no checkpoint.

    Raises `InputError` for a damaged file or one that belongs to other settings, another clip, budget or seed.
    """
    if not path.exists():
        return None
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(path, "", "a checkpoint", reason, "Delete it to start over.") from error
    if not isinstance(content, dict) or content.get("layout") != LAYOUT or "state" not in content:
        raise InputError(path, "layout", str(LAYOUT), "another layout", "Delete it to start over.")
    if content.get("run") != run:
        raise InputError(
            path,
            "run",
            "a checkpoint of this method, clip, settings, budget and seed",
            "one of another run",
            "Use another output folder, or delete it to start over.",
        )
    return content["state"]

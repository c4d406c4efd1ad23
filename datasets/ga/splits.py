"""Frame keys and splits of a capture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path

from ...bench.contracts import FrameKey
from ...bench.errors import InputError
from .layout import parse_sequence_folder
from .transforms import FrameEntry


def sequence_names(entries: Iterable[FrameEntry], declared: Mapping[str, str]) -> dict[str, str]:
    """Sequence name by sequence folder: the declared one, else what the folder's name says.

    Folders whose names would say the same keep their whole names.
    """
    folders = sorted({entry.sequence_folder for entry in entries})
    names = {folder: declared.get(folder) or parse_sequence_folder(folder)[1] for folder in folders}
    taken = [*names.values()]
    return {folder: name if taken.count(name) == 1 else folder for folder, name in names.items()}


def check_disjoint(file: Path, splits: Mapping[str, Sequence[FrameKey]]) -> None:
    """Raise `InputError` where a key stands twice, in one split or in two."""
    for name, keys in splits.items():
        if len(set(keys)) != len(keys):
            twice, count = Counter(keys).most_common(1)[0]
            raise InputError(file, name, "every frame once", f"{twice} {count} times")
    for one, other in combinations(splits, 2):
        shared = sorted(set(splits[one]) & set(splits[other]))
        if shared:
            found = f"{len(shared)} frames in both, such as {shared[0]}"
            raise InputError(file, f"{one} and {other}", "splits that share no frame", found)


def split_by_holding_out(
    file: Path, keys: Iterable[FrameKey], sequences: Sequence[str], cameras: Sequence[str]
) -> dict[str, tuple[FrameKey, ...]]:
    """Split frames by what is held out.

    All frames of the held-out sequences are self-reenactment, the held-out cameras' other frames are novel
    view, and the rest is training.

    Parameters
    ----------
    sequences : full names, or prefixes that one sequence alone has.
    cameras : camera ids.
    """
    keys = sorted(set(keys))
    available = sorted({key.sequence for key in keys})
    held_out = {_match(file, wanted, available) for wanted in sequences}
    unknown = sorted(set(cameras) - {key.camera for key in keys})
    if unknown:
        known = ", ".join(sorted({key.camera for key in keys}))
        raise InputError(file, "held_out_cameras", f"ids out of {known}", ", ".join(unknown))
    test = tuple(key for key in keys if key.sequence in held_out)
    others = [key for key in keys if key.sequence not in held_out]
    return {
        "train": tuple(key for key in others if key.camera not in cameras),
        "novel_view": tuple(key for key in others if key.camera in cameras),
        "self_reenactment": test,
    }


def _match(file: Path, wanted: str, available: Sequence[str]) -> str:
    matches = [name for name in available if name == wanted] or [n for n in available if n.startswith(wanted)]
    if len(matches) != 1:
        found = f"{wanted!r}, which fits {', '.join(matches) or 'none'}"
        raise InputError(file, "held_out_sequences", f"one sequence out of {', '.join(available)}", found)
    return matches[0]

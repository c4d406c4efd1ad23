"""Leave labelled frames out of every split: FLAME has no tongue, so frames that show one are not compared."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from os import PathLike
from pathlib import Path

from ...bench.contracts import FrameKey
from ...bench.errors import InputError
from ...bench.io.documents import read_json
from ..clip import CaptureClip
from .exclusion_file import read_exclusions


def exclude_timesteps(
    clip: CaptureClip,
    reasons: Mapping[int, str],
    *,
    only: Collection[str] = (),
    source: str | PathLike[str] = "excluded frames",
) -> CaptureClip:
    """Move the labelled timesteps of a clip from its splits to `excluded`, with their reasons.

    Parameters
    ----------
    reasons : label by timestep, such as {57: "tongue out"}.
    only : labels to act on; empty means all.
    source : where the reasons come from; named in the error.

    Raises
    ------
    InputError
        Where a timestep is not in the clip, or no training frame would be left.
    """
    unknown = sorted(set(reasons) - set(clip.poses))
    if unknown:
        expected = f"timesteps of the clip, 0 to {max(clip.poses)}"
        raise InputError(source, "timestep", expected, ", ".join(map(str, unknown)))
    chosen = {t: reason for t, reason in reasons.items() if not only or reason in only}
    gone = {key: chosen[key.timestep] for key in clip.files if key.timestep in chosen}
    splits = {name: tuple(key for key in keys if key not in gone) for name, keys in clip.splits.items()}
    if not splits["train"]:
        raise InputError(source, "timestep", "training frames left", "none left")
    parameters = {"reasons": {str(t): reason for t, reason in sorted(chosen.items())}}
    excluded: dict[FrameKey, str] = {**clip.excluded, **gone}
    return clip.derive("exclude_timesteps", parameters, splits=splits, excluded=excluded)


def exclude_given(clip: CaptureClip, exclude: Mapping[int, str] | str | Path | None) -> CaptureClip:
    """Leave out what a reader's setting ``exclude`` names: reason by timestep, or a file for `read_reasons`."""
    if isinstance(exclude, (str, Path)):
        return exclude_timesteps(clip, read_reasons(Path(exclude), clip), source=exclude)
    return exclude_timesteps(clip, exclude) if exclude else clip


def read_labels(path: Path) -> dict[int, str]:
    """Read frame labels: a JSON object {"<timestep>": "<reason>"}; `InputError` where it is none."""
    labels = {}
    for key, reason in read_json(path).items():
        if not (key.isascii() and key.isdigit() and isinstance(reason, str)):
            expected = "entries that map a timestep to a reason"
            raise InputError(path, key, expected, f"{key!r}: {reason!r}"[:80])
        labels[int(key)] = reason
    return labels


def read_reasons(path: Path, clip: CaptureClip) -> dict[int, str]:
    """Reasons by timestep for a clip: from the YAML of `exclusion_file`, or from JSON labels by the suffix.

    Raises
    ------
    InputError
        Where the file says nothing of the clip's subject, or numbers timesteps as another capture does.
    """
    if path.suffix.lower() == ".json":
        return read_labels(path)
    subjects = read_exclusions(path)
    if clip.subject not in subjects:
        found = ", ".join(subjects) or "no subjects"
        raise InputError(path, "subjects", clip.subject, found, "Run `headbench tongue` on this capture too.")
    decided = subjects[clip.subject]
    sequences = {key.timestep: key.sequence for key in clip.files}
    for timestep, frame in decided.frames.items():
        if sequences.get(timestep, frame.sequence) != frame.sequence:
            raise InputError(
                path,
                f"subjects.{clip.subject}.frames.{timestep}.sequence",
                f"{sequences[timestep]}, as the capture has it",
                frame.sequence,
                "The file was made for a capture that numbers its timesteps otherwise.",
            )
    return decided.reasons()

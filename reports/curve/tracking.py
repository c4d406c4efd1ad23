"""The captures of a run with other errors of tracking."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from ...bench.contracts import Clip
from ...bench.errors import InputError
from ...bench.progress import progress
from ...bench.registry import get, resolve
from ...bench.runner.captures import open_clips, synthesis_arguments
from ...bench.runner.config import RunConfig


def tracking_error(clip: Clip) -> float | None:
    """The level of tracking error that a clip's synthetic capture was made with; None for a recording."""
    made = clip.steps[0].parameters.get("synthetic") if clip.steps else None
    return float(made.get("tracking_error", 0.0)) if made else None


def clips_by_level(
    config: RunConfig, clips: Sequence[Clip], levels: Sequence[float]
) -> Iterator[tuple[float, list[Clip]]]:
    """The clips of a run by rising level of tracking error, from captures made in ``config.out`` with the same pictures.

    Raises `InputError` for captures that are not synthetic.
    """
    for clip in clips:
        if tracking_error(clip) is None:
            raise InputError(
                config.data, "--over", "a synthetic capture, to track with other errors", "a recording"
            )
    make = resolve(get("datasets", "synthetic").implementation)
    arguments = synthesis_arguments([asdict(step) for step in clips[0].steps], clips[0].subject)
    data = Path(config.data)
    pictures = data if (data / "synthesis.json").is_file() else data.parent  # of one subject's folder, or all
    for level in levels:
        capture = Path(config.out) / f"capture-tracking-{level:g}"
        with progress(f"tracking with error {level:g}") as report:
            make(capture, **{**arguments, "tracking_error": level}, pictures=pictures, progress=report)
        place = capture if pictures == data else capture / data.name
        found = {clip.subject: clip for clip in open_clips(replace(config, data=str(place)))}
        yield level, [found[clip.subject] for clip in clips]

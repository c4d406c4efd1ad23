"""The captures of a run with another level of tracking error: a registered change of clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from ..contracts import Clip
from ..engine.captures import open_clips, synthesis_arguments
from ..engine.config import RunConfig
from ..errors import InputError
from ..progress import progress
from ..registry import get, resolve


def tracking_error(steps: Sequence[Mapping[str, Any]]) -> float | None:
    """Tracking error level of a synthetic capture, from the steps of its clip; None for a recording."""
    made = steps[0].get("parameters", {}).get("synthetic") if steps else None
    return float(made.get("tracking_error", 0.0)) if made else None


def with_tracking_error(clip: Clip, config: RunConfig, *, level: float) -> Clip:
    """The clip of a capture with the same images and another level of tracking error, which is made in ``config.out``.

    Raises `InputError` for a capture that is not synthetic.
    """
    steps = [asdict(step) for step in clip.steps]
    if tracking_error(steps) is None:
        expected = "a synthetic capture, to track with other errors"
        raise InputError(config.data, "--over", expected, "a recording")
    data = Path(config.data)
    pictures = (
        data if (data / "synthesis.json").is_file() else data.parent
    )  # folder of one subject, or of all
    capture = Path(config.out) / f"capture-tracking-{level:g}"
    arguments = {**synthesis_arguments(steps, clip.subject), "tracking_error": level}
    make = resolve(get("datasets", "synthetic").implementation)
    with progress(f"tracking with error {level:g}") as report:
        make(capture, **arguments, pictures=pictures, progress=report)
    place = capture if pictures == data else capture / data.name
    return next(c for c in open_clips(replace(config, data=str(place))) if c.subject == clip.subject)

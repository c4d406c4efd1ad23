"""Settings of ``headbench run suite``, and its ablations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..engine.config import parse_size
from ..errors import InputError
from ..executors.settings import ExecutionOptions
from ..listing import presets_of_methods

SEED = 39_000
"""Seed of the suite's captures. Methods are tuned on captures with seeds below 10,000 (`docs/explanation/suite.md`)."""

ALL, NONE = "all", "none"

TRACKED, LEVEL, AS_TRACKED, EQUAL = "tracked", "tracking-{:g}", "as-tracked", "equal-iterations"
"""Names of conditions: tracking estimated from images; a level of simulated tracking errors; the capture's own tracking
without conversion; the same number of iterations as `EQUAL_TO`."""
EQUAL_TO = "ga"
TRACKED_METHODS = ("ga", "gbs", "ours", "ours-plus")
"""Default methods of the first two conditions."""

RUN, LARGE_RUN, SEEDS_RUN = "run", "run-large", "run-seeds"
"""Folders of a suite's runs, each with one folder per subject. Runs in the second have images of twice the size, those in
the third other training seeds."""


@dataclass(frozen=True)
class SuiteSettings(ExecutionOptions):
    """The whole benchmark: makes the synthetic subjects of the suite, trains and measures methods on all of them, and writes
    result tables.

    Subjects differ in shape, skin, hair and performance. Each subject has a separate run, so that subjects can be measured on
    different machines. If it is interrupted, the same command continues it. Takes hours.
    """

    out: str
    """Folder for captures, runs and results.md."""

    methods: tuple[str, ...] = ()
    """Methods; default: those of `headbench demo`."""

    preset: str = "fast"
    """Preset, as for `headbench run`, whose help lists the presets."""

    seeds: tuple[int, ...] = (0,)
    """Seeds of the training."""

    ablations: tuple[str, ...] = ()
    """Train a method with these parts left out or changed, too, each as a condition of the run (`headbench list methods --json` has
    their names and settings); or "all" those of ours."""

    tracked: tuple[str, ...] = ()
    """Methods trained a second time, on tracking estimated from the images as by `headbench track`, as condition `tracked` of
    the run; or "none". Default: those of ga, gbs, ours and ours-plus that run. Tracking takes about 1 second per timestep, once
    per subject, and each method one more training."""

    tracked_ablations: tuple[str, ...] = ()
    """Train ours with these parts left out or changed also under the conditions of --tracked and --levels, as conditions such
    as `no-lines-tracked`. This tests whether an effect depends on the tracking, for example lines-move-splats (Table 4 of the
    paper)."""

    levels: tuple[float, ...] = ()
    """Train the methods of --tracked a further time for each of these levels of simulated tracking errors (see `headbench synth`), as
    conditions such as `tracking-3`."""

    equal_iterations: tuple[str, ...] = ()
    """Methods trained a second time, with as many iterations as ga, as condition `equal-iterations`; or "none". Default: ours, if it
    runs and has another number of iterations."""

    subjects: int = 10
    """Number of the suite's subjects, from the first. Significant differences require 6 subjects for two
    methods, 8 for five methods, 9 for ten ablations."""

    first: int = 1
    """Begin with this subject, counted from 1. Earlier ones may have been measured on another machine."""

    large: int = 2
    """At most this many subjects, from the first, are also rendered at twice the size, in separate runs and tables, without
    conditions. Each takes about half a processor hour to render, twice as long as at the usual size."""

    repeated: int = 0
    """At most this many subjects, from the first, are also trained with two further seeds, without conditions, in separate
    runs; `results.md` then has the variance between and within subjects."""

    extremes: int = 10
    """Avatars of at most this many subjects, from the first, are also rendered in new poses and views, as by `headbench run
    extremes`. A frame that exceeds a limit is a result, not a failure."""

    cameras: int = 16
    """Number of cameras, including the held-out one."""

    timesteps: int = 96
    """Number of timesteps of each subject; a quarter is held out."""

    size: str = "275x401"
    """Width x height of the images in pixels."""

    performance: Literal["parts", "natural"] = "natural"
    """As for `headbench synth`; with `natural` each subject has another choreography."""

    tracking_error: float = 0.0
    """As for `headbench synth`."""

    tracker: Literal["per-frame", "video"] = "video"
    """As for `headbench synth`."""

    def __post_init__(self) -> None:
        """Refuse invalid sizes and names."""
        parse_size(self.size)
        for option in ("tracked", "equal_iterations"):
            names = getattr(self, option)
            if NONE in names and len(names) > 1:
                where = f"--{option.replace('_', '-')}"
                raise InputError("command line", where, f"names of methods, or {NONE}", " ".join(names))
        for name, least in (("large", 0), ("repeated", 0), ("extremes", 0), ("first", 1)):
            if getattr(self, name) < least:
                raise InputError("command line", f"--{name}", f"at least {least}", str(getattr(self, name)))
        if self.first > self.subjects:
            raise InputError(
                "command line", "--first", f"at most --subjects, {self.subjects}", str(self.first)
            )
        if any(not 0 < level <= 4 for level in self.levels):
            raise InputError(
                "command line", "--levels", "above 0 and at most 4", " ".join(map(str, self.levels))
            )

    @staticmethod
    def notes() -> str:
        """Description of the presets in the help."""
        return presets_of_methods()

    def tracked_of(self, methods: tuple[str, ...]) -> tuple[str, ...]:
        """Names of the run's methods with the condition `TRACKED`."""
        if self.tracked:
            return tuple(name for name in self.tracked if name != NONE)
        return tuple(name for name in TRACKED_METHODS if name in methods)

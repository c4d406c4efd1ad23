"""Settings of ``headbench run suite``, and its ablations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from ..engine.config import Isolation, parse_size
from ..errors import InputError
from ..executors.options import ExecutionOptions
from ..listing import presets_of_methods

SEED = 26_000
"""Of the suite's captures. Settings of methods are chosen on captures of seeds below 10,000 (`docs/explanation/statistics.md`)."""

ABLATIONS: Mapping[str, Mapping[str, Any]] = {
    "no-lines": {"lines": {"enabled": False}},
    "lines-move-splats": {"lines": {"dynamic": ["position", "rotation", "scale"]}},
    "no-penalty": {"penalty": {"weight": 0.0}},
    "no-balanced-sampling": {"sampling": {"balanced": False}},
    "harmonics": {"color": "sh"},
    "official": {"lines": {"bounds": "head"}},
    "weak-penalty": {"penalty": {"weight": 1e-3, "softness": 0.1}},
    "own-colors": {"planes": {"residual_lr": 1e-2}},
    "smooth-directions": {"planes": {"direction_smoothing": 0.3}},
    "fixed-positions": {"planes": {"move_splats": False}},
    "planned-sizes": {"capacity": {"mode": "auto"}},
}
"""Settings of the method "ours" by name of the ablation. The first two are the paper's Table 4; "official" is the choice of the
authors' program, lines in the whole head; the last five are the additions of "ours-plus", one by one."""

ALL, NONE = "all", "none"

TRACKED = "tracked"
"""Condition of methods that are trained on tracking estimated from the images."""
TRACKED_METHODS = ("ga", "gbs", "ours")
"""Methods that have this condition where none are named."""

RUN, LARGE_RUN = "run", "run-large"
"""Folders of a suite's runs; the second has images of twice the size."""


@dataclass(frozen=True)
class SuiteSettings(ExecutionOptions):
    """The whole benchmark: makes the suite's synthetic subjects, trains and measures methods on all, writes result tables.

    Subjects differ in shape, skin, hair and performance; their tracking has errors, and their held-out sequence parts: seen,
    recombined and beyond training, and speech. Started again after a kill it continues. Takes hours.
    """

    out: str
    """Folder for captures, runs and results.md."""

    methods: tuple[str, ...] = ()
    """Methods; default: those of `headbench demo`."""

    preset: str = "fast"
    """How much training, as for `headbench run`, whose help lists the presets."""

    seeds: tuple[int, ...] = (0,)
    """Seeds of the training."""

    ablations: tuple[str, ...] = ()
    """Train ours with these parts left out or changed, too, each as a condition of the run; or "all"."""

    tracked: tuple[str, ...] = ()
    """Methods trained a second time, on tracking estimated from the images as by `headbench track`, as condition `tracked` of
    the run; or "none". Default: those of ga, gbs and ours that run. Tracking takes about 1 second a timestep, once a
    subject; each method one more training."""

    subjects: int = 10
    """Number of the suite's subjects, from the first. Significant differences require 6 subjects for two
    methods, 8 for five methods, 9 for ten ablations."""

    large: int = 2
    """At most this many subjects, from the first, are also rendered at twice the size, with a run and tables of their own, without
    conditions. Each takes about half a processor hour to render, twice as long as at the usual size."""

    cameras: int = 16
    """Views of each, the held-out one included."""

    timesteps: int = 160
    """Of each subject; a quarter is held out."""

    size: str = "275x401"
    """Width x height of the images in pixels."""

    performance: Literal["parts", "natural"] = "natural"
    """As for `headbench synth`; with `natural` each subject has another choreography."""

    tracking_error: float = 1.0
    """As for `headbench synth`."""

    tracker: Literal["per-frame", "video"] = "video"
    """As for `headbench synth`."""

    isolation: Isolation = "plugins"
    """Methods that train and render in processes of their own, without access to test images (see SECURITY.md)."""

    def __post_init__(self) -> None:
        """Refuse invalid sizes and names."""
        parse_size(self.size)
        unknown = [name for name in self.ablations if name not in (*ABLATIONS, ALL)]
        if unknown:
            raise InputError("command line", "--ablations", f"{', '.join(ABLATIONS)} or {ALL}", unknown[0])
        if NONE in self.tracked and len(self.tracked) > 1:
            raise InputError(
                "command line", "--tracked", f"names of methods, or {NONE}", " ".join(self.tracked)
            )
        if self.large < 0:
            raise InputError("command line", "--large", "at least 0", str(self.large))

    @staticmethod
    def notes() -> str:
        """Description of the presets in the help."""
        return presets_of_methods()

    @property
    def chosen(self) -> tuple[str, ...]:
        """Names of the requested ablations, in the order of `ABLATIONS`."""
        return tuple(name for name in ABLATIONS if name in self.ablations or ALL in self.ablations)

    def tracked_of(self, methods: tuple[str, ...]) -> tuple[str, ...]:
        """Names of the methods that have the condition `TRACKED`, among those that run."""
        if self.tracked:
            return tuple(name for name in self.tracked if name != NONE)
        return tuple(name for name in TRACKED_METHODS if name in methods)

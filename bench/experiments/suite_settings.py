"""Settings of ``headbench run suite``, and its ablations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..engine.config import Isolation, parse_size
from ..errors import InputError
from ..executors.options import ExecutionOptions
from ..listing import presets_of_methods

SEED = 26_000
"""Of the suite's captures. Settings of methods are chosen on captures of seeds below 10,000 (`docs/explanation/statistics.md`)."""

ABLATIONS: Mapping[str, Mapping[str, Any]] = {
    "no-lines": {"lines": {"enabled": False}},
    "lines-move-splats": {"lines": {"dynamic": ["position", "rotation", "scale"]}},
    "lines-color": {"lines": {"dynamic": ["color"]}},
    "no-penalty": {"penalty": {"weight": 0.0}},
    "no-balanced-sampling": {"sampling": {"balanced": False}},
    "fixed-sizes": {"capacity": {"mode": "fixed"}},
    "harmonics": {"color": "sh"},
    "lines-in-head": {"lines": {"bounds": "head"}},
    "no-direction-smoothing": {"planes": {"direction_smoothing": 0.0}},
    "published": {
        "capacity": {"mode": "fixed"},
        "lines": {"bounds": "head"},
        "planes": {"direction_smoothing": 0.0, "residual_lr": 0.0, "move_splats": True},
    },
}
"""Settings of the method "ours" by name of the ablation; the first two are the paper's Table 4."""

ALL = "all"


@dataclass(frozen=True)
class SuiteSettings(ExecutionOptions):
    """The whole benchmark: makes the suite's synthetic subjects, trains and measures methods on all, writes result tables.

    Subjects differ in shape, skin, hair and performance; their tracking has errors, and their held-out sequence three parts:
    seen, recombined and beyond training. Started again after a kill it continues. Takes hours.
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

    subjects: int = 10
    """Number of the suite's subjects, from the first. Significant differences require 6 subjects for two
    methods, 8 for five methods, 9 for ten ablations."""

    cameras: int = 8
    """Views of each, the held-out one included."""

    timesteps: int = 160
    """Of each subject; a quarter is held out."""

    size: str = "144x208"
    """Width x height of the images in pixels."""

    tracking_error: float = 1.0
    """As for `headbench synth`."""

    isolation: Isolation = "plugins"
    """Methods that train and render in processes of their own, without access to test images (see SECURITY.md)."""

    def __post_init__(self) -> None:
        """Refuse invalid sizes and names."""
        parse_size(self.size)
        unknown = [name for name in self.ablations if name not in (*ABLATIONS, ALL)]
        if unknown:
            raise InputError("command line", "--ablations", f"{', '.join(ABLATIONS)} or {ALL}", unknown[0])

    @staticmethod
    def notes() -> str:
        """Description of the presets in the help."""
        return presets_of_methods()

    @property
    def chosen(self) -> tuple[str, ...]:
        """Names of the requested ablations, in the order of `ABLATIONS`."""
        return tuple(name for name in ABLATIONS if name in self.ablations or ALL in self.ablations)

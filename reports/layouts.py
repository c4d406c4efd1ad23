"""Tables by name: those that a run's metrics ask for, and the layouts of the paper's tables.

The paper is "3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations"
(CVPR 2025, arXiv 2504.14967).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from ..bench.errors import InputError
from ..bench.specs import MetricSpec
from .run_set import RunSet

NAMES = {
    "insta": "INSTA",
    "gha": "GaussianHeadAvatar",
    "gbs": "GaussianBlendshapes",
    "ga": "GaussianAvatars",
    "ours": "Ours",
}
"""Methods as papers write them, in the order of their tables."""

TASKS = ("novel_view", "self_reenactment")
QUALITY = {"psnr": 2, "ssim": 3, "lpips": 3}


@dataclass(frozen=True)
class PaperLayout:
    """A table of the paper.

    Attributes
    ----------
    digits : of each metric, in the order of the columns.
    methods : names of those that it compares; () for all.
    """

    summary: str
    digits: Mapping[str, int] = field(default_factory=lambda: {**QUALITY, "storage": 1, "fps": 0})
    methods: tuple[str, ...] = ()

    def metrics(self, runs: RunSet, name: str) -> tuple[MetricSpec, ...]:
        """Columns. Raises `InputError` for a metric or a task that the runs lack."""
        known = {spec.name: spec for spec in runs.metrics}
        for what, wanted, there in (("metrics", self.digits, known), ("tasks", TASKS, runs.tasks)):
            lacking = [item for item in wanted if item not in there]
            if lacking:
                raise InputError(
                    runs.runs[0].folder.root, f"{what} of layout {name}", ", ".join(wanted), ", ".join(there)
                )
        return tuple(replace(known[metric], digits=digits) for metric, digits in self.digits.items())

    def labels(self, runs: RunSet, name: str) -> dict[str, str]:
        """Rows: labels of methods and how the paper writes them, in its order; floors have no place in it."""
        order = list(NAMES)
        chosen = [
            label for label in runs.ranked if not self.methods or runs.records[label].name in self.methods
        ]
        if not chosen:
            found = ", ".join(runs.methods)
            raise InputError(runs.runs[0].folder.root, f"layout {name}", ", ".join(self.methods), found)

        def place(label: str) -> tuple[bool, int]:
            known = runs.records[label].name
            # Methods that no table of the paper has come before "ours", which is last.
            return known == "ours", order.index(known) if known in order else len(order)

        own = {label: runs.records[label].name for label in chosen}
        return {
            label: NAMES.get(own[label], own[label]) + label.removeprefix(own[label])
            for label in sorted(chosen, key=place)
        }


PAPER: Mapping[str, PaperLayout] = {
    "paper-1": PaperLayout("every method: both tasks' quality, storage, speed"),
    "paper-3": PaperLayout("INSTA and ours: both tasks' quality, storage, speed", methods=("insta", "ours")),
    "paper-4": PaperLayout(
        "settings of ours, one run each: both tasks' quality", digits=QUALITY, methods=("ours",)
    ),
}

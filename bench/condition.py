"""Conditions: what a cell of a run changes against the plain comparison.

A condition is plain data: it is written into ``run.json``, crosses to worker processes as text, and enters the fingerprint of
what it changes. What it names is registered as a plug-in of the group ``headbench.conditions``, see `ConditionSpec`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from .contracts import Budget

CONDITION_MARK = "+"
"""Between the names of a method and of a condition in labels and in folders of cells."""


def label_of(method: str, condition: str) -> str:
    """Name of a method under a condition, as tables and folders show it: "ours", or "ours+cameras-4"."""
    return f"{method}{CONDITION_MARK}{condition}" if condition else method


@dataclass(frozen=True)
class Named:
    """A registered change and its parameters.

    Attributes
    ----------
    name : str
        Name of a `ConditionSpec`; "" for no change.
    parameters : dict
        Keyword arguments of its implementation, values that JSON has.
    """

    name: str = ""
    parameters: dict[str, Any] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.name)


@dataclass(frozen=True)
class Condition:
    """A named set of changes. Without any it is the plain comparison, whose name is "".

    Attributes
    ----------
    name : str
        As tables show it after the method, and part of the folder of the cell.
    methods : tuple of str
        Names of the methods that have it; empty: all.
    settings : dict
        Changes of the method's settings, laid over those of the run.
    budget : str
        Part of the method's budget, above 0 and at most 1, such as "1/4".
    clip : Named
        Change of the clip that the method is trained on; the frames that are scored stay those of the run.
    derive : Named
        Change of a trained avatar without training, such as fewer splats. The avatar is that of the run's ``source``.
    drive : Named
        Poses and views to render in place of the scored frames, judged without ground truth.
    """

    name: str = ""
    methods: tuple[str, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    budget: str = "1"
    clip: Named = field(default_factory=Named)
    derive: Named = field(default_factory=Named)
    drive: Named = field(default_factory=Named)

    def __post_init__(self) -> None:
        """Refuse a budget that is not a part."""
        try:
            part = Fraction(self.budget)
        except (ValueError, ZeroDivisionError):
            part = Fraction(0)
        if not 0 < part <= 1:
            raise ValueError(f"budget is {self.budget!r}; a part above 0 and at most 1, such as 1/4 or 0.25")

    @property
    def part(self) -> Fraction:
        """Part of the budget as a number."""
        return Fraction(self.budget)

    def part_of(self, whole: Budget) -> Budget:
        """The part of a budget, an iteration at least."""
        return Budget(
            None if whole.iterations is None else max(1, round(whole.iterations * self.part)),
            None if whole.seconds is None else whole.seconds * float(self.part),
        )

    @property
    def summary(self) -> str:
        """What is changed, in words."""
        named = (("clip", self.clip), ("derived", self.derive), ("driven", self.drive))
        changes = [f"{what}: {_text(change.name, change.parameters)}" for what, change in named if change]
        if self.part != 1:
            changes.insert(0, f"budget: {self.budget}")
        if self.settings:
            changes.insert(0, _text("settings", self.settings))
        return "; ".join(changes)

    def applies_to(self, method: str) -> bool:
        """Whether a method has this condition."""
        return not self.methods or method in self.methods


def _text(name: str, values: Any) -> str:
    return " ".join([name, *(f"{key}={value}" for key, value in values.items())])


PLAIN = Condition()
"""The plain comparison."""

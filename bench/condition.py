"""Conditions: changes of a cell of a run from the plain comparison.

A condition is plain data: it is written into ``run.json``, sent to worker processes as text, and part of the fingerprints of
the steps that it changes. Its changes are plug-ins of the group ``headbench.conditions``, see `ConditionSpec`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from .contracts import Budget

CONDITION_MARK = "+"
"""Separator between method and condition in labels and folders of cells."""


def label_of(method: str, condition: str) -> str:
    """Label of a method under a condition in tables and folders: "ours", or "ours+cameras-4"."""
    return f"{method}{CONDITION_MARK}{condition}" if condition else method


def part_of_text(text: str, name: str) -> Fraction:
    """Parse a fraction in (0, 1]. Raises `ValueError` for any other text."""
    # Bounded, since `Fraction` needs hours for a long exponent. The reduced form of a fraction is accepted, too.
    match = re.fullmatch(r"\d{1,6}(\.\d{1,12})?(/\d{1,6})?|\d{1,18}/\d{1,18}", text)
    parts = text.split("/") if match else ["0"]
    value = Fraction(parts[0]) / (int(parts[1]) if len(parts) > 1 and int(parts[1]) else 1)
    if not 0 < value <= 1 or (len(parts) > 1 and not int(parts[1])):
        raise ValueError(f"{name} is {text[:40]!r}; a part above 0 and at most 1, such as 1/4 or 0.25")
    return value


def seconds_of_text(text: str) -> float | None:
    """Parse a training time such as "30 s"; None for other text. Raises `ValueError` for 0 s."""
    match = re.fullmatch(r"(\d{1,6}(?:\.\d{1,6})?) s", text)
    if match and not float(match[1]):
        raise ValueError(f"budget is {text!r}; more than 0 s")
    return float(match[1]) if match else None


@dataclass(frozen=True)
class Named:
    """A registered change and its parameters."""

    name: str = ""
    """Name of a `ConditionSpec`; "" for no change."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of its implementation, as JSON values."""

    def __bool__(self) -> bool:
        return bool(self.name)


@dataclass(frozen=True)
class Condition:
    """A named set of changes. The plain comparison has no changes and the name ""."""

    name: str = ""
    """Name after the method in tables, and part of the cell's folder name."""
    methods: tuple[str, ...] = ()
    """Names of the methods that it applies to; empty: all."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Changes of the method's settings, applied over those of the run."""
    budget: str = "1"
    """Fraction of the method's budget in (0, 1], such as "1/4"; or a training time instead, such as "30 s"."""
    as_tracked: bool = False
    """Train on the head model, neck, static offset and cameras of the capture, without the usual conversion to
    another head model and a single video (`MethodSpec.conversion`)."""
    clip: Named = field(default_factory=Named)
    """Change of the clip that the method is trained on; the scored frames do not change."""
    derive: Named = field(default_factory=Named)
    """Change of a trained avatar without training, such as fewer splats. The avatar is that of the run's ``source``
    or, without one, that of the plain comparison in the same run."""
    drive: Named = field(default_factory=Named)
    """Poses and views to render instead of the scored frames, evaluated without ground truth."""
    views: Named = field(default_factory=Named)
    """Change of the camera and pose that each scored frame is rendered with by the avatar, which is that of ``derive``."""

    def __post_init__(self) -> None:
        """Refuse a budget that is neither a fraction nor a time."""
        if seconds_of_text(self.budget) is None:
            part_of_text(self.budget, "budget")

    @property
    def part(self) -> Fraction:
        """Fraction of the budget; 1 for a training time."""
        return Fraction(1) if seconds_of_text(self.budget) else part_of_text(self.budget, "budget")

    @property
    def changes_budget(self) -> bool:
        """Whether methods train with a budget other than the run's."""
        return seconds_of_text(self.budget) is not None or self.part != 1

    @property
    def follows(self) -> bool:
        """Whether it uses the avatar of the plain comparison instead of training one."""
        return bool(self.derive or self.views)

    @property
    def changes_settings_alone(self) -> bool:
        """Whether it changes settings of methods and nothing else."""
        return bool(self.settings) and self == Condition(self.name, self.methods, self.settings)

    def part_of(self, whole: Budget) -> Budget:
        """The fraction of a budget, at least one iteration; or the training time instead."""
        seconds = seconds_of_text(self.budget)
        if seconds is not None:
            return Budget(None, seconds)
        return Budget(
            None if whole.iterations is None else max(1, round(whole.iterations * self.part)),
            None if whole.seconds is None else whole.seconds * float(self.part),
        )

    def applies_to(self, method: str) -> bool:
        """Whether the condition applies to a method."""
        return not self.methods or method in self.methods


PLAIN = Condition()
"""The plain comparison."""

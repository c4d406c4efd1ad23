"""Settings of ``headbench check-plugin``. Light to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class CheckPluginSettings:
    """Try a method, a reader or a metric and list every breach of its contract.

    Exit code 0: it conforms; 1: it does not; 2: wrong usage, or the plug-in cannot be imported.
    """

    plugin: tyro.conf.Positional[str]
    """The plug-in: "package.module:SPEC", or a name that `headbench list` shows."""

    kind: Literal["methods", "datasets", "metrics"] | None = None
    """What it is, where several have the name."""

    data: str | None = None
    """Capture: for a reader one in its layout (required); for a method default: a tiny synthetic one, made on the
    spot."""

    reader: str = "ga"
    """Which reader opens --data for a method."""

    preset: str | None = None
    """Preset of the method; default: smoke if it has that, else its first."""

    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """A setting of the method or reader, such as `budget.iterations=5`; repeatable."""

    device: str = "cpu"
    """Where the method trains."""

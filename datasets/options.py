"""Options of all commands on captures. Light to import."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ..bench.contracts import Progress

if TYPE_CHECKING:
    from .clip import CaptureClip


Cut = Literal["bust-line", "none"]
"""Part of a tracked person that commands replace by background."""


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """Options of opening a capture."""

    reader: str = ""
    """Reader of the capture: a name that `headbench list` shows, or "module:SPEC"; default: the one that recognises
    it."""

    head: str | None = None
    """Head model of captures that do not contain one: FLAME pickle or npz."""

    cy: Literal["auto", "top", "bottom", "centre"] = "auto"
    """Principal-point convention of the reader ga; auto takes the declared one, else compares with the images."""

    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """A setting of the reader, such as `exclude=tongue.yaml`, as reader_settings of `headbench run`; repeatable."""

    def open(self, path: str, progress: Progress, **settings: Any) -> CaptureClip:
        """Open the one capture at ``path``; see `open_clip`. Leaks between splits are recorded, if the reader can."""
        from .open import open_clip

        return open_clip(path, self.reader, progress=progress, **self._settings(settings))

    def open_all(self, path: str, progress: Progress, **settings: Any) -> Iterator[CaptureClip]:
        """Open every capture under ``path``, one after the other."""
        from .open import open_clips

        return open_clips(path, self.reader, progress=progress, **self._settings(settings))

    def _settings(self, others: dict[str, Any]) -> dict[str, Any]:
        from ..bench.configuration import merge, parse_assignments  # slow to import

        options = {"head": self.head, "cy": None if self.cy == "auto" else self.cy, **others}
        given = {key: value for key, value in options.items() if value is not None}
        return {"wishes": {"leaks": "record"}, "settings": merge(given, parse_assignments(self.set))}

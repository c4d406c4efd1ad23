"""Settings of the viewer."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from ...bench.engine.config import RunOptions
from ...bench.options import DependentOptions

STANDARD_INPUT = "-"
"""Value of ``--live`` for standard input."""


@dataclass(frozen=True)
class ViewSettings(RunOptions):
    """View avatars in a browser: side by side, from any view, with sliders and with recorded sequences. Images are rendered on
    this machine, at a smaller size while something moves. Ends with Ctrl-C. Needs viser (extra `view`).
    """

    avatars: tyro.conf.Positional[tuple[str, ...]]
    """Folders of runs, or of avatars as `headbench render` takes them; an imported avatar needs --data, its capture."""

    methods: tuple[str, ...] = ()
    """Only these methods of runs; by default all but the trivial baselines."""

    subjects: tuple[str, ...] = ()
    """Only these subjects of runs; by default the first."""

    source: str | None = None
    """Capture of another subject, with the same head model, whose sequences drive the avatars too."""

    live: str = ""
    """Live signal that drives all avatars: lines of JSON, each a frame as `headbench drive` reads them, on standard input (-) or on
    a port of this machine (a number), at which only programs of this machine can connect."""

    signal_head: str = ""
    """With --live: head model of the signal, as of `headbench drive`."""

    expressions: int = 10
    """Number of sliders for expressions of each head model: the named ones, else the single coefficients, that move it farthest."""

    method: str = ""
    """Method of an avatar outside of runs as package.module:SPEC, where it is not registered."""

    device: str = ""
    """Rendering device; by default that of the training."""

    port: int = 8080
    """Port of this machine to listen at; 0 takes a free one. Only browsers of this machine can connect."""

    seconds: float | None = None
    """Stop after this time; by default when interrupted."""

    dependent = (DependentOptions(("signal_head",), "live"),)

    def __post_init__(self) -> None:
        is_port = self.live.isascii() and self.live.isdigit() and 0 < int(self.live) < 65536
        if self.live not in ("", STANDARD_INPUT) and not is_port:
            raise ValueError(f"live is {self.live!r}; - or a port from 1 to 65535")
        if not self.avatars:
            raise ValueError("avatars: at least one folder")
        if not 0 <= self.port < 65536:
            raise ValueError(f"port is {self.port}; from 0 to 65535")
        if self.expressions < 0:
            raise ValueError(f"expressions is {self.expressions}; at least 0")
        if self.seconds is not None and self.seconds < 0:
            raise ValueError(f"seconds is {self.seconds}; at least 0")

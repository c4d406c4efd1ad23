"""Common code for programs that fix the image size or the intrinsics in a call: a list of frames is rendered in several calls."""

from __future__ import annotations

import sys
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TypeVar

from ...bench.contracts import Frame
from .config import OfficialConfig
from .method import OfficialMethod
from .video import read_covered
from .workplace import Listed, Workplace, write_launcher

LAUNCHER = Path(__file__).with_name("parts.py")

Config = TypeVar("Config", bound=OfficialConfig)


@dataclass(frozen=True)
class RenderCall:
    """One call of the authors' renderer."""

    command: list[str]
    """The command, run in the program's working directory."""
    numbers: list[int]
    """Numbers of its frames in the list, in the order in which it renders them."""
    renders: str
    """Folder of its renders ``00000.png`` and following."""
    cameras: list[str] = field(default_factory=list)
    """A JSON of the listed cameras, and the one that the program writes beside its renders, which must agree; empty if it
    writes none."""


class PartsMethod(OfficialMethod[Config]):
    """Renders a list by the launcher `parts`, which gives each render the number of its frame."""

    frame_line = r"^headbench: drawn (\d+)"
    starts_launcher = False

    def command_of(self, calls: Sequence[RenderCall], drawn: str, work: Workplace) -> list[str]:
        """Write the launcher and its plan; return its command, for headbench's interpreter.

        ``drawn`` is a regular expression for the frames done in the output of the calls.
        """
        renders = work.model / self.render_folder
        renders.mkdir(parents=True)
        plan = {"drawn": drawn, "renders": str(renders), "parts": [asdict(call) for call in calls]}
        return [sys.executable, *write_launcher(LAUNCHER, plan, work)]

    def read_back(self, frame: Listed, path: Path, background: Sequence[float], work: Workplace) -> Frame:
        """A render on black, composited on the background by its coverage."""
        return read_covered(frame, path, background)


def same_intrinsics(frame: Listed) -> Hashable:
    """Equal for frames of one image size, focal length and principal point."""
    return frame.camera.width, frame.camera.height, frame.camera.K.tobytes()


def in_parts(
    frames: Sequence[Listed], key: Callable[[Listed], Hashable], most: int
) -> Iterator[list[Listed]]:
    """Groups of frames with equal keys, at most ``most`` each, in order."""
    groups: dict[Hashable, list[Listed]] = {}
    for frame in frames:
        groups.setdefault(key(frame), []).append(frame)
    for same in groups.values():
        for start in range(0, len(same), most):
            yield same[start : start + most]

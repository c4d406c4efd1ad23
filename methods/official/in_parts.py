"""Common code for programs that fix the image size or the intrinsics in a call: a list of frames is rendered in several calls."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

from ...bench.io.files import read_bytes, write_bytes, write_json
from .checkout import Checkout
from .config import OfficialConfig
from .method import Listed, OfficialMethod, Workplace

PLAN, LAUNCHER = "parts.json", Path(__file__).with_name("parts.py")
RENDERS = "renders"
MOST_LAUNCHER = 1 << 16
_DRAWN = re.compile(r"^headbench: drawn (\d+)")

Config = TypeVar("Config", bound=OfficialConfig)


@dataclass(frozen=True)
class RenderCall:
    """One call of the authors' renderer.

    Attributes
    ----------
    command : list[str]
        The command, run in the program's working directory.
    numbers : list[int]
        Numbers of its frames in the list, in the order in which it renders them.
    renders : str
        Folder of its renders ``00000.png`` and following.
    cameras : list[str]
        A JSON of the listed cameras, and the one that the program writes beside its renders, which must agree; empty
        if it writes none.
    """

    command: list[str]
    numbers: list[int]
    renders: str
    cameras: list[str]


class PartsMethod(OfficialMethod[Config]):
    """Renders a list by the launcher `parts`, which gives each render the number of its frame."""

    def write_calls(self, folder: Path, calls: Sequence[RenderCall], drawn: str, work: Workplace) -> None:
        """Write the launcher and its plan; ``drawn`` is a regular expression for the frames done in their output."""
        renders = self.render_folder(folder, work)
        renders.mkdir(parents=True)
        plan = {"drawn": drawn, "renders": str(renders), "parts": [asdict(call) for call in calls]}
        write_json(work.root / PLAN, plan)
        write_bytes(work.root / LAUNCHER.name, read_bytes(LAUNCHER, "the launcher", MOST_LAUNCHER))

    def render_command(self, folder: Path, checkout: Checkout, work: Workplace) -> list[str]:
        """The launcher with the plan of the list, run by headbench's interpreter."""
        return [sys.executable, str(work.root / LAUNCHER.name), str(work.root / PLAN)]

    def drawn(self, line: str) -> int | None:
        """From the launcher."""
        match = _DRAWN.search(line)
        return None if match is None else int(match[1])

    def render_folder(self, folder: Path, work: Workplace) -> Path:
        """Output folder of the launcher."""
        return work.model / RENDERS

    def render_name(self, number: int) -> str:
        """Render by the number of the frame in the list."""
        return f"{number:06d}.png"


def same_intrinsics(frame: Listed) -> Hashable:
    """Equal for frames of one image size, focal length and principal point."""
    return frame.camera.width, frame.camera.height, frame.camera.K.tobytes()


def in_parts(
    frames: Sequence[Listed], key: Callable[[Listed], Hashable], most: int
) -> Iterator[list[Listed]]:
    """Frames with equal keys, at most ``most`` together, in order."""
    groups: dict[Hashable, list[Listed]] = {}
    for frame in frames:
        groups.setdefault(key(frame), []).append(frame)
    for same in groups.values():
        for start in range(0, len(same), most):
            yield same[start : start + most]

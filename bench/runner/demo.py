"""The demonstration: which capture is made and which comparison is run on it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError


@dataclass(frozen=True)
class DemoConfig:
    """Settings of ``headbench demo``.

    The sizes are chosen so that the whole demonstration takes minutes on two cores; ``smoke`` shrinks them
    further, so that it takes seconds and shows only that everything runs.
    """

    out: str = "demo-output"
    preset: str = "demo"
    seed: int = 0  # of the training
    subject_seed: int = 14  # of the capture: who is recorded and what they do
    cameras: int = 12
    timesteps: int = 28
    size: str = "144x208"
    head: str = "procedural"
    tracking_noise: float = 0.0

    def capture_arguments(self) -> dict[str, Any]:
        """Arguments of the synthesiser."""
        smoke = self.preset == "smoke"
        return {
            "out": self.capture_folder,
            "subjects": 1,
            "cameras": min(self.cameras, 3) if smoke else self.cameras,
            "timesteps": min(self.timesteps, 8) if smoke else self.timesteps,
            "size": (48, 64) if smoke else parse_size(self.size),
            "head": self.head,
            "seed": self.subject_seed,
            "tracking_noise": self.tracking_noise,
        }

    @property
    def capture_folder(self) -> Path:
        return Path(self.out) / "capture"


DEMO_METHODS = ("mean-image", "nearest-camera", "ga", "gbs", "gha", "insta", "ours")
"""Both floors and every native method: the demonstration's head model suits them all."""


def demo_run_config(config: DemoConfig) -> dict[str, Any]:
    """Settings of the comparison, as `RunConfig` fields."""
    return {
        "data": str(config.capture_folder),
        "out": config.out,
        "methods": DEMO_METHODS,
        "preset": config.preset,
        "seeds": (config.seed,),
    }


def parse_size(text: str) -> tuple[int, int]:
    """Read ``WIDTHxHEIGHT``. Raises `InputError` for anything else."""
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    if match is None or min(int(match[1]), int(match[2])) < 16:
        raise InputError("size", "", "WIDTHxHEIGHT in pixels, each at least 16, such as 275x401", repr(text))
    return int(match[1]), int(match[2])

"""What a refit came to: residuals per timestep and per vertex, parameters at a bound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ....bench.contracts import FloatArray


@dataclass(frozen=True)
class FrameResidual:
    """Distances between source and refitted mesh at one timestep, over the facial region, millimetres."""

    timestep: int
    mean_mm: float
    p95_mm: float
    max_mm: float
    eyeballs_mm: float
    """Mean over the eyeballs; 0 where they were not fitted."""
    at_bound: tuple[str, ...]
    """Parameters that ended at a bound, such as "expression[3]" or "jaw[0]"."""
    evaluations: int


@dataclass(frozen=True, eq=False)
class RefitReport:
    """Residuals of a whole clip.

    Attributes
    ----------
    source, target : versions of the head models.
    frames : one for each timestep, ascending.
    vertex_mm : (V,) mean residual of each of the target's vertices over the timesteps; NaN where a vertex was
        not fitted.
    neutral_mm : mean distance of the neutral heads over the facial region.
    shape_at_bound : identity coefficients that ended at their bound.
    """

    source: str
    target: str
    frames: Sequence[FrameResidual]
    vertex_mm: FloatArray
    neutral_mm: float
    shape_at_bound: tuple[str, ...]

    def summary(self) -> dict[str, Any]:
        """Means over the timesteps and the worst of them, as plain values."""
        worst = max(self.frames, key=lambda frame: frame.mean_mm)
        bounded = sum(bool(frame.at_bound) for frame in self.frames)
        return {
            "source": self.source,
            "target": self.target,
            "timesteps": len(self.frames),
            "neutral_mm": self.neutral_mm,
            "mean_mm": float(np.mean([frame.mean_mm for frame in self.frames])),
            "p95_mm": float(np.mean([frame.p95_mm for frame in self.frames])),
            "eyeballs_mm": float(np.mean([frame.eyeballs_mm for frame in self.frames])),
            "worst_timestep": worst.timestep,
            "worst_mean_mm": worst.mean_mm,
            "worst_p95_mm": max(frame.p95_mm for frame in self.frames),
            "timesteps_at_bound": bounded,
            "shape_at_bound": list(self.shape_at_bound),
        }

    def to_json(self) -> Mapping[str, Any]:
        """Summary, settings-free, and every timestep."""
        return {**self.summary(), "frames": [asdict(frame) for frame in self.frames]}

    def text(self) -> str:
        """A paragraph for a terminal."""
        s = self.summary()
        lines = [
            f"{s['source']} to {s['target']}, {s['timesteps']} timesteps; distances over the face, millimetres",
            f"  neutral head    mean {s['neutral_mm']:.3f}",
            f"  timesteps       mean {s['mean_mm']:.3f}   95th percentile {s['p95_mm']:.3f}",
            f"  worst timestep  mean {s['worst_mean_mm']:.3f}   95th percentile {s['worst_p95_mm']:.3f}",
            f"  eyeballs        mean {s['eyeballs_mm']:.3f}",
            f"  timesteps with a parameter at a bound: {s['timesteps_at_bound']}",
        ]
        if self.shape_at_bound:
            lines.append(f"  identity at a bound: {', '.join(self.shape_at_bound)}")
        return "\n".join(lines)

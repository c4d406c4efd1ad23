"""Which variants of a trained avatar are derived: each change alone, then several together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..shared.bound_avatar import USUAL, Cutoffs

Storage = Literal["exact", "half", "8bit", "compact"]
STORAGE_SUMMARIES: dict[Storage, str] = {
    "exact": "",
    "half": "16-bit floats",
    "8bit": "8 bits between each column's extremes",
    "compact": "quantised by what shows, entropy-coded",
}
# Both avatars of a capture at 144x208 (20,000 splats, 2,000 iterations) lost 0.3 and 0.8 dB, and twice their LPIPS, by
# the earlier ones, for no measurable processor time; hence no other variant has them.
EARLY = Cutoffs(2 / 255, 1e-3)
EARLIER = Cutoffs(4 / 255, 1e-2)


@dataclass(frozen=True)
class Recipe:
    """Changes of an avatar, made in this order; None and 1 leave as it is.

    Attributes
    ----------
    splats : fraction of the splats kept, those that contribute most to training views.
    degree : highest degree of spherical harmonics.
    planes, lines : samples along a side of a plane, along a line.
    storage : how its numbers are stored.
    cutoffs : below what the renderer leaves work out.
    """

    splats: float = 1.0
    degree: int | None = None
    planes: int | None = None
    lines: int | None = None
    storage: Storage = "exact"
    cutoffs: Cutoffs = USUAL

    @property
    def name(self) -> str:
        """Short, unique among recipes of one method."""
        parts = [
            f"splats{round(100 * self.splats)}" if self.splats < 1 else "",
            "" if self.degree is None else f"sh{self.degree}",
            "" if self.planes is None else f"planes{self.planes}",
            "" if self.lines is None else f"lines{self.lines}",
            "" if self.storage == "exact" else self.storage,
            "" if self.cutoffs == USUAL else f"cut{round(255 * self.cutoffs.alpha_min)}",
        ]
        return "-".join(part for part in parts if part)

    @property
    def summary(self) -> str:
        """What was changed, in words."""
        cutoffs = f"alpha from {self.cutoffs.alpha_min:.3f}, light from {self.cutoffs.transmittance_min:g} on"
        parts = [
            f"the {self.splats:.0%} of splats that contribute most" if self.splats < 1 else "",
            "" if self.degree is None else f"harmonics up to degree {self.degree}",
            "" if self.planes is None else f"planes of {self.planes}x{self.planes}",
            "" if self.lines is None else f"lines of {self.lines} samples",
            STORAGE_SUMMARIES[self.storage],
            "" if self.cutoffs == USUAL else cutoffs,
        ]
        return "; ".join(part for part in parts if part)


COMMON = (
    *(Recipe(splats=fraction) for fraction in (0.75, 0.5, 0.25)),
    *(Recipe(storage=storage) for storage in ("half", "8bit", "compact")),
    *(Recipe(cutoffs=cutoffs) for cutoffs in (EARLY, EARLIER)),
    Recipe(splats=0.5, storage="compact"),
)

GA = (
    *COMMON,
    *(Recipe(degree=degree) for degree in (2, 1, 0)),
    *(Recipe(degree=degree, storage="compact") for degree in (2, 1, 0)),
    *(Recipe(splats=f, degree=1, storage="compact") for f in (0.75, 0.5, 0.25)),
)

OURS = (
    *COMMON,
    *(Recipe(planes=resolution) for resolution in (64, 32)),
    Recipe(lines=16),
    *(Recipe(planes=resolution, lines=16, storage="compact") for resolution in (64, 32)),
    *(Recipe(splats=f, planes=64, lines=16, storage="compact") for f in (0.75, 0.5, 0.25)),
)

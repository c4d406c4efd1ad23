"""From areas to decisions: an automatic threshold, and a reason in words for every frame."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ....bench.contracts import FloatArray
from ..exclusion_file import Exclusions, FrameDecision
from .evidence import Evidence

NEVER, ALWAYS = 20.0, 60.0
"""mm². Up to the first, what looks covered is put down to the tracker: along a lip of 50 mm, a line that is off by
a pixel of the map in a quarter of its length makes as much. From the second on it is a third of the lower lip."""

NEAR = 1.5
"""Factor around the threshold within which a decision deserves a look."""

TONGUE = "tongue out"
_SEEN = 0.25  # share of the lower lip below which a frame says nothing


def choose_threshold(areas: FloatArray) -> tuple[float, str]:
    """Threshold in mm² for a subject's areas (T,), and how it was found.

    Between `NEVER` and `ALWAYS` it is the middle (of logarithms) of the widest gap between neighbouring areas:
    where another choice would change the fewest decisions.
    """
    inside = np.sort(areas[(areas > NEVER) & (areas < ALWAYS)])
    edges = np.log(np.concatenate([[NEVER], inside, [ALWAYS]]))
    widest = int(np.argmax(np.diff(edges)))
    threshold = float(np.exp(0.5 * (edges[widest] + edges[widest + 1])))
    between = f"{np.exp(edges[widest]):.0f} and {np.exp(edges[widest + 1]):.0f} mm2"
    basis = f"middle of the widest gap, {between}; {len(inside)} frames between {NEVER:g} and {ALWAYS:g} mm2"
    return round(threshold, 1), basis


def decide(
    timesteps: Mapping[int, str],
    evidence: Evidence,
    cameras: tuple[str, ...],
    threshold: float | None,
    overrides: Mapping[int, str],
) -> Exclusions:
    """Decide every timestep.

    Parameters
    ----------
    timesteps : sequence by timestep, in the order of the evidence.
    threshold : mm²; None chooses one.
    overrides : what people decided, see `Exclusions`.
    """
    basis = "given"
    if threshold is None:
        threshold, basis = choose_threshold(evidence.areas)
    frames = {}
    for (timestep, sequence), area, seen in zip(timesteps.items(), evidence.areas.tolist(), evidence.seen):
        excluded = area >= threshold
        frames[timestep] = FrameDecision(
            sequence, round(area, 1), excluded, _reason(area, threshold, float(seen))
        )
    return Exclusions(threshold, basis, cameras, frames, dict(overrides))


def _reason(area: float, threshold: float, seen: float) -> str:
    if area >= threshold:
        near = ", near the threshold" if area < NEAR * threshold else ""
        return f"{TONGUE}: {area:.0f} mm2 of lip and chin covered{near}"
    if seen < _SEEN:
        return f"mouth not seen: {100 * seen:.0f} % of the lower lip"
    return "near the threshold" if area * NEAR >= threshold else ""

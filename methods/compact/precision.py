"""How finely a compact avatar is stored. Light to import."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Precision:
    """Quantisation steps of the parts of a compact avatar; smaller is finer, and 0 keeps a part as float32.

    Each step is in a unit in which equal errors look equally bad, so that one number serves a whole part, whatever
    its range: the entropy coder, not a fixed number of bits, pays for rare large values. The defaults cost less than
    0.1 dB together (``headbench compact --compare`` measures each).
    """

    positions: float = 0.1
    """Of local positions, in the splat's own size (geometric mean of its three standard deviations)."""

    scales: float = 0.08
    """Of log-scales: 0.08 is an error of at most 4 %."""

    rotations: float = 0.025
    """Of the three smaller components of unit quaternions: 0.025 is an error of about 1 degree."""

    opacities: float = 0.2
    """Of opacity logits: an opacity is off by 0.025 at most."""

    harmonics: float = 0.02
    """Of spherical-harmonics coefficients, where they hold the colour: 0.0056 of colour in degree 0."""

    planes: float = 0.01
    """Of the colour that one plane channel contributes, in [0, 1], as the colour network weighs it."""

    lines: float = 0.03
    """Of the offset (logits) that one line channel contributes at coefficient 1, as the offset network weighs it."""

    networks: float = 0.02
    """Of network weights, in the largest weight of the same row: 1/127 would be 8 bits."""

    subject: float = 2e-6
    """Of the subject's static offset, metres."""

    def __post_init__(self) -> None:
        for part in fields(self):
            step = getattr(self, part.name)
            if not 0 <= step < 1:
                raise ValueError(f"{part.name} must be at least 0 and below 1, found {step}")


EXACT = Precision(**{part.name: 0.0 for part in fields(Precision)})
"""Nothing is rounded."""

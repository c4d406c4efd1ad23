"""Precision of a compact avatar. Light to import: options of ``headbench export compact``."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Precision:
    """Quantisation steps of the parts of a compact avatar; smaller is finer, and 0 keeps a part as float32.

    Each step is in a unit in which equal errors are equally visible, so that one number serves a whole part. The range
    of values needs no fixed number of bits because values are entropy-coded. The defaults cost less than 0.1 dB
    together (``headbench export compact --compare`` measures each).
    """

    positions: float = 0.08
    """Step of local positions, in the splat's own size (geometric mean of its three standard deviations)."""

    scales: float = 0.06
    """Step of log-scales: 0.06 is an error of at most 3 %."""

    rotations: float = 0.02
    """Step of the three smaller components of unit quaternions: 0.02 is an error of about 1 degree."""

    opacities: float = 0.1
    """Step of opacity logits: an opacity is off by 0.0125 at most."""

    harmonics: float = 0.02
    """Step of spherical-harmonics coefficients, if colours are stored as such: 0.0056 of colour in degree 0."""

    colors: float = 0.02
    """Step of the separate colours of splats, added to those of the planes."""

    planes: float = 0.005
    """Step of the colour contribution of one plane channel, in [0, 1], as weighted by the colour network."""

    lines: float = 0.001
    """Step of the offset (logits) by one channel of one line at coefficient 1, as weighted by the offset network.
    Small, since the errors of thousands of channels add up: at 0.003 a trained avatar lost 0.13 dB, at 0.001
    nothing, for 16 kB more."""

    networks: float = 0.01
    """Step of network weights, relative to the largest weight of the same row: 1/127 would be 8 bits."""

    subject: float = 2e-6
    """Step of the subject's static offset, metres."""

    def __post_init__(self) -> None:
        for part in fields(self):
            step = getattr(self, part.name)
            if not 0 <= step < 1:
                raise ValueError(f"{part.name} must be at least 0 and below 1, found {step}")


EXACT = Precision(**{part.name: 0.0 for part in fields(Precision)})
"""Nothing is rounded."""

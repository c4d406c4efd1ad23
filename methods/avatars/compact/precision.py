"""Precision of a compact avatar. Light to import: options of ``headbench export compact``."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Precision:
    """Quantisation steps of the parts of a coded avatar; smaller is finer, and 0 keeps a part as float32.

    Each step is in a unit in which equal errors are equally visible, so that one number serves a whole part. With a capture,
    steps are those of a splat of average visibility in the training views, and others have steps in inverse proportion to
    their visibility (`coder.visibility_classes`). ``headbench export compact --compare`` measures what each costs.
    """

    step: float = 1.0
    """Factor of all steps: a coarser or finer codec with the same balance."""

    positions: float = 0.08
    """Step of local positions, in the splat's own size (geometric mean of its three standard deviations)."""

    scales: float = 0.045
    """Step of log-scales: 0.045 is an error of at most 2.3 %."""

    rotations: float = 0.02
    """Step of the components of quaternions: 0.02 is an error of about 0.7 degrees."""

    opacities: float = 0.12
    """Step of opacity logits: an opacity is off by 0.015 at most."""

    harmonics: float = 0.0115
    """Step of colours by spherical harmonics, in colour: root mean square over directions."""

    colors: float = 0.0115
    """Step of the separate colours of splats, added to those of the planes."""

    planes: float = 0.0115
    """Step of the colour contribution of the channels of a plane, in [0, 1], as weighted by the colour network."""

    lines: float = 0.012
    """Step of the offset (logits) by the channels of one line at coefficient 1, as weighted by the offset network."""

    networks: float = 0.01
    """Step of network weights, relative to the largest weight of the same output: 1/127 would be 8 bits."""

    tables: float = 0.2
    """Step of trained features (of a hash grid, or of splats that a network shades), in their standard deviation."""

    subject: float = 1e-5
    """Step of the subject's static offset, metres."""

    def __post_init__(self) -> None:
        for part, step in self.parts.items():
            if not 0 <= step < 1:
                raise ValueError(f"{part} must be at least 0 and below 1, found {step}")
        if not 0 < self.step <= MAX_STEP:
            raise ValueError(f"step must be above 0 and at most {MAX_STEP:g}, found {self.step}")

    @property
    def parts(self) -> dict[str, float]:
        """Steps by part, without the factor."""
        return {name: step for name, step in asdict(self).items() if name != "step"}

    @property
    def scaled(self) -> Precision:
        """The same steps with the factor 1."""
        return Precision(**{part: min(self.step * step, LARGEST_STEP) for part, step in self.parts.items()})


MAX_STEP, LARGEST_STEP = 64.0, 0.999
EXACT = Precision(**dict.fromkeys(Precision().parts, 0.0))
"""Nothing is rounded."""

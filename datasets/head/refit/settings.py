"""Settings of the refit of tracking to another head model."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from ....bench.errors import InputError

Algorithm = Literal["slsqp", "lbfgs", "mma"]


@dataclass(frozen=True)
class RefitSettings:
    """Settings of the refit of tracking to another head model.

    The defaults follow published practice for monocular methods: vertex distances over the facial region are
    minimised, identity is fitted to the neutral head, and neither static offset nor neck rotation is kept.
    """

    static_offset: Literal["zero", "residual"] = "zero"
    """Residual of the neutral head after fitting identity: dropped, or kept as a static offset (only for equal topologies)."""

    neck: Literal["fold", "keep"] = "fold"
    """Rotation of the neck: merged into the head's, as in monocular trackers, or kept."""

    eyeballs: float = 1.0
    """Weight of an eyeball's vertex relative to the face; 0 leaves the eyes unchanged."""

    lips: float = 1.0
    """Weight of a lip vertex relative to other vertices of the face."""

    eye_region: float = 1.0
    """Weight of a vertex around the eyes relative to other vertices of the face."""

    prior_mm: float = 0.005
    """Regularisation: root mean square distance with the same cost as a coefficient of one standard deviation, millimetres."""

    coefficient_bound: float = 6.0
    """Largest magnitude of identity and expression coefficients, standard deviations."""

    eyelid_bound: float = 2.0
    """Largest magnitude of an eyelid coefficient; 1 closes the eye."""

    jaw_bound: float = 0.9
    """Largest magnitude of each component of the jaw's axis-angle, radians."""

    eye_bound: float = 1.0
    """Largest magnitude of each component of an eye's axis-angle, radians."""

    algorithm: Algorithm = "slsqp"
    """Algorithm of nlopt for the angles."""

    tolerance: float = 1e-5
    """Tolerance of the angles, radians."""

    evaluations: int = 200
    """Maximum number of evaluations per frame."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not isinstance(value, (int, float)):
                continue
            lowest = 0.0 if name in ("eyeballs", "lips", "eye_region") else 1e-12
            if not lowest <= value < float("inf"):
                raise InputError("refit settings", name, f"a number of at least {lowest:g}", str(value))

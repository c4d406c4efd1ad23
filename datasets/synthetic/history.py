"""State of the skin over a sequence: hysteresis of folds, delay of blood flow, drying of lips.

A state is a function of the exact controls of a sequence up to a timestep, starting at rest. Tracked parameters alone
do not determine it.

Hair and the skin of the neck follow the head late, which tracked parameters do not show. Each follows as a mass on a
damped spring, with a transfer function of second order. Hair swings as a rod that hangs from one end (compare Keller,
"Ponytail motion", SIAM Journal on Applied Mathematics 70(7), 2010), so that its frequency follows from its length.
Damping, and both numbers of the neck, are choices, not measurements.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray
from ..head.geometry import COEFFICIENT_BITS, on_grid, share_left
from .anatomy import SIDES, Person
from .performance import Activations, Performed
from .skin import FLUSHES, FOLDS, flush_strengths

FOLLOWED = ("head_nod", "head_turn", "head_tilt", "neck_nod", "neck_turn", "sway_x", "sway_y", "sway_z")
"""Controls that hair and neck follow."""
RATE = 73.0
"""Rate at which past controls are sampled, per second: NeRSemble's frame rate."""
_MEMORY = 2.0  # seconds, after which the slowest response is within 1e-3 of its limit
_GRAVITY = 9.81
HAIR_DAMPING = 0.5
NECK_FREQUENCY, NECK_DAMPING = 4.0, 0.3
"""Natural frequency in hertz and damping ratio of the skin of the neck over the muscles."""
NECK_SHARE = 0.3
"""Fraction of the neck's lag in its skin; the tissue below prevents the rest."""
FREE_LENGTH = 0.15
"""Distance from the root, metres, beyond which hair swings freely; closer to the root, head and other hair hold it."""


@dataclass(frozen=True)
class Lagging:
    """Delayed controls at one moment, for hair and for the neck."""

    hair: Activations
    neck: Activations


def hair_frequency(length: float) -> float:
    """Natural frequency, hertz, of a rod of ``length`` metres that hangs from one end."""
    return float(np.sqrt(1.5 * _GRAVITY / length) / (2.0 * np.pi))


def step_response(seconds: FloatArray, frequency: float, damping: float) -> FloatArray:
    """Response to a unit step at 0 of a system of second order, ``damping`` below 1."""
    speed = 2.0 * np.pi * frequency
    swing = speed * np.sqrt(1.0 - damping**2)
    phase = swing * seconds
    return 1.0 - np.exp(-damping * speed * seconds) * (
        np.cos(phase) + damping * speed / swing * np.sin(phase)
    )


def shares(frequency: float, damping: float) -> FloatArray:
    """(K,) weights of the moments (k + 1/2) / `RATE` seconds ago; they sum to 1."""
    reached = step_response(np.arange(round(_MEMORY * RATE) + 1) / RATE, frequency, damping)
    weights = on_grid(np.diff(reached), COEFFICIENT_BITS)
    weights[-1] += 1.0 - weights.sum()
    return weights


def follow(performed: Performed, moment: float, amount: float, length: float) -> Lagging:
    """Delayed controls at a ``moment`` (seconds) for hair of ``length`` metres and for the neck. ``amount`` scales the
    distance to the controls of that moment. Before a sequence the head is still."""
    past = performed.curves(np.maximum(moment - (np.arange(round(_MEMORY * RATE)) + 0.5) / RATE, 0.0))
    now = {name: float(values[0]) for name, values in performed.curves(np.array([moment])).items()}

    def late(frequency: float, damping: float) -> Activations:
        # Weights and controls are rounded to grids, so the sums are exact.
        weights = shares(frequency, damping)
        late_values: Mapping[str, float] = {name: float((weights * past[name]).sum()) for name in FOLLOWED}
        moved = {name: now[name] + amount * (late_values[name] - now[name]) for name in FOLLOWED}
        return {**now, **moved}

    return Lagging(late(hair_frequency(length), HAIR_DAMPING), late(NECK_FREQUENCY, NECK_DAMPING))


BUCKLES = (0.30, 0.55)
"""Range of the strength at which a fold buckles, drawn for each subject and fold."""
SLACK = (0.12, 0.25)
"""Hysteresis: difference to that strength at which it becomes smooth again, drawn likewise."""
_SMOOTH = 0.3  # depth, as a share of the strength, of a fold that has not buckled
_BUCKLED = (0.25, 0.75)  # depth of one that has: a constant, and a share of the strength
_DEEPEST = 1.1

FLUSH_SECONDS = {"cheeks": (0.9, 2.5), "anger": (0.9, 2.5), "nose": (0.6, 1.5), "lips_full": (0.4, 0.8)}
"""Time constants of blood flow into and out of the skin."""
_REFILL = (0.0, 0.8)  # pressed skin: pale immediately, refilled within about two seconds
DRYING = 4.0
"""Seconds after which the wetness of lips has decayed to 1/e."""


@dataclass(frozen=True, eq=False)
class SkinState:
    """Strengths of folds (G,) and flushes (F,), and wetness of the lips, 0 to 1."""

    folds: FloatArray
    flushes: FloatArray
    wet: float = 0.0


def over_time(activations: Sequence[Activations], seconds: float, person: Person) -> list[SkinState]:
    """States at the timesteps of a sequence, which are ``seconds`` apart."""
    rng = np.random.default_rng([person.seed, 13])
    upper = on_grid(rng.uniform(*BUCKLES, len(FOLDS)), COEFFICIENT_BITS)
    lower = upper - on_grid(rng.uniform(*SLACK, len(FOLDS)), COEFFICIENT_BITS)
    coming, going = (
        np.array([_kept(seconds, FLUSH_SECONDS.get(name, _REFILL)[way]) for name in FLUSHES])
        for way in (0, 1)
    )
    drying = _kept(seconds, DRYING)
    buckled = np.zeros(len(FOLDS), bool)
    flushes, wet, states = np.zeros(len(FLUSHES)), 0.0, []
    for a in activations:
        strength = coupled_strengths(a)
        buckled = strength > np.where(buckled, lower, upper)
        depth = np.where(buckled, _BUCKLED[0] + _BUCKLED[1] * strength, _SMOOTH * strength)
        target = flush_strengths(a)
        kept = np.where(target > flushes, coming, going)
        flushes = target + kept * (flushes - target)
        wet = min(max(a["lip_roll"], a["tongue_out"], drying * wet), 1.0)
        folds = np.maximum(person.lines_at_rest * _AGED, depth) + 0.25 * person.lines_at_rest * _AGED
        states.append(SkinState(np.minimum(folds, _DEEPEST), flushes, wet))
    return states


def _kept(seconds: float, constant: float) -> float:
    """Fraction of a difference that remains after ``seconds``; 0 without delay."""
    return float(share_left(seconds, constant)) if constant else 0.0


_AGED = np.array(
    [
        {"forehead": 0.4, "glabella": 0.35, "crow": 0.3, "nasolabial": 0.7, "under": 0.4, "neck": 0.6}.get(
            name.split("_")[0], 0.0
        )
        for name in FOLDS
    ]
)
"""Depth of an aged face's folds at rest."""


def coupled_strengths(a: Activations) -> FloatArray:
    """(G,) strengths of the folds caused by several muscles: most are products of controls."""
    jaw = min(max(a["jaw_open"], 0.0), 1.0)
    smile = {side: min(max(a[f"smile_{side}"], 0.0), 1.2) for side in SIDES}
    down = {side: a[f"brow_down_{side}"] for side in SIDES}
    tense = {side: max(a[f"squint_{side}"], a[f"cheek_raise_{side}"]) for side in SIDES}
    frown = 0.5 * (down["left"] + down["right"])
    sneer = 0.5 * (a["nose_sneer_left"] + a["nose_sneer_right"])
    upper = 0.5 * (a["upper_lip_up_left"] + a["upper_lip_up_right"])
    stretch = 0.5 * (a["mouth_stretch_left"] + a["mouth_stretch_right"])
    strengths = {
        "forehead_mid": a["brow_inner_up"] * (1.0 - 0.6 * frown),
        **{f"forehead_{side}": a[f"brow_outer_up_{side}"] * (1.0 - 0.6 * down[side]) for side in SIDES},
        "glabella": frown * (0.75 + 0.5 * a["brow_inner_up"]) + 0.35 * sneer,
        **{f"crow_{side}": tense[side] * (0.3 + 0.4 * smile[side]) + 0.1 * smile[side] for side in SIDES},
        **{
            f"nasolabial_{side}": smile[side] * (0.5 + 0.9 * jaw)
            + a[f"nose_sneer_{side}"] * (0.5 + 0.5 * a[f"upper_lip_up_{side}"])
            + 0.5 * a[f"mouth_stretch_{side}"] * jaw
            for side in SIDES
        },
        "bunny": sneer * (0.6 + 0.7 * upper),
        **{f"under_eye_{side}": tense[side] * (0.55 + 0.6 * smile[side]) for side in SIDES},
        "chin": max(a["chin_raise"], 0.6 * a["mouth_frown"], 0.8 * a["lip_press"]) * (1.0 - 0.8 * jaw),
        **{f"dimple_{side}": smile[side] * (1.0 - 0.8 * jaw) for side in SIDES},
        "lip_lines": a["pucker"] * (1.0 - 0.6 * jaw),
        "neck": stretch * (0.5 + 0.8 * jaw),
    }
    return np.clip([strengths[name] for name in FOLDS], 0.0, 1.3)

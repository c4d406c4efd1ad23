"""The performance of a subject: NeRSemble's sequences as smooth curves of the semantic controls.

A sequence is a list of phrases, each a target set of controls held around its peak; curves between them are
monotone cubics, so nothing overshoots and a held face stays held. Blinks, gaze and head motion run on top.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import nnls

from ...bench.contracts import FloatArray, HeadAsset, HeadPose
from ...bench.errors import InputError
from ..head.geometry import COEFFICIENT_BITS, on_grid
from ..head.procedural.expressions import SEMANTIC_NAMES
from ..head.procedural.versions import semantic_to_coefficients
from . import natural
from .anatomy import SIDES
from .natural import SPEECH, Curves, Face, both

Activations = Mapping[str, float]

_PAIRED = (
    *("brow_down", "brow_outer_up", "blink", "squint", "eye_wide", "cheek_raise", "nose_sneer", "smile"),
    *("mouth_stretch", "upper_lip_up", "lower_lip_down"),
)
EXPRESSION_CONTROLS = (
    "brow_inner_up",
    *(f"{name}_{side}" for name in _PAIRED for side in ("left", "right")),
    *("cheek_puff", "mouth_frown", "pucker", "funnel", "lip_press", "lip_roll", "chin_raise"),
    *("mouth_left", "mouth_right"),
)
"""Shapes of the skin; each is 0 at rest and 1 at its natural extreme."""

POSE_CONTROLS = (
    *("jaw_open", "jaw_side", "jaw_roll", "gaze_left", "gaze_up", "head_turn", "head_nod", "head_tilt"),
    *("neck_turn", "neck_nod", "sway_x", "sway_y", "sway_z", "tongue_out"),
)
"""Jaw and tongue in [0, 1] (sideways and gaze in [-1, 1]); head, neck in radians; sway in metres."""

CONTROLS = (*EXPRESSION_CONTROLS, *POSE_CONTROLS)

_JAW_OPEN = 0.36  # radians at jaw_open = 1
_JAW_SIDE, _JAW_ROLL = 0.09, 0.11
_GAZE_SIDE, _GAZE_UP = 0.45, 0.32


@dataclass(frozen=True, eq=False)
class Translation:
    """From expression controls to one head model: ``expression`` (K, E) and, where it has them, eyelids (K, 2). Both
    stand on the grid of coefficients, as activations do: their products and sums are exact."""

    head_model: str
    expression: FloatArray
    eyelids: FloatArray | None

    def pose(self, activations: Activations, subject: str, timestep: int | None) -> HeadPose:
        """The head pose of one moment, rounded to float32 as it will be stored."""
        a = activations
        values = np.array([a[name] for name in EXPRESSION_CONTROLS])
        gaze = [-_GAZE_UP * a["gaze_up"], _GAZE_SIDE * a["gaze_left"], 0.0]
        fields = {
            "expression": values @ self.expression,
            "rotation": np.array([a["head_nod"], a["head_turn"], a["head_tilt"]]),
            "neck": np.array([a["neck_nod"], a["neck_turn"], 0.0]),
            "jaw": np.array(
                [_JAW_OPEN * a["jaw_open"], _JAW_SIDE * a["jaw_side"], _JAW_ROLL * a["jaw_roll"]]
            ),
            "eyes": np.array(gaze + gaze),
            "translation": np.array([a["sway_x"], a["sway_y"], a["sway_z"]]),
        }
        stored = {name: value.astype(np.float32).astype(np.float64) for name, value in fields.items()}
        eyelids = (
            None if self.eyelids is None else (values @ self.eyelids).astype(np.float32).astype(np.float64)
        )
        return HeadPose(self.head_model, **stored, eyelids=eyelids, subject=subject, timestep=timestep)

    def activations(self, pose: HeadPose) -> Activations:
        """Controls of a pose: those from 0 up whose expression and eyelids are nearest to its own, with the tongue inside.

        The inverse of `pose` where that expression needs no negative control; jaw, gaze and rigid motion are exact.
        """
        matrix, wanted = self.expression, np.asarray(pose.expression, np.float64)
        if self.eyelids is not None and pose.eyelids is not None:
            matrix, wanted = np.hstack([matrix, self.eyelids]), np.concatenate([wanted, pose.eyelids])
        values, _ = nnls(matrix.T, wanted)
        return {
            **dict(zip(EXPRESSION_CONTROLS, values.tolist())),
            **dict(zip(("jaw_open", "jaw_side", "jaw_roll"), pose.jaw / [_JAW_OPEN, _JAW_SIDE, _JAW_ROLL])),
            "gaze_left": float(pose.eyes[[1, 4]].mean()) / _GAZE_SIDE,
            "gaze_up": -float(pose.eyes[[0, 3]].mean()) / _GAZE_UP,
            **dict(zip(("head_nod", "head_turn", "head_tilt"), pose.rotation)),
            **dict(zip(("neck_nod", "neck_turn"), pose.neck)),
            **dict(zip(("sway_x", "sway_y", "sway_z"), pose.translation)),
            "tongue_out": 0.0,
        }


Kind = Literal["full", "parts", "natural", "expressions", "still"]
"""Kind of performance: full; full with FREE in the parts of `FREE_PARTS`, each a sequence; these parts and speech with the
motion of tracked recordings (see `natural`); without jaw and tongue; only head, neck and gaze."""

_JAW = ("jaw_open", "jaw_side", "jaw_roll", "tongue_out")
_MUTED: Mapping[Kind, frozenset[str]] = {
    "full": frozenset(),
    "parts": frozenset(),
    "natural": frozenset(),
    "expressions": frozenset(_JAW),
    "still": frozenset((*_JAW, *EXPRESSION_CONTROLS)),
}
KINDS = tuple(_MUTED)

HELD_OUT = "FREE"
"""The sequence kept for self-reenactment; its parts begin with this."""

TONGUE = "tongue out"
"""Reason for the exclusion of frames: no head model of FLAME's layout has a tongue."""

TONGUE_SHOWS = 0.6
"""`Performed.excluded` begins here for a subject without its own: see `parts.share_that_shows`."""

_PHRASE_SECONDS = 0.9


_REST: Face = {}
_SHOUT: Face = {"jaw_open": 0.95, **both(upper_lip_up=0.5, lower_lip_down=0.5, brow_down=0.5)}
_LAUGH: Face = {"jaw_open": 0.45, **both(smile=1.0, cheek_raise=0.8, squint=0.5)}
_SURPRISE: Face = {"brow_inner_up": 1.0, "jaw_open": 0.55, **both(brow_outer_up=1.0, eye_wide=0.8)}
_FEAR: Face = {"brow_inner_up": 0.9, **both(brow_down=0.3, eye_wide=0.9, mouth_stretch=0.8)}
_ANGRY: Face = {"lip_press": 0.9, **both(brow_down=1.0, squint=0.4, nose_sneer=0.25)}
_SAD: Face = {"brow_inner_up": 0.85, "mouth_frown": 0.9, "chin_raise": 0.5, "gaze_up": -0.4}
_DISGUST: Face = both(nose_sneer=1.0, upper_lip_up=0.6, brow_down=0.5, squint=0.4)
_HAPPY: Face = both(smile=1.0, cheek_raise=0.5)
_TONGUE: Face = {"jaw_open": 0.55, "tongue_out": 1.0, **both(lower_lip_down=0.2)}

SEQUENCES: Mapping[str, tuple[Face, ...]] = {
    "EMO-1-shout+laugh": (_REST, _SHOUT, _SHOUT, _REST, _LAUGH, {**_LAUGH, "jaw_open": 0.2}, _LAUGH, _REST),
    "EMO-2-surprise+fear": (
        _REST,
        _SURPRISE,
        {**_SURPRISE, "jaw_open": 0.2},
        _REST,
        _FEAR,
        {**_FEAR, "jaw_open": 0.3},
        _REST,
    ),
    "EMO-3-angry+sad": (
        _REST,
        _ANGRY,
        {**_ANGRY, "lip_press": 0.0, "jaw_open": 0.3},
        _REST,
        _SAD,
        {**_SAD, "gaze_left": 0.5},
        _REST,
    ),
    "EMO-4-disgust+happy": (
        _REST,
        _DISGUST,
        {**_DISGUST, "jaw_open": 0.2},
        _REST,
        _HAPPY,
        {**_HAPPY, "jaw_open": 0.2},
        _REST,
    ),
    "EXP-2-eyes": (
        {"gaze_left": 0.9},
        {"gaze_left": -0.9},
        {"gaze_up": 0.9, "brow_inner_up": 0.4, **both(brow_outer_up=0.4)},
        {"gaze_up": -0.9, **both(blink=0.3)},
        both(squint=1.0, blink=0.5, cheek_raise=0.6),
        both(blink=1.0),
        {"blink_left": 1.0, "squint_left": 0.6},
        {"blink_right": 1.0, "squint_right": 0.6},
        both(eye_wide=1.0),
    ),
    "EXP-3-cheeks+nose": (
        {"cheek_puff": 1.0},
        _REST,
        both(nose_sneer=1.0),
        {"nose_sneer_left": 1.0, "smile_left": 0.4},
        {"nose_sneer_right": 1.0, "smile_right": 0.4},
        {"cheek_puff": 0.8, "lip_press": 0.6},
        both(cheek_raise=1.0),
    ),
    "EXP-4-lips": (
        {"pucker": 1.0},
        {"funnel": 1.0, "jaw_open": 0.15},
        {"lip_press": 1.0},
        {"lip_roll": 1.0},
        both(mouth_stretch=1.0),
        {"mouth_left": 1.0},
        {"mouth_right": 1.0},
        both(smile=0.8),
    ),
    "EXP-5-mouth": (
        both(upper_lip_up=1.0, smile=0.3),
        both(lower_lip_down=1.0),
        both(smile=1.0, upper_lip_up=0.5, lower_lip_down=0.4),
        {"mouth_frown": 1.0, "chin_raise": 0.6},
        {"chin_raise": 1.0},
        {"smile_left": 1.0},
        {"smile_right": 1.0},
        {"jaw_open": 0.4, "funnel": 0.7},
    ),
    "EXP-8-jaw-1": (
        {"jaw_open": 0.5},
        {"jaw_open": 1.0},
        {"jaw_open": 0.3},
        {"jaw_open": 0.9, "funnel": 0.4},
        _REST,
    ),
    "EXP-9-jaw-2": (
        {"jaw_side": 0.9},
        {"jaw_side": -0.9},
        {"jaw_side": 0.7, "jaw_open": 0.4},
        {"jaw_side": -0.7, "jaw_open": 0.4},
    ),
    # Only the combinations here are new, not the controls.
    "FREE": (
        {**both(smile=0.6), "gaze_left": 0.4},
        {"brow_inner_up": 0.7, "brow_outer_up_left": 1.0, "smile_right": 0.7},
        {**both(brow_down=0.6), "pucker": 0.7},
        {"jaw_open": 0.6, **both(smile=0.7, brow_outer_up=0.7), "brow_inner_up": 0.7},
        _TONGUE,
        {**both(nose_sneer=0.6), "mouth_left": 0.5, "blink_left": 0.9},
        {"jaw_open": 0.3, "jaw_side": 0.5, **both(brow_down=0.5)},
        {"mouth_frown": 0.7, "brow_inner_up": 0.6, "gaze_left": -0.7},
        {"jaw_open": 0.75, **both(eye_wide=0.6, lower_lip_down=0.5)},
        {**both(cheek_raise=0.8), "lip_press": 0.5},
    ),
}
"""Phrases by sequence, in NeRSemble's order."""

BEYOND = 1.3
"""Distance of the last part of FREE beyond training."""


def _beyond(face: Face) -> Face:
    """Scale up all controls without a natural limit (lids, gaze and tongue have one)."""
    free = {name for name in EXPRESSION_CONTROLS if not name.startswith("blink")} | {"jaw_open", "jaw_side"}
    return {name: BEYOND * value if name in free else value for name, value in face.items()}


FREE_PARTS: Mapping[str, tuple[Face, ...]] = {
    "FREE-1-seen": (
        {**_HAPPY, "gaze_left": 0.5},
        {name: 0.8 * value for name, value in _SURPRISE.items()},
        {"pucker": 0.9},
        both(squint=0.8, blink=0.4, cheek_raise=0.5),
        {"jaw_open": 0.7},
        {name: 0.85 * value for name, value in _DISGUST.items()},
        {"mouth_frown": 0.8, "chin_raise": 0.5},
        {**_LAUGH, "jaw_open": 0.3},
    ),
    "FREE-2-recombined": SEQUENCES[HELD_OUT],
    "FREE-3-beyond": tuple(
        map(
            _beyond,
            (
                {**both(smile=1.0), "gaze_left": 0.4},
                _SURPRISE,
                {"pucker": 1.0},
                _DISGUST,
                {"jaw_open": 0.95, **both(lower_lip_down=0.6)},
                {"mouth_frown": 0.9, "brow_inner_up": 0.9},
                {**_ANGRY, "jaw_open": 0.0},
                {"jaw_open": 0.5, "jaw_side": 0.9},
            ),
        )
    ),
}
"""Held-out phrases by how far they are from training: poses of training, in part or less of them; controls that training
has, in combinations that it has not; beyond the range of training."""

_HELD_OUT_SHARE = 0.25  # of the timesteps of a performance in parts

# The order in which sequences join as timesteps allow: first those that differ most.
_PRIORITY = (
    *("FREE", "EMO-1-shout+laugh", "EXP-4-lips", "EMO-2-surprise+fear", "EXP-2-eyes", "EMO-4-disgust+happy"),
    *("EMO-3-angry+sad", "EXP-8-jaw-1", "EXP-5-mouth", "EXP-3-cheeks+nose", "EXP-9-jaw-2"),
)
_MINIMUM = 8  # minimum timesteps of an additional sequence


@dataclass(frozen=True, eq=False)
class Performed:
    """A performed sequence: one dictionary of controls per timestep, the timesteps to label, and seconds between two.
    ``moments`` (T,) are the timesteps in seconds, and ``curves`` are the controls at any moments (n,), (n,) each."""

    name: str
    activations: Sequence[Mapping[str, float]]
    excluded: Mapping[int, str]
    step: float
    moments: FloatArray
    curves: Callable[[FloatArray], Curves]


def at_moments(curves: Curves) -> list[Activations]:
    """One dictionary of controls per moment."""
    count = len(curves[CONTROLS[0]])
    return [{control: float(curves[control][t]) for control in CONTROLS} for t in range(count)]


def share_out(timesteps: int, kind: Kind = "full") -> dict[str, int]:
    """Timesteps of each sequence, in NeRSemble's order; they sum to ``timesteps``.

    A natural performance, or one in parts, has all sequences, each with as many timesteps as it has phrases to show, and a
    quarter of them for the held-out ones. Others, and natural ones of few timesteps, have as many sequences as the timesteps
    allow, two at least, of which FREE gets a double share.
    """
    if kind in ("parts", "natural"):
        train = {name: len(phrases) for name, phrases in SEQUENCES.items() if name != HELD_OUT}
        shares = {name: count / sum(train.values()) * (1 - _HELD_OUT_SHARE) for name, count in train.items()}
        held_out = (*FREE_PARTS, SPEECH) if kind == "natural" else tuple(FREE_PARTS)
        shares |= dict.fromkeys(held_out, _HELD_OUT_SHARE / len(held_out))
        least = int(np.ceil(2.5 / min(shares.values())))
        if timesteps >= least:
            ends = np.round(np.cumsum([*shares.values()]) * timesteps).astype(int)
            return {name: int(n) for name, n in zip(shares, np.diff(ends, prepend=0))}
        if kind == "parts":
            expected = f"at least {least} for a performance in parts"
            raise InputError("--timesteps", "", expected, str(timesteps))
    if timesteps < 4:
        raise InputError("--timesteps", "", "at least 4 (two sequences)", str(timesteps))
    count = int(np.clip(timesteps // _MINIMUM, 2, len(_PRIORITY)))
    chosen = [name for name in SEQUENCES if name in _PRIORITY[:count]]
    weight = np.array([2.0 if name == HELD_OUT and count > 2 else 1.0 for name in chosen])
    ends = np.round(np.cumsum(weight) / weight.sum() * timesteps).astype(int)
    return {name: int(n) for name, n in zip(chosen, np.diff(ends, prepend=0))}


def frames_kept(timesteps: int, sequences: Iterable[str]) -> int:
    """n, where a natural performance of ``timesteps`` keeps every n-th frame, so that it has time for the phrases of its
    ``sequences``."""
    phrases = sum(len({**SEQUENCES, **FREE_PARTS}.get(name, SEQUENCES[HELD_OUT])) for name in sequences)
    return max(1, round(natural.PHRASE_SECONDS * phrases * natural.FRAME_RATE / timesteps))


def perform(
    name: str,
    timesteps: int,
    seed: int,
    tongue_shows: float = TONGUE_SHOWS,
    kind: Kind = "full",
    every: int = 1,
) -> Performed:
    """Sample a sequence at ``timesteps`` moments. The same seed gives the same performance.

    ``tongue_shows`` is the share in [0, 1] by which the tongue has to be out for a timestep to be labelled. A natural
    performance keeps every ``every``-th frame of a video of `natural.FRAME_RATE`; others distribute the moments evenly over
    their phrases. Controls that ``kind`` leaves out stay at rest; all others move as in the full performance.
    """
    names = [*SEQUENCES, *FREE_PARTS, SPEECH]

    def begin() -> np.random.Generator:
        return np.random.default_rng([seed, names.index(name)])

    if kind == "natural":
        moments = (np.arange(timesteps) + 0.5) * every / natural.FRAME_RATE
        seconds = timesteps * every / natural.FRAME_RATE
    else:
        seconds = _PHRASE_SECONDS * (len({**SEQUENCES, **FREE_PARTS}[name]) + 1)
        moments = _moments(name, timesteps, seconds, begin())

    def curves(time: FloatArray) -> Curves:
        make_curves = _natural_curves if kind == "natural" else _smooth_curves
        values = make_curves(name, time, seconds, begin())
        values |= {control: np.zeros(len(time)) for control in CONTROLS if control not in values}
        # Lids follow the eyes down.
        for side in SIDES:
            values[f"blink_{side}"] = np.clip(
                values[f"blink_{side}"] + 0.35 * np.maximum(-values["gaze_up"], 0), 0, 1
            )
        values |= {control: np.zeros(len(time)) for control in _MUTED[kind]}
        return {control: on_grid(curve, COEFFICIENT_BITS) for control, curve in values.items()}

    activations = at_moments(curves(moments))
    excluded = {t: TONGUE for t, a in enumerate(activations) if a["tongue_out"] >= tongue_shows}
    return Performed(name, activations, excluded, seconds / timesteps, moments, curves)


_NEW = {"FREE": 1, "FREE-1-seen": 1, "FREE-2-recombined": 1, "FREE-3-beyond": 2}
"""Synergies of each phrase that training does not show, by sequence."""


def _natural_curves(name: str, time: FloatArray, seconds: float, rng: np.random.Generator) -> Curves:
    """Controls of a natural performance at the moments ``time``."""
    if name == SPEECH:
        values = natural.speech_curves(time, seconds, rng)
    else:
        values = natural.face_curves({**SEQUENCES, **FREE_PARTS}[name], time, seconds, rng, _NEW.get(name, 0))
    gap = natural.BLINK_GAP["speech" if name == SPEECH else "posed"]
    closed = natural.blinks(time, seconds, gap, rng)
    for side in SIDES:
        values[f"blink_{side}"] = np.maximum(values.get(f"blink_{side}", 0.0), closed)
    yaw, pitch = natural.gaze(time, seconds, rng).T
    values["gaze_left"] = values.get("gaze_left", 0.0) + yaw / _GAZE_SIDE
    values["gaze_up"] = values.get("gaze_up", 0.0) + pitch / _GAZE_UP
    values["head_nod"], values["head_turn"], values["head_tilt"] = natural.head(time, seconds, rng).T
    values["jaw_roll"] = values.get("jaw_side", 0.0) + natural.JAW_ROLL * natural.wander(
        time, natural.IDLE_SECONDS, rng
    )
    for control, amplitude in natural.SWAY.items():
        values[control] = amplitude * natural.wander(time, natural.IDLE_SECONDS, rng)
    return values


def _middles(phrases: Sequence[Face], rng: np.random.Generator) -> FloatArray:
    """Moments of the phrases, seconds; drawn before anything else of a performance."""
    return _PHRASE_SECONDS * np.arange(1, len(phrases) + 1) + rng.uniform(-0.08, 0.08, len(phrases))


def _moments(name: str, timesteps: int, seconds: float, rng: np.random.Generator) -> FloatArray:
    """(T,) timesteps of the other kinds in seconds, distributed evenly."""
    phrases = {**SEQUENCES, **FREE_PARTS}[name]
    time = (np.arange(timesteps) + 0.5) / timesteps * seconds
    for middle, phrase in zip(_middles(phrases, rng), phrases):
        if "tongue_out" in phrase:
            # At least one timestep shows the tongue, so that every capture tests exclusion.
            time[np.abs(time - middle).argmin()] = middle
    return time


def _smooth_curves(name: str, time: FloatArray, seconds: float, rng: np.random.Generator) -> Curves:
    """Controls of the other kinds: phrases as monotone cubics, with blinks and idle motion."""
    phrases = {**SEQUENCES, **FREE_PARTS}[name]
    middles = _middles(phrases, rng)
    curves = _phrase_curves(phrases, middles, seconds, rng)
    values = {control: curve(time) for control, curve in curves.items()}
    values |= {control: np.zeros(len(time)) for control in CONTROLS if control not in values}
    blinks = _blinks(time, seconds, rng)
    for side in SIDES:
        values[f"blink_{side}"] = np.maximum(values[f"blink_{side}"], blinks)
    for control, amplitude, period in _IDLE:
        values[control] = values[control] + amplitude * _drift(time, period, rng)
    return values


_IDLE = (
    *(("head_turn", 0.10, 3.1), ("head_nod", 0.05, 2.7), ("head_tilt", 0.035, 3.7)),
    *(("neck_turn", 0.05, 2.9), ("neck_nod", 0.03, 3.3)),
    *(("sway_x", 0.004, 4.1), ("sway_y", 0.003, 3.9), ("sway_z", 0.004, 4.7)),
    *(("gaze_left", 0.10, 1.3), ("gaze_up", 0.06, 1.7)),
)
"""(control, amplitude, seconds per swing) of permanent motion."""


def _phrase_curves(
    phrases: Sequence[Face], middles: FloatArray, seconds: float, rng: np.random.Generator
) -> dict[str, PchipInterpolator]:
    """Monotone cubics through rest, each phrase (held for a moment, at its own strength), and rest."""
    knots, faces = [0.0], [_REST]
    for middle, phrase in zip(middles, phrases):
        strength = rng.uniform(0.85, 1.0)
        face = {control: strength * value for control, value in phrase.items()}
        knots += [middle - 0.14, middle + 0.14]
        faces += [face, face]
    knots.append(seconds)
    faces.append(_REST)
    used = sorted({control for face in faces for control in face})
    return {c: PchipInterpolator(knots, [face.get(c, 0.0) for face in faces]) for c in used}


def _blinks(time: FloatArray, seconds: float, rng: np.random.Generator) -> FloatArray:
    """Spontaneous blinks, every two to four seconds, of a quarter of a second."""
    closed, moment = np.zeros(len(time)), rng.uniform(0.5, 2.0)
    while moment < seconds:
        closed = np.maximum(closed, np.exp(-0.5 * ((time - moment) / 0.055) ** 2))
        moment += rng.uniform(2.0, 4.0)
    return closed


def _drift(time: FloatArray, period: float, rng: np.random.Generator) -> FloatArray:
    """Slow irregular motion in about [-1, 1]: two sines of unrelated periods."""
    a, b = rng.uniform(0.0, 2.0 * np.pi, 2)
    return 0.65 * np.sin(2.0 * np.pi * time / period + a) + 0.35 * np.sin(
        2.0 * np.pi * time / (0.381 * period) + b
    )


# ICT-FaceKit's shapes have ARKit's names with _L and _R.
_ICT_PAIRED = {
    "brow_down": "browDown",
    "brow_outer_up": "browOuterUp",
    "blink": "eyeBlink",
    "squint": "eyeSquint",
    "eye_wide": "eyeWide",
    "cheek_raise": "cheekSquint",
    "nose_sneer": "noseSneer",
    "smile": "mouthSmile",
    "mouth_stretch": "mouthStretch",
    "upper_lip_up": "mouthUpperUp",
    "lower_lip_down": "mouthLowerDown",
}
ICT_TARGETS: Mapping[str, tuple[str, ...]] = {
    **{f"{name}_{s}": (f"{shape}_{s[0].upper()}",) for name, shape in _ICT_PAIRED.items() for s in SIDES},
    "brow_inner_up": ("browInnerUp_L", "browInnerUp_R"),
    "cheek_puff": ("cheekPuff_L", "cheekPuff_R"),
    "mouth_frown": ("mouthFrown_L", "mouthFrown_R"),
    "pucker": ("mouthPucker",),
    "funnel": ("mouthFunnel",),
    "lip_press": ("mouthPress_L", "mouthPress_R"),
    "lip_roll": ("mouthRollLower", "mouthRollUpper"),
    "chin_raise": ("mouthShrugLower", "mouthShrugUpper"),
    "mouth_left": ("mouthLeft",),
    "mouth_right": ("mouthRight",),
}
"""ICT-FaceKit shapes that play each expression control."""


def ict_translation(head: HeadAsset, names: Sequence[str]) -> Translation:
    """Translation for a head whose expression directions have the names of ICT-FaceKit's shapes."""
    matrix = np.zeros((len(EXPRESSION_CONTROLS), head.expression_basis.shape[2]))
    for row, control in enumerate(EXPRESSION_CONTROLS):
        for name in ICT_TARGETS.get(control, ()):
            if name not in names:
                raise InputError(head.version, "expression names", name, f"{len(names)} others")
            matrix[row, names.index(name)] = 1.0
    return Translation(head.version, matrix, None)


def procedural_translation(head: HeadAsset) -> Translation:
    """Translation for the procedural head, whose coefficients are combinations of these controls."""
    expression, eyelids = semantic_to_coefficients(head.version)
    rows = [SEMANTIC_NAMES.index(control) for control in EXPRESSION_CONTROLS]
    return Translation(head.version, expression[rows], None if eyelids is None else eyelids[rows])

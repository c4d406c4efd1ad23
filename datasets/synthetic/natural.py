"""Performances that move as tracked recordings do: speeds, pauses, blinks, gaze, and controls that act together.

The amounts are those of tracked sequences of NeRSemble and of other public recordings; the tests measure them and
compare them with the recorded values. Moments lie at a video's rate, of which a capture keeps every n-th.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...bench.contracts import FloatArray
from .anatomy import SIDES

SPEECH = "FREE-4-speech"
"""Name of the sequence of speech; it is held out."""
FRAME_RATE = 73.0 / 3.0
"""Frames per second of NeRSemble's recordings."""

Face = Mapping[str, float]
"""Controls of a face by name; others are at rest."""
Curves = dict[str, FloatArray]
"""(T,) values of controls by name."""


def both(**values: float) -> dict[str, float]:
    """Controls of both sides."""
    return {f"{name}_{side}": value for name, value in values.items() for side in SIDES}


SYNERGIES: tuple[Face, ...] = (
    both(smile=1.0, cheek_raise=0.7, squint=0.4),
    {**both(brow_down=1.0, squint=0.5, nose_sneer=0.4), "lip_press": 0.4},
    {**both(brow_outer_up=0.9, eye_wide=0.7), "brow_inner_up": 1.0},
    {"mouth_frown": 1.0, "chin_raise": 0.8, "lip_press": 0.5, "brow_inner_up": 0.4},
    {"pucker": 1.0, "funnel": 0.7, "lip_press": 0.4, **both(cheek_raise=0.3)},
    both(nose_sneer=1.0, upper_lip_up=0.8, brow_down=0.4, cheek_raise=0.5),
    both(mouth_stretch=1.0, lower_lip_down=0.7, smile=0.4),
    {"lip_roll": 1.0, "chin_raise": 0.6, "cheek_puff": 0.5},
)
"""Synergies: controls that act together, in addition to those of a phrase."""
ONE_SIDED: tuple[Face, ...] = (
    {"brow_down_left": 0.8, "squint_left": 0.7, "brow_outer_up_right": 0.3},
    {"cheek_raise_right": 1.0, "upper_lip_up_right": 0.7, "mouth_right": 0.3},
    {"lower_lip_down_left": 1.0, "mouth_stretch_left": 0.8},
    {"eye_wide_right": 0.9, "brow_down_left": 0.5},
    {"nose_sneer_left": 0.6, "upper_lip_up_left": 0.8, "squint_right": 0.5},
)
"""Synergies of held-out sequences alone: training does not show them."""
COMPANY, COMPANY_SHARE = 1, (0.35, 0.8)
"""Number of synergies that accompany a phrase, and the range of their strengths."""
OPENING = 0.15, (0.1, 0.5)
"""Probability that the jaw opens in a phrase that does not specify it, and the range of openings."""
WIDER, WIDEST = 1.25, 1.35
"""Factor on the openings of phrases, and the largest opening."""
WITH_JAW: Face = {**both(lower_lip_down=0.7), "funnel": 0.3}
"""Increase of each control per opening of the jaw."""

PHRASE_SECONDS = 0.85
"""Mean time from one target to the next; `_JITTER` of it at random."""
_JITTER = 0.25
RISE_SECONDS = 0.65
"""Duration of a transition of the face; 59 % of it lies between 10 and 90 %."""
FAST = {"jaw_open": 0.36, "jaw_side": 0.4, "tongue_out": 0.4, "gaze_left": 0.06, "gaze_up": 0.06}
"""Duration of the transitions of other controls."""
TREMBLE, RESTLESS, TREMBLE_SECONDS = 0.2, 0.02, (0.5, 1.6)
"""Amplitudes of the motion of a held face, relative to its controls and of all controls, and the range of its periods."""


def face_curves(
    phrases: Sequence[Face], time: FloatArray, seconds: float, rng: np.random.Generator, new: int
) -> Curves:
    """Controls of a sequence of ``seconds`` at the moments ``time`` (T,): its phrases in random order, repeated as needed.

    Every phrase has a random strength and random synergies, ``new`` of which do not occur in training. The jaw moves in
    strokes and moves the lips.
    """
    count = max(1, round(seconds / PHRASE_SECONDS) - 1)
    order: list[int] = []
    while len(order) < count:
        order += rng.permutation(len(phrases)).tolist()
    faces = [_in_company(phrases[index], rng, new) for index in order[:count]]
    rest = _in_company({}, rng, new)
    middles = seconds * (np.arange(1, count + 1) + rng.uniform(-_JITTER, _JITTER, count)) / (count + 1)
    switches = np.concatenate(
        [[0.5 * middles[0]], 0.5 * (middles[1:] + middles[:-1]), [0.5 * (middles[-1] + seconds)]]
    )
    every = [rest, *faces, rest]
    names = sorted({name for face in every for name in face} | {*WITH_JAW})
    curves: Curves = {}
    for name in names:
        duration = FAST.get(name, RISE_SECONDS)
        curves[name] = _steps([face.get(name, 0.0) for face in every], switches, duration, time, rng)
    for name in sorted(curves.keys() - FAST.keys()):
        curves[name] = curves[name] + (TREMBLE * curves[name] + RESTLESS) * wander(time, TREMBLE_SECONDS, rng)
    curves["jaw_open"] = opening = np.minimum(WIDER * curves["jaw_open"], WIDEST)
    _move_with_jaw(curves, opening)
    return curves


def _move_with_jaw(curves: Curves, opening: FloatArray) -> None:
    """Add the motion of the lips that an opening (T,) of the jaw causes."""
    for name, share in WITH_JAW.items():
        curves[name] = curves[name] + share * opening


def _in_company(phrase: Face, rng: np.random.Generator, new: int) -> dict[str, float]:
    """A phrase at a random strength with random synergies; each control takes the larger of both values."""
    face = {name: rng.uniform(0.8, 1.0) * value for name, value in phrase.items()}
    probability, openings = OPENING
    opening = rng.uniform(*openings) if rng.random() < probability else 0.0
    face.setdefault("jaw_open", opening)
    company = [SYNERGIES[i] for i in rng.choice(len(SYNERGIES), COMPANY, replace=False)]
    company += [ONE_SIDED[i] for i in rng.choice(len(ONE_SIDED), new, replace=False)]
    for synergy in company:
        strength = rng.uniform(*COMPANY_SHARE)
        for name, value in synergy.items():
            asked = strength * rng.uniform(0.6, 1.2) * value
            face[name] = asked if name not in face else max(face[name], asked)
    return face


def _steps(
    values: Sequence[float], switches: FloatArray, duration: float, time: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """(T,) from each value to the next around a moment of ``switches``, by half a cosine of about ``duration`` seconds."""
    curve = np.full(len(time), values[0])
    moments = switches + rng.uniform(-0.1, 0.1, len(switches))
    lengths = duration * rng.uniform(0.8, 1.25, len(switches))
    for before, after, moment, length in zip(values, values[1:], moments, lengths):
        curve = curve + (after - before) * _rise(time, moment, length)
    return curve


def _rise(time: FloatArray, moment: float, seconds: float) -> FloatArray:
    """(T,) from 0 to 1 by half a cosine of ``seconds`` around a moment."""
    phase = np.clip((time - moment) / seconds + 0.5, 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * phase))


def wander(time: FloatArray, periods: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    """(T,) smooth irregular motion of unit standard deviation: five sines of random phase, ``periods`` seconds each."""
    periods_, phases = rng.uniform(*periods, 5), rng.uniform(0.0, 2.0 * np.pi, 5)
    return np.sqrt(2.0 / 5.0) * np.sin(2.0 * np.pi * time[:, None] / periods_ + phases).sum(axis=1)


SYLLABLE_SECONDS = 0.21
_VISEMES: tuple[Face, ...] = (
    {"jaw_open": 0.36},
    {"jaw_open": 0.2, **both(mouth_stretch=0.5, smile=0.2)},
    {"jaw_open": 0.18, "funnel": 0.7, "pucker": 0.3},
    {"jaw_open": 0.08, "pucker": 0.8},
    {"lip_press": 0.8},
    {"jaw_open": 0.06, "lip_roll": 0.5},
    {"jaw_open": 0.12, **both(lower_lip_down=0.5)},
    {},
)


def speech_curves(time: FloatArray, seconds: float, rng: np.random.Generator) -> Curves:
    """Controls of speech: syllables between pauses, over faces that change as between phrases."""
    curves = face_curves([{}], time, seconds, rng, new=1)
    count = int(seconds / SYLLABLE_SECONDS)
    pause = rng.random(count) < 0.12
    faces = [{} if pause[i] else _VISEMES[rng.integers(len(_VISEMES))] for i in range(count)]
    switches = SYLLABLE_SECONDS * (np.arange(1, count) + rng.uniform(-0.2, 0.2, count - 1))
    for name in sorted({name for viseme in _VISEMES for name in viseme}):
        syllables = _steps([face.get(name, 0.0) for face in faces], switches, 0.2, time, rng)
        curves[name] = curves.get(name, np.zeros(len(time))) + syllables
        if name == "jaw_open":
            _move_with_jaw(curves, syllables)
    return curves


BLINK_GAP = {"posed": 60.0 / 9.0, "speech": 60.0 / 24.0}
"""Mean seconds between spontaneous blinks."""
_GAP_SHAPE = 1.0 / 0.8**2  # of a gamma distribution whose deviation is 0.8 of its mean
_BLINK_WIDTH = 0.110 / 2.355  # standard deviation of a blink of 110 ms at half height


def blinks(time: FloatArray, seconds: float, gap: float, rng: np.random.Generator) -> FloatArray:
    """(T,) closure of the lids by spontaneous blinks at irregular times."""
    closed, moment = np.zeros(len(time)), gap * rng.uniform(0.0, 1.0)
    while moment < seconds:
        closed = np.maximum(closed, np.exp(-0.5 * ((time - moment) / _BLINK_WIDTH) ** 2))
        moment += max(rng.gamma(_GAP_SHAPE, gap / _GAP_SHAPE), 0.3)
    return closed


FIXATION_SECONDS = 0.75
_SACCADE_SECONDS = 0.05
_FIXATION = np.radians((2.2, 2.2))  # deviations of yaw and pitch
_LONG = 0.12, 3.0  # share of large saccades, and their factor


def gaze(time: FloatArray, seconds: float, rng: np.random.Generator) -> FloatArray:
    """(T, 2) yaw and pitch of the eyes, radians, added to those of a phrase: fixations and saccades."""
    moments, moment = [], 0.0
    while moment < seconds:
        moment += 0.15 + rng.gamma(2.0, (FIXATION_SECONDS - 0.15) / 2.0)
        moments.append(moment)
    places = rng.standard_normal((len(moments) + 1, 2)) * _FIXATION
    places *= np.where(rng.random(len(places)) < _LONG[0], _LONG[1], 1.0)[:, None]
    turns = np.broadcast_to(places[0], (len(time), 2)).copy()
    for before, after, moment in zip(places, places[1:], moments):
        turns += (after - before) * _rise(time, moment, _SACCADE_SECONDS)[:, None]
    return turns


JAW_ROLL = 0.12
"""Standard deviation of independent jaw roll, in units of the control."""
IDLE_SECONDS = (1.5, 6.0)
SWAY = {"neck_turn": 0.004, "neck_nod": 0.004, "sway_x": 0.002, "sway_y": 0.0015, "sway_z": 0.002}
"""Deviations of idle motion by control: radians, metres."""
HEAD_IDLE = np.radians((1.0, 0.5, 0.4))
"""Standard deviations of pitch, yaw and roll of a head at rest over a few seconds."""
TURN_GAP, _TURN_SECONDS, _TURN = 7.0, 0.24, np.radians((7.0, 9.0, 3.0))


def head(time: FloatArray, seconds: float, rng: np.random.Generator) -> FloatArray:
    """(T, 3) pitch, yaw and roll of the head in radians: idle motion, and rare fast turns."""
    turns = np.stack([wander(time, IDLE_SECONDS, rng) for _ in range(3)], axis=1) * HEAD_IDLE
    moment, place = rng.exponential(TURN_GAP), np.zeros(3)
    while moment < seconds:
        after = rng.standard_normal(3) * _TURN if not place.any() else np.zeros(3)
        turns += (after - place) * _rise(time, moment, _TURN_SECONDS)[:, None]
        place = after
        moment += 0.8 if place.any() else 0.5 + rng.exponential(TURN_GAP)
    return turns

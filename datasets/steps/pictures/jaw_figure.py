"""The jaw bases as meshes, and where they lie among the poses of the performance; after the paper's Figure 7."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ....bench.contracts import ByteArray, FloatArray
from ...clip import CaptureClip
from ...inspect.canvas import FINE, HELD_OUT, INK, MUTED, RULE, TRAIN, Canvas, nice_ticks
from ..jaw_bases import DEFAULT_COUNT, jaw_bases, jaw_quaternions, jaw_weights, leaks
from .meshes import draw_meshes, unposed_meshes

_COLUMNS, _WIDTH, _HEIGHT = 8, 128, 156
_LABEL, _TOP, _MARGIN, _PLOT = 40, 58, 24, 280
_AXIS, _LEGEND = 44, 190
_LEAK = (190, 30, 45)


class JawFindings(NamedTuple):
    """Jaw bases of a clip and how its poses lie among them."""

    bases: FloatArray
    """(n, 4) unit quaternions, real part first."""
    angles: FloatArray
    """(n, 3) their rotation vectors, degrees: opening, to the side, twist."""
    shares: FloatArray
    """(n,) share of the training timesteps whose largest weight is on the basis."""
    largest_gap: float
    """Largest angle, degrees, between a training pose and the basis nearest to it."""
    train: FloatArray
    """(T, 3) rotation vectors of the training timesteps, degrees."""
    held_out: FloatArray
    """The same of the held-out timesteps."""
    variant: str

    def record(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "variant": self.variant,
            "leaks": list(leaks(self.variant)),
            "bases": self.bases.round(6).tolist(),
            "degrees": self.angles.round(2).tolist(),
            "shares": self.shares.round(4).tolist(),
            "largest_gap_degrees": round(self.largest_gap, 3),
            "train_timesteps": len(self.train),
            "held_out_timesteps": len(self.held_out),
        }


def find_jaw_bases(
    clip: CaptureClip, count: int = DEFAULT_COUNT, *, variant: Literal["paper", "official"] = "paper"
) -> JawFindings:
    """Find the bases of a clip and what of its poses they cover."""
    bases = jaw_bases(clip, count, variant=variant)
    train = clip.timesteps("train")
    held_out = [t for t in clip.timesteps("self_reenactment") if t not in set(train)]
    quaternions = jaw_quaternions([clip.poses[t] for t in train])
    weights = jaw_weights(quaternions, bases)
    shares = np.bincount(weights.argmax(axis=1), minlength=len(bases)) / len(train)
    likeness = np.abs(quaternions @ bases.T).max(axis=1).clip(0, 1)
    return JawFindings(
        bases,
        _degrees(bases),
        shares,
        float(np.degrees(2 * np.arccos(likeness.min()))),
        _degrees(quaternions),
        _degrees(jaw_quaternions([clip.poses[t] for t in held_out])),
        variant,
    )


def draw_jaw_bases(clip: CaptureClip, found: JawFindings) -> ByteArray:
    """Draw the figure, (H, W, 3)."""
    rows = -(-len(found.bases) // _COLUMNS)
    width = 2 * _MARGIN + _COLUMNS * _WIDTH
    plot_top = _TOP + rows * (_HEIGHT + _LABEL) + 14
    canvas = Canvas(width, plot_top + _PLOT + 40 + 26)
    canvas.text((_MARGIN, 16), f"Jaw bases, subject {clip.subject}", 19)
    notes = leaks(found.variant)
    origin = f"Leak: {notes[0]}" if notes else "from training poses alone, the neutral jaw first"
    canvas.text((width - _MARGIN, 20), origin, 13, _LEAK if notes else MUTED, "ra")
    neutral = next(iter(clip.poses.values()))
    still = replace(neutral, expression=np.zeros_like(neutral.expression), eyes=np.zeros(6), eyelids=None)
    poses = [replace(still, jaw=np.radians(angle)) for angle in found.angles]
    pictures = draw_meshes(clip, unposed_meshes(clip, poses), FINE * _WIDTH, FINE * _HEIGHT)
    for index, picture in enumerate(pictures):
        left = _MARGIN + index % _COLUMNS * _WIDTH
        top = _TOP + index // _COLUMNS * (_HEIGHT + _LABEL)
        canvas.image(left, top, picture)
        opening, side, _ = found.angles[index]
        middle = left + _WIDTH / 2
        canvas.text(
            (middle, top + _HEIGHT + 2),
            f"{index + 1}:  {opening:.1f}° open, {side:+.1f}° side",
            11,
            anchor="ma",
        )
        canvas.text(
            (middle, top + _HEIGHT + 17), f"nearest for {100 * found.shares[index]:.0f} %", 11, MUTED, "ma"
        )
    _scatter(canvas, found, _MARGIN + _AXIS, plot_top, width - _MARGIN - _LEGEND, plot_top + _PLOT)
    return canvas.finish()


def _scatter(
    canvas: Canvas, found: JawFindings, left: float, top: float, right: float, bottom: float
) -> None:
    """Opening against sideways angle: training poses, held-out poses, bases by number."""
    near = found.bases[:, 0] > np.cos(np.pi / 4)  # a half turn would leave no room for anything else
    points = np.vstack([found.train, found.held_out, found.angles[near]])[:, :2]
    low, high = points.min(axis=0), points.max(axis=0)
    pad = np.maximum(0.06 * (high - low), 0.5)
    low, high = low - pad, high + pad

    def place(angles: Sequence[float]) -> tuple[float, float]:
        x = left + (angles[0] - low[0]) / (high[0] - low[0]) * (right - left)
        return x, bottom - (angles[1] - low[1]) / (high[1] - low[1]) * (bottom - top)

    for tick in nice_ticks(low[0], high[0], 8):
        x, _ = place((tick, low[1]))
        canvas.line([(x, top), (x, bottom)], RULE)
        canvas.text((x, bottom + 5), f"{tick:g}°", 11, MUTED, "ma")
    for tick in nice_ticks(low[1], high[1], 5):
        _, y = place((low[0], tick))
        canvas.line([(left, y), (right, y)], RULE)
        canvas.text((left - 6, y), f"{tick:g}°", 11, MUTED, "rm")
    canvas.text(((left + right) / 2, bottom + 22), "opening (rotation about the ears' axis)", 12, MUTED, "ma")
    canvas.text((left + 6, top + 4), "to the side", 12, MUTED)
    for angles in found.held_out:
        canvas.dot(place(angles), 2.2, HELD_OUT)
    for angles in found.train:
        canvas.dot(place(angles), 2.2, TRAIN)
    for index in np.flatnonzero(near):
        x, y = place(found.angles[index])
        _ring(canvas, x, y)
        canvas.text((x, y - 7), str(index + 1), 11, INK, "ms")
    x, y = right + 18, top + 8
    for text, colour in (
        (f"{len(found.train)} training poses", TRAIN),
        (f"{len(found.held_out)} held-out poses", HELD_OUT),
    ):
        canvas.dot((x, y), 4, colour)
        canvas.text((x + 12, y), text, 12, INK, "lm")
        y += 22
    _ring(canvas, x, y)
    canvas.text((x + 12, y), f"{len(found.bases)} bases", 12, INK, "lm")
    canvas.text((x - 6, y + 22), "Every training pose has", 12, MUTED, "lm")
    canvas.text((x - 6, y + 38), f"a basis within {found.largest_gap:.1f}°.", 12, MUTED, "lm")
    if not near.all():
        canvas.text((x - 6, y + 60), "Not shown: the half turn", 12, _LEAK, "lm")
        canvas.text((x - 6, y + 76), "that seeds the bases.", 12, _LEAK, "lm")


def _ring(canvas: Canvas, x: float, y: float) -> None:
    turns = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    canvas.polygon(zip(x + 5 * np.cos(turns), y + 5 * np.sin(turns)), None, INK)


def _degrees(quaternions: FloatArray) -> FloatArray:
    """(N, 3) rotation vectors, degrees, of (N, 4) quaternions with the real part first."""
    turns = Rotation.from_quat(quaternions.reshape(-1, 4)[:, [1, 2, 3, 0]])
    return np.degrees(turns.as_rotvec())

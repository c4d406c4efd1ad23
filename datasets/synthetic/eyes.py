"""Eyeballs to be looked at: a finer ball than the tracked one, with cornea, iris and veins painted on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray, IntArray
from ..head.geometry import smoothstep
from .anatomy import Eye
from .noise import value_noise
from .people import Person

_IRIS_ANGLE = 0.485  # radians; an iris of 5.9 mm radius on a ball of 12 mm
_PUPIL_SHARE = 0.40
_CORNEA_LIFT = 0.035  # of the ball's radius


@dataclass(frozen=True, eq=False)
class EyeMesh:
    """(n, 3) vertices at rest looking along +z, (m, 3) faces, (n, 3) linear reflectance."""

    vertices: FloatArray
    faces: IntArray
    albedo: FloatArray


def eye_mesh(person: Person, eye: Eye, *, inset: float = 0.0) -> EyeMesh:
    """Build the ball around ``eye``, its pole on the gaze axis.

    ``inset`` (metres) makes it smaller than the tracked ball, so that lids that touch the ball stay in front.
    """
    rings, spokes = 72, 96
    # Rings crowd where the iris is.
    polar = np.pi * np.linspace(0.0, 1.0, rings) ** 1.8
    around = np.linspace(0.0, 2.0 * np.pi, spokes, endpoint=False)
    theta, phi = np.meshgrid(polar[1:-1], around, indexing="ij")
    theta, phi = (np.concatenate([[0.0], a.ravel(), [b]]) for a, b in ((theta, np.pi), (phi, 0.0)))
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    lift = 1.0 + _CORNEA_LIFT * smoothstep(theta, 1.15 * _IRIS_ANGLE, 0.0)
    vertices = eye.center + (eye.radius - inset) * lift[:, None] * unit
    return EyeMesh(vertices, _ball_faces(rings, spokes), _paint(person, eye, theta, phi, unit))


def _ball_faces(rings: int, spokes: int) -> IntArray:
    index = 1 + np.arange((rings - 2) * spokes).reshape(rings - 2, spokes)
    a, b = index[:-1], index[1:]
    a1, b1 = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    strips = [np.stack([a, b, b1], -1).reshape(-1, 3), np.stack([a, b1, a1], -1).reshape(-1, 3)]
    last = 1 + (rings - 2) * spokes
    first_row, last_row = index[0], index[-1]
    caps = [
        np.stack([np.zeros(spokes, int), first_row, np.roll(first_row, -1)], -1),
        np.stack([np.full(spokes, last), np.roll(last_row, -1), last_row], -1),
    ]
    return np.concatenate(strips + caps)


def _paint(person: Person, eye: Eye, theta: FloatArray, phi: FloatArray, unit: FloatArray) -> FloatArray:
    radius = theta / _IRIS_ANGLE  # 1 at the limbus
    white = np.tile(np.array([0.70, 0.66, 0.63]), (len(theta), 1))
    # Veins and warmth grow towards the corners.
    side = smoothstep(np.abs(unit[:, 0]), 0.35, 0.8)
    veins = smoothstep(np.abs(value_noise(unit * np.array([4.0, 14.0, 4.0]), person.seed + 71)), 0.08, 0.0)
    white *= (
        1.0
        - side[:, None] * np.array([0.10, 0.26, 0.28])
        - (side * veins * 0.5)[:, None] * np.array([0.2, 0.7, 0.7])
    )
    ring = np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], axis=1)
    fibres = value_noise(np.concatenate([ring[:, :2] * 9.0, radius[:, None] * 1.5], axis=1), person.seed + 72)
    glow = 0.8 + 0.55 * smoothstep(radius, 0.9, 0.45) + 0.35 * fibres
    iris = person.iris[None] * np.clip(glow, 0.3, 2.0)[:, None]
    iris *= (1.0 - 0.75 * smoothstep(radius, 0.80, 1.0))[:, None]  # limbal ring
    color = white + smoothstep(radius, 1.06, 0.96)[:, None] * (iris - white)
    return np.clip(
        color * (1.0 - 0.985 * smoothstep(radius, _PUPIL_SHARE + 0.05, _PUPIL_SHARE - 0.05))[:, None], 0.002, 0.9
    )

"""One subject's recording before it is rendered: traits, head model, poses, camera rig, output folder."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...bench.contracts import Camera, FloatArray, HeadPose
from ...bench.errors import InputError
from ...bench.io.files import digest
from ..ga.writer import CapturePlan, CaptureWriter, SequencePlan
from ..head.arrays import HeadArrays
from ..head.geometry import ANGLE_BITS, COEFFICIENT_BITS, LENGTH_BITS, on_grid, smoothstep
from ..head.ict import expression_names, ict_head, is_ict, read_ict
from ..head.model import HeadModel
from ..head.procedural.model import procedural_head
from .anatomy import HAIR, IRIS, SKIN, Anatomy, Person, linear, measure
from .hair import STYLES, Style, tracked_volume
from .parts import MouthPart, procedural_parts, share_that_shows, tongue
from .performance import (
    HELD_OUT,
    Kind,
    Performed,
    Translation,
    frames_kept,
    ict_translation,
    perform,
    procedural_translation,
    share_out,
)
from .tracking import Tracker, with_tracking_error, with_tracking_noise

AGES = (20.0, 78.0)
_GREY = "#c4c0ba"
_SHORT = 0.05  # metres; of longer hair the hairline does not recede
_TRAITS, _BLOCK = 5, 10  # traits that are distributed evenly over every ten subjects


def spread(seed: int, index: int) -> FloatArray:
    """(5,) numbers in [0, 1): a Latin hypercube over every ten subjects of a seed. They are skin tone, age, hair style,
    beard and glasses."""
    rng = np.random.default_rng([seed, 21, index // _BLOCK])
    tenths = np.stack([rng.permutation(_BLOCK) for _ in range(_TRAITS)], axis=1)
    return (tenths + rng.random((_BLOCK, _TRAITS)))[index % _BLOCK] / _BLOCK


def draw_person(name: str, index: int, seed: int, dynamics: float = 1.0) -> Person:
    """Draw subject number ``index`` of a capture made with ``seed``."""
    rng = np.random.default_rng([seed, index, 22])
    tone, years, style, growth, eyewear = spread(seed, index)
    age = AGES[0] + (AGES[1] - AGES[0]) * years
    place = tone * (len(SKIN) - 1)
    lower, upper = linear(SKIN[int(place)]), linear(SKIN[int(place) + 1])
    skin = (lower + (place - int(place)) * (upper - lower)) * rng.uniform(0.95, 1.05, 3)
    old = float(smoothstep(age, 35.0, 75.0))
    dark = place > 3.0
    hair = linear(HAIR[rng.integers(0, 2 if dark else len(HAIR) - 1)]) * rng.uniform(0.85, 1.15)
    grey = float(np.clip(smoothstep(age, 38.0, 74.0) + 0.2 * rng.standard_normal() * old, 0.0, 1.0))
    hair = hair + grey * (linear(_GREY) - hair)
    lips = skin * np.array([0.86, 0.50, 0.50]) * rng.uniform(0.9, 1.1)
    lips = lips + 0.35 * old * (0.8 * skin - lips)
    beard = 0.0 if growth < 0.6 else 0.006 if growth < 0.8 else float(rng.uniform(0.012, 0.020))
    worn = tuple(STYLES)[int(style * len(STYLES))]
    recession = (
        float(rng.random() < 0.6) * float(rng.uniform(0.0, 0.045)) * float(smoothstep(age, 28.0, 60.0))
    )
    return Person(
        name=name,
        seed=int(rng.integers(1, 2**31)),
        skin=skin,
        lips=lips,
        hair=hair,
        iris=linear(IRIS[rng.choice([0, 4] if dark else len(IRIS))]),
        style=worn,
        brow_thickness=float(rng.uniform(0.85, 1.25)),
        freckles=float(rng.choice([0.0, 0.0, 0.5, 1.0])) if place < 2.5 else 0.0,
        stubble=1.0 if beard else float(rng.uniform(0.3, 1.0)) if growth > 0.4 else 0.0,
        lines=float(rng.uniform(0.85, 1.2)) * (0.85 + 0.3 * old),
        dynamics=dynamics,
        lines_at_rest=old * float(rng.uniform(0.6, 1.0)),
        oil=float(rng.uniform(0.4, 1.2)) * (1.0 - 0.4 * old),
        sag=float(smoothstep(age, 38.0, 78.0)),
        spots=old * float(rng.uniform(0.2, 1.0)),
        recession=recession if STYLES[worn].length < _SHORT else 0.0,
        beard=beard,
        glasses="" if eyewear < 0.7 else "metal" if eyewear < 0.9 else "plastic",
    )


FIRST_SUBJECT = 900
"""First number of synthetic subjects; NeRSemble's participants have smaller numbers."""

_IDENTITY_SPREAD = 0.65  # standard deviations of the identity basis; 1 would draw rare faces too often
_BUST = 0.213  # metres from the target down to the end of the bust, which lies below the image
_LOOK_BELOW, _LOOK_ABOVE = 0.004, 0.012  # metres at most between the target and the middle of the head


def subject_name(place: int) -> str:
    """Name of the subject at a place of a capture, from 0."""
    return f"{FIRST_SUBJECT + place}"


EDITION = 3
"""Version of the content: captures of one version and the same settings have the same content."""


RESIDUALS = ("hair_lag", "camera_colour", "motion_blur", "mask_error", "correctives")
"""Settings of effects that tracked parameters and calibrated cameras do not explain; each is a level, and 0 disables it."""
MOST_RESIDUAL = 4.0
"""Highest level of these settings."""


@dataclass(frozen=True)
class SyntheticSettings:
    """Settings that define a synthetic capture's content. ``size`` is (width, height)."""

    subjects: int
    cameras: int
    timesteps: int
    size: tuple[int, int]
    head: str
    seed: int
    tracking_noise: float
    samples_per_pixel: int
    performance: Kind = "natural"
    dynamics: float = 1.0
    tracking_error: float = 0.0
    tracker: Tracker = "video"
    hair_lag: float = 0.0
    camera_colour: float = 0.0
    motion_blur: float = 0.0
    mask_error: float = 0.0
    correctives: float = 0.0

    def described(self) -> dict[str, Any]:
        """The settings for records, and the edition."""
        return {**asdict(self), "edition": EDITION}


@dataclass(frozen=True, eq=False)
class SubjectPlan:
    """One subject's plan. ``poses`` are exact, by sequence; stored ones may have tracking noise."""

    index: int
    person: Person
    geometry: Geometry
    shape: FloatArray
    cameras: Mapping[str, Camera]
    performed: Mapping[str, Performed]
    poses: Mapping[str, tuple[HeadPose, ...]]
    writer: CaptureWriter
    settings: SyntheticSettings

    def moments(self) -> Iterator[tuple[str, int]]:
        """(sequence, timestep) of everything to render."""
        for name, poses in self.poses.items():
            for timestep in range(len(poses)):
                yield name, timestep

    def render_seed(self, sequence: str, timestep: int, camera: str) -> int:
        """Seed of one image's sampling, independent of the distribution of work."""
        return int(digest(self.settings.seed, self.person.name, sequence, timestep, camera)[:7], 16)


def plan_subject(out: Path, index: int, geometry: Geometry, settings: SyntheticSettings) -> SubjectPlan:
    """Plan subject number ``index``: nothing is rendered or written."""
    name = subject_name(index)
    who = draw_person(name, index, settings.seed, settings.dynamics)
    rng = np.random.default_rng([settings.seed, index, 3])
    head = geometry.head
    drawn = rng.standard_normal(head.shape_basis.shape[2]) * _IDENTITY_SPREAD
    shape = on_grid(np.clip(drawn, -1.6, 1.6), COEFFICIENT_BITS)
    width, height = settings.size
    neutral = HeadModel(head, dtype=torch.float64).canonical(torch.from_numpy(shape))[0].numpy()
    anatomy = measure(head, neutral)
    target = _middle(anatomy, neutral, STYLES[who.style])
    tongue_shows = share_that_shows(geometry.mouth(who, anatomy, shape), anatomy, neutral)
    views = cameras(settings.cameras, width, height, target, seed=settings.seed + 101 * index)
    performed, poses = {}, {}
    counts = share_out(settings.timesteps, settings.performance)
    interval = frames_kept(settings.timesteps, counts)
    for sequence, count in counts.items():
        performed[sequence] = perform(
            sequence, count, settings.seed + 101 * index, tongue_shows, settings.performance, interval
        )
        poses[sequence] = tuple(
            geometry.translation.pose(activations, name, timestep)
            for timestep, activations in enumerate(performed[sequence].activations)
        )
    tracked_by_name = with_tracking_error(
        poses,
        {sequence: played.activations for sequence, played in performed.items()},
        geometry.translation,
        head,
        shape,
        settings.tracking_error,
        settings.seed + 101 * index,
        settings.tracker,
        {sequence: played.step for sequence, played in performed.items()},
    )
    every = [pose for sequence in tracked_by_name.values() for pose in sequence]
    tracked = iter(with_tracking_noise(every, settings.tracking_noise, settings.seed + 101 * index))
    plan = CapturePlan(
        subject=name,
        head=head,
        shape=shape,
        static_offset=tracked_volume(who, anatomy, head, neutral),
        cameras=list(views.values()),
        sequences=[
            SequencePlan(sequence, [next(tracked) for _ in exact], performed[sequence].excluded)
            for sequence, exact in poses.items()
        ],
        test_sequences=[sequence for sequence in poses if sequence.startswith(HELD_OUT)],
        novel_view_cameras=[FRONTAL],
        synthetic={**settings.described(), "head": geometry.source, "style": who.style},
    )
    return SubjectPlan(
        index, who, geometry, shape, views, performed, poses, CaptureWriter(out, plan), settings
    )


def _middle(anatomy: Anatomy, neutral: FloatArray, style: Style) -> FloatArray:
    """Target of the cameras: near the middle of the head with its hair, at rest, so high that the bust's end is not
    visible. Only parts above the chin count: neck and shoulders need not be in the frame from every side."""
    skin = neutral[np.unique(anatomy.skin_faces)]
    above = skin[skin[:, 1] > anatomy["chin"][1]]
    low, high = above.min(axis=0), above.max(axis=0)
    low[2] -= (style.cap + style.rise) * anatomy.scale
    middle = 0.5 * (low + high)
    lift = np.clip(skin[:, 1].min() + _BUST - middle[1], -_LOOK_BELOW, _LOOK_ABOVE)
    return on_grid(middle + np.array([0.0, lift, 0.0]), LENGTH_BITS)


FRONTAL = "222200037"
SERIALS = (
    *("222200042", "222200044", "222200046", "222200040", "222200036", "222200048", "220700191", "222200041"),
    *(FRONTAL, "222200038", "222200047", "222200043", "222200049", "222200039", "222200045", "221501007"),
)
_LOWER = {
    *("222200044", "222200040", "222200048", "222200041"),
    *("222200038", "222200043", "222200039", "222200045"),
}
_ARC = np.radians(93.0)
_RISE = np.radians(32.0)
CAMERA_DISTANCE = 1.0  # metres from the head's middle
_FRAME_HEIGHT = 0.394  # metres of the scene that the image's height shows at the head's middle
_FRAME_WIDTH = 0.270

# Order in which cameras are selected: the frontal one, then those farthest apart.
_SPREAD = (8, 0, 15, 3, 12, 6, 5, 10, 1, 14, 7, 9, 2, 13, 4, 11)


def serials(count: int) -> list[str]:
    """Names of ``count`` cameras, in canonical order."""
    if not 1 <= count <= len(SERIALS):
        raise InputError("--cameras", "", f"1 to {len(SERIALS)} cameras", str(count))
    return [SERIALS[i] for i in sorted(_SPREAD[:count])]


def cameras(count: int, width: int, height: int, target: FloatArray, seed: int = 0) -> dict[str, Camera]:
    """``count`` cameras by serial, in canonical order, looking at ``target`` (3,).

    Every set holds the frontal camera. The principal point lies a little off the image's centre (below 1 %
    of the width, another one per capture), and all cameras share it, as one calibration does.
    """
    names = serials(count)
    focal = CAMERA_DISTANCE * min(width / _FRAME_WIDTH, height / _FRAME_HEIGHT)
    shift = np.random.default_rng([seed, 11]).uniform(-0.008, 0.008, 2) * width
    K = np.array(
        [[focal, 0.0, 0.5 * width + shift[0]], [0.0, focal, 0.5 * height + shift[1]], [0.0, 0.0, 1.0]]
    )
    return {
        name: Camera(name, width, height, K, _look_at(*_place(SERIALS.index(name)), target)) for name in names
    }


def _place(index: int) -> tuple[float, float]:
    """Azimuth (positive to the subject's left) and elevation of a camera, radians."""
    lower = SERIALS[index] in _LOWER
    azimuth = _ARC * (index // 2 / 7.0 - 0.5)
    if SERIALS[index] == FRONTAL:
        return 0.0, 0.0
    # The rows are staggered by half a column so that sixteen azimuths differ.
    azimuth += (0.25 if lower else -0.25) * _ARC / 7.0
    return float(np.clip(azimuth, -0.5 * _ARC, 0.5 * _ARC)), -0.4 * _RISE if lower else 0.6 * _RISE


def _look_at(azimuth: float, elevation: float, target: FloatArray) -> FloatArray:
    outward = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
    )
    forward = -outward
    right = np.cross(forward, np.array([0.0, 1.0, 0.0]))
    right /= np.linalg.norm(right)
    rotation = on_grid(np.stack([right, np.cross(forward, right), forward]), ANGLE_BITS)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    # From the rounded axis and with a fixed order of summation, since the JSONs contain all digits of these numbers.
    matrix[:3, 3] = -(rotation * (target - CAMERA_DISTANCE * rotation[2])).sum(axis=1) + 0.0
    return matrix


PROCEDURAL = ("procedural", "procedural2020", "procedural2023")


@dataclass(frozen=True, eq=False)
class Geometry:
    """A head model that can be animated and rendered. ``mouth(person, anatomy, shape)`` makes the parts in the mouth
    that the head model lacks."""

    head: HeadArrays
    translation: Translation
    mouth: Callable[[Person, Anatomy, FloatArray], Sequence[MouthPart]]
    source: str


def load_geometry(name: str) -> Geometry:
    """``procedural`` (or ``procedural2020``, ``procedural2023``), or the folder ``FaceXModel`` of ICT-FaceKit or an npz of its arrays."""
    if name in PROCEDURAL:
        return _procedural(name.removeprefix("procedural") or "2023")
    path = Path(name)
    if not path.exists():
        raise InputError("--head", "", f"{', '.join(PROCEDURAL)} or an existing file or folder", name)
    content = read_ict(path)
    if not is_ict(content):
        expected = "ICT-FaceKit, its folder FaceXModel or an npz"
        raise InputError(path, "", expected, f"{', '.join(sorted(content))}", "Or take the procedural head.")
    head = ict_head(path, content)
    translation = ict_translation(head, expression_names(content))

    def mouth(person: Person, anatomy: Anatomy, shape: FloatArray) -> Sequence[MouthPart]:
        return (tongue(person, anatomy, len(head.parents)),)

    return Geometry(head, translation, mouth, "ict-facekit")


@functools.cache
def _procedural(version: str) -> Geometry:
    head = procedural_head(version)

    def mouth(person: Person, anatomy: Anatomy, shape: FloatArray) -> Sequence[MouthPart]:
        return procedural_parts(person, head, shape)

    return Geometry(head, procedural_translation(head), mouth, head.version)

"""One subject's recording before it is photographed: who, which poses, which cameras, where it is written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...bench.contracts import Camera, FloatArray, HeadPose
from ...bench.io.files import digest
from ..ga.writer import CapturePlan, CaptureWriter, SequencePlan
from ..head.model import HeadModel
from ..rounding import COEFFICIENT_BITS, LENGTH_BITS, on_grid
from .anatomy import Anatomy, measure
from .geometry import Geometry
from .hair import STYLES, Style
from .people import Person, person
from .performance import HELD_OUT, Kind, Performed, perform, share_out
from .rig import FRONTAL, cameras
from .tongue_labels import share_that_shows
from .tracking import with_tracking_noise

FIRST_SUBJECT = 900
"""Synthetic subjects count from here: no participant of NeRSemble has such a number."""

_IDENTITY_SPREAD = 0.65  # standard deviations of the identity basis; 1 would draw rare faces too often
_LOOK_BELOW = 0.004  # metres below the middle of the head


@dataclass(frozen=True)
class Settings:
    """What decides a synthetic capture's content. ``size`` is (width, height)."""

    subjects: int
    cameras: int
    timesteps: int
    size: tuple[int, int]
    head: str
    seed: int
    tracking_noise: float
    samples_per_pixel: int
    performance: Kind = "full"
    dynamics: float = 1.0

    def described(self) -> dict[str, Any]:
        """The settings for records; those that came later are left out where they have their default."""
        described = asdict(self)
        for name, usual in (("performance", "full"), ("dynamics", 1.0)):
            if described[name] == usual:
                del described[name]
        return described


@dataclass(frozen=True, eq=False)
class Take:
    """One subject's plan. ``poses`` are exact, by sequence; what is stored may carry tracking noise."""

    index: int
    person: Person
    geometry: Geometry
    shape: FloatArray
    cameras: Mapping[str, Camera]
    performed: Mapping[str, Performed]
    poses: Mapping[str, tuple[HeadPose, ...]]
    writer: CaptureWriter
    settings: Settings

    def moments(self) -> Iterator[tuple[str, int]]:
        """(sequence, timestep) of everything to photograph."""
        for name, poses in self.poses.items():
            for timestep in range(len(poses)):
                yield name, timestep

    def render_seed(self, sequence: str, timestep: int, camera: str) -> int:
        """Seed of one image's sampling, the same however the work is divided."""
        return int(digest(self.settings.seed, self.person.name, sequence, timestep, camera)[:7], 16)


def plan_take(out: Path, index: int, geometry: Geometry, settings: Settings) -> Take:
    """Plan subject number ``index``: nothing is rendered or written."""
    name = f"{FIRST_SUBJECT + index}"
    who = person(name, index, settings.seed, settings.dynamics)
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
    for sequence, count in share_out(settings.timesteps).items():
        performed[sequence] = perform(
            sequence, count, settings.seed + 101 * index, tongue_shows, settings.performance
        )
        poses[sequence] = tuple(
            geometry.translation.pose(activations, name, timestep)
            for timestep, activations in enumerate(performed[sequence].activations)
        )
    every = [pose for sequence in poses.values() for pose in sequence]
    tracked = iter(with_tracking_noise(every, settings.tracking_noise, settings.seed + 101 * index))
    plan = CapturePlan(
        subject=name,
        head=head,
        shape=shape,
        static_offset=np.zeros(head.template.shape),
        cameras=list(views.values()),
        sequences=[
            SequencePlan(sequence, [next(tracked) for _ in exact], performed[sequence].excluded)
            for sequence, exact in poses.items()
        ],
        test_sequences=[HELD_OUT],
        novel_view_cameras=[FRONTAL],
        synthetic={**settings.described(), "head": geometry.source, "style": who.style},
    )
    return Take(index, who, geometry, shape, views, performed, poses, CaptureWriter(out, plan), settings)


def _middle(anatomy: Anatomy, neutral: FloatArray, style: Style) -> FloatArray:
    """Where the cameras look: the middle of the head with its hair, at rest, a little low so that the bust shows.

    From the chin up only: neck and shoulders are no part of what must stay in the frame from every side.
    """
    skin = neutral[np.unique(anatomy.skin_faces)]
    above = skin[skin[:, 1] > anatomy["chin"][1]]
    low, high = above.min(axis=0), above.max(axis=0)
    low[2] -= (style.cap + style.rise) * anatomy.scale
    middle = 0.5 * (low + high)
    return on_grid(middle - np.array([0.0, _LOOK_BELOW * anatomy.scale, 0.0]), LENGTH_BITS)

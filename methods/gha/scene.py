"""What both stages of training know of a clip."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Clip, FrameKey, IntArray
from ..shared.avatar_files import Subject
from ..shared.rendering import View, view_of
from .config import GHAConfig
from .driving import ANGLES, Driver, Signal, code_size
from .landmarks import landmark_vertices


class Scene(NamedTuple):
    """A clip made ready.

    Attributes
    ----------
    keys : training frames.
    timesteps : of the training frames, ascending; ``row`` gives the place of each.
    signals : by row.
    tracked : driving arguments by name, (T, n) each.
    views : training cameras.
    background : (3,).
    rest : (V, 3) the subject's neutral head with the jaw open by the configured angle, canonical units: what the
        neutral surface is to be.
    landmark_rows : (L,) vertices of the head model.
    expression_scale : (E,) that expression codes are divided by.
    code_low, code_high : (E,) bounds of the expression code that colour and attributes follow.
    """

    clip: Clip
    driver: Driver
    keys: tuple[FrameKey, ...]
    timesteps: list[int]
    row: Mapping[int, int]
    signals: list[Signal]
    tracked: Mapping[str, Tensor]
    views: Mapping[str, View]
    background: Tensor
    rest: Tensor
    landmark_rows: IntArray
    expression_scale: Tensor
    code_low: Tensor
    code_high: Tensor
    device: str
    seed: int

    def frame(self) -> dict[str, Tensor]:
        """What an avatar keeps of it: origin of the canonical frame, background and scale of the expression."""
        return {
            "origin": self.driver.origin,
            "background": self.background,
            "expression_scale": self.expression_scale,
            "code_low": self.code_low,
            "code_high": self.code_high,
        }


def scene_of(clip: Clip, config: GHAConfig, device: str, seed: int) -> Scene:
    """Make a clip ready. Raises `InputError` where its head model has no face region."""
    subject = Subject.of(clip)
    identity = (clip.head, subject.shape, subject.static_offset)
    plain = Driver(*identity, np.zeros(3), 1.0, None, device)
    neutral = plain.neutral.cpu().numpy()
    rows = landmark_vertices(clip.head, neutral, config.landmarks)
    timesteps = sorted({key.timestep for key in clip.splits["train"]})
    tracked = plain.arguments([clip.poses[timestep] for timestep in timesteps])
    scale = torch.ones(code_size(clip.head), device=device)
    expressions = clip.head.expression_basis.shape[2]
    scale[expressions : expressions + ANGLES] = config.angle_unit
    driver = Driver(*identity, neutral[rows].mean(0), config.unit, scale, device)
    opened = torch.zeros(1, len(scale), device=device)
    opened[0, expressions] = config.neutral_jaw / config.angle_unit
    signals = driver.signals(tracked)
    low, high = bounds(torch.stack([signal.expression for signal in signals]), config.appearance_margin)
    return Scene(
        clip=clip,
        driver=driver,
        keys=tuple(clip.splits["train"]),
        timesteps=timesteps,
        row={timestep: row for row, timestep in enumerate(timesteps)},
        signals=signals,
        tracked=tracked,
        views={
            name: view_of(clip.cameras[name], device) for name in {k.camera for k in clip.splits["train"]}
        },
        background=torch.as_tensor(np.asarray(clip.background), dtype=torch.float32, device=device),
        rest=driver.unposed(driver.still(opened))[0],
        landmark_rows=rows,
        expression_scale=scale,
        code_low=low,
        code_high=high,
        device=device,
        seed=seed,
    )


def bounds(codes: Tensor, margin: float | None) -> tuple[Tensor, Tensor]:
    """(E,) lowest and highest values of (T, E) codes, each pushed out by ``margin`` of the range between them; without
    a margin, the largest numbers there are."""
    if margin is None:
        largest = torch.full_like(codes[0], torch.finfo(codes.dtype).max)
        return -largest, largest
    low, high = codes.amin(0), codes.amax(0)
    return low - margin * (high - low), high + margin * (high - low)

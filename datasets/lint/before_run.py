"""The errors of the linter that make every result of a capture meaningless, looked for in a few frames before a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from ...bench.contracts import Clip, FrameKey
from ...bench.io.images import ImageInfo
from ..ga import layout
from ..ga.tracking import Tracking
from ..ga.transforms import FrameEntry
from .catalogue import RULES
from .evidence import Evidence
from .mesh import Parameters, TrackedSubject
from .rules import apply
from .settings import LintSettings
from .views import Pixels, inspect_views, pick_views

if TYPE_CHECKING:
    from ..head.arrays import HeadArrays

CODES = ("HB503", "HB504", "HB505", "HB701")
"""The head behind the cameras, upside down, or far off; the mesh beside the subject. What else the linter finds makes
numbers wrong, not void."""
FRAMES = 12
"""Frames that are decoded, spread over timesteps and cameras."""
MOST = 1000
"""Frames that they are chosen of."""


def errors(clip: Clip) -> list[str]:
    """Errors of the linter for a clip: code, fault and remedy of each error in `CODES`."""
    if clip.head is None:
        return []  # a capture of something else, for methods that need no head
    keys = sorted({key for part in clip.splits.values() for key in part})
    keys = keys[:: max(1, len(keys) // MOST)]
    entries = {_entry(clip, key): key for key in keys}
    by_image = {entry.image: key for entry, key in entries.items()}
    headers = {
        entry.image: ImageInfo(clip.cameras[key.camera].width, clip.cameras[key.camera].height, 3)
        for entry, key in entries.items()
    }
    pixels = Pixels(
        headers,
        lambda entry: clip.image(by_image[entry.image]),
        lambda entry: clip.mask(by_image[entry.image]),
    )
    chosen = pick_views([*entries], FRAMES)
    head = cast("HeadArrays", clip.head)  # any `HeadAsset` can be posed
    subject = TrackedSubject(Tracking(head, clip.poses, clip.shape, clip.static_offset))
    parameters = {
        entry.timestep: Parameters(entry.timestep, Path(), {}, pose=clip.poses[entry.timestep])
        for entry in chosen
    }
    background = tuple(map(float, clip.background))
    evidence = Evidence(
        folder=Path(clip.subject),
        settings=LintSettings(),
        of_layout=False,
        background=background,
        splits={"train": tuple(entries)},
        headers=headers,
        digests={},
        parameters=parameters,
        subject=subject,
        views=inspect_views(chosen, pixels, subject, parameters, background, "top"),
        thumbnails=(),
        cameras={},
        expression_fit=None,
    )
    rules = [rule for rule in RULES if rule.code in CODES]
    return [f"{found.code}: {found.message}. {found.remedy}" for found in apply(rules, evidence)]


def _entry(clip: Clip, key: FrameKey) -> FrameEntry:
    """A clip's frame as the layout would state it; the key stands for paths."""
    camera = clip.cameras[key.camera]
    return FrameEntry(
        file=Path(clip.subject),
        where=f"frame {key}",
        timestep=key.timestep,
        camera_index=list(clip.cameras).index(key.camera),
        camera_id=key.camera,
        sequence_folder=key.sequence,
        image=Path(str(key)),
        mask=None,
        parameters=Path(clip.subject),
        width=camera.width,
        height=camera.height,
        intrinsics=layout.intrinsics_to_json(camera, "top"),
        camera_to_world=np.array(layout.extrinsics_to_json(camera.world_to_camera)),
    )

"""Checks of a few frames before a run for errors that make every result of a capture meaningless."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

from ...bench.contracts import Clip
from ...bench.io.images import ImageInfo
from ..ga.tracking import Tracking
from .catalogue import RULES
from .evidence import Evidence, clip_entry
from .mesh import Parameters, TrackedSubject
from .rules import apply
from .settings import LintSettings
from .views import Pixels, inspect_views, pick_views

if TYPE_CHECKING:
    from ..head.arrays import HeadArrays

CODES = ("HB503", "HB504", "HB505", "HB701")
"""Codes for a head behind the cameras, upside down or far away, and for a mesh beside the subject. Other findings of
the linter make numbers inaccurate, not meaningless."""
FRAMES = 12
"""Number of decoded frames, spread over timesteps and cameras."""
MOST = 1000
"""Number of candidate frames."""


def errors(clip: Clip) -> list[str]:
    """Errors of the linter for a clip: code, fault and remedy of each error in `CODES`."""
    if clip.head is None:
        return []  # a capture without a head, for methods that need none
    folder = Path(clip.subject)
    keys = sorted({key for part in clip.splits.values() for key in part})
    keys = keys[:: max(1, len(keys) // MOST)]
    entries = {clip_entry(folder, clip, key): key for key in keys}
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
        folder=folder,
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

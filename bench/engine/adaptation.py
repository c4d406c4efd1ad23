"""Adapts clips to the needs that a method declares: head model, image size, one video.

One function adapts the clips of every reader, the entry point of the group ``headbench.adaptation``::

    adapt(clip, needs, heads) -> (folder, progress) -> AdaptedClip

The outer call checks whether the needs can be met and raises `InputError` otherwise, before any long work;
the returned function adapts the clip and stores results of slow steps in ``folder``. ``heads`` are files of
head models by version.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ..contracts import Clip, FloatArray, FrameKey, Progress
from ..errors import HeadbenchError, InputError
from ..progress import progress
from ..registry import entry_points
from ..specs import MethodSpec, ResolutionRule


@dataclass(frozen=True)
class MethodNeeds:
    """Requirements of a method on its clips; see the attributes of `MethodSpec`."""

    head_models: tuple[str, ...] = ()
    monocular: bool = False
    resolution: ResolutionRule = field(default_factory=ResolutionRule)

    @classmethod
    def of(cls, spec: MethodSpec) -> MethodNeeds:
        """The requirements that a method declares."""
        return cls(spec.head_models, spec.monocular, spec.resolution)


@dataclass(frozen=True, eq=False)
class AdaptedClip:
    """A clip adapted to a method, and the mapping back to the frames of the protocol."""

    clip: Clip
    """Clip that the method is trained on; its cameras and poses are rendered."""
    key: Callable[[FrameKey], FrameKey] = lambda key: key
    """Maps a frame key of the protocol to its key in ``clip``."""
    restore: Callable[[FrameKey, FloatArray], FloatArray] = lambda key, rgb: rgb
    """Maps a protocol key and the (H, W, 3) float render of that frame in ``clip`` to the render at the protocol's
    size, before quantisation."""


Adaptation = Callable[[Path, Progress], AdaptedClip]
Adapter = Callable[[Clip, MethodNeeds, Mapping[str, str]], Adaptation]


def adapter() -> Adapter:
    """The registered adaptation function, see the module."""
    entries = entry_points(group="headbench.adaptation")
    if not entries:
        raise HeadbenchError("nothing is registered as headbench.adaptation; install headbench again")
    registered: Adapter = next(iter(entries)).load()
    return registered


def plan(clip: Clip, needs: MethodNeeds, heads: Mapping[str, str]) -> Adaptation | None:
    """Check that ``clip`` can be adapted; return the adaptation, or None if the clip already meets the needs.

    For a monocular method the steps are applied even to a single view, since they also move the head's rigid
    motion into the cameras.
    """
    fits = not needs.head_models or clip.head.version in needs.head_models
    if fits and needs.resolution.native and not needs.monocular:
        return None
    return adapter()(clip, needs, heads)


def apply(adaptation: Adaptation, needs: MethodNeeds, folder: Path, label: str) -> AdaptedClip:
    """Run a planned adaptation and check that its result meets the needs."""
    with progress(label) as report:
        adapted = adaptation(folder, report)
    check(adapted.clip, needs)
    return adapted


def adapt(
    clip: Clip, needs: MethodNeeds, heads: Mapping[str, str], folder: Path, label: str = ""
) -> AdaptedClip:
    """`plan` and `apply` at once; a clip that meets the needs is not changed. ``label`` is that of the progress."""
    adaptation = plan(clip, needs, heads)
    if adaptation is None:
        return AdaptedClip(clip)
    return apply(adaptation, needs, folder, label or f"adapting {clip.subject}")


def check(clip: Clip, needs: MethodNeeds) -> None:
    """Raise `InputError` for a head model or number of views that a method does not support."""
    where = f"clip {clip.subject}"
    if needs.head_models and clip.head.version not in needs.head_models:
        expected = f"a capture tracked with {' or '.join(needs.head_models)}"
        raise InputError(where, "head_models", expected, clip.head.version)
    train = clip.splits["train"]
    views = len(train) - len({key.timestep for key in train})
    if needs.monocular and views:
        expected = "a single video, one training frame at a timestep"
        raise InputError(where, "monocular", expected, f"{views} further views")


def record(clip: Clip, adapted: AdaptedClip, method: str) -> dict[str, Any]:
    """Entry of the manifest for an adapted clip: the steps added and the resulting fingerprint."""
    added: Sequence[Any] = adapted.clip.steps[len(clip.steps) :]
    return {
        "subject": clip.subject,
        "method": method,
        "fingerprint": adapted.clip.fingerprint,
        "steps": [asdict(step) for step in added],
    }

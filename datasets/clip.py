"""A capture as methods and the harness see it: a `Clip` over files on disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from ..bench.contracts import ByteArray, Camera, FloatArray, FrameKey, HeadPose, StepRecord
from ..bench.errors import InputError
from ..bench.files import digest
from .head.arrays import HeadArrays
from .images import ImageStore


class FrameFiles(NamedTuple):
    """Where a frame's pixels are."""

    image: Path
    mask: Path | None


@dataclass(frozen=True, eq=False)
class CaptureClip:
    """A `Clip` (see there) whose images stay on disk until asked for.

    Attributes
    ----------
    files : of every frame, those of excluded frames included.
    source_fingerprint : digest of the content of all files behind the clip; does not depend on their place.
    store : decodes images and bounds the memory they take; shared by clips derived from one another.
    """

    subject: str
    head: HeadArrays
    shape: FloatArray
    static_offset: FloatArray
    cameras: Mapping[str, Camera]
    poses: Mapping[int, HeadPose]
    splits: Mapping[str, tuple[FrameKey, ...]]
    excluded: Mapping[FrameKey, str]
    background: FloatArray
    steps: Sequence[StepRecord]
    files: Mapping[FrameKey, FrameFiles]
    source_fingerprint: str
    store: ImageStore

    @cached_property
    def fingerprint(self) -> str:
        """Hex digest of the files' content, the steps with their parameters, and what the splits hold."""
        splits = {name: [str(key) for key in keys] for name, keys in self.splits.items()}
        excluded = {str(key): reason for key, reason in self.excluded.items()}
        return digest(self.source_fingerprint, [*self.steps], splits, excluded, self.background)

    def image(self, key: FrameKey) -> ByteArray:
        """(H, W, 3) 8-bit sRGB, composited on `background`; read-only, shared with the store.

        Raises `InputError` for a key the clip does not have.
        """
        return self.store.image(self._files(key).image, self.background)

    def mask(self, key: FrameKey) -> ByteArray | None:
        """(H, W) 8-bit foreground coverage, read-only; None where the capture has none."""
        path = self._files(key).mask
        return None if path is None else self.store.mask(path)

    def timesteps(self, split: str) -> list[int]:
        """Distinct timesteps of a split, sorted."""
        return sorted({key.timestep for key in self.splits[split]})

    def derive(self, step: str, parameters: Mapping[str, Any], **changes: Any) -> CaptureClip:
        """Copy with some fields changed and the step that changed them on record."""
        record = StepRecord(step, parameters, self.fingerprint)
        return replace(self, steps=(*self.steps, record), **changes)

    def _files(self, key: FrameKey) -> FrameFiles:
        try:
            return self.files[key]
        except KeyError:
            raise InputError("clip", "frame key", f"a frame of subject {self.subject}", str(key)) from None

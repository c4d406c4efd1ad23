"""The contact sheet of a run: ground truth, and each method's render and error map, of some frames of each task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np

from ..bench.contracts import ByteArray, FloatArray, FrameKey
from ..bench.engine.store import FinishedRun
from ..bench.errors import InputError
from ..bench.protocol import TASK_TITLES, evenly
from .drawing import SheetSection, Tile, TileRow, colour_map, write_sheet
from .runs import RunData

FRAMES_PER_TASK = 3
PANEL_WIDTH = 240
NICE_SCALES = (2, 5, 10, 20, 50, 100, 255)


def write_contact_sheet(run: Path | FinishedRun, frames_per_task: int = FRAMES_PER_TASK) -> list[Path]:
    """Draw some frames of each task, evenly spaced over its sorted keys; return the file written."""
    data = RunData.read(run)
    frames = [
        compared_frame(data, task, key, data.methods)
        for task in data.tasks
        for key in evenly(data.keys(task), frames_per_task)
    ]
    protocols = ", ".join(f"{p.id} ({p.hash})" for p in data.manifest.protocols.values())
    subjects = dict.fromkeys(key.subject for task in data.tasks for key in data.keys(task))
    contact_sheet(
        frames,
        data.methods,
        data.folder.contact_sheet,
        title=f"headbench: {', '.join(subjects)}",
        subtitle=f"Frames evenly spaced over each task. Protocol {protocols}. Seed {data.seed}.",
        scaled_by=[method for method in data.methods if method not in data.trivial],
    )
    return [data.folder.contact_sheet]


@dataclass(frozen=True)
class ComparedFrame:
    """One frame at its displayed size; ``section`` is its heading."""

    section: str
    labels: Sequence[str]  # short lines to its left (sequence, timestep, camera)
    ground_truth: ByteArray  # (H, W, 3) 8-bit
    renders: Mapping[str, ByteArray | str]  # by method, of the same size, or the reason why it is missing
    errors: Mapping[
        str, FloatArray
    ]  # by method, (H, W) absolute difference in levels, mean over the channels
    captions: Mapping[str, str]  # by method, a short text under the render (its PSNR)

    @classmethod
    def of(
        cls,
        section: str,
        labels: Sequence[str],
        ground_truth: ByteArray,
        renders: Mapping[str, ByteArray | str],
        captions: Mapping[str, str],
        width: int = PANEL_WIDTH,
    ) -> ComparedFrame:
        """Resize images to a width: wider ones are reduced to it (by area), narrower ones enlarged by the largest
        integer factor that fits (nearest neighbour). Raises `InputError` for a render that differs in size from
        the ground truth.
        """
        height, own = ground_truth.shape[:2]
        factor = width // own or width / own
        size = (max(1, round(own * factor)), max(1, round(height * factor)))
        shown: dict[str, ByteArray | str] = {}
        errors = {}
        for method, image in renders.items():
            if isinstance(image, str):
                shown[method] = image
                continue
            if image.shape != ground_truth.shape:
                expected, found = (f"shape {one.shape}" for one in (ground_truth, image))
                raise InputError("contact sheet", f"render of {method}", expected, found)
            shown[method] = _resized(image, size)
            # Reduced after the difference, since errors of opposite sign would cancel if reduced before.
            errors[method] = _resized(np.abs(image.astype(np.float32) - ground_truth).mean(axis=2), size)
        return cls(section, labels, _resized(ground_truth, size), shown, errors, captions)


def contact_sheet(
    frames: Sequence[ComparedFrame],
    methods: Sequence[str],
    out: Path,
    *,
    title: str = "",
    subtitle: str = "",
    scaled_by: Sequence[str] = (),
) -> None:
    """Draw the sheet and write it as a PNG, atomically: ground truth, then a render and an error map for each method.

    All error maps of the sheet share a scale: a round number at or above the 99th percentile of the errors.
    Larger errors are clipped.

    Parameters
    ----------
    frames : Sequence[ComparedFrame]
        Frames, at least one; frames of a section are consecutive.
    methods : Sequence[str]
        Columns, in order.
    scaled_by : Sequence[str]
        Methods whose errors determine the scale (default: all), so that a trivial baseline does not darken
        the others.
    """
    if not frames:
        raise InputError("contact sheet", "rows", "at least one frame", "none")
    deciding = [error for f in frames for method, error in f.errors.items() if method in scaled_by]
    scale = _nice_scale(deciding or [error for frame in frames for error in frame.errors.values()])
    heads = ["Ground truth", *(head for method in methods for head in (method, "error"))]

    def row(frame: ComparedFrame) -> TileRow:
        tiles = [Tile(frame.ground_truth)]
        for method in methods:
            error = frame.errors.get(method)
            tiles.append(Tile(frame.renders.get(method, "not rendered"), frame.captions.get(method, "")))
            tiles.append(Tile("no error map" if error is None else colour_map(error / scale)))
        return TileRow(frame.labels, tiles)

    sections = [
        SheetSection(section, heads, [row(frame) for frame in members])
        for section, members in groupby(frames, key=lambda frame: frame.section)
    ]
    more = " or more" if scale < NICE_SCALES[-1] else ""
    write_sheet(
        out, sections, title=title, subtitle=subtitle, error_scale=(scale, more), pairs=True, label_width=150
    )


def compared_frame(
    data: RunData, task: str, key: FrameKey, methods: Sequence[str], width: int = PANEL_WIDTH
) -> ComparedFrame:
    """One frame of a run with the renders of some ``methods``, and their values of the run's first frame metric."""
    metric = next((m for m in data.metrics if m.per_frame), None)
    renders: dict[str, ByteArray | str] = {}
    captions: dict[str, str] = {}
    for method in methods:
        render = data.render(method, task, key)
        renders[method] = data.reason(method, task, key) if render is None else render
        value = data.value(metric.name, method, task, key) if metric else None
        if metric and value is not None:
            captions[method] = f"{metric.label} {value:.{metric.digits}f} {metric.unit}".rstrip()
    labels = (key.sequence, f"subject {key.subject}", f"timestep {key.timestep}", f"camera {key.camera}")
    section = TASK_TITLES.get(task, task)
    return ComparedFrame.of(section, labels, data.ground_truth(key), renders, captions, width)


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if size == (image.shape[1], image.shape[0]):
        return image
    larger = size[0] > image.shape[1]
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if larger else cv2.INTER_AREA))


def _nice_scale(errors: Sequence[FloatArray]) -> int:
    if not errors:
        return NICE_SCALES[-1]
    top = float(np.percentile(np.concatenate([error.ravel() for error in errors]), 99))
    return next(scale for scale in NICE_SCALES if scale >= top)

"""The contact sheet of a run: ground truth, and each method's render and error map, of some frames of each task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, zip_longest
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..bench.contracts import ByteArray, FloatArray, FrameKey
from ..bench.engine.store import FinishedRun
from ..bench.errors import InputError
from ..bench.io.documents import read_json
from ..bench.io.images import read_png
from ..bench.protocol import TASK_TITLES, evenly
from ..bench.specs import CommandResult
from .drawing import SheetSection, Tile, TileRow, colour_map, write_sheet
from .runs import RunData

RECORD_FILE, SHEET_FILE = "record.json", "contact_sheet.png"

EXTRAPOLATED, BROKEN = "#e88714", "#cd142d"
EXTREMES_WIDTH, REENACT_WIDTH, REENACT_COLUMNS = 110, 150, 8


def robustness_report(folder: Path) -> CommandResult:
    """Draw the contact sheet of ``headbench run extremes`` or ``headbench run reenact``; summarise it.

    Does not pass if an avatar broke a limit or failed.
    """
    record = read_json(folder / RECORD_FILE)
    avatars, failed = record["avatars"], record.get("failed", [])
    rendered = [avatar for avatar in avatars if "missing" not in avatar]
    text = table(avatars)
    for avatar in failed:
        text += f"\n{avatar['subject']} {avatar['method']} seed {avatar['seed']} failed: {avatar['reason']}"
    if rendered:
        write = write_extremes_sheet if "views" in rendered[0] else write_reenact_sheet
        write(folder, rendered)
        text += f"\n{folder / SHEET_FILE}"
    passed = not failed and all(avatar["frames_broken"] == 0 for avatar in avatars)
    return CommandResult(text, {"out": folder, "avatars": avatars}, passed)


def write_extremes_sheet(
    folder: Path, avatars: Sequence[Mapping[str, Any]], width: int = EXTREMES_WIDTH
) -> None:
    """Draw the sheet of avatars that ``headbench run extremes`` rendered into a folder: a column per view, then the path.

    The ground truth, if available, is above each render. Views beyond the training cameras have an orange border, frames that
    violate a limit a red one. The typical pose comes first, sampled poses below it.
    """
    write_sheet(
        folder / SHEET_FILE,
        [section for avatar in avatars for section in _extremes_sections(folder, avatar, width)],
        title="Novel views and poses",
        subtitle="Turntable between the training cameras and beyond; joint samples of expression and jaw along the principal "
        "components of training; a path through two of them. Truth: the person of the synthetic capture, path-traced.",
        marks={EXTRAPOLATED: "view beyond the training cameras", BROKEN: "a limit is exceeded"},
        label_width=66,
    )


def write_reenact_sheet(
    folder: Path,
    rendered: Sequence[Mapping[str, Any]],
    width: int = REENACT_WIDTH,
    columns: int = REENACT_COLUMNS,
) -> None:
    """Draw the sheet of avatars that ``headbench run reenact`` rendered into a folder.

    The source's frame is above the avatars that it drives, for up to ``columns`` evenly spaced timesteps of each pair of
    target and source. Frames that violate a limit have a red border.
    """

    def pair(avatar: Mapping[str, Any]) -> tuple[str, str]:
        return avatar["subject"], avatar["source"]

    sections = []
    for (target, source), group in groupby(sorted(rendered, key=pair), key=pair):
        avatars = list(group)
        chosen = evenly(range(len(avatars[0]["shown"])), columns)
        first = [avatars[0]["shown"][i] for i in chosen]
        places = [shown["key"].split("/") for shown in first]
        rows = [TileRow(["source"], [Tile(_picture(folder / shown["source"], width)) for shown in first])]
        for avatar in avatars:
            broken = {item["key"] for item in avatar["broken"]}
            tiles = [
                Tile(_picture(folder / shown["driven"], width), mark=BROKEN if shown["key"] in broken else "")
                for shown in (avatar["shown"][i] for i in chosen)
            ]
            rows.append(TileRow([avatar["method"], f"seed {avatar['seed']}"], tiles))
        heads = [f"{sequence} {int(timestep)}" for _, _, sequence, timestep, _ in places]
        sections.append(SheetSection(f"Subject {target} driven by {source}", heads, rows))
    write_sheet(
        folder / SHEET_FILE,
        sections,
        title="Cross-reenactment",
        subtitle="Expressions of the source in the first row, avatars of another subject below; no ground truth.",
        marks={BROKEN: "a limit is exceeded"},
    )


def _extremes_sections(folder: Path, avatar: Mapping[str, Any], width: int) -> list[SheetSection]:
    """The turntable, whose columns are views, and the path, whose columns are time."""
    views = {view["id"]: view for view in avatar["views"]}
    broken = {item["key"] for item in avatar["broken"]}
    columns: dict[str, list[Mapping[str, Any]]] = {name: [] for name in views}
    path: list[Mapping[str, Any]] = []
    for frame in avatar["shown"]:
        _, sequence, _, camera = frame["key"].split("/")
        (path if sequence == "path" else columns[camera]).append(frame)

    def rows(frames: Sequence[Mapping[str, Any] | None], label: str) -> list[TileRow]:
        """The ground truth of some frames, if available, with their renders below; None leaves a gap."""
        lines = []
        for name, picture in (("truth", "truth"), ("render", "driven")):
            if all(frame is None or picture in frame for frame in frames):
                tiles = [Tile("") if frame is None else tile(frame, picture) for frame in frames]
                lines.append(TileRow([label, name], tiles))
        return lines

    def tile(frame: Mapping[str, Any], picture: str) -> Tile:
        _, sequence, _, camera = frame["key"].split("/")
        mark = BROKEN if picture == "driven" and frame["key"] in broken else ""
        mark = mark or (EXTRAPOLATED if views[camera]["extrapolated"] else "")
        return Tile(_picture(folder / frame[picture], width), sequence if picture == "driven" else "", mark)

    turntable = []
    for index, frames in enumerate(zip_longest(*columns.values())):
        turntable += rows(frames, "samples" if index else "typical")
    title = f"{avatar['method']}, subject {avatar['subject']}, seed {avatar['seed']}"
    limits = f"{avatar['frames_broken']} of {avatar['frames']} frames exceed a limit"
    heads = [f"{view['azimuth']:+.0f}°" for view in views.values()]
    sections = [SheetSection(f"{title}: {limits}", heads, turntable)]
    if path:
        starts = range(0, len(path), len(views))
        lines = [row for start in starts for row in rows(path[start : start + len(views)], "path")]
        sections.append(SheetSection(f"{title}: path", [""] * len(views), lines))
    return sections


def _picture(path: Path, width: int) -> Any:
    """The image at a width, reduced by area; frames with non-finite values have no file."""
    if not path.exists():
        return "not finite"
    image = read_png(path)
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    method = cv2.INTER_CUBIC if width > image.shape[1] else cv2.INTER_AREA
    return cv2.resize(image, size, interpolation=method)


def table(avatars: Sequence[Mapping[str, Any]]) -> str:
    """Mean and worst value and failed frames of every measure of each avatar, for a terminal."""
    lines = []
    form = "  {:<16} {:>10} {:>10} {:>7} {:>7}".format
    for avatar in avatars:
        title = f"{avatar['subject']} {avatar['method']} seed {avatar['seed']}"
        lines.append(f"{title}: {avatar['frames_broken']} of {avatar['frames']} frames exceed a limit")
        if "missing" in avatar:
            lines.append(f"  missing: {avatar['missing']}")
            continue
        if "no_truth" in avatar:
            lines.append(f"  not compared with the truth: {avatar['no_truth']}")
        lines.append(form("measure", "mean", "worst", "failed", "frames"))
        for name, measure in avatar["measures"].items():
            if measure["frames"] or measure["failed"]:
                values = ("-" if measure[k] is None else f"{measure[k]:.3f}" for k in ("mean", "worst"))
                lines.append(form(name.replace("_", " "), *values, measure["failed"], measure["frames"]))
        if avatar.get("identity") is not None:
            parts = [f"{name} {value:.1f}" for name, value in avatar["identity"].items() if value is not None]
            lines.append(f"  colour difference from the subject's recordings (CIEDE2000): {', '.join(parts)}")
        lines += [f"  {b['key']}: {'; '.join(b['limits'])}" for b in avatar["broken"][:5]]
        if len(avatar["broken"]) > 5:
            lines.append(f"  and {len(avatar['broken']) - 5} more; all are in {RECORD_FILE}")
    return "\n".join(lines)


FRAMES_PER_TASK = 3
PANEL_WIDTH = 240
NICE_SCALES = (2, 5, 10, 20, 50, 100, 255)


def write_contact_sheet(run: Path | FinishedRun, frames_per_task: int = FRAMES_PER_TASK) -> list[Path]:
    """Draw some frames of each task, evenly spaced over its sorted keys; return the file written, none without frames."""
    data = RunData.read(run)
    frames = [
        compared_frame(data, task, key, data.methods)
        for task in data.tasks
        for key in evenly(data.keys(task), frames_per_task)
    ]
    if not frames:
        return []
    protocols = ", ".join(f"{p.id} ({p.hash})" for p in data.manifest.protocols.values())
    subjects = dict.fromkeys(key.subject for task in data.tasks for key in data.keys(task))
    contact_sheet(
        frames,
        data.methods,
        data.folder.contact_sheet,
        title=f"headbench: {', '.join(subjects)}",
        subtitle=f"Frames evenly spaced over each task. Protocol {protocols}. Seed {data.seed}.",
        scaled_by=[method.label for method in data.manifest.methods if not method.trivial],
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
        integer factor that fits (nearest neighbour).
        """
        height, original = ground_truth.shape[:2]
        factor = width // original or width / original
        size = (max(1, round(original * factor)), max(1, round(height * factor)))
        resized: dict[str, ByteArray | str] = {}
        errors = {}
        for method, image in renders.items():
            if isinstance(image, str):
                resized[method] = image
                continue
            if image.shape != ground_truth.shape:
                shapes = (f"shape {array.shape}" for array in (ground_truth, image))
                raise InputError("contact sheet", f"render of {method}", *shapes)
            resized[method] = _resized(image, size)
            # Reduced after the difference, since errors of opposite sign would cancel if reduced before.
            errors[method] = _resized(np.abs(image.astype(np.float32) - ground_truth).mean(axis=2), size)
        return cls(section, labels, _resized(ground_truth, size), resized, errors, captions)


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

    All error maps of the sheet share a scale: a round number at or above the 99th percentile of the errors of the methods
    ``scaled_by`` (default: all), so that a trivial baseline does not darken the others. Larger errors are clipped. ``frames`` of
    a section are consecutive, ``methods`` are the columns.
    """
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
    bar = scale, " or more" if scale < NICE_SCALES[-1] else ""
    write_sheet(out, sections, title=title, subtitle=subtitle, error_scale=bar, pairs=True, label_width=150)


def compared_frame(
    data: RunData, task: str, key: FrameKey, methods: Sequence[str], width: int = PANEL_WIDTH
) -> ComparedFrame:
    """One frame of a run with the renders of some ``methods``, and their values of the run's first frame metric."""
    metric = next((m for m in data.manifest.metrics if m.per_frame), None)
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

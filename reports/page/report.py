"""The HTML page of runs: its contents and file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro

from ...bench.contracts import Progress, no_progress
from ...bench.engine.config import RunOptions
from ...bench.engine.store import FinishedRun
from ...bench.errors import InputError
from ...bench.io.files import check_kind, check_output_folder, check_writable, write_text
from ...bench.io.images import probe_image
from ...bench.io.provenance import COMPOSITE, source_type
from ...bench.io.style import SHAPES, policy_hash, stylesheet
from ...bench.protocol import TASK_TITLES
from ...bench.rows import FULL
from ...bench.specs import CommandResult, MetricSpec, command
from ..aggregate import LATENCY, SPEED, STORAGE, pareto_front, summarise
from ..drawing import colour_map
from ..runs import FrameSelection, RunSet
from ..statistics.command import compare_methods
from ..table_report import layouts, table_of
from ..tables import AVATAR_TITLE, COMPARISON, TITLES, Table, compact
from ..writers import render_page
from .frames import Opening, Pictures, ShownFrame, choose_pictures, frame_values, opening, worst_frames
from .sections import (
    ENTRY_BYTES,
    FILE_BYTES,
    INDEX,
    PictureFile,
    cards_of,
    check_folder,
    failed_cells,
    loss_curves,
    picture_files,
    record_of,
    remove_others,
    verdict,
    write_pictures,
)

MAX_MB, MAX_SPLIT_MB = 10.0, 500.0


@dataclass(frozen=True)
class PageSettings(RunOptions):
    """Write finished runs to one HTML file: the result in words, frames of all methods side by side, tables, curves, record of
    the run.

    It needs no network and no other file. Images are chosen to fit in --max-mb: always the worst frames of each method and
    task, the others evenly over time. With --split the output is a folder, for large runs, whose index.html loads images when
    they are viewed.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs on the same frames, as for `headbench table`."""
    out: str | None = None
    """File to write, with --split a folder that is new or holds an earlier report. By default report.html or report."""
    split: bool = False
    """Write images to separate files, in a folder with the page."""
    max_mb: float | None = None
    """Maximum size in megabytes (10^6 bytes). By default 10, with --split 500."""
    papers: Annotated[tuple[str, ...], tyro.conf.arg(name="as")] = ()
    """Papers (`headbench list papers`) in whose table layout the runs are also shown, with the rows of the paper."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")
        most = 4000 if self.split else 1000
        if self.max_mb is not None and not 0.1 <= self.max_mb <= most:
            raise ValueError(f"max-mb is {self.max_mb}; from 0.1 to {most}")


HERE = Path(__file__).parent
MEGABYTE = 10**6
OPENING_SHARE = 0.97
"""Share of the bytes for images that excludes the second copy of the opening images."""


class TitledTable(NamedTuple):
    """A table with a heading."""

    title: str
    table: Table


def write_page(run: FinishedRun) -> list[Path]:
    """Write ``report.html`` of a run that has just ended; return the file."""
    page, _, _ = page_text(RunSet.read([run]), MAX_MB)
    write_text(run.folder.page, page)
    return [run.folder.page]


@command("report", group="inspect")
def write_report(settings: PageSettings, progress: Progress = no_progress) -> CommandResult:
    """Write an HTML report of finished runs; it opens without a network."""
    out = Path(settings.out or ("report" if settings.split else "report.html"))
    max_mb = settings.max_mb or (MAX_SPLIT_MB if settings.split else MAX_MB)
    if settings.split:
        check_kind(out)
        check_folder(out)
        check_output_folder(out)
    else:
        check_writable(out, "--out")
    runs = RunSet.read([Path(folder) for folder in settings.runs])
    page, pictures, files = page_text(
        runs, max_mb, settings.papers, options=settings, split=settings.split, progress=progress
    )
    if settings.split:
        write_pictures(out, files)
        write_text(out / INDEX, page)
        remove_others(out, files)
    else:
        write_text(out, page)
    frames = sum(len(keys) for keys in runs.keys.values())
    size = _size(page, files)
    shown = len(pictures.shown)
    text = f"{out}: {size / MEGABYTE:.1f} MB, {shown} of {frames} frames with pictures"
    text += f"; no ground truth: {pictures.truth}" if pictures.truth else ""
    return CommandResult(text, {"out": out, "bytes": size, "frames": frames, "shown": shown})


def _size(page: str, files: Sequence[PictureFile]) -> int:
    return len(page.encode()) + sum(len(file.text) for file in files)


def page_text(
    runs: RunSet,
    max_mb: float,
    papers: Sequence[str] = (),
    *,
    options: RunOptions | None = None,
    split: bool = False,
    progress: Progress = no_progress,
) -> tuple[str, Pictures, list[PictureFile]]:
    """The page of loaded runs, its images, and with ``split`` their files; ``options`` are those to open captures."""
    printed = [table for name in papers for table in _printed(runs, name)]
    metrics = [spec for spec in runs.metrics if spec.per_frame and COMPARISON in spec.tables]
    values = frame_values(runs, metrics)
    worst = worst_frames(values, runs, metrics[0]) if metrics else []
    parts = _parts(runs)
    comparisons = _comparisons(runs)
    words = verdict(runs, metrics, comparisons["all"])
    cards = cards_of(runs)
    content = {
        "title": words.title,
        "verdict": words,
        "tables": parts,
        "layouts": [
            *(TitledTable(TITLES.get(name, name), table_of(runs, name)) for name in layouts(runs)[1:]),
            *printed,
        ],
        "comparisons": comparisons,
        "cards": cards,
        "anchors": {card["label"]: card["anchor"] for card in cards},
        "marks": _marks(runs),
        "records": [record_of(run) for run in runs.runs],
        "failed": failed_cells(runs),
        "source_type": source_type(COMPOSITE),
        "scripts": [(HERE.parent / "sort.js").read_text("utf-8"), (HERE / "page.js").read_text("utf-8")],
        "ratio": "1000 / 1000",
        "own_style": (HERE / "page.css").read_text("utf-8"),
    }
    data = _data(runs, metrics, values)
    empty = Pictures(truth="-" * 400)
    limit = int(max_mb * MEGABYTE)
    room = limit - len(_filled(content, data, [], empty, []).encode()) - 1000
    # Two files together have more than `FILE_BYTES`.
    room -= ENTRY_BYTES * (1 + 2 * limit // FILE_BYTES) if split else 0
    entry = 8 * (len(runs.methods) + 2)  # bytes of a frame's entry in the list, without its images
    room -= entry * len(data["frames"])
    # The opening images are in the page twice, so that they are visible before the script has run.
    pictures = choose_pictures(runs, worst, int(room * OPENING_SHARE), options or RunOptions(), progress)
    best = [row.method for row in compact(parts[0].table).rows if not row.trivial]
    first = opening(runs, best, metrics, values, pictures)
    data["opening"]["frame"] = None if first.frame is None else _frames(runs).index(first.frame)
    data["opening"]["methods"] = [runs.methods.index(label) for label in first.methods]
    content["ratio"] = _ratio(runs, first)
    images: list[str] = []
    entries = dict(zip(_frames(runs), data["frames"]))
    for frame in sorted(pictures.shown, key=lambda f: (f.group, f.key.timestep)):  # in viewing order
        entries[frame]["p"] = _places(frame, pictures, images, data["reasons"])
        entries[frame]["l"] = int(frame in pictures.lossless)
    files = picture_files(images) if split else []
    data["files"] = [[file.name, file.count] for file in files]
    tiles = _tiles(runs, first, metrics, values, pictures)
    page = _filled(content, data, [] if split else images, pictures, tiles, split=split)
    if (size := _size(page, files)) > limit:
        needed = f"{size / MEGABYTE:.2f} needed"
        raise InputError("command line", "--max-mb", "room for tables and record", needed)
    return page, pictures, files


def _printed(runs: RunSet, name: str) -> list[TitledTable]:
    """The runs in the form of a paper's tables with the same tasks. Raises `InputError` if there is none."""
    from ..papers import as_printed, printed_tables

    tables, refused = [], None
    for table in printed_tables(name, None):
        try:
            tables.append(TitledTable(f"As {table.table} of {name}", as_printed(runs, name, table)))
        except InputError as error:  # the runs lack the task of the table
            refused = error
    if refused is not None and not tables:
        raise refused
    return tables


def _places(frame: ShownFrame, pictures: Pictures, images: list[str], reasons: list[str]) -> list[int]:
    """Index of each image of a frame in ``images``; -1 - index of its reason if it is missing."""
    places = []
    for image, reason in zip(pictures.shown[frame], pictures.reasons[frame]):
        if image is not None:
            places.append(len(images))
            images.append(image)
            continue
        if reason not in reasons:
            reasons.append(reason)
        places.append(-1 - reasons.index(reason))
    return places


def _marks(runs: RunSet) -> dict[str, int]:
    """Number of each method's mark: trivial baselines after the others."""
    order = sorted(runs.methods, key=lambda label: label in runs.trivial)
    return {label: index for index, label in enumerate(order)}


def _ratio(runs: RunSet, first: Opening) -> str:
    """Width and height of the opening renders, for the page's style."""
    for label in first.methods:
        run, name = runs.pictured[label]
        path = None if first.frame is None else run.render_path(name, *first.frame)
        if path is not None:
            with suppress(InputError):
                info = probe_image(path)
                return f"{info.width} / {info.height}"
    return "3 / 4"


def _tiles(
    runs: RunSet,
    first: Opening,
    metrics: Sequence[MetricSpec],
    values: dict[tuple[str, str, ShownFrame], float],
    pictures: Pictures,
) -> list[dict[str, Any]]:
    """The opening images: ground truth and methods, each with label, mark, value, and the image or a reason."""
    tiles: list[dict[str, Any]] = []
    if first.frame is None:
        return tiles
    for label in ("", *first.methods):
        place = runs.methods.index(label) + 1 if label else 0
        value = values.get((metrics[0].name, label, first.frame)) if metrics and label else None
        image = pictures.shown[first.frame][place]
        tile = {"label": label or "Ground truth", "mark": _marks(runs).get(label)}
        tile["value"] = "" if value is None else f"{value:.{metrics[0].digits}f}"
        tile["unit"] = metrics[0].unit if metrics else ""
        tiles.append({**tile, "image": image, "reason": pictures.reasons[first.frame][place]})
    return tiles


def _filled(
    content: dict[str, Any],
    data: dict[str, Any],
    images: Sequence[str],
    pictures: Pictures,
    tiles: Sequence[dict[str, Any]],
    *,
    split: bool = False,
) -> str:
    size = f":root {{ --tiles: {max(1, len(tiles))}; --ratio: {content['ratio']}; }}\n"
    style = stylesheet() + content["own_style"] + size
    # A page opened from a file has no origin, so 'self' matches nothing.
    beside = " 'self' file:" if split else ""
    hashes = " ".join(f"'{policy_hash(script)}'" for script in content["scripts"])
    policy = (
        f"default-src 'none'; img-src data:; script-src {hashes}{beside}; style-src '{policy_hash(style)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    words = {
        "shown": len(pictures.shown),
        "lossless": len(pictures.lossless),
        "frames": len(data["frames"]),
        "truth": pictures.truth,
        "first_cameras": pictures.first_cameras_lossless,
    }
    filled = {"policy": policy, "style": style, "words": words, "tiles": tiles}
    return render_page("page.html", **content | filled, data=_json(data), images=_json(list(images)))


def _json(value: Any) -> str:
    """JSON for a script element, without "<"."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", r"\u003c")


def _frames(runs: RunSet) -> list[ShownFrame]:
    return [ShownFrame(task, key) for task in runs.tasks for key in sorted(runs.keys[task])]


def _data(
    runs: RunSet, metrics: Sequence[MetricSpec], values: dict[tuple[str, str, ShownFrame], float]
) -> dict[str, Any]:
    """Data of the script: names once, frames by index into them, values by metric and method."""
    frames = _frames(runs)
    subjects, sequences, cameras = (
        sorted({getattr(frame.key, part) for frame in frames}) for part in ("subject", "sequence", "camera")
    )

    def number(spec: MetricSpec, label: str, frame: ShownFrame) -> float | None:
        value = values.get((spec.name, label, frame))
        return None if value is None else round(value, spec.digits + 2)

    return {
        "methods": list(runs.methods),
        "trivial": list(runs.trivial),
        "marks": [_marks(runs)[label] for label in runs.methods],
        "shapes": SHAPES,
        "tasks": [TASK_TITLES.get(task, task) for task in runs.tasks],
        "opening": {"frame": None, "methods": []},
        "subjects": subjects,
        "sequences": sequences,
        "cameras": cameras,
        "metrics": [
            {"label": s.label, "unit": s.unit, "digits": s.digits, "up": s.higher_is_better} for s in metrics
        ],
        "frames": [
            {
                "at": [
                    runs.tasks.index(task),
                    *(subjects.index(key.subject), sequences.index(key.sequence), cameras.index(key.camera)),
                    key.timestep,
                ],
                "v": [[number(m, label, ShownFrame(task, key)) for label in runs.methods] for m in metrics],
            }
            for task, key in frames
        ],
        "reasons": [],
        "colours": colour_map(np.linspace(0, 1, 256)[None])[0].tolist(),
        "plots": _plots(runs, metrics),
        "training": loss_curves(runs),
    }


def _parts(runs: RunSet) -> list[TitledTable]:
    """The comparison of all frames, of each region and of each held-out sequence."""
    parts = {"All frames": FrameSelection()}
    parts |= {f"Region: {name}": FrameSelection(name) for name in sorted(runs.rows.regions - {FULL})}
    if len({key.sequence for keys in runs.keys.values() for key in keys}) > 1:
        held_out = {key.sequence for key in runs.keys.get("self_reenactment", ())} & {*runs.rows.sequences}
        parts |= {f"Sequence: {name}": FrameSelection(sequences=(name,)) for name in sorted(held_out)}
    return [TitledTable(title, table_of(runs.of(part))) for title, part in parts.items()]


def _plots(runs: RunSet, metrics: Sequence[MetricSpec]) -> list[dict[str, Any]]:
    """Quality by the first metric against size and frame time, with the front; empty without points."""
    plots = []
    runs = runs.by_camera
    for task in runs.tasks if metrics else ():
        for cost, words in (("megabytes", "Size (MB)"), ("milliseconds", "Frame time (ms)")):
            points = []
            for label in runs.ranked:
                quality = summarise(runs.rows, label, metrics[0].name, task).value
                x = _cost(runs, label, cost)
                if quality is not None and x is not None and x > 0:
                    points.append((label, x, quality))
            if len(points) < 2:
                continue
            sign = 1 if metrics[0].higher_is_better else -1
            front = pareto_front([x for _, x, _ in points], [sign * quality for _, _, quality in points])
            title, label = TASK_TITLES.get(task, task), metrics[0].label
            against = f"{title}: {label} against {words.split(' (')[0].lower()}"
            y = f"{label} ({metrics[0].unit})" if metrics[0].unit else label
            plot = {"task": title, "title": against, "x": words, "y": y, "points": points, "front": front}
            plots.append(plot)
    return plots


def _cost(runs: RunSet, label: str, cost: str) -> float | None:
    """Size or median frame time, or the inverse of the mean rate if there is no median, as in `ParetoPoint`."""
    if cost == "megabytes":
        return summarise(runs.rows, label, STORAGE, "").value
    milliseconds, rate = (summarise(runs.rows, label, name, "").value for name in (LATENCY, SPEED))
    return milliseconds if milliseconds is not None or not rate else 1000.0 / rate


FOREST = 120
"""Half the width of a plot of differences."""


def _comparisons(runs: RunSet) -> dict[str, Any]:
    """Paired differences by task and metric, or the reason why they are missing; ``all`` are plain comparisons."""
    if len(runs.ranked) < 2:
        reason = "A comparison takes two methods that are no trivial baselines."
        return {"reason": reason, "groups": [], "all": []}
    specs = {spec.name: spec for spec in runs.metrics}
    data = compare_methods(runs).data
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for one in data["comparisons"]:
        spec = specs[one["metric"]]
        task = TASK_TITLES.get(one["task"], one["task"]) or AVATAR_TITLE
        unit = f" ({spec.unit})" if spec.unit else ""
        better = "higher" if spec.higher_is_better else "lower"
        texts = [f"{one['first']} − {one['second']}"]
        if one["difference"] is None:
            texts += ["–", "–", "–", f"{one['verdict']}: {one['reason']}"]
        else:
            digits = spec.digits + 1
            bounds = (one["low"], one["high"])
            interval = "–" if None in bounds else " to ".join(f"{bound:+.{digits}f}" for bound in bounds)
            texts += [f"{one['difference']:+.{digits}f}", interval, f"{one['p_holm']:.4f}", one["verdict"]]
        line = {"texts": texts, "one": one}
        groups.setdefault((task, f"{spec.label}{unit}, {better} is better"), []).append(line)
    subjects = len(runs.rows.subjects)
    return {
        "reason": "",
        "all": data["comparisons"],
        "subjects": subjects,
        "level": data["level"],
        "testable": any(
            one["p_holm"] is not None and not one["verdict"].startswith("not testable")
            for one in data["comparisons"]
        ),
        "groups": [
            {"title": f"{task}, {what}", "lines": _with_forest(lines) if subjects > 1 else lines}
            for (task, what), lines in groups.items()
        ],
    }


def _with_forest(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add positions of the subjects' differences, their mean and interval, on a common axis."""
    numbers = [
        number
        for line in lines
        for number in (*line["one"]["differences"].values(), line["one"]["low"], line["one"]["high"])
        if number is not None
    ]
    scale = (FOREST - 8) / (max(map(abs, numbers), default=1.0) or 1.0)

    def place(number: float | None) -> float | None:
        return None if number is None else round(FOREST + scale * number, 1)

    for line in lines:
        one = line["one"]
        of_subjects = [(name, place(value), f"{value:+.4g}") for name, value in one["differences"].items()]
        ends = {"low": place(one["low"]), "high": place(one["high"])}
        line["forest"] = {"subjects": of_subjects, "mean": place(one["difference"]), **ends}
    return lines

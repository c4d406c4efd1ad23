"""The figure of a capture: camera rig, splits, tracked mesh on images, motion.

Overlays of the tracked mesh on images, for visual inspection of the tracking. Heat map of a refit: the subject's
neutral head, coloured by mean residual.

Matplotlib figures without a window, in one style for all commands on captures.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from ...bench.contracts import ByteArray, Camera, FloatArray, FrameKey, IntArray, Progress, no_progress
from ...bench.io.figures import drawable, pixels
from ...bench.protocol import evenly_with_ends
from ..clip import CaptureClip
from ..head.geometry import rigid_alignment
from ..head.model import PosedSubject
from ..head.refit.refit import Refitted
from ..mesh_pictures import CLAY, draw_mesh, portrait_camera, rasterize_mesh
from .statistics import KEPT_VARIANCE, ExpressionSpace, SequenceRow, SplitRow

Colour = tuple[int, int, int]

TRAIN, HELD_OUT = "#0072b2", "#d55e00"
"""Two of Okabe and Ito's colours, distinguishable with any colour vision."""
MUTED, RULE, LEAK = "#737373", "#d6d6d6", "#be1e2d"
DPI = 100

_STYLE: Any = {
    "text.parse_math": False,  # names may have dollar signs
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.edgecolor": RULE,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.labelsize": 9,
    "axes.axisbelow": True,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
}


@contextmanager
def new_figure(width: float, height: float) -> Iterator[Figure]:
    """An empty figure of a size in inches; drawing and rasterising must happen within the context."""
    with style.context(["default", _STYLE]):  # independent of the user's matplotlibrc, such as text.usetex
        yield Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def bands(figure: Figure, heights: Sequence[float]) -> list[SubFigure]:
    """Vertically stacked parts of a figure with proportional heights."""
    return list(np.asarray(figure.subfigures(len(heights), 1, height_ratios=heights)))


def show(axes: Axes, image: ByteArray, *, frame: bool = False) -> None:
    """Show an image on new axes without ticks."""
    axes.imshow(image)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(frame)


def shortened(text: str, length: int) -> str:
    """The text as it is drawn, shortened with an ellipsis to a number of characters."""
    text = drawable(text)
    return text if len(text) <= length else f"{text[: length - 1]}…"


def hexadecimal(colour: str) -> Colour:
    """Levels of a colour such as `TRAIN`."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def draw_overlay(clip: CaptureClip, timesteps: Sequence[int], cameras: Sequence[str]) -> ByteArray:
    """Images of some timesteps (rows) and cameras, and beside each one the mesh over it. Returns (H, W, 3) 8-bit sRGB.
    Images of another size than the first are left out."""
    subject, rows = PosedSubject.of(clip), []
    height, width = clip.image(clip.frame_at[timesteps[0], cameras[0]]).shape[:2]
    for timestep, mesh in subject.each(clip, timesteps):
        row = []
        for name in cameras:
            camera = clip.cameras[name].resized(width, height)
            image = clip.image(clip.frame_at[timestep, name])
            if image.shape[:2] != (height, width):
                continue
            row += [image, draw_mesh(mesh, clip.head.faces, camera, background=image, opacity=0.6)]
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows)


WIDTH = 16.0
"""Width of the figure, inches."""

OVERLAY_HEIGHT = 2.8
"""Maximum height of an overlay, inches."""

OVERLAY_PIXELS = 560
MESH_OPACITY = 0.72
FRUSTUM_M = 0.10
"""Length of a drawn frustum."""

SIGMA_BARS = 40
"""Number of leading coefficients whose standard deviation is shown."""

MAX_SEQUENCES = 16
_FAR_M = 100.0  # at this distance the projection is orthographic to a thousandth
_HEAD_PIXELS_PER_M = 1200


def draw_figure(
    clip: CaptureClip,
    splits: Sequence[SplitRow],
    sequences: Sequence[SequenceRow],
    space: ExpressionSpace,
    *,
    timesteps: int,
    cameras: int,
    progress: Progress = no_progress,
) -> ByteArray:
    """(H, W, 3) figure of a clip: up to ``timesteps`` rows and ``cameras`` columns of overlays."""
    columns, rows = pick_cameras(clip, cameras), pick_timesteps(clip, space, timesteps)
    widest = max((clip.cameras[name].width / clip.cameras[name].height for name in columns), default=1.0)
    overlay_height = min(OVERLAY_HEIGHT, (WIDTH - 1.6) / max(1, len(columns)) / (2 * widest))
    heights = [4.0, 0.7 + len(rows) * overlay_height, 3.8]
    with new_figure(WIDTH, sum(heights) + 0.7) as figure:
        figure.suptitle(_title(clip), x=0.01, ha="left", fontsize=14)
        handles = [
            Line2D([], [], marker="o", linestyle="", color=colour, label=name)
            for name, colour in (("training", TRAIN), ("held out", HELD_OUT))
        ]
        figure.legend(handles=handles, loc="upper right", ncols=2)
        top, middle, bottom = bands(figure, heights)
        _draw_rigs(top, clip, splits)
        _draw_overlays(middle, clip, rows, columns, progress)
        _draw_motion(bottom, clip, sequences, space)
        return pixels(figure)


def _title(clip: CaptureClip) -> str:
    sizes = sorted({f"{camera.width}x{camera.height}" for camera in clip.cameras.values()})
    return (
        f"Subject {clip.subject}: {len(clip.files)} images of {', '.join(sizes[:3])} pixels, "
        f"{len(clip.cameras)} cameras, {len(clip.poses)} timesteps; head model {clip.head.version}, "
        f"{len(clip.head.template)} vertices, {clip.head.expression_basis.shape[2]} expressions"
    )


# ------------------------------------------------------------------ rig and splits


def _draw_rigs(figure: SubFigure, clip: CaptureClip, splits: Sequence[SplitRow]) -> None:
    timestep = min(clip.poses, key=lambda t: float(np.linalg.norm(clip.poses[t].expression)))
    vertices = PosedSubject.of(clip).meshes([clip.poses[timestep]])[0]
    members = clip.head.regions.get("face", np.arange(len(vertices)))
    frame = head_frame(vertices, clip.head.template, members)
    above, side, table = figure.subplots(1, 3, width_ratios=[5, 5, 4.4])
    for axes, from_above in ((above, True), (side, False)):
        draw_rig(axes, clip.cameras, _held_out(clip), vertices, clip.head.faces, frame, from_above=from_above)
    table.axis("off")
    table.set_title("splits")
    cells = [
        [row.split.replace("_", " "), *map(str, (row.images, row.timesteps, row.cameras, row.sequences))]
        for row in splits
    ]
    labels = ["", "images", "timesteps", "cameras", "sequences"]
    widths = [0.3, 0.16, 0.19, 0.16, 0.19]
    drawn = table.table(cells, colLabels=labels, colWidths=widths, loc="upper left", edges="B")
    drawn.auto_set_font_size(False)
    for (row, _), cell in drawn.get_celld().items():
        cell.set_edgecolor("white")
        if row and splits[row - 1].split != "excluded":
            cell.set_text_props(color=TRAIN if splits[row - 1].split == "train" else HELD_OUT)
    facts = _facts(clip)
    y = 0.88 - 0.075 * len(splits)
    for number, (name, fact) in enumerate(facts):
        table.text(0.02, y - 0.075 * number, name, color=MUTED, va="top", transform=table.transAxes)
        table.text(0.34, y - 0.075 * number, shortened(fact, 44), va="top", transform=table.transAxes)


def head_frame(vertices: FloatArray, template: FloatArray, members: IntArray) -> FloatArray:
    """(4, 4) world to head: origin at the mean of the vertices, axes those of the template."""
    rotation = rigid_alignment(vertices[members], template[members])[:3, :3]
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation, -rotation @ vertices.mean(axis=0)
    return frame


def draw_rig(
    axes: Axes,
    cameras: Mapping[str, Camera],
    held_out: Collection[str],
    vertices: FloatArray,
    faces: IntArray,
    frame: FloatArray,
    *,
    from_above: bool,
) -> None:
    """Draw the rig to scale: from above with the face looking down, or from the head's right with it looking right."""
    # Rows: head axes along the page's right and down, and away from the viewer.
    view = np.array(
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]] if from_above else [[0, 0, 1], [0, -1, 0], [1, 0, 0]], float
    )
    to_page, shift = view @ frame[:3, :3], view @ frame[:3, 3]
    head = vertices @ to_page.T + shift
    low, high = head[:, :2].min(axis=0), head[:, :2].max(axis=0)
    extent = (low[0], high[0], high[1], low[1])
    axes.imshow(_head_picture(head, faces), extent=extent, interpolation="antialiased", zorder=2)
    names = _short_names(list(cameras))
    for name, camera in cameras.items():
        centre = to_page @ camera.center + shift
        rays = to_page @ camera.world_to_camera[:3, :3].T @ _corner_rays(camera)
        corners = centre[:2] + FRUSTUM_M * rays.T[:, :2]
        edges = [*zip(corners, np.roll(corners, -1, axis=0)), *((centre[:2], corner) for corner in corners)]
        colour = HELD_OUT if name in held_out else TRAIN
        axes.add_collection(LineCollection(edges, colors=colour, linewidths=0.9))
        axes.plot(*centre[:2], "o", color=colour, markersize=4)
        x, y, _ = centre.tolist()
        away = max(float(np.hypot(x, y)), 1e-6)
        axes.annotate(
            names[name],
            (x, y),
            (12 * x / away, -10 * y / away),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=8,
            color=colour if name in held_out else MUTED,
        )
    axes.autoscale(True)
    axes.margins(0.1)
    if not axes.yaxis_inverted():
        axes.invert_yaxis()
    axes.set_aspect("equal", adjustable="datalim")
    up = 1 if from_above else -1
    axes.xaxis.set_major_formatter(FuncFormatter(lambda metres, _: f"{100 * metres + 0:g}"))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda metres, _: f"{100 * up * metres + 0:g}"))
    axes.grid()
    axes.set_xlabel("cm")
    axes.set_title("rig from above" if from_above else "rig from the side")


def _corner_rays(camera: Camera) -> FloatArray:
    """(3, 4) rays through the image's corners in the camera's axes, depth 1."""
    width, height = camera.width, camera.height
    corners = np.array([[0, width, width, 0], [0, 0, height, height], [1, 1, 1, 1]], dtype=np.float64)
    return np.linalg.solve(camera.K, corners)


def _head_picture(head: FloatArray, faces: IntArray) -> ByteArray:
    """(H, W, 4) orthographic image of the head's bounding box, transparent beside the head."""
    low, high = head[:, :2].min(axis=0), head[:, :2].max(axis=0)
    width, height = np.maximum(1, np.ceil(_HEAD_PIXELS_PER_M * (high - low))).astype(int).tolist()
    scale = np.array([width, height]) / (high - low) * _FAR_M
    intrinsics = np.array(
        [[scale[0], 0, -scale[0] * low[0] / _FAR_M], [0, scale[1], -scale[1] * low[1] / _FAR_M], [0, 0, 1.0]]
    )
    away = np.eye(4)
    away[2, 3] = _FAR_M
    camera = Camera("panel", width, height, intrinsics, away)
    covered = rasterize_mesh(head, faces, camera).face >= 0
    return np.dstack([draw_mesh(head, faces, camera), np.where(covered, 255, 0).astype(np.uint8)])


def _short_names(names: list[str]) -> dict[str, str]:
    """The shortest unique suffixes of the names, of at least two characters."""
    longest = max(map(len, names), default=0)
    for length in range(2, longest + 1):
        short = {name: name[-length:] for name in names}
        if len(set(short.values())) == len(names):
            return short
    return {name: name for name in names}


def _facts(clip: CaptureClip) -> list[tuple[str, str]]:
    record = clip.steps[0].parameters if clip.steps else {}
    background = tuple(float(c) for c in clip.background)
    named = "white" if background == (1, 1, 1) else "black" if background == (0, 0, 0) else f"{background}"
    leaks = record.get("leaks") or []
    masks = sum(map(clip.has_mask, clip.files))
    facts = [
        ("novel view", ", ".join(sorted(_held_out(clip))) or "none"),
        ("background", named),
        ("masks", "all frames" if masks == len(clip.files) else f"{masks} of {len(clip.files)} frames"),
        ("principal point", f"cy from the {record['cy']}" if "cy" in record else "as the reader gives it"),
        ("excluded for", ", ".join(sorted(set(clip.excluded.values()))) or "nothing"),
    ]
    if "leaks" in record:
        facts.append(("leaks", f"{len(leaks)}: {leaks[0]}" if leaks else "none"))
    return [*facts, ("origin", "synthetic" if record.get("synthetic") else "recorded")]


# ------------------------------------------------------------------ overlays


def pick_cameras(clip: CaptureClip, count: int) -> list[str]:
    """Up to ``count`` camera ids: a held-out one first, then evenly over the others in the order of the rig."""
    held_out = _held_out(clip)
    first = [name for name in clip.cameras if name in held_out][:1]
    others = [name for name in clip.cameras if name not in first]
    return (first + evenly_with_ends(others, max(0, count - len(first))))[:count]


def pick_timesteps(clip: CaptureClip, space: ExpressionSpace, count: int) -> list[tuple[int, str]]:
    """Up to ``count`` timesteps with the reason for each: the calmest, the widest jaw, the most unusual test
    face, then evenly spaced ones."""
    size = np.linalg.norm(space.scores_mm - space.scores_mm.mean(axis=0), axis=1)
    jaw = [float(np.linalg.norm(clip.poses[t].jaw)) for t in space.timesteps]
    calm = [float(np.linalg.norm(clip.poses[t].expression)) for t in space.timesteps]
    wanted = [
        (space.timesteps[int(np.argmin(calm))], "calmest face"),
        (space.timesteps[int(np.argmax(jaw))], "widest jaw"),
    ]
    if space.novelty_mm:
        newest = max(space.novelty_mm, key=lambda t: space.novelty_mm[t])
        wanted.append((newest, "test face farthest\nfrom training"))
    wanted.append((space.timesteps[int(np.argmax(size))], "strongest expression"))
    spread = np.linspace(0, len(space.timesteps) - 1, count + 2).round().astype(int)[1:-1]
    wanted += [(space.timesteps[i], "evenly spaced") for i in spread]
    chosen: dict[int, str] = {}
    for timestep, reason in wanted:
        chosen.setdefault(timestep, reason)
    return list(chosen.items())[:count]


def overlay(
    image: ByteArray, vertices: FloatArray, faces: IntArray, camera: Camera, height: int
) -> tuple[ByteArray, ByteArray]:
    """The image with the mesh's outline, and under the shaded mesh, both ``height`` pixels high."""
    width = max(1, round(camera.width * height / camera.height))
    smaller = height < camera.height
    scaled = cv2.resize(
        image, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
    ).astype(np.uint8, copy=False)
    fitted = camera.resized(width, height)
    filled = (rasterize_mesh(vertices, faces, fitted).face >= 0).astype(np.uint8)
    contours, _ = cv2.findContours(filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outlined = scaled.copy()
    cv2.drawContours(outlined, contours, -1, hexadecimal(HELD_OUT), max(1, round(height / 300)), cv2.LINE_AA)
    covered = draw_mesh(vertices, faces, fitted, background=scaled, opacity=MESH_OPACITY)
    return outlined, covered


def _draw_overlays(
    figure: SubFigure,
    clip: CaptureClip,
    rows: Sequence[tuple[int, str]],
    columns: Sequence[str],
    progress: Progress,
) -> None:
    figure.suptitle("tracked mesh on images: outline and shaded", x=0.01, ha="left", fontsize=11)
    held_out, grid = _held_out(clip), figure.subplots(len(rows), len(columns), squeeze=False)
    meshes = PosedSubject.of(clip).meshes([clip.poses[timestep] for timestep, _ in rows])
    tests = {key.timestep for key in clip.splits.get("self_reenactment", ())}
    for row, (timestep, reason) in enumerate(rows):
        frames = {key.camera: key for key in clip.files if key.timestep == timestep}
        sequence = shortened(next(iter(frames.values())).sequence, 20)
        label = f"timestep {timestep}\n{sequence}\n{reason}"
        colour = HELD_OUT if timestep in tests else TRAIN
        grid[row, 0].set_ylabel(label, rotation=0, ha="right", va="center", color=colour)
        for column, name in enumerate(columns):
            progress(row * len(columns) + column, len(rows) * len(columns), "drawing")
            show(
                grid[row, column],
                _cell(clip, frames.get(name), clip.cameras[name], meshes[row], OVERLAY_PIXELS),
                frame=True,
            )
    for column, name in enumerate(columns):
        suffix, colour = (" (held out)", HELD_OUT) if name in held_out else ("", TRAIN)
        grid[0, column].set_title(f"camera {name}{suffix}", color=colour, fontsize=10)


def _cell(
    clip: CaptureClip, key: FrameKey | None, camera: Camera, mesh: FloatArray, height: int
) -> ByteArray:
    """Both overlays of a frame side by side; a light grey field if the camera did not record it."""
    if key is None:
        width = max(1, round(camera.width * height / camera.height))
        return np.full((height, 2 * width, 3), 238, dtype=np.uint8)
    return np.concatenate(overlay(clip.image(key), mesh, clip.head.faces, camera, height), axis=1)


def _held_out(clip: CaptureClip) -> set[str]:
    return {key.camera for key in clip.splits.get("novel_view", ())}


# ------------------------------------------------------------------ motion


def _draw_motion(
    figure: SubFigure, clip: CaptureClip, sequences: Sequence[SequenceRow], space: ExpressionSpace
) -> None:
    jaw, reach, scores, sigma = figure.subplots(1, 4, width_ratios=[2.2, 2.2, 4, 4])
    _draw_sequences(jaw, reach, sequences)
    points = np.pad(space.scores_mm, ((0, 0), (0, max(0, 2 - space.scores_mm.shape[1]))))[:, :2]
    share = [*space.explained[:2], 0.0, 0.0]
    size = 24 if len(points) < 300 else 8
    for chosen, colour in ((~space.held_out, TRAIN), (space.held_out, HELD_OUT)):
        scores.scatter(*points[chosen].T, s=size, color=colour, edgecolors="white", linewidths=0.4)
    scores.set(xlabel=f"PC 1, mm ({share[0]:.0%} of variance)", ylabel=f"PC 2, mm ({share[1]:.0%})")
    scores.set_title("space of expressions")
    scores.grid()
    expressions = np.stack([clip.poses[t].expression for t in space.timesteps])[:, :SIGMA_BARS]
    groups = [
        (c, expressions[t]) for c, t in ((TRAIN, ~space.held_out), (HELD_OUT, space.held_out)) if t.any()
    ]
    for number, (colour, values) in enumerate(groups):
        width = 0.84 / len(groups)
        places = np.arange(values.shape[1]) + 0.08 + (number + 0.5) * width
        sigma.bar(places, values.std(axis=0), width, color=colour)
    sigma.set_xlabel("coefficient")
    sigma.set_title("standard deviation of coefficients")
    sigma.grid(axis="y")
    figure.supxlabel(space_summary(space), x=0.99, ha="right", fontsize=9, color=MUTED)


def _draw_sequences(jaw: Axes, reach: Axes, rows: Sequence[SequenceRow]) -> None:
    """Ranges of each sequence as bars from minimum to maximum, with a mark at the median."""
    visible = rows if len(rows) <= MAX_SEQUENCES else rows[: MAX_SEQUENCES - 1]
    for place, row in enumerate(visible):
        colour = HELD_OUT if row.held_out else TRAIN
        for axes, (low, typical, high) in ((jaw, row.jaw_deg), (reach, (0.0, *row.reach_mm))):
            axes.barh(place, high - low, left=low, height=0.5, color=colour, alpha=0.5)
            axes.plot([typical, typical], [place - 0.35, place + 0.35], color=colour, linewidth=2)
        place_right = reach.get_yaxis_transform()
        motion = f"{row.head_deg:.0f}° {row.head_mm:.0f} mm"
        reach.text(1.02, place, motion, transform=place_right, va="center", fontsize=9)
    labels = [
        f"{shortened(row.sequence, 24)}, {row.timesteps}"
        + (f" (+{row.excluded} excl.)" if row.excluded else "")
        for row in visible
    ]
    jaw.set_yticks(range(len(visible)), labels)
    for text, row in zip(jaw.get_yticklabels(), visible):
        text.set_color(HELD_OUT if row.held_out else TRAIN)
    reach.set_yticks([])
    for axes, label in ((jaw, "jaw, degrees"), (reach, "expression, mm")):
        axes.set_ylim(max(len(visible), 4) - 0.4, -0.6)
        axes.set_xlim(left=0)
        axes.set_xlabel(label)
        axes.grid(axis="x")
    more = f" (and {len(rows) - len(visible)} more)" if len(visible) < len(rows) else ""
    jaw.set_title(f"motion by sequence, timesteps{more}")
    reach.set_title("head, most", loc="right", fontsize=9, color=MUTED)


def space_summary(space: ExpressionSpace) -> str:
    """One sentence on the variety of the training faces and the novelty of the test faces."""
    components = "1 component explains" if space.kept == 1 else f"{space.kept} components explain"
    parts = [f"{components} {KEPT_VARIANCE:.0%} of the training faces"]
    if space.novelty_mm:
        new = np.array([*space.novelty_mm.values()])
        parts.append(
            f"test faces lie {np.median(new):.2f} mm (median; most {new.max():.2f}) from the nearest of them"
        )
    return "; ".join(parts)


_YAWS = (-0.75, 0.0, 0.75)
_VIEW = (560, 720)
_SHOWN = 99  # percentile of the residuals at the upper end of the scale


def draw_heat_map(refitted: Refitted) -> ByteArray:
    """(H, W, 3) image of the head from three sides with a scale; vertices that were not fitted are grey."""
    clip, report = refitted.clip, refitted.report
    neutral = PosedSubject.of(clip).neutral
    fitted = np.isfinite(report.vertex_mm)
    top = max(float(np.percentile(report.vertex_mm[fitted], _SHOWN)), 1e-3)
    colours = np.tile(np.array(CLAY), (len(neutral), 1))
    colours[fitted] = matplotlib.colormaps["viridis"](np.clip(report.vertex_mm[fitted] / top, 0, 1))[:, :3]
    summary = report.summary()
    with new_figure(8.8, 5) as figure:
        figure.suptitle(
            f"Refit of {clip.subject}: {summary['source']} to {summary['target']}\n"
            f"mean over {summary['timesteps']} timesteps; face: mean {summary['mean_mm']:.3f} mm, "
            f"95th percentile {summary['p95_mm']:.3f} mm"
        )
        grid = figure.subplots(1, len(_YAWS))
        for axes, yaw in zip(grid, _YAWS):
            camera = portrait_camera(neutral, *_VIEW, yaw=yaw)
            picture = draw_mesh(neutral, clip.head.faces, camera, colours, shading=0.35, supersampling=1)
            show(axes, picture)
        scale = ScalarMappable(Normalize(0, top), "viridis")
        figure.colorbar(scale, ax=grid, location="bottom", shrink=0.5, aspect=40, label="mm")
        return pixels(figure)

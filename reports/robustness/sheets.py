"""Contact sheets of the robustness tests, drawn from the output folder of a command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2

from ...bench.io.documents import read_json
from ...bench.io.images import read_png
from ...bench.protocol import evenly
from ...bench.specs import CommandResult
from ..drawing import SheetSection, Tile, TileRow, write_sheet

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
    for each in failed:
        text += f"\n{each['subject']} {each['method']} seed {each['seed']} failed: {each['reason']}"
    if rendered:
        write = write_extremes_sheet if "views" in rendered[0] else write_reenact_sheet
        write(folder, rendered)
        text += f"\n{folder / SHEET_FILE}"
    passed = not failed and all(avatar["frames_broken"] == 0 for avatar in avatars)
    return CommandResult(text, {"out": folder, "avatars": avatars}, passed)


def write_extremes_sheet(
    folder: Path, avatars: Sequence[Mapping[str, Any]], width: int = EXTREMES_WIDTH
) -> None:
    """Draw the sheet of avatars that ``headbench run extremes`` rendered into a folder: a column a view, a row a step.

    Views beyond the training cameras have an orange frame, frames that break a limit a red one. In every view the
    expression goes along one component, named above its column, from the mean in the first row outwards.
    """
    write_sheet(
        folder / SHEET_FILE,
        [_extremes_section(folder, avatar, width) for avatar in avatars],
        title="Novel views and expressions",
        subtitle="Turntable between the training cameras; every column goes along one principal component of the "
        "training expressions, in steps of its standard deviation. No ground truth.",
        marks={EXTRAPOLATED: "view beyond the training cameras", BROKEN: "a limit is broken"},
        label_width=66,
    )


def write_reenact_sheet(
    folder: Path,
    rendered: Sequence[Mapping[str, Any]],
    width: int = REENACT_WIDTH,
    columns: int = REENACT_COLUMNS,
) -> None:
    """Draw the sheet of avatars that ``headbench run reenact`` rendered into a folder.

    The source's frame above, the avatars it drives below: up to ``columns`` timesteps of each pair of target and
    source, evenly spaced. A frame that breaks a limit has a red frame.
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
        marks={BROKEN: "a limit is broken"},
    )


def _extremes_section(folder: Path, avatar: Mapping[str, Any], width: int) -> SheetSection:
    cell = folder / avatar["subject"] / avatar["method"] / f"seed-{avatar['seed']}"
    views, names = avatar["views"], avatar["expressions"]
    components = max((_component(name) for name in names), default=0)
    broken = {item["key"] for item in avatar["broken"]}

    def tile(index: int, view: Mapping[str, Any], step: str) -> Tile:
        name = f"pc{index % components + 1}{step}" if step else "mean"
        key = f"{avatar['subject']}/{name}/{names.index(name):05d}/{view['id']}"
        mark = BROKEN if key in broken else EXTRAPOLATED if view["extrapolated"] else ""
        return Tile(_picture(cell / f"{name}_{view['id']}.png", width), mark=mark)

    heads = [
        f"{view['azimuth']:+.0f}°" + (f", pc{index % components + 1}" if components else "")
        for index, view in enumerate(views)
    ]
    rows = [
        TileRow([f"{step} s.d." if step else "mean"], [tile(i, view, step) for i, view in enumerate(views)])
        for step in _steps(names)
    ]
    found = f"{avatar['frames_broken']} of {avatar['frames']} frames break a limit"
    title = f"{avatar['method']}, subject {avatar['subject']}, seed {avatar['seed']}: {found}"
    return SheetSection(title, heads, rows)


def _picture(path: Path, width: int) -> Any:
    """The image at a width, reduced by area; frames that were not finite have no file."""
    if not path.exists():
        return "not finite"
    image = read_png(path)
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    method = cv2.INTER_CUBIC if width > image.shape[1] else cv2.INTER_AREA
    return cv2.resize(image, size, interpolation=method)


def _component(name: str) -> int:
    """Number of the component in ``pc3+2``, 0 for the mean."""
    return 0 if name == "mean" else int(name[2:].replace("-", "+").split("+")[0])


def _steps(names: Sequence[str]) -> list[str]:
    """The mean (as ""), then the steps of the first component: small ones first, each with its opposite."""
    steps = [name[3:] for name in names if _component(name) == 1]
    return ["", *sorted(steps, key=lambda step: (abs(float(step)), -float(step)))]


def table(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Summaries for a terminal."""
    names = ("coverage", "translucent", "largest_splat", "mean_opacity")
    form = "{:<10} {:<16} {:>4} {:>6} {:>6}  {:>13} {:>13} {:>13} {:>13}".format
    lines = [form("subject", "method", "seed", "frames", "broken", *(n.replace("_", " ") for n in names))]
    for s in summaries:
        ranges = [s["ranges"][name] for name in names]
        shown = ["-" if low is None else f"{low:.2f} to {high:.2f}" for low, high in ranges]
        lines.append(form(s["subject"], s["method"], s["seed"], s["frames"], s["frames_broken"], *shown))
        if "missing" in s:
            lines.append(f"  missing: {s['missing']}")
        if s.get("identity") is not None:
            known = [f"{name} {value:.1f}" for name, value in s["identity"].items() if value is not None]
            lines.append(f"  colour difference from the subject's recordings (CIEDE2000): {', '.join(known)}")
        lines += [f"  {b['key']}: {'; '.join(b['limits'])}" for b in s["broken"][:5]]
        if len(s["broken"]) > 5:
            lines.append(f"  and {len(s['broken']) - 5} more; all are in {RECORD_FILE}")
    return "\n".join(lines)

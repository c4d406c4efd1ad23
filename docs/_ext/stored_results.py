"""Stores finished runs in reports/gallery, and writes their tables and sentences into the README and the documentation.

python docs/_ext/stored_results.py WHAT OUT .

WHAT is demo, suite, profiles, faces or frames (a run of one subject), or further, mechanisms, curves, further-curves, large-curves,
sizes or scenes (a folder of runs); OUT is the folder of the run or runs. A block of a page is between ``<!-- NAME:begin -->`` and ``<!-- NAME:end -->``.
"""

import os
import re
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import readme_pictures

from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.experiments.specs import MOVED_LINES, RECORD_FILE, RECORDED_RUN, RUN, SEEDS_RUN
from headbench.bench.experiments.suite import HELD_OUT_CAMERAS
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import write_json, write_text
from headbench.bench.progress import counted
from headbench.bench.protocol import SEEN_CAMERAS, TASK_TITLES, UNSEEN_CAMERAS
from headbench.bench.registry import discover, get
from headbench.bench.rows import FULL, Rows
from headbench.reports.aggregate import OTHERS_LIMIT, summarise, whole_images
from headbench.reports.curve.curve import HELD_OUT, CurveData, CurvePoint, Leader, leaders_text, read_curve
from headbench.reports.papers import papers
from headbench.reports.protocols import choice_effects
from headbench.reports.runs import FrameSelection, RunData, RunSet
from headbench.reports.statistics.comparisons import LEAST_SUBJECTS
from headbench.reports.suite.suite import (
    FOLDER,
    comparison,
    differences,
    planned_subjects,
    primary_table,
    read_extremes,
    variance_table,
)
from headbench.reports.table_report import Columns, table_of
from headbench.reports.tables import build_table
from headbench.reports.writers import pipe_table, to_markdown, to_text

PLANNED_FILE = "planned.json"
SCENES = ("still", "speech", "full")
"""Captures for which sizes are planned: without expressions, of speech, of all sequences."""
NOVEL, FACE, DOCS = "novel_view", "face", "docs/explanation"
OURS, REFERENCE = "ours", "ga"
MOVED = f"{OURS}+{MOVED_LINES}"
BESIDE = (OURS, MOVED, "ours-plus", "gbs")
"""Methods of the results page's differences from `REFERENCE`."""
CAMERAS = dict(zip(("frontal", "side", "low"), HELD_OUT_CAMERAS))
"""The suite's unseen cameras by position."""
ODD, OTHERS = "side", ("frontal", "low")
"""The camera whose colours differ most from those of its neighbours on captures as recordings are, and the others of `CAMERAS`."""
COLUMNS = (
    ("Face PSNR, novel views (dB) ↑", FACE, "psnr", NOVEL, 1),
    ("Face PSNR, new expressions (dB) ↑", FACE, "psnr", UNSEEN_CAMERAS, 1),
    ("Face LPIPS ↓", FULL, "lpips-face", NOVEL, 3),
    ("PSNR (dB) ↑", FULL, "psnr", NOVEL, 1),
    ("LPIPS ↓", FULL, "lpips", NOVEL, 3),
    ("MB ↓", FULL, "storage", "", 1),
    ("ms a frame ↓", FULL, "latency_p50", "", 0),
    ("s of training ↓", FULL, "training_processor", "", 0),
)
"""Of the README's table: title, region, metric, task, digits."""


class StoredResults:
    """The stored runs of a repository, each read once, and what pages show of them, as Markdown."""

    def __init__(self, root: Path):
        self.root, self.gallery = root, root / "reports" / "gallery"
        self.run = cache(RunData.read)
        self.read = cache(lambda *folders: RunSet.joined(tuple(map(self.run, folders))))
        self.curve = cache(
            lambda *methods, of="curves": read_curve([*map(self.run, self.runs(of))], "budget", methods)
        )

    def runs(self, name: str) -> list[Path]:
        """Folders of all stored runs in a folder of the gallery, at any depth."""
        return sorted(file.parent for file in (self.gallery / name).rglob("run.json"))

    @property
    def suite(self) -> RunSet:
        """The runs of the suite on exact captures."""
        return self.read(*self.runs(f"suite/{RUN}"))

    @property
    def recorded(self) -> RunSet:
        """The runs of the suite on captures as recordings are."""
        return self.read(*self.runs(f"suite/{RECORDED_RUN}"))

    @property
    def seeded(self) -> RunSet:
        """The face in the runs of the subjects on which `OURS` and `REFERENCE` have further training seeds, as recordings are."""
        seeds = self.runs(f"suite/{SEEDS_RUN}")
        first = [self.gallery / "suite" / RECORDED_RUN / run.name for run in seeds]
        return self.read(*first, *seeds).only([OURS, REFERENCE]).of(FrameSelection(FACE))

    def blocks(self) -> dict[tuple[str, str], str]:
        """Every block by its page and name."""
        demo, profiles, faces = (self.read(self.gallery / name) for name in ("", "profiles", "faces"))
        folders = self.runs("further")
        same = self.read(*folders, *(self.gallery / "suite" / RUN / run.name for run in folders))
        further, new = same.only(same.ranked).shared.by_camera, self.run(folders[0]).methods
        scenes = {name: self.gallery / "scenes" / name for name in SCENES}
        beside = f"{main_table(further)}\n\n{psnr_differences(further, new, REFERENCE)}"
        columns = Columns((NOVEL, "psnr", "ssim", "lpips"), digits=("psnr=1", "ssim=3", "lpips=3"))
        printed = to_text(table_of(demo, columns=columns))
        return {
            ("README.md", "demo"): "```text\n{}\n```".format(
                next(part for part in printed.split("\n\n") if "\nMethod" in part)
            ),
            ("README.md", "suite"): main_table(self.ranked),
            ("README.md", "findings"): findings(
                self.recorded,
                self.suite,
                self.curve(),
                self.curve(OURS, REFERENCE),
                self.curve(of="large-curves"),
            ),
            (f"{DOCS}/results.md", "endpoints"): primary_table(self.recorded),
            (f"{DOCS}/results.md", "cameras"): by_unseen_camera(self.recorded),
            (f"{DOCS}/results.md", "differences"): psnr_differences(self.recorded, BESIDE, REFERENCE),
            (f"{DOCS}/results.md", "exact"): psnr_differences(self.suite, BESIDE, REFERENCE, (FACE,)),
            (f"{DOCS}/results.md", "table-4"): moved_lines(self.recorded, self.suite),
            (f"{DOCS}/results.md", "seeds"): variance_table(self.seeded, (OURS, REFERENCE), of_methods=False),
            (f"{DOCS}/results.md", "curves"): curve_table(self.curve(), self.curve(OURS, REFERENCE)),
            (f"{DOCS}/methods/rgbavatar.md", "further-curves"): trainings(self.curve(of="further-curves")),
            (f"{DOCS}/results.md", "large-curves"): trainings(self.curve(of="large-curves")),
            (f"{DOCS}/results.md", "sizes"): sizes({run.name: self.read(run) for run in self.runs("sizes")}),
            (f"{DOCS}/results.md", "extremes"): extremes(read_extremes(self.runs(f"suite/{RUN}"))),
            (f"{DOCS}/protocols.md", "protocols"): choices(self.recorded),
            (f"{DOCS}/protocols.md", "profiles"): choices(profiles, "the third suite"),
            (f"{DOCS}/metrics.md", "faces"): to_markdown(table_of(faces)).strip(),
            (f"{DOCS}/metrics.md", "mechanisms"): mechanisms(
                {folder.name: self.read(folder) for folder in self.runs("mechanisms")}
            ),
            (f"{DOCS}/methods/index.md", "matrix"): matrix(self.root / "docs"),
            (f"{DOCS}/methods/ours.md", "planned"): planned(
                {
                    scene: (self.read(folder), read_json(folder / PLANNED_FILE))
                    for scene, folder in scenes.items()
                }
            ),
            (f"{DOCS}/methods/rgbavatar.md", "further"): beside,
        }

    @property
    def ranked(self) -> RunSet:
        """The suite's methods on captures as recordings are, without baselines and conditions, with self-reenactment by camera."""
        return self.recorded.only(self.recorded.ranked).shared.by_camera

    def write(self) -> None:
        """Write every block into its page, and means of the suite into their file."""
        for (name, block), text in self.blocks().items():
            page = self.root / name
            write_text(page, page.read_text(encoding="utf-8").replace(block_of(page, block), text))
        write_json(self.root / "reports" / "measured.json", self.measured())

    def measured(self) -> dict[str, object]:
        """Means on captures as recordings are, as `MeasuredFigures` has them; over all cameras, as papers print them."""
        runs = self.recorded
        metrics = [spec for spec in runs.metrics if "comparison" in spec.tables]
        table = build_table(runs.listing(runs.ranked), metrics, runs.tasks)
        names = [column.name for column in table.columns]
        ((_, rows),) = table.groups
        methods = {row.method: dict(zip(names, (cell.text for cell in row.cells))) for row in rows}
        sizes = {found.resolution for run in runs.runs for found in run.manifest.protocols.values()}
        data = f"{counted(len(runs.rows.subjects), 'synthetic subject')}, {' and '.join(sorted(sizes))}"
        return {"suite": "suite", "data": data, "methods": methods}


def main_table(runs: RunSet) -> str:
    """Means of the methods, the best face first, the best value of each column bold."""
    parts = {region: runs.of(FrameSelection(region)).rows for region in (FULL, FACE)}
    cells = {
        name: [f"{summarise(parts[r], name, metric, task).value:.{n}f}" for _, r, metric, task, n in COLUMNS]
        for name in runs.methods
    }
    titles = [title for title, *_ in COLUMNS]
    best = [(max if "↑" in t else min)(own, key=float) for t, own in zip(titles, zip(*cells.values()))]
    lines = [["Method", *titles], ["---", *["--:"] * len(titles)]]
    for name in sorted(cells, key=lambda name: -float(cells[name][0])):
        lines.append([f"`{name}`", *(f"**{v}**" if v == top else v for v, top in zip(cells[name], best))])
    how = f"{runs.image_size} pixels, times on {runs.machine} beside other programs"
    subjects = counted(len(runs.rows.subjects), "subject")
    return f"{pipe_table(lines)}\n\nMeans over {subjects}, the best in bold; images of {how}."


def at_cameras(runs: RunSet, *positions: str) -> RunSet:
    """The runs with the rows of some of `CAMERAS`."""
    chosen = [CAMERAS[position] for position in positions]
    frames = {
        task: [frame for frame in runs.rows.frames(task, FULL) if frame[3] in chosen] for task in runs.tasks
    }
    return replace(runs, rows=runs.rows.of_frames(frames))


def by_unseen_camera(runs: RunSet) -> str:
    """PSNR of the face of `REFERENCE`, and the difference of `OURS` from it, at the camera `ODD` and at `OTHERS`."""
    heads = [f"`{REFERENCE}`, novel view", f"`{OURS}` - `{REFERENCE}`, novel view"]
    heads += [f"`{OURS}` - `{REFERENCE}`, self-reenactment"]
    lines = [["Unseen cameras, PSNR of the face (dB)", *heads], ["---", *["--:"] * len(heads)]]
    for positions in ((ODD,), OTHERS):
        at = at_cameras(runs, *positions)
        found = [comparison(at, (OURS, REFERENCE), task, "psnr", FACE) for task in (NOVEL, UNSEEN_CAMERAS)]
        value = summarise(at.of(FrameSelection(FACE)).rows, REFERENCE, "psnr", NOVEL).value
        lines.append([" and ".join(positions), f"{value:.1f}", *(each.text(1) for each in found)])
    return pipe_table(lines)


def in_the_face(runs: RunSet, pair: tuple[str, str], *, intervals: bool = True) -> str:
    """Difference of a pair in PSNR of the face at unseen cameras, in novel views and in new expressions."""
    found = [comparison(runs, pair, task, "psnr", FACE) for task in (NOVEL, UNSEEN_CAMERAS)]
    return " and ".join(each.text(1) if intervals else f"{each.difference:+.1f}" for each in found)


def findings(suite: RunSet, exact: RunSet, curve: CurveData, both: CurveData, large: CurveData) -> str:
    """Sentences on the endpoints, the crossing of Table 4, and the training time; ``both`` is the curve of the pair alone."""
    pair, moved = (OURS, REFERENCE), (MOVED, OURS)
    novel, new = (comparison(suite, pair, task, "psnr", FACE) for task in (NOVEL, UNSEEN_CAMERAS))
    novel_moved, new_moved = (
        comparison(suite, moved, task, "psnr", FACE) for task in (NOVEL, UNSEEN_CAMERAS)
    )
    planned = planned_subjects(suite)
    interim = f"; interim, {planned} are planned" if novel.subjects < planned else ""
    over = counted(novel.subjects, "subject") + ", 95 % intervals" * (novel.subjects >= LEAST_SUBJECTS)
    longest, largest = (max(p.cost[each.clock] or 0.0 for p in each.means) for each in (curve, large))
    after = [best_at(curve, seconds) for seconds in (60.0, longest)]
    also = "too" if after[0] == after[1] else f"that of {after[1]}"
    odd, others = (
        in_the_face(at_cameras(suite, *names), pair, intervals=False) for names in ((ODD,), OTHERS)
    )
    crossing = turns(both.best[f"psnr_{FACE}", NOVEL])
    return f"""\
- In the face at unseen cameras, `{OURS}` minus `{REFERENCE}` is {novel.text(1)} dB in novel views and {new.text(1)} dB \
in new expressions ({over}{interim}): \
{odd} dB at the {ODD} camera, which has other colours than its neighbour, {others} dB at the other two. On exact captures it is {in_the_face(exact, pair)} dB. `ours-plus` minus `gbs` is {in_the_face(suite, ("ours-plus", "gbs"))} dB.
- Lines that move splats (`{MOVED}`) instead of changing their opacity change novel views by {novel_moved.text(1)} dB and new \
expressions by {new_moved.text(1)} dB in the face; in Table 4 of its paper +1.2 and -0.7 dB.
- After one minute on one processor the best face is that of {after[0]}, after {longest / 60:.0f} minutes {also} \
({counted(len(curve.subjects), "development subject")}); at 550x802 with 60,000 splats, after {largest / 60:.0f} minutes, \
that of {best_at(large, largest)}, on {counted(len(large.subjects), "subject")}. A night is not measured. Of \
`{OURS}` and `{REFERENCE}`, in novel views {crossing}."""


def turns(leading: Sequence[Leader]) -> str:
    """Which method is better up to which processor seconds."""
    first, *later = leading
    text = f"`{first.method}` is better"
    for each in later:
        text += f" up to {each.start:.0f} s"
        if each.interval is not None:
            low, high = each.interval
            ends = f"less than {each.compared[0]:.0f}" if low is None else f"{low:.0f}"
            ends += f" to more than {each.compared[1]:.0f}" if high is None else f" to {high:.0f}"
            text += f" (no significant difference from {ends} s)"
        text += f", then `{each.method}`"
    return text if later else f"{text} at all measured times"


SPOKEN = {
    NOVEL: "novel views",
    UNSEEN_CAMERAS: "new expressions at unseen cameras",
    SEEN_CAMERAS: "new expressions at seen cameras",
}


def best_at(curve: CurveData, seconds: float) -> str:
    """The methods with the best mean PSNR of the face after a number of processor seconds, each with its tasks."""
    tasks: dict[str, list[str]] = defaultdict(list)
    for task, what in SPOKEN.items():
        leading = [each.method for each in curve.best[f"psnr_{FACE}", task] if each.start <= seconds]
        tasks[leading[-1]].append(what)
    named = {
        method: "all tasks" if len(own) == len(SPOKEN) else ", ".join(own) for method, own in tasks.items()
    }
    return " and ".join(f"`{method}` ({what})" for method, what in named.items())


def moved_lines(recorded: RunSet, exact: RunSet) -> str:
    """Lines that move splats minus lines that change their opacity, PSNR by task, beside the values of the paper's Table 4."""
    tasks = (NOVEL, SEEN_CAMERAS, UNSEEN_CAMERAS)
    (table,) = [each for each in papers()["tensorial-2025"].tables if each.table == "Table 4"]
    opacity, moved = ({key: float(value) for key, value in row.values.items()} for row in table.rows)
    printed = {key.split("/")[0]: moved[key] - opacity[key] for key in moved if key.endswith("/psnr")}
    lines = [
        ["PSNR (dB)", *(TASK_TITLES[task] for task in tasks), "novel view minus unseen cameras", "subjects"]
    ]
    lines.append(["---", *["--:"] * (2 + len(tasks))])
    both = printed[NOVEL], printed["self_reenactment"]
    lines.append(
        ["paper, whole frame", f"{both[0]:+.2f}", f"{both[1]:+.2f}", "–", f"{both[0] - both[1]:+.2f}*", "1"]
    )
    for title, runs, region in (
        ("as recordings are, face", recorded, FACE),
        ("as recordings are, whole frame", recorded, FULL),
        ("exact, face", exact, FACE),
        ("exact, whole frame", exact, FULL),
    ):
        found = [comparison(runs, (MOVED, OURS), task, "psnr", region) for task in tasks]
        found.append(comparison(runs, (MOVED, OURS), NOVEL, "psnr", region, minus=UNSEEN_CAMERAS))
        lines.append([title, *(each.text(2) for each in found), str(found[0].subjects)])
    return f"{pipe_table(lines)}\n\n\\* All cameras, of which one has no training images."


def psnr_differences(
    runs: RunSet, methods: Sequence[str], reference: str, regions: Sequence[str] = (FULL, FACE)
) -> str:
    """Differences of the methods that the runs have from another, in whole frames and in the face."""
    columns = [(task, "psnr", region) for task, region in product(runs.by_camera.tasks, regions)]
    known = [name for name in methods if name in runs.methods]
    return differences(runs, known, reference, columns, f"PSNR minus that of `{reference}`, dB")


def mechanisms(runs: Mapping[str, RunSet]) -> str:
    """How much of each avatar its mechanism changes, and PSNR in the face minus that of the ablation without it, by run."""
    titles = [f"{name}: {what}" for name in runs for what in ("changes (%)", "worth (dB)")]
    lines = [["Method", *titles], ["---", *["--:"] * len(titles)]]
    labels = {label: None for each in runs.values() for label in each.methods}
    for label in labels:
        method, _, condition = label.partition("+")
        ablation = f"{method}+{get('methods', method).mechanism.ablation}"
        if condition and not label.startswith("ours+penalty"):
            continue
        cells = []
        for each in runs.values():
            without = next((name for name in each.methods if name.startswith(ablation)), "")
            if label not in each.methods or not without:
                cells += ["–", "–"]
                continue
            face = each.of(FrameSelection(FACE)).rows
            worth = [
                summarise(face, label, "psnr", task).value - summarise(face, without, "psnr", task).value
                for task in each.tasks
            ]
            changed = summarise(each.rows, label, "dynamic_splats", "").value
            cells += [f"{changed:.1f}", " / ".join(f"{value:+.2f}" for value in worth)]
        lines.append([f"`{label}`", *cells])
    return pipe_table(lines)


def matrix(docs: Path) -> str:
    """Native methods: devices, adapters to the authors' code with licence and parity, and papers that print a row of them.

    Licences and parity are those of the tables of the pages on official methods.
    """
    parity = rows_by_name(docs / "explanation" / "methods" / "official.md", 5)
    licences = rows_by_name(docs / "howto" / "official-programs.md", 4)
    specs = [plugin.spec for plugin in discover("methods").values() if plugin.spec and plugin.spec.source]
    printed = printed_by()
    titles = ["Method", "GPU", "Authors' code", "on a CPU", "Licence of that code", "Papers", "Parity, dB"]
    lines = [titles, ["---"] * 5 + ["--:", "---"]]
    natives = [spec for spec in specs if spec.native and spec.name in printed]
    for spec in sorted(natives, key=lambda spec: -printed[spec.name]):
        official = next(each for each in specs if not each.native and each.source == spec.source)
        licence = re.split("[,;]", licences[official.name][-1])[0]
        measured = parity.get(spec.name)
        cells = ["yes" if spec.computes_on("cuda") else "no", f"`{official.name}`"]
        cells += ["shim" if "cpu-shim" in official.summary else "no", licence, str(printed[spec.name])]
        lines.append([f"`{spec.name}`", *cells, " / ".join(measured[1:3]) if measured else "not measured"])
    absent = sorted(
        ((-n, name) for name, n in printed.items() if name not in {s.name for s in specs} and n >= 4)
    )
    others = ", ".join(f"{name} ({-number})" for number, name in absent)
    return f"{pipe_table(lines)}\n\nPrinted by at least four of the {len(papers())} stored papers, and not in headbench: {others}."


def rows_by_name(page: Path, columns: int) -> dict[str, list[str]]:
    """Cells after the first one of the rows of tables with this number of columns, by the name in code in the first one."""
    rows = (re.split(r" *\| *", line)[1:-1] for line in page.read_text(encoding="utf-8").splitlines())
    return {row[0].strip("`"): row[1:] for row in rows if len(row) == columns and row[0].startswith("`")}


def printed_by() -> dict[str, int]:
    """Number of papers of others that print a row of a method, by registered name or the usual one of its spellings."""
    sources = {name: plugin.spec.source for name, plugin in discover("methods").items() if plugin.spec}
    found: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for paper_name, paper in papers().items():
        for row in (row for table in paper.tables for row in table.rows):
            bare = row.method or re.sub(r" *[(+,].*", "", row.name)
            own = bare.lower() in OF_THE_PAPER and not row.method
            if not own and not (paper.arxiv and paper.arxiv in sources.get(row.method, "")):
                key = row.method or re.sub("[^a-z0-9]", "", bare.lower()).rstrip("s")
                found[key][bare].add(paper_name)
    usual = {key: max(names, key=lambda name: len(names[name])) for key, names in found.items()}
    return {usual[key]: len(set().union(*names.values())) for key, names in found.items()}


OF_THE_PAPER = ("", "ours", "baseline", "full")
"""Names of rows that are a paper's own method."""


def choices(runs: RunSet, suite: str = "the suite") -> str:
    """Effects of evaluation choices on two methods."""
    subjects = counted(len(runs.rows.subjects), "subject")
    return f"`{OURS}` and `{REFERENCE}`, {subjects} of {suite}:\n\n{choice_effects(runs.only([OURS, REFERENCE]))[0]}"


def curve_table(curve: CurveData, pair: CurveData) -> str:
    """`trainings` of a curve with an explanation, and the best methods, of all and of a pair."""
    of_face = [spec for spec in curve.metrics if spec.name == f"psnr_{FACE}"]
    led = [leaders_text(replace(each, metrics=of_face)) for each in (curve, pair)]
    names = " and ".join(f"`{name}`" for name in pair.by_method)
    kinds = " / ".join(TASK_TITLES[task].lower() for task in curve.tasks)
    head = f"PSNR of the face in dB, {kinds}, and processor seconds of the training; means over {len(curve.subjects)} subjects:"
    return "\n\n".join([head, trainings(curve), led[0], f"Of {names} alone:", led[1].partition("\n\n")[2]])


def trainings(curve: CurveData) -> str:
    """PSNR of the face and processor seconds by method and length of training."""
    parts = sorted({point.part for point in curve.means})
    lines = [["Method", *(f"{part} of the longest" for part in parts)], ["---", *["---"] * len(parts)]]
    for method, points in curve.by_method.items():
        cells = {point.part: curve_cell(point, curve) for point in points}
        lines.append([f"`{method}`", *(cells.get(part, "ended") for part in parts)])
    return pipe_table(lines)


def curve_cell(point: CurvePoint, curve: CurveData) -> str:
    """Values of a training by task, and its seconds."""
    values = " / ".join(f"{point.values[f'psnr_{FACE}_{HELD_OUT[task]}']:.1f}" for task in curve.tasks)
    return f"{values} ({point.cost[curve.clock]:.0f} s)"


def sizes(runs: Mapping[str, RunSet]) -> str:
    """PSNR of the face, bytes of trained and coded avatars, and ms a frame, by maximum number of splats."""
    heads = [
        "Most splats",
        "Method",
        "splats",
        *(f"{TASK_TITLES[task]}, face (dB)" for task in (NOVEL, UNSEEN_CAMERAS)),
    ]
    heads += ["MB", "coded MB", "change by coding (dB)", "ms a frame"]
    lines = [heads, ["---", "---", *["--:"] * (len(heads) - 2)]]
    for thousands, read in sorted(runs.items(), key=lambda item: float(item[0])):
        each = read.by_camera
        face = each.of(FrameSelection(FACE)).rows
        for name in each.ranked:
            metrics = {"storage": 2, "storage_coded": 2, "coded_change": 2, "latency_p50": 0}
            cells = [f"{summarise(face, name, 'psnr', task).value:.1f}" for task in (NOVEL, UNSEEN_CAMERAS)]
            cells += [f"{summarise(each.rows, name, m, '').value:.{n}f}" for m, n in metrics.items()]
            loaded = whole_images(each.rows, name, "latency_p50", "")["other_cores"].max() > OTHERS_LIMIT
            cells[-1] += "*" * bool(loaded)
            count = f"{summarise(each.rows, name, 'primitives', '').value:,.0f}"
            lines.append([f"{thousands},000", f"`{name}`", count, *cells])
    return f"{pipe_table(lines)}\n\n\\* Timed while other programs used more than a core, not comparable with the other times."


def planned(scenes: Mapping[str, tuple[RunSet, Mapping[str, Mapping[str, object]]]]) -> str:
    """What `capacity.mode=auto` keeps of `OURS` by capture, and its bytes and PSNR of the face beside those of fixed sizes."""
    (label,) = {label for _, sizes in scenes.values() for label in sizes}
    names = list(dict.fromkeys(name for _, sizes in scenes.values() for name in sizes[label]))
    heads = [f"`{name}`" for name in names]
    lines = [["Capture", *heads, "MB, of fixed sizes", "Novel view, face (dB), of fixed sizes"]]
    lines.append(["---", *["--:"] * (len(heads) + 2)])
    for scene, (runs, sizes) in scenes.items():
        face = runs.of(FrameSelection(FACE)).rows
        kept = [str(sizes[label].get(name, "–")) for name in names]
        both = [
            ", ".join(f"{summarise(rows, each, metric, task).value:.2f}" for each in (label, OURS))
            for rows, metric, task in ((runs.rows, "storage", ""), (face, "psnr", NOVEL))
        ]
        lines.append([scene, *kept, *both])
    return pipe_table(lines)


def extremes(avatars: Sequence[Mapping[str, Any]]) -> str:
    """Failures of avatars in new poses and views by method: a table and a sentence."""
    by_method: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for avatar in avatars:
        by_method[avatar["method"]].append(avatar)
    heads = [
        "Method",
        "subjects",
        "frames",
        "non-finite values",
        "face PSNR (dB)",
        "worst",
        "flicker",
        "frames over a limit",
    ]
    lines = [heads, ["---", *["--:"] * (len(heads) - 1)]]
    finite, worst = True, {}
    for method, own in by_method.items():
        measures = [avatar["measures"] for avatar in own]
        faces = [each["psnr face"] for each in measures if each["psnr face"]["mean"] is not None]
        steady = [each["flicker"]["mean"] for each in measures if each["flicker"]["mean"] is not None]
        broken = sum(each["non_finite"]["failed"] for each in measures)
        finite = finite and not broken
        face = ["–", "–"]
        if faces:
            worst[method] = min(each["worst"] for each in faces)
            face = [
                f"{fmean(each['mean'] for each in faces):.1f}",
                f"{worst[method]:.1f}",
            ]
        flicker = f"{fmean(steady):.2f}" if steady else "–"
        counts = [len(own), sum(avatar["frames"] for avatar in own), broken]
        over = sum(avatar["frames_broken"] for avatar in own)
        lines.append([f"`{method}`", *map(str, counts), *face, flicker, str(over)])
    said = "No avatar renders non-finite values." if finite else "Some avatars render non-finite values."
    if worst:
        said += f" The worst frame is one of `{min(worst, key=worst.__getitem__)}`."
    return f"{said}\n\n{pipe_table(lines)}"


def block_of(page: Path, name: str) -> str:
    """Text of a page between the marks of a block."""
    parts = page.read_text(encoding="utf-8").split(f"<!-- {name}:begin -->\n")
    if len(parts) != 2 or parts[1].count(f"\n<!-- {name}:end -->") != 1:
        raise InputError(page, name, "the marks of the block once each", "something else")
    return parts[1].partition(f"\n<!-- {name}:end -->")[0]


def store(run: Path, target: Path) -> None:
    """Copy manifest, without this machine's folders, protocols, rows and the record of extreme poses of a run."""
    manifest = RunFolder(run).read_manifest()
    config = manifest.configuration
    heads = {name: Path(path).name for name, path in config.heads.items()}
    settings = {k: Path(v).name if os.path.isabs(str(v)) else v for k, v in config.reader_settings.items()}
    places = {"data": Path(config.data).name, "out": "", "source": config.source and Path(config.source).name}
    config = replace(config, **places, reader_settings=settings, heads=heads)
    replace(manifest, configuration=config).write(RunFolder(target).manifest)
    Rows.read(RunFolder(run).rows).in_single_precision().write(RunFolder(target).rows)
    if sizes := planned_sizes(run):
        write_json(target / PLANNED_FILE, sizes)
    if avatars := read_extremes([run]):
        write_json(target / FOLDER / RECORD_FILE, {"avatars": avatars})


def planned_sizes(run: Path) -> dict[str, dict[str, object]]:
    """Sizes that the training data of the first subject require, by method and setting."""
    sizes = {}
    for cell in sorted(run.glob("*/*/seed-0")):
        file = RunFolder(run).cell(cell.parts[-3], cell.parts[-2], 0).avatar / "training.json"
        decisions = read_json(file).get("capacity", {}).get("decisions", []) if file.is_file() else []
        if decisions:
            sizes.setdefault(cell.parts[-2], {each["name"]: each["chosen"] for each in decisions})
    return sizes


def main(what: str, out: Path, root: Path) -> None:
    """Store the runs in a folder, write all blocks, and draw pictures of these runs."""
    stored, place = StoredResults(root), "" if what == "demo" else what
    for run in sorted(found.parent for found in out.rglob("run.json")):
        if run.name != FOLDER:  # of extremes, whose record is stored with the run
            store(run, stored.gallery / place / run.relative_to(out))
    stored.write()
    if what == "curves":
        readme_pictures.draw_curves(stored.curve(), root / "docs" / "pictures")
    if what == "suite":
        readme_pictures.draw_subjects(out, stored.gallery / "subjects.jpg")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))

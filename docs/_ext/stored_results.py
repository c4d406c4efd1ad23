"""Stores finished runs in reports/gallery, and writes their tables and sentences into the README and the documentation.

python docs/_ext/stored_results.py WHAT OUT .

WHAT is demo, suite, profiles, faces or frames (a run of one subject), further or mechanisms (a folder of runs) or curves (a folder of
seconds and pictures); OUT is the folder of the run or runs. A block of a page is between ``<!-- NAME:begin -->`` and ``<!-- NAME:end -->``.
"""

import os
import re
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import groupby, product
from pathlib import Path
from statistics import fmean

import readme_pictures

from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.experiments.extremes import RECORD_FILE
from headbench.bench.io.files import write_json, write_text
from headbench.bench.progress import counted
from headbench.bench.protocol import UNSEEN_CAMERAS
from headbench.bench.registry import discover, get
from headbench.bench.rows import FULL, Rows
from headbench.reports.aggregate import coded_labels, summarise
from headbench.reports.curve.curve import HELD_OUT, CurveData, leaders_text, read_curve
from headbench.reports.papers import papers
from headbench.reports.protocols import choice_effects
from headbench.reports.runs import FrameSelection, RunData, RunSet
from headbench.reports.suite.suite import (
    FOLDER,
    comparison,
    differences,
    read_extremes,
    suite_report,
    suite_runs,
)
from headbench.reports.table_report import Columns, table_of
from headbench.reports.tables import build_table
from headbench.reports.writers import pipe_table, to_markdown, to_text

NOVEL, FACE, DOCS = "novel_view", "face", "docs/explanation"
OURS, REFERENCE = "ours", "ga"
BESIDE = (OURS, "ours+equal-iterations", "ours-plus", "gbs", "gbs+as-tracked")
"""Methods of the results page's differences from `REFERENCE`."""
COLUMNS = (
    ("Face PSNR, novel views (dB) ↑", FACE, "psnr", NOVEL, 1),
    ("Face PSNR, new expressions (dB) ↑", FACE, "psnr", UNSEEN_CAMERAS, 1),
    ("PSNR (dB) ↑", FULL, "psnr", NOVEL, 1),
    ("SSIM ↑", FULL, "ssim", NOVEL, 3),
    ("LPIPS ↓", FULL, "lpips", NOVEL, 3),
    ("MB ↓", FULL, "storage", "", 1),
    ("ms a frame ↓", FULL, "latency_p50", "", 0),
    ("s of training ↓", FULL, "training_processor", "", 0),
)
"""Of the README's table: title, region, metric, task, digits."""


def read_stored(folder: Path) -> RunData:
    """A run without coded avatars: those stored were written with a codec that headbench no longer has."""
    run = RunData.read(folder)
    coded, methods = coded_labels(run.manifest).values(), run.manifest.methods
    kept = tuple(record for record in methods if record.label not in coded)
    manifest = replace(run.manifest, methods=kept)
    return replace(run, manifest=manifest, rows=run.rows.of_methods([record.label for record in kept]))


class StoredResults:
    """The stored runs of a repository, each read once, and what pages show of them, as Markdown."""

    def __init__(self, root: Path):
        self.root, self.gallery = root, root / "reports" / "gallery"
        self.run = cache(read_stored)
        self.read = cache(lambda *folders: RunSet.joined(tuple(map(self.run, folders))))
        self.curve = cache(lambda over: read_curve([*map(self.run, self.runs("curves", over))], over))

    def runs(self, *place: str) -> list[Path]:
        """Folders of the stored runs of one kind."""
        return suite_runs(self.gallery.joinpath(*place[:-1]), place[-1])

    @property
    def suite(self) -> RunSet:
        """The runs of the suite."""
        return self.read(*self.runs("suite", "run"))

    def blocks(self) -> dict[tuple[str, str], str]:
        """Every block by its page and name."""
        demo, profiles, faces = (self.read(self.gallery / name) for name in ("", "profiles", "faces"))
        folders = self.runs("further")
        same = self.read(*folders, *(self.gallery / "suite" / "run" / run.name for run in folders))
        further, new = same.only(same.ranked).shared.by_camera, self.run(folders[0]).methods
        beside = f"{main_table(further)}\n\n{psnr_differences(further, new, REFERENCE)}"
        columns = Columns(digits=("psnr=1", "ssim=3", "lpips=3"))
        printed = to_text(table_of(demo, columns=replace(columns, names=(NOVEL, "psnr", "ssim", "lpips"))))
        lines = [f"{OURS}+{name}" for name in get("methods", OURS).ablations]
        return {
            ("README.md", "demo"): "```text\n{}\n```".format(
                next(part for part in printed.split("\n\n") if "\nMethod" in part)
            ),
            ("README.md", "suite"): main_table(self.ranked),
            ("README.md", "findings"): findings(self.suite, self.curve("seconds")),
            (f"{DOCS}/results.md", "demo"): to_markdown(table_of(demo, columns=columns)).strip(),
            (f"{DOCS}/results.md", "differences"): psnr_differences(self.suite, BESIDE, REFERENCE),
            (f"{DOCS}/results.md", "curves-seconds"): curve_table(self.curve("seconds"), 1),
            (f"{DOCS}/results.md", "curves-pictures"): curve_table(self.curve("pictures"), 2),
            (f"{DOCS}/protocols.md", "protocols"): choices(self.suite),
            (f"{DOCS}/protocols.md", "profiles"): choices(profiles),
            (f"{DOCS}/metrics.md", "faces"): to_markdown(table_of(faces)).strip(),
            (f"{DOCS}/metrics.md", "mechanisms"): mechanisms(
                {folder.name: self.read(folder) for folder in self.runs("mechanisms")}
            ),
            (f"{DOCS}/methods/index.md", "matrix"): matrix(self.root / "docs"),
            (f"{DOCS}/methods/ours.md", "ablations"): psnr_differences(self.suite, lines, OURS),
            (f"{DOCS}/methods/rgbavatar.md", "further"): beside,
        }

    @property
    def ranked(self) -> RunSet:
        """The suite's methods, without baselines and conditions, with self-reenactment by camera."""
        return self.suite.only(self.suite.ranked).shared.by_camera

    def write(self) -> None:
        """Write every block into its page, and all tables and means of the suite into their files."""
        for (name, block), text in self.blocks().items():
            page = self.root / name
            write_text(page, page.read_text(encoding="utf-8").replace(block_of(page, block), text))
        write_text(self.gallery / "suite" / "results.md", self.results())
        write_json(self.root / "reports" / "measured.json", self.measured())

    def results(self) -> str:
        """All tables of the suite."""
        return suite_report(self.gallery / "suite", OURS, lambda folders: self.read(*folders))

    def measured(self) -> dict[str, object]:
        """Means of the suite, as `MeasuredFigures` has them; over all cameras, as papers print them."""
        runs = self.suite
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
    return f"{pipe_table(lines)}\n\nMeans over {len(runs.rows.subjects)} subjects, the best in bold; images of {how}."


def findings(suite: RunSet, curve: CurveData) -> str:
    """Three sentences on the suite's results."""
    trainings = [summarise(suite.rows, name, "training_processor", "").value for name in suite.ranked]
    behind = comparison(suite, (REFERENCE, OURS), NOVEL, "psnr", FACE)
    without = comparison(suite, (f"{OURS}+no-lines", OURS), NOVEL, "psnr", FACE)
    values = {(point.method, point.budget.seconds): point.values["psnr_timesteps"] for point in curve.means}
    early, late = (values[REFERENCE, limit] - values[OURS, limit] for limit in (30, 120))
    assert min(behind.low, early, late) > 0 > without.low, "the sentences do not fit these rows"
    return f"""\
- In the face at the unseen camera `{OURS}` is {behind.difference:.1f} dB behind `{REFERENCE}` (95 % interval {behind.low:.1f} to \
{behind.high:.1f} dB, {behind.subjects} subjects), with about {fmean(trainings):.0f} processor seconds of training.
- The feature lines of `{OURS}`, the main idea of its paper, are off in these runs: without them the face changes by \
{without.difference:+.2f} dB ({without.low:+.2f} to {without.high:+.2f}, {without.subjects} subjects). Since version 5 they \
[act](docs/explanation/methods/ours.md#feature-lines).
- The differences depend on the training time: on held-out timesteps `{OURS}` is {early:.1f} dB behind `{REFERENCE}` after 30 s, and \
{late:.1f} dB after 120 s ({len(curve.subjects)} subjects, whole frames)."""


def psnr_differences(runs: RunSet, methods: Sequence[str], reference: str) -> str:
    """Differences of the methods that the runs have from another, in whole frames and in the face."""
    columns = [(task, "psnr", region) for task, region in product(runs.by_camera.tasks, (FULL, FACE))]
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


def choices(runs: RunSet) -> str:
    """Effects of evaluation choices on two methods."""
    subjects = counted(len(runs.rows.subjects), "subject")
    return f"`{OURS}` and `{REFERENCE}`, {subjects} of the suite:\n\n{choice_effects(runs.only([OURS, REFERENCE]))[0]}"


def curve_table(curve: CurveData, place: int) -> str:
    """PSNR of both kinds of held-out frames by method and quantity, size of the largest avatar, and the best methods."""
    kinds = [HELD_OUT[task] for task in curve.tasks]
    amounts = sorted({point.place[place] for point in curve.means})
    lines = [[curve.over, *(f"{each:g}" for each in amounts), "MB"], ["---"] * (2 + len(amounts))]
    for method, points in groupby(curve.means, key=lambda point: point.method):
        values = {point.place[place]: point.values for point in points}
        cells = {n: " / ".join(f"{own[f'psnr_{kind}']:.2f}" for kind in kinds) for n, own in values.items()}
        shown = [cells.get(n, "–") for n in amounts]
        lines.append([f"`{method}`", *shown, f"{max(own['storage'] for own in values.values()):.1f}"])
    head = (
        f"PSNR in dB, held-out {' / '.join(kinds)}, means over subjects {', '.join(sorted(curve.subjects))}:"
    )
    return f"{head}\n\n{pipe_table(lines)}\n\n{leaders_text(curve)}"


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
    if avatars := read_extremes([run]):
        write_json(target / FOLDER / RECORD_FILE, {"avatars": avatars})


def main(what: str, out: Path, root: Path) -> None:
    """Store the runs in a folder, write all blocks, and draw pictures of these runs."""
    stored, place = StoredResults(root), "" if what == "demo" else what
    for found in sorted(out.rglob("run.json")):
        store(found.parent, stored.gallery / place / found.parent.relative_to(out))
    stored.write()
    if what == "curves":
        readme_pictures.draw_curves(stored.curve, stored.ranked.methods, root / "docs" / "pictures")
    if what == "suite":
        readme_pictures.draw_subjects(out, stored.gallery / "subjects.jpg")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))

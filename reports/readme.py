"""Writes results into the README and the documentation: tables, what may be concluded, the demo's picture, and the rows.

python -m headbench.reports.readme demo demo-output .
python -m headbench.reports.readme suite suite-output .
python -m headbench.reports.readme profiles run-of-one-subject .
python -m headbench.reports.readme faces run-of-one-subject .
python -m headbench.reports.readme rates folder-of-sweeps .
python -m headbench.reports.readme further folder-of-runs .
python -m headbench.reports.readme curves folder-of-seconds-and-pictures .
python -m headbench.reports.readme subjects suite-output .
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import chain, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2

from ..bench.contracts import no_progress
from ..bench.engine.config import CODED
from ..bench.engine.scoring import FULL
from ..bench.engine.store import RunFolder
from ..bench.errors import InputError
from ..bench.experiments.robustness import RECORD_FILE
from ..bench.experiments.suite_settings import (
    AS_TRACKED,
    EQUAL,
    LARGE_RUN,
    LEVEL,
    NONE,
    RUN,
    SEEDS_RUN,
    TRACKED,
)
from ..bench.io.files import write_bytes, write_json, write_text
from ..bench.io.images import encode_image, read_png
from ..bench.manifest import Manifest
from ..bench.progress import counted
from ..bench.protocol import SEEN_CAMERAS, TASK_TITLES, evenly
from ..bench.registry import discover
from ..bench.rows import ALL, Rows
from ..bench.specs import CommandResult, MethodSpec
from .aggregate import summarise
from .cameras import SPLIT_TASK, unseen_cameras
from .contact_sheet import compared_frame, contact_sheet
from .curve.blocks import UNITS as CURVE_UNITS
from .curve.blocks import curve_block
from .curve.curve import read_curve, write_curve
from .papers import paper_named
from .pareto.plot import write_rates
from .pareto.rates import read_rates
from .pareto.table import rate_tables
from .protocols import USUAL, ProtocolsSettings, protocols_command
from .runs import FrameSelection, RunData, RunSet, joined_subjects, synthetic_settings
from .statistics.comparisons import compare
from .statistics.primary import primary_table
from .suite.extremes import FOLDER as EXTREMES
from .suite.extremes import read_extremes
from .suite.suite import suite_report, suite_runs
from .suite.tracked import drops_by_tracking
from .suite.variance import variance_text
from .table_report import Columns, table_of, table_text
from .writers import pipe_table, to_markdown

GALLERY = "reports/gallery"
PROTOCOLS = "protocols"
SUITE = "suite"
"""Stored results of the suite in `GALLERY`."""
DROPS, ABLATIONS = "drops", "ablations"
"""Blocks of the suite's drops from novel views to self-reenactment, and of its ablations."""
PROFILES, FACES = "profiles", "faces"
"""Stored results of one of its subjects: by the definitions of all protocols, and by metrics of faces."""
RATES = "rates"
"""Stored sweeps over codec steps, one each for some of its subjects."""
OURS = "ours"
FURTHER = "further"
"""Stored runs of methods outside of the suite's plan, on some of its subjects; each named as that subject's run."""
CURVES = "curves"
"""Stored curves on some subjects of the suite, in a folder for each quantity of `CURVE_UNITS`."""
CURVE_PICTURE = "docs/pictures/curve-{}.png"
PICTURE = "contact_sheet.jpg"
SUBJECTS = "subjects.jpg"
"""The README's picture: a frame of each subject of a suite that was run here, with the methods `SHOWN_METHODS`."""
SHOWN_METHODS, PANEL = ("ga", "gbs", OURS), 150
RESULTS = "results.md"
MEASURED = "reports/measured.json"
"""Values of the suite for cards of methods (`method_cards`)."""
PAGES = {
    "demo": "docs/explanation/results.md",
    SUITE: "README.md",
    PROTOCOLS: "docs/explanation/protocols.md",
    DROPS: "docs/explanation/suite.md",
    ABLATIONS: "docs/explanation/methods/ours.md",
    PROFILES: "docs/explanation/protocols.md",
    FACES: "docs/explanation/metrics.md",
    RATES: "docs/explanation/fairness.md",
    FURTHER: "docs/explanation/methods/rgbavatar.md",
    **{f"{CURVES}-{over}": "docs/explanation/budgets.md" for over in CURVE_UNITS},
}
"""The page of each block, in the repository."""
COMPARED = (OURS, "ga")
"""Methods of the tables of protocols."""
TRACKING = {
    "": "exact tracking",
    TRACKED: "tracked from images",
    LEVEL.format(3): "tracking errors of level 3",
}
"""Conditions of the table of drops, and their titles."""
BESIDE = (
    (f"{OURS}+{EQUAL}", "ga"),
    ("ours-plus", "ga"),
    ("gbs", "ga"),
    (f"gbs+{AS_TRACKED}", "gbs"),
)
"""Pairs of the README's exploratory differences."""
PAPER = "tensorial-2025"
"""The paper of `OURS`."""
RATES_PICTURE = "docs/pictures/rate-distortion.png"
RATES_TASKS = ("novel_view", "self_reenactment")
SHOWN = ("psnr", "lpips")
"""Metrics of frames in the README, whose table would not fit a page with all; those of the suite's tables are in `RESULTS`."""


def publish_demo(out: Path, root: Path) -> None:
    """Copy manifest, rows and contact sheet of a run to the repository ``root``, and write its block."""
    target = RunFolder(root / GALLERY)
    _copy(RunFolder(out), target)
    # An image for a page, not for measurements: a lossy copy of a third of the size.
    path, sheet = target.root / PICTURE, read_png(RunFolder(out).contact_sheet)
    write_bytes(path, encode_image(sheet, path.suffix, (cv2.IMWRITE_JPEG_QUALITY, 90), place=path))
    _write(root / PAGES["demo"], "demo", demo_block(target.root))


def publish_suite(out: Path, root: Path) -> None:
    """Copy manifest and rows of a suite's run to the repository ``root``, and write its tables and block."""
    target = root / GALLERY / SUITE
    for run in chain.from_iterable(suite_runs(out, base) for base in (RUN, SEEDS_RUN, LARGE_RUN)):
        place = target / run.relative_to(out)
        _copy(RunFolder(run), RunFolder(place))
        if avatars := read_extremes([run]):
            write_json(place / EXTREMES / RECORD_FILE, {"avatars": avatars})
    write_text(target / RESULTS, suite_results(target))
    write_json(root / MEASURED, measured(target))
    _write(root / PAGES[PROTOCOLS], PROTOCOLS, protocols_block(target))
    _write(root / PAGES[DROPS], DROPS, drops_block(target))
    _write(root / PAGES[ABLATIONS], ABLATIONS, ablations_block(target))
    _write(root / PAGES[SUITE], SUITE, suite_block(root))


def publish_picture(out: Path, root: Path) -> None:
    """Draw a frame of self-reenactment at the unseen camera for each subject of a suite that was run here, as the README's picture."""
    frames = []
    for folder in suite_runs(out):
        data = RunData.read(folder)
        keys = data.keys(SPLIT_TASK)
        unseen, _ = unseen_cameras([data.manifest], keys)
        chosen = evenly([key for key in keys if (key.subject, key.camera) in unseen], 1)
        frames += [compared_frame(data, SPLIT_TASK, key, SHOWN_METHODS, PANEL) for key in chosen]
    path = root / GALLERY / SUBJECTS
    with TemporaryDirectory() as temporary:
        sheet = Path(temporary) / "sheet.png"
        contact_sheet(frames, SHOWN_METHODS, sheet, title="Subjects of the suite, unseen camera")
        picture = read_png(sheet)
    write_bytes(path, encode_image(picture, path.suffix, (cv2.IMWRITE_JPEG_QUALITY, 90), place=path))


def publish_subject(name: str, out: Path, root: Path) -> None:
    """Copy manifest and rows of a run of one subject of the suite to the repository ``root``, and write the block ``name``."""
    target = root / GALLERY / name
    _copy(RunFolder(out), RunFolder(target))
    _write(root / PAGES[name], name, SUBJECT_BLOCKS[name](target))


def publish_further(out: Path, root: Path) -> None:
    """Copy manifests and rows of the runs in a folder to the repository ``root``, and write the block that compares them with the suite."""
    _copy_all(out, root / GALLERY / FURTHER)
    _write(root / PAGES[FURTHER], FURTHER, further_block(root / GALLERY))


def publish_curves(out: Path, root: Path) -> None:
    """Copy manifests and rows of curves to the repository ``root``, and write their blocks and plots."""
    for over in (name for name in CURVE_UNITS if (out / name).is_dir()):
        target = root / GALLERY / CURVES / over
        _copy_all(out / over, target)
        runs = stored_curves(root / GALLERY, over)
        write_curve(root / CURVE_PICTURE.format(over), read_curve([RunData.read(run) for run in runs], over))
        _write(root / PAGES[f"{CURVES}-{over}"], f"{CURVES}-{over}", curve_block(runs, over))


def stored_curves(gallery: Path, over: str) -> list[Path]:
    """Folders of the stored curves over a quantity."""
    return suite_runs(gallery / CURVES, over)


def _copy_all(out: Path, target: Path) -> None:
    for run in sorted(path.parent for path in out.glob("*/rows.parquet")):
        _copy(RunFolder(run), RunFolder(target / run.name))


def publish_rates(out: Path, root: Path) -> None:
    """Copy manifests and rows of the sweeps in a folder to the repository ``root``, and write their block and its plot."""
    target = root / GALLERY / RATES
    _copy_all(out, target)
    runs = rate_runs(target)
    write_rates(root / RATES_PICTURE, {task: read_rates(runs, task) for task in RATES_TASKS})
    _write(root / PAGES[RATES], RATES, rates_block(runs))


def _copy(source: RunFolder, target: RunFolder) -> None:
    """Manifest, without this machine's folders, protocols and rows of a run."""
    manifest = source.read_manifest()
    target.root.mkdir(parents=True, exist_ok=True)
    _without_folders(manifest).write(target.manifest)
    Rows.read(source.rows).in_single_precision().write(target.rows)


def _without_folders(manifest: Manifest) -> Manifest:
    """The record of a run with the names of files and folders instead of their paths."""
    config = manifest.configuration
    files = {key.rpartition(".")[2] for key in manifest.paths or {}}
    settings = {
        key: Path(value).name if key in files else value for key, value in config.reader_settings.items()
    }
    config = replace(
        config,
        data=Path(config.data).name,
        out="",
        source=Path(config.source).name,
        reader_settings=settings,
        heads={name: Path(path).name for name, path in config.heads.items()},
    )
    return replace(manifest, configuration=config, paths=None)


def marks(name: str) -> tuple[str, str]:
    """Text before and after a block of a page."""
    return f"<!-- {name}:begin -->", f"<!-- {name}:end -->"


def _write(page: Path, name: str, block: str) -> None:
    begin, end = marks(name)
    text = page.read_text(encoding="utf-8")
    if text.count(begin) != 1 or text.count(end) != 1:
        raise InputError(page, "", f"the marks {begin} and {end} once each", "something else")
    before, rest = text.split(begin)
    _, after = rest.split(end)
    write_text(page, f"{before}{begin}\n{block}\n{end}{after}")


DEMO_DIGITS = ("psnr=1", "ssim=3", "lpips=3", "fps=0")
"""Decimals of the demo's table; further ones depend on the processor, as the page states below the table."""


def demo_block(gallery: Path) -> str:
    """Return the block for the stored result of the demo: Markdown."""
    record = RunFolder(gallery).read_manifest()
    machine = record.machine
    timed = [(method, value) for method, value in _minutes(gallery) if value is not None]
    minutes = ", ".join(f"{method} {value:.1f}" for method, value in timed if value >= 0.05)
    cost = (
        f"Minutes of training: {minutes}, on {machine['cores']} cores ({machine['processor']}); the largest process took "
        f"{(record.peak_memory_bytes or 0) / 1e9:.1f} GB."
    )
    return f"{table_text([gallery], 'md', digits=DEMO_DIGITS).strip()}\n\n{cost}"


def _minutes(run_folder: Path, metric: str = "training_time") -> list[tuple[str, float | None]]:
    """Values of ``metric``, by default minutes of training, of every method and subject that was trained; None of one that was interrupted.

    This is not the run's duration, which after a restart is that of its last part.
    """
    rows = Rows.read(RunFolder(run_folder).rows)
    times = rows.select(method=ALL, condition=ALL, metric=metric, task="", region=FULL, seeds=ALL)
    trained = times[times["condition"] != CODED]  # derived from a trained avatar
    ended = trained["status"] == "ok"
    return [
        (str(m), float(v) if ok else None) for m, v, ok in zip(trained["method"], trained["value"], ended)
    ]


def suite_results(folder: Path) -> str:
    """All tables of the stored runs of the suite."""
    return suite_report(folder, OURS)


def measured(folder: Path) -> dict[str, Any]:
    """Means of the stored runs of the suite, as `method_cards.MeasuredFigures` has them; over all cameras, as papers print them."""
    runs = _read(*suite_runs(folder))
    specs = {spec.name: spec for spec in runs.metrics}
    keys = [(task, name) for task in runs.tasks for name in specs if specs[name].per_frame]
    keys += [("", name) for name in ("storage", "storage_coded", "fps") if name in specs]
    methods: dict[str, dict[str, str]] = {}
    for label in runs.ranked:
        for task, name in keys:
            value = summarise(runs.rows, label, name, task).value
            if value is not None:
                key = f"{task}/{name}".lstrip("/")
                methods.setdefault(label, {})[key] = f"{value:.{specs[name].digits}f}"
    subjects = len(runs.rows.subjects)
    sizes = {found.resolution for run in runs.runs for found in run.manifest.protocols.values()}
    data = f"{counted(subjects, 'synthetic subject')}, {' and '.join(sorted(sizes))}"
    return {"suite": folder.name, "data": data, "methods": methods}


def protocols_block(folder: Path) -> str:
    """Effects of evaluation choices on stored runs of the suite, for two methods: Markdown."""
    return _worth_of_choices(suite_runs(folder))


def further_block(gallery: Path) -> str:
    """The methods of the runs in `FURTHER` beside those of the suite on the same subjects: Markdown."""
    further = suite_runs(gallery, FURTHER)
    names = {run.name for run in further}
    runs = RunSet.read([*further, *(run for run in suite_runs(gallery / SUITE) if run.name in names)])
    runs = runs.only([*runs.ranked]).shared.by_camera
    methods = [record.name for run in further for record in RunFolder(run).read_manifest().methods]
    columns = Columns((*SHOWN, "storage", "training_processor", "fps_one_thread"))
    lines = [
        ["PSNR, dB", *(TASK_TITLES.get(task, task) for task in runs.tasks)],
        ["---"] * (1 + len(runs.tasks)),
    ]
    for method in dict.fromkeys(methods):
        pair = (method, COMPARED[1])
        lines.append([" - ".join(pair), *(_difference(runs, pair, task, "psnr", 2) for task in runs.tasks)])
    table = to_markdown(table_of(runs, columns=columns)).strip()
    return f"{table}\n\nDifferences, means over subjects and 95 % intervals:\n\n{pipe_table(lines)}"


def ablations_block(folder: Path) -> str:
    """Differences of the ablations of `OURS` from it, on those stored runs of the suite that have them: Markdown."""
    runs = _read(*suite_runs(folder))
    spec = discover("methods")[OURS].spec
    assert isinstance(spec, MethodSpec)
    names = {name: f"{OURS}+{name}" for name in spec.ablations if f"{OURS}+{name}" in runs.methods}
    runs = runs.only([OURS, *names.values()]).shared.by_camera
    parts = {"": runs, "face, ": runs.of(FrameSelection("face"))}
    columns = [(title, task) for title in parts for task in ("novel_view", SEEN_CAMERAS)]
    lines = [
        ["", *(f"{title}{TASK_TITLES[task].lower()}" for title, task in columns), "MB"],
        ["---"] * (2 + len(columns)),
    ]
    for name, label in names.items():
        found = [_difference(parts[title], (label, OURS), task, "psnr", 2) for title, task in columns]
        lines.append([f"`{name}`", *found, _difference(runs, (label, OURS), "", "storage", 1)])
    subjects = ", ".join(sorted(runs.rows.subjects))
    return f"Subjects {subjects}, PSNR in dB:\n\n{pipe_table(lines)}"


def _difference(runs: RunSet, pair: tuple[str, str], task: str, metric: str, digits: int) -> str:
    """First minus second of a pair with its interval."""
    (spec,) = (spec for spec in runs.metrics if spec.name == metric)
    (found,) = compare(runs.rows, [pair], task=task, metric=metric, higher_is_better=spec.higher_is_better)
    # Sizes differ by nearly the same for all subjects.
    return (found if task else replace(found, low=None)).text(digits)


def drops_block(folder: Path) -> str:
    """The drop from novel views to self-reenactment by condition of tracking, on the stored runs of the suite: Markdown."""
    return drops_by_tracking(_read(*suite_runs(folder)), TRACKING)


@cache
def _read(*runs: Path) -> RunSet:
    """Stored runs, cached for several blocks."""
    return RunSet.read(runs)


@cache
def _choices(runs: tuple[Path, ...]) -> CommandResult:
    """Effects of evaluation choices for `COMPARED`, for both tables of the suite's runs."""
    return protocols_command(ProtocolsSettings(tuple(map(str, runs)), COMPARED), no_progress)


def _worth_of_choices(runs: Sequence[Path]) -> str:
    subjects = counted(len(_read(*runs).rows.subjects), "subject")
    found = _choices(tuple(runs))
    return f"`{'` and `'.join(COMPARED)}`, {subjects} of the suite:\n\n{found.text}"


def rate_runs(folder: Path) -> list[RunData]:
    """The stored sweeps over steps of the codec, of all subjects."""
    return joined_subjects([RunData.read(path.parent) for path in sorted(folder.glob("*/rows.parquet"))])


def rates_block(runs: Sequence[RunData]) -> str:
    """Bytes and losses by step of the codec, and BD-rates: Markdown."""
    subjects = counted(len({subject for run in runs for subject in run.rows.subjects}), "subject")
    return f"Means of {subjects} of the suite:\n\n{rate_tables(runs, RATES_TASKS, COMPARED[1])}"


SUBJECT_BLOCKS: dict[str, Callable[[Path], str]] = {
    PROFILES: lambda folder: _worth_of_choices([folder]),
    FACES: lambda folder: table_text([folder], "md").strip(),
}
"""Markdown of the stored rows of a folder."""


def choices_text(runs: Sequence[Path]) -> str:
    """The range of the change of PSNR of `COMPARED` by any single choice of an evaluation, in one sentence: Markdown."""
    found = _choices(tuple(runs)).data["values"]
    keys = [f"{method} {task} psnr" for method, task in product(COMPARED, ("novel_view", "self_reenactment"))]
    changes = [
        (own[key] - found[USUAL][key], choice)
        for choice, own in found.items()
        for key in keys
        if key in own and choice != USUAL
    ]
    ends = " to ".join(f"{change:+.1f} dB ({choice})" for change, choice in (min(changes), max(changes)))
    return f"Other evaluation choices change the mean PSNR of these avatars by {ends}: [all choices]({PAGES[PROTOCOLS]})."


def suite_options(folder: Path) -> tuple[str, ...]:
    """Options of ``headbench run suite`` that make the captures of stored runs, as these record them."""
    runs, large = (
        [RunFolder(run).read_manifest() for run in suite_runs(folder, base)] for base in (RUN, LARGE_RUN)
    )
    given = {"tracker": "per-frame", **synthetic_settings(runs[0].clips[0])}
    given["size"] = "x".join(map(str, given["size"]))
    names = ("performance", "tracker", "tracking_error", "cameras", "timesteps", "size", "subjects")
    options = [(f"--{name.replace('_', '-')}", str(given[name])) for name in names]
    options.append(("--large", str(sum(len(each.clips) for each in large))))
    words = [word for option in options for word in option]
    for option, condition in (("--tracked", TRACKED), ("--equal-iterations", EQUAL)):
        named = dict.fromkeys(
            each.name for run in runs for each in run.methods if each.condition == condition
        )
        words += [option, *(named or [NONE])]
    return tuple(words)


def suite_block(root: Path) -> str:
    """Return the block for stored results of the suite in the repository ``root``, with a link to all tables: Markdown."""
    folder = root / GALLERY / SUITE
    results = os.path.relpath(folder / RESULTS, (root / PAGES[SUITE]).parent)
    folders = suite_runs(folder)
    runs = _read(*folders)
    options = " ".join(suite_options(folder))
    made = synthetic_settings(runs.runs[0].manifest.clips[0])
    seeds = suite_runs(folder, SEEDS_RUN)
    plain = runs.only([*runs.ranked]).shared
    subjects = runs.rows.subjects_of(runs.methods)
    # Conditions with fewer subjects would reduce the subjects of the table of all methods.
    conditions = [
        n for n in (f"{OURS}+{EQUAL}", f"gbs+{AS_TRACKED}") if subjects.get(n, set()) >= plain.rows.subjects
    ]
    shown = runs.only([*runs.ranked, *conditions]).shared
    columns = Columns((*SHOWN, "storage", "storage_coded", "coded_change", "fps_one_thread"))
    return "\n\n".join(
        filter(
            None,
            [
                to_markdown(table_of(shown, columns=columns)).strip(),
                f"Primary endpoints:\n\n{primary_table(shown)} {variance_text(folders, seeds)}".strip(),
                f"Other differences (exploratory), mean over subjects and 95 % interval:\n\n{beside_table(shown)}",
                (
                    f"{_speed_text(shown)} {choices_text(folders)} SSIM, baselines, tables by region and by part of the sequence FREE, and all other "
                    f"comparisons with tests are in [the results]({results}).".lstrip()
                ),
                (
                    f"The captures are of edition {made.get('edition', 1)}, made with seed {made['seed']} and the options "
                    f"`headbench run suite {options}`. {_cost_text(runs, folders, seeds)}"
                ),
            ],
        )
    )


def _speed_text(runs: RunSet) -> str:
    """Frames per second of `COMPARED` on one thread, with and without the head model, beside what the paper prints; "" if not measured."""
    values = {
        (name, metric): summarise(runs.rows, name, metric, "").value
        for metric in ("fps_one_thread", "fps_without_head")
        for name in COMPARED
        if metric in {spec.name for spec in runs.metrics} and name in runs.methods
    }
    known = [value for value in values.values() if value is not None]
    if len(known) < 2 * len(COMPARED) or ";" in runs.machine:
        return ""
    whole, deformed = (
        " and ".join(f"{value:.0f} (`{name}`)" for (name, of), value in values.items() if of == metric)
        for metric in ("fps_one_thread", "fps_without_head")
    )
    rows = (row for table in paper_named(PAPER).tables for row in table.rows)
    printed = {row.method: row.values["fps"] for row in rows if "fps" in row.values}
    paper = " and ".join(f"{printed[name]} (`{name}`)" for name in COMPARED)
    return (
        f"Frames per second on one thread of {runs.machine}, under the load that the table notes: {whole}; without the head model {deformed}. "
        f"The paper of `{OURS}` reports {paper}, without naming the hardware."
    )


def beside_table(runs: RunSet) -> str:
    """Differences in PSNR of the pairs `BESIDE` with intervals: Markdown."""
    runs = runs.by_camera
    lines = [
        ["PSNR, dB", *(TASK_TITLES.get(task, task) for task in runs.tasks)],
        ["---"] * (1 + len(runs.tasks)),
    ]
    for pair in (pair for pair in BESIDE if {*pair} <= {*runs.methods}):
        lines.append([" - ".join(pair), *(_difference(runs, pair, task, "psnr", 2) for task in runs.tasks)])
    return pipe_table(lines)


def _cost_text(runs: RunSet, folders: Sequence[Path], seeds: Sequence[Path]) -> str:
    """Mean processor seconds of a training by method; number, processor hours and hours of all, the further seeds among them."""
    means = {name: summarise(runs.rows, name, "training_processor", "").value for name in runs.ranked}
    known = ", ".join(f"{name} {value:.0f}" for name, value in means.items() if value is not None)
    if not known:
        return ""
    minutes = [value for each in (*folders, *seeds) for _, value in _minutes(each)]
    seconds = [value for each in (*folders, *seeds) for _, value in _minutes(each, "training_processor")]
    busy = sum(value for value in seconds if value is not None) / 3600
    hours = sum(value for value in minutes if value is not None) / 60
    without = minutes.count(None)
    interrupted = f"; {without} that were interrupted and continued are not included" if without else ""
    return (
        f"Mean processor seconds of a training: {known}. {len(minutes) - without} trainings, including baselines and further seeds, took "
        f"{busy:.1f} processor hours ({hours:.1f} hours of wall-clock time){interrupted}."
    )


PUBLISH: dict[str, Callable[[Path, Path], None]] = {
    "demo": publish_demo,
    SUITE: publish_suite,
    RATES: publish_rates,
    FURTHER: publish_further,
    CURVES: publish_curves,
    "subjects": publish_picture,
    **{name: partial(publish_subject, name) for name in SUBJECT_BLOCKS},
}

if __name__ == "__main__":
    PUBLISH[sys.argv[1]](Path(sys.argv[2]), Path(sys.argv[3]))

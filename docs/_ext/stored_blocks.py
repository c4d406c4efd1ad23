"""Tables and sentences of pages on stored runs, as Markdown."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from statistics import fmean

from headbench.bench.engine.scoring import FULL
from headbench.bench.experiments.suite_settings import LEVEL, TRACKED
from headbench.bench.progress import counted
from headbench.bench.protocol import SEEN_CAMERAS, TASK_TITLES
from headbench.bench.registry import get
from headbench.bench.rows import ALL
from headbench.reports.aggregate import means_by_seed, subject_means, summarise, whole_images
from headbench.reports.curve.curve import CurveData, leaders_text
from headbench.reports.curve.points import HELD_OUT, CurvePoint, column
from headbench.reports.papers import paper_named
from headbench.reports.runs import FrameSelection, RunSet
from headbench.reports.statistics.comparisons import compare
from headbench.reports.statistics.paired import interval
from headbench.reports.suite.variance import components, difference_by_seed
from headbench.reports.writers import pipe_table

OURS, COMPARED = "ours", ("ours", "ga")
TRACKING = {
    "": "exact tracking",
    TRACKED: "tracked from images",
    LEVEL.format(3): "tracking errors of level 3",
}
"""Conditions of the table of drops, and their titles."""
UNITS = {"seconds": " s", "pictures": ""}
"""Varied quantities of stored curves, and the unit of their columns."""


def differences(runs: RunSet, pairs: Sequence[tuple[str, str]]) -> str:
    """Differences in PSNR of the pairs that the runs have, a column for each task."""
    lines = [["PSNR, dB", *(TASK_TITLES[task] for task in runs.tasks)], ["---"] * (1 + len(runs.tasks))]
    for pair in (pair for pair in pairs if {*pair} <= {*runs.methods}):
        lines.append([" - ".join(pair), *(_difference(runs, pair, task) for task in runs.tasks)])
    return pipe_table(lines)


def _difference(runs: RunSet, pair: tuple[str, str], task: str, metric: str = "psnr", digits: int = 2) -> str:
    """First minus second of a pair with its interval."""
    better = next(spec.higher_is_better for spec in runs.metrics if spec.name == metric)
    (found,) = compare(runs.rows, [pair], task=task, metric=metric, higher_is_better=better)
    # Sizes differ by nearly the same for all subjects.
    return (found if task else replace(found, low=None)).text(digits)


def ablations(runs: RunSet) -> str:
    """Differences of the ablations of `OURS` from it, on those runs of the suite that have them."""
    names = [name for name in get("methods", OURS).ablations if f"{OURS}+{name}" in runs.methods]
    runs = runs.only([OURS, *(f"{OURS}+{name}" for name in names)]).shared.by_camera
    parts = {"": runs, "face, ": runs.of(FrameSelection("face"))}
    columns = [(title, task) for title in parts for task in ("novel_view", SEEN_CAMERAS)]
    lines = [["", *(f"{title}{TASK_TITLES[task].lower()}" for title, task in columns), "MB"]]
    lines.append(["---"] * len(lines[0]))
    for name in names:
        pair = (f"{OURS}+{name}", OURS)
        found = [_difference(parts[title], pair, task) for title, task in columns]
        lines.append([f"`{name}`", *found, _difference(runs, pair, "", "storage", 1)])
    return f"Subjects {', '.join(sorted(runs.rows.subjects))}, PSNR in dB:\n\n{pipe_table(lines)}"


def drops(runs: RunSet) -> str:
    """PSNR of novel views minus that of self-reenactment, a row for each condition of tracking and task."""
    by_condition: dict[str, dict[str, str]] = {condition: {} for condition in TRACKING}
    for label, record in runs.records.items():
        by_condition.get(record.condition, {})[record.name] = label
    methods = [name for name in by_condition[""] if all(name in own for own in by_condition.values())]
    shared = runs.only([own[name] for own in by_condition.values() for name in methods]).shared.by_camera
    lines = [["drop of PSNR, dB", *(f"`{name}`" for name in methods)], ["---", *["---:"] * len(methods)]]
    for task, (condition, labels) in product(shared.tasks[1:], by_condition.items()):
        cells = []
        for name in methods:
            novel, other = (
                subject_means(whole_images(shared.rows, labels[name], "psnr", each))
                for each in ("novel_view", task)
            )
            values = [novel[subject] - other[subject] for subject in novel]
            low, high = interval(values) or (0.0, 0.0)
            cells.append(f"{fmean(values):.2f} ({low:.1f}, {high:.1f})")
        lines.append([f"{TASK_TITLES[task]}, {TRACKING[condition]}", *cells])
    subjects = ", ".join(sorted(shared.rows.subjects))
    return f"Subjects {subjects}, means and 95 % intervals:\n\n{pipe_table(lines)}"


def variance(repeated: RunSet) -> str:
    """A sentence on the variation of the difference of `COMPARED` in runs with several seeds."""
    runs = repeated.only(COMPARED).by_camera
    values = {name: means_by_seed(whole_images(runs.rows, name, "psnr", "novel_view")) for name in COMPARED}
    by_seed = difference_by_seed(values, COMPARED)
    subjects, mean, between, within = components(by_seed)
    return (
        f"With {len(by_seed)} training seeds on {subjects} of the subjects, the mean of `{'` - `'.join(COMPARED)}` in novel views is "
        f"{mean:+.2f} dB. Its standard deviation is {within:.2f} dB over the seeds of one subject, and "
        f"{between:.2f} dB over subjects (means over seeds)."
    )


def speeds(runs: RunSet) -> str:
    """Frames per second of `COMPARED` on one thread, with and without the head model, beside what the paper prints."""
    whole, deformed = (
        " and ".join(f"{summarise(runs.rows, name, metric, '').value:.0f} (`{name}`)" for name in COMPARED)
        for metric in ("fps_one_thread", "fps_without_head")
    )
    rows = (row for table in paper_named("tensorial-2025").tables for row in table.rows)
    printed = {row.method: row.values["fps"] for row in rows if "fps" in row.values}
    paper = " and ".join(f"{printed[name]} (`{name}`)" for name in COMPARED)
    return (
        f"Frames per second on one thread of {runs.machine}, under the load that the table notes: {whole}; without the head model "
        f"{deformed}. The paper of `{OURS}` reports {paper}, without naming the hardware."
    )


def trainings(runs: RunSet, metric: str) -> list[tuple[str, float | None]]:
    """Method and value of every training; None of those that were interrupted and continued."""
    rows = runs.rows.select(method=ALL, condition=ALL, metric=metric, task="", region=FULL, seeds=ALL)
    values = (value if status == "ok" else None for value, status in zip(rows["value"], rows["status"]))
    return list(zip(rows["method"], values))


def costs(runs: RunSet, seeds: RunSet) -> str:
    """Mean processor seconds of a training by method; number, processor hours and hours of all."""
    means = {name: summarise(runs.rows, name, "training_processor", "").value for name in runs.ranked}
    known = ", ".join(f"{name} {value:.0f}" for name, value in means.items() if value is not None)
    minutes, seconds = (
        [value for each in (runs, seeds) for _, value in trainings(each, metric)]
        for metric in ("training_time", "training_processor")
    )
    without = minutes.count(None)
    interrupted = f"; {without} that were interrupted and continued are not included" if without else ""
    return (
        f"Mean processor seconds of a training: {known}. {len(minutes) - without} trainings, including baselines and further seeds, took "
        f"{sum(filter(None, seconds)) / 3600:.1f} processor hours ({sum(filter(None, minutes)) / 60:.1f} hours of wall-clock time)"
        f"{interrupted}."
    )


def measured(runs: RunSet) -> dict[str, object]:
    """Means of the suite, as `MeasuredFigures` has them; over all cameras, as papers print them."""
    specs = {spec.name: spec for spec in runs.metrics}
    keys = [(task, name) for task in runs.tasks for name in specs if specs[name].per_frame]
    methods: dict[str, dict[str, str]] = {}
    for label, (task, name) in product(runs.ranked, [*keys, ("", "storage"), ("", "fps")]):
        if (value := summarise(runs.rows, label, name, task).value) is not None:
            methods.setdefault(label, {})[f"{task}/{name}".lstrip("/")] = f"{value:.{specs[name].digits}f}"
    sizes = {found.resolution for run in runs.runs for found in run.manifest.protocols.values()}
    data = f"{counted(len(runs.rows.subjects), 'synthetic subject')}, {' and '.join(sorted(sizes))}"
    return {"suite": "suite", "data": data, "methods": methods}


def curve(data: CurveData) -> str:
    """PSNR of both kinds of held-out frames by method and quantity, size of the avatar, and the best methods."""
    (psnr,) = (spec for spec in data.metrics if spec.name == "psnr")

    def amount(point: CurvePoint) -> float:
        return point.place[1 if data.over == "seconds" else 2]

    amounts = sorted({amount(point) for point in data.means})
    lines = [["", *(f"{each:g}{UNITS[data.over]}" for each in amounts), "MB"], ["---"] * (2 + len(amounts))]
    for method in dict.fromkeys(point.method for point in data.means):
        own = {amount(point): point.values for point in data.means if point.method == method}
        values = [
            [own[each][column(psnr, task)] for task in data.tasks] if each in own else [] for each in amounts
        ]
        cells = [
            " / ".join("–" if v is None else f"{v:.{psnr.digits}f}" for v in each) or "–" for each in values
        ]
        sizes = [each["storage"] for each in own.values()]
        lines.append(
            [f"`{method}`", *cells, " to ".join(dict.fromkeys(f"{s:.1f}" for s in (min(sizes), max(sizes))))]
        )
    kinds = " / ".join(HELD_OUT[task] for task in data.tasks)
    subjects = f"{counted(len(data.subjects), 'subject')} ({', '.join(data.subjects)})"
    table = f"PSNR in dB, held-out {kinds}, means over {subjects}:\n\n{pipe_table(lines)}"
    return f"{table}\n\n{leaders_text(data)}"

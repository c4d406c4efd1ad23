"""Sections of a page: what the results say, provenance, cards of methods, losses, and images in files of their own."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from markupsafe import Markup

from ...bench.engine.stored import training_losses
from ...bench.errors import HeadbenchError, InputError
from ...bench.io.files import entries, write_text
from ...bench.progress import counted
from ...bench.protocol import TASK_TITLES
from ...bench.registry import get
from ...bench.rows import ALL
from ...bench.specs import MethodSpec, MetricSpec
from ..aggregate import SPEED, STORAGE, mechanisms, summarise
from ..runs import RunData, RunSet
from ..statistics.comparisons import LEVEL, subjects_needed
from ..tables import BELOW_CAUSES, not_better

NAMED = 3
"""Maximum number of methods named in a title."""


@dataclass
class Conclusions:
    """Texts of the head of a page; ``sentences`` are HTML."""

    title: str
    sentences: list[Markup] = field(default_factory=list)
    limit: str = ""
    facts: list[tuple[str, str]] = field(default_factory=list)


def verdict(
    runs: RunSet, metrics: Sequence[MetricSpec], comparisons: Sequence[Mapping[str, Any]]
) -> Conclusions:
    """Describe the results of the ranked methods by the first of the ``metrics`` of frames and `compare_methods`."""
    head = Conclusions(_title(runs), facts=_facts(runs))
    methods = runs.ranked
    if below := not_better(runs.by_camera.rows, metrics, methods, runs.trivial, runs.by_camera.tasks):
        head.sentences += [Markup("<b>{}</b>").format(" ".join(below.values())), Markup.escape(BELOW_CAUSES)]
    head.sentences += [Markup("<b>{}</b>").format(text) for text in mechanisms(runs.rows, methods)[1]]
    methods = tuple(name for name in methods if name not in below)
    for task in runs.by_camera.tasks if metrics else ():
        if scores := _scores(runs.by_camera, methods, metrics[0], task):
            head.sentences.append(_sentence(scores, metrics[0], task, comparisons))
    head.sentences += _costs(runs, methods)
    if len(methods) > 1:
        pairs, subjects = len(methods) * (len(methods) - 1) // 2, len(runs.rows.subjects)
        needed = subjects_needed(LEVEL, pairs)
        head.limit = (
            f"{counted(subjects, 'subject')} cannot show which method is better: a test of {counted(pairs, 'pair')} needs {needed}."
            if subjects < needed
            else f"Exact sign-flip test over {subjects} subjects, Holm’s correction, level {LEVEL:.0%}. It applies to subjects of "
            "captures like these, not to other captures, resolutions or training budgets. “Not significant” does not mean equal."
        )
    return head


def _title(runs: RunSet) -> str:
    """The methods, or their number, and the subjects."""
    names, subjects = runs.ranked or runs.methods, sorted(runs.rows.subjects)
    methods = " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
    if len(names) > NAMED:
        methods = f"{len(names)} {'avatar methods' if runs.ranked else 'baselines'}"
    where = f"subject {subjects[0]}" if len(subjects) == 1 else f"{len(subjects)} subjects"
    return f"{methods} on {where}"


def _scores(runs: RunSet, names: Sequence[str], spec: MetricSpec, task: str) -> list[tuple[str, float]]:
    """Methods with their means, best first."""
    means = [(name, summarise(runs.rows, name, spec.name, task).value) for name in names]
    measured = [(name, value) for name, value in means if value is not None]
    return sorted(measured, key=lambda pair: -pair[1] if spec.higher_is_better else pair[1])


def _task(task: str) -> str:
    return TASK_TITLES.get(task, task).lower()


def _amount(value: float, spec: MetricSpec) -> str:
    return f"{value:.{spec.digits}f}\u00a0{spec.unit}".rstrip("\u00a0")


def _sentence(
    scores: Sequence[tuple[str, float]], spec: MetricSpec, task: str, comparisons: Sequence[Mapping[str, Any]]
) -> Markup:
    """The best method of a task and its lead over the next, with interval and outcome of the test where there is one."""
    leader, best = scores[0]
    text = Markup("<b>{}</b> has the best {} in {}, {}").format(
        leader, spec.label, _task(task), _amount(best, spec)
    )
    if len(scores) == 1:
        return text + "."
    second, next_best = scores[1]
    text += Markup(", {} ahead of {}").format(_amount(abs(best - next_best), spec), second)
    pair = {leader, second}
    tested = [c for c in comparisons if (c["task"], c["metric"]) == (task, spec.name)]
    for one in (c for c in tested if {c["first"], c["second"]} == pair and None not in (c["low"], c["high"])):
        sign = 1 if one["difference"] > 0 else -1
        low, high = sorted(sign * one[end] for end in ("low", "high"))
        outcome = {f"{leader} is better": ", significant", "no significant difference": ", not significant"}
        ends = f"{low:+.{spec.digits}f} to {high:+.{spec.digits}f}".replace("-", "−")
        text += f" (95\u00a0% interval {ends}{outcome.get(one['verdict'], '')})"
    return text + "."


def _costs(runs: RunSet, names: Sequence[str]) -> list[Markup]:
    """The smallest and the fastest method, each with the next one."""
    specs, sentences = {spec.name: spec for spec in runs.metrics}, []
    for metric, what in ((STORAGE, "smallest"), (SPEED, "fastest")):
        scores = _scores(runs, names, specs[metric], "") if metric in specs else []
        if len(scores) > 1:
            (first, value), (second, other) = scores[:2]
            amounts = _amount(value, specs[metric]), second, _amount(other, specs[metric])
            sentences.append(Markup("<b>{}</b> is the {}, {} ({} {}).").format(first, what, *amounts))
    return sentences


def _facts(runs: RunSet) -> list[tuple[str, str]]:
    """Short lines describing the compared data."""
    configurations = [run.manifest.configuration for run in runs.runs]
    changed = f"{len(runs.changed)} under other conditions" * bool(runs.changed)
    trivial = counted(len(runs.trivial), "trivial baseline") * bool(runs.trivial)
    cores = runs.runs[0].manifest.machine.get("cores", "")
    frames = [f"{len(keys)} {_task(task)}" for task, keys in runs.keys.items()]
    cameras = {key.camera for keys in runs.keys.values() for key in keys}
    trained = [record.budget for record in runs.records.values() if not record.trivial]
    budgets = sorted({int(budget["iterations"]) for budget in trained if budget.get("iterations")})
    iterations = " to ".join(f"{n:,}" for n in dict.fromkeys([*budgets[:1], *budgets[-1:]]))
    presets = f"preset {', '.join(dict.fromkeys(config.preset for config in configurations))}"
    seeds = counted(len({seed for config in configurations for seed in config.seeds}), "seed")
    files = [run.folder.rows for run in runs.runs if run.folder.rows.exists()]
    when = max((datetime.fromtimestamp(file.stat().st_mtime) for file in files), default=None)
    lines = [
        ("Methods", "; ".join(filter(None, [", ".join(runs.ranked), changed, trivial]))),
        ("Subjects", ", ".join(sorted(runs.rows.subjects))),
        ("Frames", ", ".join(frames) + f"; {counted(len(cameras), 'camera')}" * bool(cameras)),
        ("Images", f"{runs.image_size} pixels{runs.cut and f', {runs.cut}'}" * bool(runs.image_size)),
        ("Training", f"{presets}; {f'{iterations} iterations; ' * bool(iterations)}{seeds}"),
        ("Machine", ", ".join(filter(None, [runs.machine, cores and f"{cores} cores"]))),
        ("Results of", f"{when.day} {when:%B %Y}" if when else ""),
    ]
    return [(name, text) for name, text in lines if text]


INDEX, FOLDER = "index.html", "pictures"
FILE_BYTES = 2 * 10**6
"""Target size of a file, small enough to load quickly from a slow disk or network."""
ENTRY_BYTES = 100
"""Maximum overhead of a file: its name on the page and the call in it."""


@dataclass(frozen=True)
class PictureFile:
    """A file of consecutive images: path in the page's folder, text, number of images."""

    name: str
    text: str
    count: int


def picture_files(images: Sequence[str]) -> list[PictureFile]:
    """Distribute base64 images over files of at most `FILE_BYTES`, or with a single image."""
    groups: list[list[str]] = []
    for image in images:
        if not groups or sum(map(len, groups[-1])) + len(image) > FILE_BYTES:
            groups.append([])
        groups[-1].append(image)
    files = []
    for index, group in enumerate(groups):
        text = f"addPictures({index}, {json.dumps(group, separators=(',', ':'))});\n"
        name = f"{FOLDER}/{hashlib.sha256(text.encode()).hexdigest()[:20]}.js"
        files.append(PictureFile(name, text, len(group)))
    return files


def check_folder(folder: Path) -> None:
    """Raise `InputError` for a folder that holds anything but an earlier report."""
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "--out", "a folder", "a file")
    names = [path.name for path in entries(folder)]
    others = sorted({*names} - {INDEX, FOLDER})
    if others:
        expected = "a new folder, or one with an earlier report alone"
        raise InputError(folder, "--out", expected, f"{others[0]} in it")


def write_pictures(folder: Path, files: Sequence[PictureFile]) -> None:
    """Write the missing files; those of an earlier page are kept until `remove_others`."""
    for file in files:
        write_text(folder / file.name, file.text)


def remove_others(folder: Path, files: Sequence[PictureFile]) -> None:
    """Remove the images of earlier pages."""
    names = {file.name for file in files}
    for path in (folder / FOLDER).glob("*.js"):
        if f"{FOLDER}/{path.name}" not in names:
            path.unlink()


def record_of(run: RunData) -> dict[str, Any]:
    """Provenance of a run's results, as text; without local paths."""
    manifest = run.manifest
    excluded = {
        (*key, why): None for protocol in manifest.protocols.values() for key, why in protocol.excluded
    }
    machine = manifest.machine
    return {
        "name": run.folder.root.resolve().name,
        "done": manifest.status == "done",
        "facts": [
            ("Machine", run.machine),
            *((name.capitalize(), str(machine.get(name, ""))) for name in ("cores", "system", "python")),
            *((str(name), str(version)) for name, version in dict(machine.get("packages") or {}).items()),
            ("Seconds of the last start", "" if manifest.seconds is None else f"{manifest.seconds:.0f}"),
        ],
        "protocols": [
            (TASK_TITLES.get(task, task), p.id, p.hash, str(len(p.keys)), p.resolution, p.quantisation)
            for task, p in manifest.protocols.items()
        ],
        "clips": [(clip.subject, clip.fingerprint) for clip in manifest.clips],
        "methods": [(m.label, m.version, json.dumps(m.budget)) for m in manifest.methods],
        "configuration": json.dumps(_without_folders(asdict(manifest.configuration)), indent=1, default=str),
        "settings": json.dumps(
            _without_folders({m.label: m.config for m in manifest.methods}), indent=1, default=str
        ),
        "excluded": _excluded(excluded),
    }


def _excluded(frames: dict[tuple[Any, ...], None]) -> list[tuple[str, str, str, str, str]]:
    """Subject, sequence, timestep, number of cameras, reason."""
    moments = Counter((subject, sequence, timestep, why) for subject, sequence, timestep, _, why in frames)
    return [(subject, seq, str(t), str(n), why) for (subject, seq, t, why), n in sorted(moments.items())]


def _without_folders(value: Any) -> Any:
    """A value with absolute paths shortened to their last part."""
    if isinstance(value, dict):
        return {key: _without_folders(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_folders(item) for item in value]
    return os.path.basename(value) if isinstance(value, str) and os.path.isabs(value) else value


def failed_cells(runs: RunSet) -> list[tuple[str, str, str, str]]:
    """Method, seed, subject and error of each avatar that failed."""
    cells = []
    for label in runs.rows.failed:
        rows = runs.rows.select(method=label, metric=ALL, task=ALL, region=ALL, seeds=ALL)
        errors = rows[rows["status"] == "failed"][["seed", "subject", "reason"]].drop_duplicates()
        for seed, subject, reason in errors.itertuples(index=False, name=None):
            cells.append((label, str(seed), str(subject), str(reason)))
    return cells


def loss_curves(runs: RunSet) -> list[dict[str, Any]]:
    """For each method that recorded positive losses: its index among the methods, and iterations with losses.

    Losses are divided by the first recorded one, and averaged over the subjects that recorded the same iterations as the
    first; seeds are those of the pictures. Damaged records are ignored.
    """
    by_method = []
    for index, label in enumerate(runs.methods):
        run, name = runs.pictured[label]
        curves: list[dict[int, float]] = []
        for clip in run.manifest.clips:
            losses: list[tuple[int, float]] = []
            with suppress(InputError, OSError):
                losses = training_losses(run.folder.cell(clip.subject, name, run.seed).avatar)
            if len(losses) > 1 and all(value > 0 for _, value in losses):
                curves.append({at: value / losses[0][1] for at, value in losses})
        if curves:
            alike = [curve for curve in curves if [*curve] == [*curves[0]]]
            means = ((at, sum(curve[at] for curve in alike) / len(alike)) for at in curves[0])
            by_method.append({"method": index, "points": [(at, float(f"{mean:.4g}")) for at, mean in means]})
    return by_method


def cards_of(runs: RunSet) -> list[dict[str, Any]]:
    """A card for each method, trivial baselines last.

    Summary, source and citation are those of the registered method of the same name and implementation; other methods
    have none. ``anchor`` is the name of the card in the page.
    """
    cards = []
    for index, (label, record) in enumerate(runs.records.items()):
        registered: MethodSpec | None = None
        with suppress(HeadbenchError):  # no installed method
            spec: MethodSpec = get("methods", record.name)
            registered = spec if spec.implementation == record.implementation else None
        budget = ", ".join(f"{n:,} {name}" for name, n in record.budget.items() if n is not None)
        recorded = {name: getattr(record, name) for name in ("name", "trivial", "version", "implementation")}
        texts = {name: getattr(registered, name, "").strip() for name in ("summary", "source", "bibtex")}
        card = {"anchor": f"method-{index + 1}", "label": label, **recorded, **texts}
        cards.append({**card, "budget": "" if record.trivial else budget})
    return sorted(cards, key=lambda card: card["trivial"])

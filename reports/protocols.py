"""Evaluates stored rows under named protocols, and the effect of each difference between protocols."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import tyro

from ..bench.contracts import FrameKey, Progress
from ..bench.engine.config import CANONICAL
from ..bench.errors import InputError
from ..bench.io.files import check_writable, write_text
from ..bench.protocol import TASK_TITLES, NamedProtocol, TaskFrames, check_trained, named_protocols
from ..bench.registry import get
from ..bench.rows import FULL
from ..bench.specs import CommandResult, MetricSpec, command
from ..bench.terminal import table
from .aggregate import AVERAGED, summarise
from .runs import RunSet, synthetic_settings, unseen_cameras
from .writers import pipe_table

QUALITY = {"psnr": 2, "lpips": 4}
"""Metrics whose changes are tabulated, and their decimals."""


def under(runs: RunSet, name: str, protocol: NamedProtocol) -> RunSet:
    """Runs under a protocol: its frames, pixels, metric definitions and means.

    Raises `InputError` if the runs or their captures lack a task, cameras, a sequence, a region or a metric profile.
    """
    source = runs.runs[0].folder.rows
    check_trained(name, protocol, source)
    tasks = tuple(task for task in protocol.tasks if task in runs.tasks)
    if not tasks:
        expected = f"{' or '.join(protocol.tasks)}, by protocol {name}"
        raise InputError(source, "tasks", expected, ", ".join(runs.tasks))
    keys = {task: _frames(runs, task, protocol.tasks[task], name) for task in tasks}
    if protocol.region != FULL and protocol.region not in runs.rows.regions:
        expected = f"{protocol.region}, by protocol {name}"
        remedy = f"`headbench run --protocol {name}` measures it."
        raise InputError(source, "regions", expected, ", ".join(sorted(runs.rows.regions)), remedy)
    metrics, names = _metrics(runs, name, protocol)
    rows = runs.rows.of_part(protocol.region, (), FULL).of_frames(keys).with_metrics(names)
    if protocol.average == "frames":
        rows = rows.as_one_sequence()
    if protocol.pooled is not None:
        rows = rows.pooled(protocol.pooled, {spec.name for spec in metrics if spec.unit == "dB"})
    # With one mean over all frames, sequences and timesteps of rows no longer identify frames.
    by_sequence = protocol.average == "sequences"
    scored = {task: frozenset(frames) for task, frames in keys.items()} if by_sequence else {}
    part = " ".join([f"Protocol {name}: {protocol.title}.", *differences(runs, protocol)])
    measured = tuple(spec for spec in metrics if spec.name in rows.metrics)
    batches = "" if protocol.pooled is None else f"batches of {protocol.pooled} "
    averaged = f"{batches}{AVERAGED if by_sequence else 'frames, then subjects'}"
    selected = replace(runs, rows=rows, tasks=tasks, metrics=measured, keys=scored, part=part)
    return replace(selected, protocol=name, averaged=averaged)


def _frames(runs: RunSet, task: str, wanted: TaskFrames, name: str) -> list[FrameKey]:
    """The frames of a task. Raises `InputError` if there are none of its cameras or sequences, or a capture holds out others."""
    source, keys = runs.runs[0].folder.rows, sorted(runs.keys[task])
    for clip in (clip for run in runs.runs for clip in run.manifest.clips):
        wanted.check_share(clip.splits.get(task, 0), clip.splits["train"], f"clip {clip.subject}", name)
    if wanted.cameras != "all" and task != "novel_view":  # cameras of novel views are unseen
        unseen, reason = unseen_cameras([run.manifest for run in runs.runs], keys)
        hidden = wanted.cameras == "unseen"
        inside = [key for key in keys if ((key.subject, key.camera) in unseen) == hidden]
        if not inside or not unseen:
            expected = f"{wanted.cameras} cameras in {task}, by protocol {name}"
            others = f"{len({key.camera for key in keys})} others"
            raise InputError(source, "cameras", expected, reason or others)
        keys = inside
    if wanted.sequences:
        sequences = sorted({key.sequence for key in keys})
        keys = [key for key in keys if key.sequence.startswith(wanted.sequences)]
        if not keys:
            expected = f"{' or '.join(wanted.sequences)}, held out, by protocol {name}"
            raise InputError(source, "sequences", expected, ", ".join(sequences))
    if wanted.last is not None:
        times: dict[tuple[str, str], list[int]] = {}
        for key in keys:
            times.setdefault((key.subject, key.sequence), []).append(key.timestep)
        last = {place: set(sorted(set(of_place))[-wanted.last :]) for place, of_place in times.items()}
        keys = [key for key in keys if key.timestep in last[key.subject, key.sequence]]
    return keys


def _metrics(runs: RunSet, name: str, protocol: NamedProtocol) -> tuple[list[MetricSpec], dict[str, str]]:
    """The metrics by the protocol's definitions, under their usual names, and the names of their rows."""
    defined = {metric.name for metric in get("profiles", CANONICAL).metrics}
    metrics, names = [], {}
    for spec in runs.metrics:
        bare, _, profile = spec.name.partition("@")
        of_profile = bare in defined and (profile or CANONICAL) == protocol.profile
        if of_profile or (bare not in defined and not profile):
            names[spec.name] = bare
            label = spec.label.removesuffix(f" ({profile})") if profile else spec.label
            tables = ("comparison",) if profile else spec.tables
            metrics.append(replace(spec, name=bare, label=label, tables=tables, profile=CANONICAL))
    if not any(spec.per_frame for spec in metrics):
        source = runs.runs[0].folder.rows
        expected = f"metrics of profile {protocol.profile}, by protocol {name}"
        remedy = f"`headbench run --protocol {name}` measures them."
        raise InputError(source, "metrics", expected, ", ".join(sorted(runs.rows.metrics)), remedy)
    return metrics, names


def differences(runs: RunSet, protocol: NamedProtocol) -> list[str]:
    """Sentences on the differences of runs from the conditions of a protocol's published values."""
    sentences = []
    synthetic = all(synthetic_settings(clip) for run in runs.runs for clip in run.manifest.clips)
    subjects = len({clip.subject for run in runs.runs for clip in run.manifest.clips})
    if protocol.subjects and synthetic:
        sentences.append(f"Subjects: {subjects} synthetic; in the protocol: {protocol.subjects}.")
    sizes = {p.resolution for run in runs.runs for p in run.manifest.protocols.values()}
    if protocol.size and sizes != {protocol.size}:
        sentences.append(f"Pixels: {', '.join(sorted(sizes))}; in the protocol: {protocol.size}.")
    trained = (record.budget.get("iterations") for record in runs.records.values() if not record.trivial)
    budgets = sorted({*filter(None, trained)})
    if protocol.iterations is not None and budgets and budgets != [protocol.iterations]:
        most = f"{budgets[0]:,}" + (f" to {budgets[-1]:,}" if len(budgets) > 1 else "")
        sentences.append(f"Iterations: {most}; in the protocol: {protocol.iterations:,}.")
    tracked = [label for label in runs.methods if label not in runs.with_refit]
    if protocol.test_refit and tracked:
        fitted = "fitted to their own pictures (condition test-refit)"
        sentences.append(f"Scored frames: as tracked; in the protocol: {fitted}.")
    return sentences


@dataclass(frozen=True)
class ProtocolsSettings:
    """Change of every metric by each single evaluation choice, and by whole protocols, from stored rows."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of runs, preferably made with `headbench run --protocol NAME`, which measures the profiles and regions."""
    methods: tuple[str, ...] = ()
    """Only these methods; default: all that are ranked."""
    out: str | None = None
    """File to write the Markdown to, instead of printing it."""


USUAL = "usual"
"""Reference for every choice: all frames and pixels, the mean over frames, the canonical metrics."""
NAMED = "protocol "


def choices(runs: RunSet) -> dict[str, NamedProtocol]:
    """The usual protocol, those that differ from it in one choice, and the named ones."""
    tasks: dict[str, TaskFrames] = {
        task: TaskFrames() for task in ("novel_view", "self_reenactment") if task in runs.tasks
    }
    usual = NamedProtocol("the usual one", "", tasks)
    offered = {USUAL: usual}
    regions = sorted(runs.rows.regions - {FULL})
    offered |= {f"pixels: {region}": replace(usual, region=region) for region in regions}
    profiles = dict.fromkeys(spec.profile for spec in runs.metrics if spec.profile != CANONICAL)
    offered |= {f"metrics: {profile}": replace(usual, profile=profile) for profile in profiles}
    offered["pooled: 16 frames"] = replace(usual, pooled=16)
    offered["mean: over sequences"] = replace(usual, average="sequences")
    if "self_reenactment" in tasks:
        starts = sorted({key.sequence.partition("-")[0] for key in runs.keys["self_reenactment"]})
        some = {f"cameras: {cameras}": TaskFrames(cameras) for cameras in ("seen", "unseen")}
        some |= {f"sequences: {start}": TaskFrames(sequences=(start,)) for start in starts if len(starts) > 1}
        offered |= {name: replace(usual, tasks={"self_reenactment": frames}) for name, frames in some.items()}
    named = {f"{NAMED}{name}": protocol for name, protocol in named_protocols().items()}
    return offered | {name: protocol for name, protocol in named.items() if not protocol.pictures}


@command("protocols", group="compare")
def protocols_command(settings: ProtocolsSettings, progress: Progress) -> CommandResult:
    """Show how each choice of an evaluation changes the results: pixels, metrics, cameras, means."""
    if settings.out is not None:
        check_writable(Path(settings.out), "--out")
    runs = RunSet.read([Path(run) for run in settings.runs])
    for method in settings.methods:
        if method not in runs.methods:
            raise InputError("command line", "--methods", f"some of {', '.join(runs.methods)}", method)
    shown = runs.only(settings.methods or runs.ranked or runs.methods)
    text, values, refused = choice_effects(shown, markdown=settings.out is not None)
    data = {"values": values, "refused": refused}
    if settings.out is None:
        return CommandResult(text, data)
    write_text(Path(settings.out), f"{text}\n")
    return CommandResult(settings.out, {**data, "out": settings.out})


def choice_effects(
    runs: RunSet, *, markdown: bool = True
) -> tuple[str, dict[str, dict[str, float]], dict[str, str]]:
    """Tables for `protocols_command`, the means by choice and "method task metric", and the choices that runs lack, with reasons."""
    values: dict[str, dict[str, float]] = {}
    refused: dict[str, str] = {}
    for label, protocol in choices(runs).items():
        try:
            selected = under(runs, label.removeprefix(NAMED), protocol)
        except InputError as error:
            refused[label] = f"{error.key}: expected {error.expected}"
            continue
        places = product(selected.methods, selected.tasks, QUALITY)
        means = {(m, t, q): summarise(selected.rows, m, q, t).value for m, t, q in places}
        values[label] = {" ".join(place): mean for place, mean in means.items() if mean is not None}
    return _text(runs.methods, values, refused, markdown=markdown), values, refused


def _text(
    methods: Sequence[str],
    values: Mapping[str, Mapping[str, float]],
    refused: Mapping[str, str],
    *,
    markdown: bool,
) -> str:
    """A table for each task, as Markdown or fitted to the terminal: values under the usual protocol, then differences from them."""
    parts = []
    base = values[USUAL]
    for task in ("novel_view", "self_reenactment"):
        columns = [(m, metric) for m in methods for metric in QUALITY if f"{m} {task} {metric}" in base]
        if not columns:
            continue
        head = ["" if markdown else "Choice", *(f"{method} {metric.upper()}" for method, metric in columns)]
        lines = []
        for label, means in values.items():
            cells = []
            for method, metric in columns:
                key, digits = f"{method} {task} {metric}", QUALITY[metric]
                subtracted, sign = (0.0, "") if label == USUAL else (base[key], "+")
                cells.append(f"{means[key] - subtracted:{sign}.{digits}f}" if key in means else "–")
            if set(cells) != {"–"}:
                lines.append([label, *cells])
        if markdown:
            rule = [":--", *("--:" for _ in columns)]
            shown = f"### {TASK_TITLES[task]}\n\n{pipe_table([head, rule, *lines])}"
        else:
            shown = table(head, lines, title=TASK_TITLES[task])
        by_method = (
            [v[key] for v in values.values() if key in v] for key in (f"{m} {task} psnr" for m in methods)
        )
        spans = [max(means) - min(means) for means in by_method if means]
        spread = f"The PSNR of one method differs by up to {max(spans, default=0):.1f} dB between these rows."
        parts.append(f"{shown}\n\n{spread}")
    parts.append(
        'The row "usual" shows values: all frames and pixels, the mean over frames and then subjects, canonical metrics. Other rows show '
        "differences from it: a protocol changes all of its choices, any other row one choice."
    )
    if refused:
        entries = (f"- {label}: {reason}" for label, reason in refused.items())
        parts.append("\n".join(["Not available from these rows:", "", *entries]))
    return "\n\n".join(parts)

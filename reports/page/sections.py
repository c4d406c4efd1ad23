"""Sections of a page: provenance of a run, cards of its methods, curves of training losses."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from typing import Any

from ...bench.engine.stored import training_losses
from ...bench.errors import InputError
from ...bench.protocol import TASK_TITLES
from ...bench.registry import discover
from ...bench.rows import ALL
from ...bench.specs import MethodSpec
from ..runs import RunData, RunSet


def name_of(run: RunData) -> str:
    return run.folder.root.resolve().name


def record_of(run: RunData) -> dict[str, Any]:
    """Provenance of a run's results, as text; without local paths."""
    manifest = run.manifest
    excluded = {
        (*key, why): None for protocol in manifest.protocols.values() for key, why in protocol.excluded
    }
    machine = manifest.machine
    return {
        "name": name_of(run),
        "done": manifest.status == "done",
        "facts": [
            ("Machine", run.machine),
            ("Cores", str(machine.get("cores", ""))),
            ("System", str(machine.get("system", ""))),
            ("Python", str(machine.get("python", ""))),
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
    moments: dict[tuple[Any, ...], int] = {}
    for subject, sequence, timestep, _, why in frames:
        moments[subject, sequence, timestep, why] = moments.get((subject, sequence, timestep, why), 0) + 1
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
    found: dict[tuple[str, str, str, str], None] = {}
    for label in runs.rows.failed:
        own = runs.rows.select(method=label, metric=ALL, task=ALL, region=ALL, seeds=ALL)
        own = own[own["status"] == "failed"].drop_duplicates(["seed", "subject", "reason"])
        for seed, subject, reason in own[["seed", "subject", "reason"]].itertuples(index=False, name=None):
            found[label, str(seed), str(subject), str(reason)] = None
    return [*found]


Curve = list[tuple[int, float]]


def loss_curves(runs: RunSet) -> list[dict[str, Any]]:
    """For each method that recorded positive losses: its index among the methods, and iterations with losses.

    Losses are divided by the first recorded one, and averaged over the subjects that recorded the same iterations as the
    first; seeds are those of the pictures. Damaged records are ignored.
    """
    found = []
    for index, label in enumerate(runs.methods):
        run, name = runs.shown[label]
        curves = []
        for clip in run.manifest.clips:
            try:
                losses = training_losses(run.folder.cell(clip.subject, name, run.seed).avatar)
            except (InputError, OSError):
                losses = []
            if len(losses) > 1 and all(value > 0 for _, value in losses):
                curves.append([(at, value / losses[0][1]) for at, value in losses])
        if curves:
            found.append({"method": index, "points": _mean(curves)})
    return found


def _mean(curves: list[Curve]) -> Curve:
    iterations = [at for at, _ in curves[0]]
    alike = [curve for curve in curves if [at for at, _ in curve] == iterations]
    return [
        (at, float(f"{sum(curve[i][1] for curve in alike) / len(alike):.4g}"))
        for i, at in enumerate(iterations)
    ]


def cards_of(runs: RunSet) -> list[dict[str, Any]]:
    """A card for each method, trivial baselines last.

    Summary, source and citation are those of the registered method of the same name and implementation; other methods
    have none. ``anchor`` is the name of the card in the page.
    """
    specs = {name: plugin.spec for name, plugin in discover("methods").items()}
    cards = []
    for index, (label, record) in enumerate(runs.records.items()):
        spec = specs.get(record.name)
        known = (
            spec if isinstance(spec, MethodSpec) and spec.implementation == record.implementation else None
        )
        budget = {name: value for name, value in record.budget.items() if value is not None}
        cards.append(
            {
                "anchor": f"method-{index + 1}",
                "label": label,
                "name": record.name,
                "trivial": record.trivial,
                "summary": known.summary if known else "",
                "source": known.source if known else "",
                "bibtex": known.bibtex.strip() if known else "",
                "version": record.version,
                "implementation": record.implementation,
                "budget": "" if record.trivial else ", ".join(f"{n:,} {name}" for name, n in budget.items()),
            }
        )
    return sorted(cards, key=lambda card: card["trivial"])

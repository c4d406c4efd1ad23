"""``headbench bench avatar``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from ....bench.contracts import Progress, no_progress
from ....bench.specs import Findings
from ....datasets.head.procedural.model import procedural_head
from ..splats.layout import table
from .savings import Bench

SIZES = ((20_000, 144, 208), (60_000, 550, 802))
QUICK = ((2_000, 72, 104),)


def measure(quick: bool = False, progress: Progress = no_progress) -> Findings:
    """Milliseconds per frame of an untrained avatar of ours by part, and of each saving alone, on one thread."""
    head = procedural_head()
    results = []
    sizes = QUICK if quick else SIZES
    for number, (count, width, height) in enumerate(sizes):
        progress(number, len(sizes), f"{count} splats, {width}x{height}")
        bench = Bench(head, count, width, height, budget=0.1 if quick else 1.5, least_runs=2 if quick else 8)
        results.append(
            {
                "splats": count,
                "width": width,
                "height": height,
                "stages_ms": dict(bench.stages()),
                "savings": [asdict(pair) for pair in bench.pairs()],
            }
        )
    text = "\n\n".join(_text(result) for result in results)
    note = (
        "Processor time of one thread, ms, the least of runs that take turns. Before: the same frame, or step, by the "
        "functions of\ntraining, or without what is known. Nothing is approximated: after differs from before by "
        "rounding alone."
    )
    return Findings(f"{text}\n\n{note}", {"sizes": results})


def _text(result: Mapping[str, Any]) -> str:
    stages = [(name, f"{ms:.2f}") for name, ms in result["stages_ms"].items()]
    savings = [
        (
            pair["name"],
            f"{pair['before']:.2f}",
            f"{pair['after']:.2f}",
            f"{pair['before'] / max(pair['after'], 1e-9):.1f}",
            pair["note"] or "-",
        )
        for pair in result["savings"]
    ]
    head = f"{result['splats']} splats, {result['width']}x{result['height']}"
    return "\n\n".join(
        [
            head,
            table(("step of a frame", "ms"), stages),
            table(("saving", "before", "after", "times", "note"), savings),
        ]
    )

"""Cards of methods: description, authors, and results of the runs."""

from __future__ import annotations

from typing import Any

from ...bench.registry import discover
from ...bench.specs import MethodSpec
from ..runs import RunSet


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

"""Compares the recorded definitions of metrics and methods with the registry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..engine.config import RunConfig
from ..manifest import Manifest
from ..registry import discover, get
from ..specs import MethodSpec, MetricSpec

METRIC_FIELDS = (
    *("label", "unit", "higher_is_better", "digits", "kind"),
    *("implementation", "detail", "machine_bound", "profile"),
)
METHOD_FIELDS = ("trivial", "implementation")


@dataclass(frozen=True)
class Mismatch:
    """A file or value that differs from its record, or a record that differs from the registry."""

    file: str
    key: str
    expected: str
    found: str

    def __str__(self) -> str:
        where = f"{self.file}, {self.key}" if self.key else self.file
        return f"{where}: expected {self.expected}, found {self.found}"


def known_metrics(config: RunConfig | None = None) -> dict[str, MetricSpec]:
    """Registered definitions by name, those of profiles and conditions included.

    Metrics that ``config`` names by their module are included too; the caller has checked that they may be imported.
    """
    found: dict[str, MetricSpec] = {}
    # Conditions first: they may redefine registered names.
    for plugin in discover("conditions").values():
        found |= {} if plugin.spec is None else {metric.name: metric for metric in plugin.spec.metrics}
    found |= {
        plugin.spec.name: plugin.spec for plugin in discover("metrics").values() if plugin.spec is not None
    }
    for profile in discover("profiles").values():
        found |= {} if profile.spec is None else {metric.name: metric for metric in profile.spec.metrics}
    for name in () if config is None else config.metrics:
        if ":" in name:
            spec: MetricSpec = get("metrics", name)
            found.setdefault(spec.name, spec)
    return found


def known_methods() -> dict[str, MethodSpec]:
    """Registered methods by name."""
    specs = (plugin.spec for plugin in discover("methods").values())
    return {spec.name: spec for spec in specs if spec is not None}


def method_of(name: str, known: Mapping[str, MethodSpec]) -> MethodSpec | None:
    """The registered method of a name, which may include a label of settings, such as "ours (static)"."""
    return known.get(name) or known.get(name.partition(" (")[0])


def contradictions(
    manifest: Manifest, file: Path, metrics: Mapping[str, MetricSpec], methods: Mapping[str, MethodSpec]
) -> Iterator[Mismatch]:
    """Differences of a record, in ``file``, from the definitions of registered metrics and methods."""
    for metric in manifest.metrics:
        if metric.name in metrics:
            yield from _differences(
                f"metrics, {metric.name}", METRIC_FIELDS, metrics[metric.name], metric, file
            )
    for record in manifest.methods:
        spec = method_of(record.name, methods)
        if spec is not None:
            yield from _differences(f"methods, {record.label}", METHOD_FIELDS, spec, record, file)


def _differences(
    place: str, names: tuple[str, ...], expected: Any, found: Any, file: Path
) -> Iterator[Mismatch]:
    for name in names:
        ours, theirs = getattr(expected, name), getattr(found, name)
        if ours != theirs:
            yield Mismatch(str(file), f"{place}, {name}", str(ours), str(theirs) or "none")

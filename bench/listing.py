"""``headbench list``."""

from __future__ import annotations

import inspect
from dataclasses import asdict, dataclass
from typing import Literal

import tyro

from .contracts import Progress
from .registry import Group, discover, resolve
from .specs import Findings


@dataclass(frozen=True)
class ListSettings:
    """--json prints all fields."""

    what: tyro.conf.Positional[
        Literal[
            "methods",
            "presets",
            "metrics",
            "profiles",
            "datasets",
            "reports",
            "conditions",
            "benchmarks",
            "commands",
        ]
    ]
    """What to list; datasets are readers, and what makes captures."""


def list_installed(settings: ListSettings, progress: Progress) -> Findings:
    """List what is installed: methods, presets, metrics, their profiles, readers, reports, benchmarks, commands."""
    group: Group = "methods" if settings.what == "presets" else settings.what
    entries = []
    for name, plugin in discover(group).items():
        known = {} if plugin.spec is None else asdict(plugin.spec)
        entries.append({"origin": plugin.origin, "error": plugin.error, **known, "name": name})
    if settings.what == "presets":
        entries = [
            {
                "name": f"{entry['name']} {preset}",
                "summary": ", ".join(f"{key}={value}" for key, value in values.items()),
                "settings": values,
                "error": "",
            }
            for entry in entries
            for preset, values in entry.get("presets", {}).items()
        ]
    if settings.what == "conditions":
        for entry in entries:
            if not entry["error"]:
                taken = ", ".join(parameters_of(entry["implementation"])) or "none"
                entry["summary"] += f" Kind: {entry['kind']}; parameters: {taken}."
    width = max((len(entry["name"]) for entry in entries), default=0)
    shown = [f"broken: {entry['error']}" if entry["error"] else entry["summary"] for entry in entries]
    lines = [f"{entry['name']:<{width}}  {text}" for entry, text in zip(entries, shown)]
    return Findings("\n".join(lines), entries)


def parameters_of(function: str) -> list[str]:
    """Names of the keyword parameters of a "module:function", with their defaults."""
    every = inspect.signature(resolve(function)).parameters.values()
    named = [parameter for parameter in every if parameter.kind == parameter.KEYWORD_ONLY]
    return [p.name if p.default is p.empty else f"{p.name}={p.default!r}" for p in named]


def presets_of_methods() -> str:
    """A sentence for the help: the presets of every method that is registered here."""
    methods_by_presets: dict[str, list[str]] = {}
    for name, plugin in discover("methods").items():
        if plugin.spec is not None and plugin.spec.presets:
            methods_by_presets.setdefault(", ".join(plugin.spec.presets), []).append(name)
    each = (f"{', '.join(methods)}: {presets}" for presets, methods in methods_by_presets.items())
    return f"Presets by method: {'; '.join(each)}. `headbench list presets` prints their settings."

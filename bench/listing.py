"""``headbench list``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import tyro

from .contracts import Progress
from .protocol import named_protocols
from .registry import Group, discover, get, resolve
from .specs import CommandResult, command


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
            "papers",
            "protocols",
        ]
    ]
    """What to list; `datasets` are readers and steps that make captures, `papers` are published tables whose
    layout `headbench table` can print, and `protocols` are evaluation protocols of papers."""

    cite: bool = False
    """With methods: their sources, BibTeX entries, and the values that papers report for them."""

    def __post_init__(self) -> None:
        """Refuse citations of anything but methods."""
        if self.cite and self.what != "methods":
            raise ValueError(f"--cite is for methods; found {self.what}")


@command("list", group="inspect")
def list_installed(settings: ListSettings, progress: Progress) -> CommandResult:
    """List installed methods, presets, metrics, readers, reports and commands."""
    if settings.what == "papers" or settings.cite:
        return _shown(resolve(get("reports", "citations" if settings.cite else "papers").implementation)())
    if settings.what == "protocols":
        protocols = {name: asdict(protocol) for name, protocol in named_protocols().items()}
        return _shown([{"name": n, "summary": p["title"], "error": "", **p} for n, p in protocols.items()])
    group: Group = "methods" if settings.what == "presets" else settings.what
    entries: list[dict[str, Any]] = []
    for name, plugin in discover(group).items():
        spec_fields = {} if plugin.spec is None else asdict(plugin.spec)
        entries.append({"origin": plugin.origin, "error": plugin.error, **spec_fields, "name": name})
    if settings.what == "presets":
        entries = [
            {
                "name": f"{entry['name']} {preset}",
                "summary": ", ".join(_assigned(values)),
                "settings": values,
                "error": "",
            }
            for entry in entries
            for preset, values in entry.get("presets", {}).items()
        ]
    return _shown(entries)


def _assigned(values: Mapping[str, Any], group: str = "") -> Iterator[str]:
    """Settings as ``--set`` takes them."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _assigned(value, f"{group}{key}.")
        else:
            yield f"{group}{key}={value}"


def _shown(entries: list[dict[str, Any]]) -> CommandResult:
    """A line for each entry."""
    width = max((len(entry["name"]) for entry in entries), default=0)
    shown = [f"broken: {entry['error']}" if entry["error"] else entry["summary"] for entry in entries]
    lines = [f"{entry['name']:<{width}}  {text}" for entry, text in zip(entries, shown)]
    return CommandResult("\n".join(lines), entries)

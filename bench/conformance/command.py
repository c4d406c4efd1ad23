"""``headbench doctor check``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import tyro

from ..configuration import parse_assignments
from ..contracts import Clip, Progress, no_progress
from ..engine.adaptation import MethodNeeds, apply, plan
from ..engine.config import DemoConfig, ResolvedMethod, RunConfig, resolve_method
from ..errors import InputError
from ..machine import check_device
from ..options import DependentOptions
from ..registry import SPEC_TYPES, Group, discover, get, resolve
from ..specs import CommandResult, DatasetSpec, MethodSpec, MetricSpec, command
from .methods import attempt, check_method
from .metrics import check_metric


@dataclass(frozen=True)
class CheckPluginSettings:
    """Test a method, a reader or a metric and list every violation of its contract.

    Exit code 0: it conforms; 1: it does not; 2: wrong usage, or the plug-in cannot be imported.
    """

    plugin: tyro.conf.Positional[str]
    """The plug-in: "package.module:SPEC", or a name that `headbench list` shows."""

    kind: Literal["methods", "datasets", "metrics"] | None = None
    """Kind of the plug-in, if several kinds have this name."""

    data: str | None = None
    """Capture: for a reader one in its layout (required); for a method by default a tiny synthetic one, made by the command."""

    reader: str = ""
    """Which reader opens --data for a method; default: the one that finds it."""

    preset: str | None = None
    """Preset of the method; default: smoke if it has that, else its first."""

    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """A setting of the method or reader, such as `budget.iterations=5`; repeatable."""

    device: str = "cpu"
    """Where the method trains."""

    dependent = (DependentOptions(("reader",), "data"),)


KINDS: dict[Group, str] = {"methods": "method", "datasets": "reader", "metrics": "metric"}
TIMESTEPS = 4  # of the generated capture


@command("doctor check", group="validate")
def check_plugin(settings: CheckPluginSettings, progress: Progress = no_progress) -> CommandResult:
    """Check a method, reader or metric against its contract.

    Raises `InputError` for wrong usage, and `HeadbenchError` where the plug-in cannot be imported.
    """
    spec, kind = _find(settings)
    values = parse_assignments(settings.set)
    breaches: list[str] = []
    if isinstance(spec, MethodSpec):
        breaches = _check_method(spec, settings, values, progress)
    elif isinstance(spec, DatasetSpec):
        if settings.data is None:
            raise InputError("command line", "--data", "a capture in the layout of the reader", "none")
        from .readers import check_reader  # slow to import

        breaches = check_reader(spec, Path(settings.data), values)
    else:
        if values:
            raise InputError("command line", "--set", "no settings: a metric has none", "a setting")
        breaches = check_metric(spec)
    breaches = list(dict.fromkeys(breaches))  # several checks may find the same fault
    verdict = f"{spec.name}: a {kind} that keeps its contract"
    if breaches:
        count = "1 breach" if len(breaches) == 1 else f"{len(breaches)} breaches"
        title = f"{spec.name}: {count} of the contract of a {kind}"
        verdict = "\n".join([title, *(f"- {breach}" for breach in breaches)])
    return CommandResult(verdict, {"name": spec.name, "kind": kind, "breaches": breaches}, not breaches)


def _find(settings: CheckPluginSettings) -> tuple[MethodSpec | DatasetSpec | MetricSpec, str]:
    """The spec named by the settings, and its kind."""
    groups = [group for group in KINDS if settings.kind in (None, group)]
    name = settings.plugin
    if ":" in name:
        spec: Any = resolve(name)
        groups = [group for group in groups if isinstance(spec, SPEC_TYPES[group])]
        if not groups:
            expected = "a MethodSpec, a DatasetSpec or a MetricSpec"
            raise InputError("command line", name, expected, f"a {type(spec).__name__}")
    elif len(groups) > 1:
        groups = [group for group in groups if name in discover(group)]
        if not groups:
            expected = 'a name that `headbench list` shows for methods, datasets or metrics, or "module:SPEC"'
            raise InputError("command line", "plugin", expected, repr(name))
        if len(groups) > 1:
            expected = f"--kind, one of {', '.join(groups)}"
            raise InputError("command line", name, expected, "a name that they share")
    return get(groups[0], name), KINDS[groups[0]]


def _check_method(
    spec: MethodSpec, settings: CheckPluginSettings, values: dict[str, Any], progress: Progress
) -> list[str]:
    preset = settings.preset or ("smoke" if "smoke" in spec.presets else next(iter(spec.presets), "smoke"))
    method = resolve_method(spec, preset, values)
    check_device(settings.device)
    breaches: list[str] = []
    with TemporaryDirectory() as folder:
        clip = _adapted(_clip(settings, Path(folder), progress), method, Path(folder))
        with attempt(breaches, "training or rendering"):
            breaches += check_method(method, clip, Path(folder) / "avatar", device=settings.device)
    return breaches


def _clip(settings: CheckPluginSettings, folder: Path, progress: Progress) -> Clip:
    from ..engine import captures  # slow to import

    data = settings.data
    if data is None:
        tiny = DemoConfig(out=str(folder), preset="smoke", timesteps=TIMESTEPS)
        resolve(get("datasets", "synthetic").implementation)(**tiny.capture_arguments(), progress=progress)
        data = str(tiny.capture_folder)
    reader = settings.reader or captures.reader_of(data)
    return captures.open_clips(RunConfig(data, str(folder / "run"), reader=reader))[0]


def _adapted(clip: Clip, method: ResolvedMethod, folder: Path) -> Clip:
    """The clip adapted to the method, as in a run."""
    needs = MethodNeeds.of(method.spec)
    planned = plan(clip, needs, {})
    return clip if planned is None else apply(planned, needs, folder / "adapted", "adapting").clip

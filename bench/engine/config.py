"""Configuration of a comparison, resolved and checked completely before execution."""

from __future__ import annotations

import inspect
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from difflib import get_close_matches
from functools import partial
from typing import Annotated, Any, Literal

import tyro

from ..condition import PLAIN, Condition, Named, label_of
from ..configuration import build, build_arguments, deciding_settings, merge, setting_paths
from ..contracts import Budget, TaskName
from ..errors import InputError
from ..io.files import check_name
from ..registry import code_digest, discover, forget_code, get, is_outside, resolve, unknown
from ..specs import ConditionSpec, MethodSpec, MetricSpec, ProfileSpec

CANONICAL = "canonical"
"""The metric profile that bare metric names belong to."""
DEVICES = r"(cpu|cuda|mps|xpu)(:\d+)?"
"""Valid device names."""


def default_names(group: Literal["methods", "metrics"]) -> tuple[str, ...]:
    """Names of the methods or metrics that a run uses by default, in the registry's order."""
    return tuple(name for name, plugin in discover(group).items() if plugin.spec and plugin.spec.default)


@dataclass(frozen=True)
class RunConfig:
    """Settings of ``headbench run``, as in its YAML file."""

    data: str
    """Folder of one capture or of several."""
    out: str
    """Output folder of the run."""
    methods: tuple[str, ...] = field(default_factory=partial(default_names, "methods"))
    """Names of registered methods, or "package.module:SPEC"."""
    preset: str = "fast"
    """Name of the settings: smoke, demo, fast, paper, or another that every method defines."""
    seeds: tuple[int, ...] = (0,)
    """One avatar is trained for each seed."""
    tasks: tuple[TaskName, ...] = ("novel_view", "self_reenactment")
    """Tasks to evaluate."""
    metrics: tuple[str, ...] = field(default_factory=partial(default_names, "metrics"))
    """Metrics to evaluate."""
    metric_profiles: tuple[str, ...] = ("canonical",)
    """Sets of metric definitions, see ``headbench list profiles``."""
    regions: tuple[str, ...] | None = None
    """Regions to evaluate besides the whole frame, for metrics that support them. Default: the face, if the capture's
    reader provides it."""
    reader: str = "ga"
    """Dataset reader that opens the captures."""
    reader_settings: dict[str, Any] = field(default_factory=dict)
    """Settings of the reader (for example ``head``: path of the head model)."""
    frames_per_task: int | None = None
    """Maximum number of scored frames per subject and task, evenly spaced. Default: all."""
    device: str = "cpu"
    """"cpu", "cuda", ..."""
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Settings by method that override the preset; the key ``budget`` holds iterations and seconds."""
    divide: int = 1
    """Factor by which all images are reduced first, by area means. Metrics are computed at the reduced size."""
    heads: dict[str, str] = field(default_factory=dict)
    """Files of further head models by version, for methods that need another model than the one used for tracking;
    the tracking is refitted."""
    conditions: tuple[Condition, ...] = (PLAIN,)
    """Variations of the comparison; each adds its own cells, see `Condition`."""
    clip: Named = field(default_factory=Named)
    """Registered change of every capture, including the scored frames, such as other held-out frames."""
    source: str = ""
    """Folder of a finished run whose avatars, trained under the same conditions, are used instead of training; ""
    trains."""

    def __post_init__(self) -> None:
        """Refuse invalid settings early."""
        names = [condition.name for condition in self.conditions]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"conditions: at least one, each name once; found {', '.join(names) or 'none'}")
        for condition in self.conditions:
            changed = replace(condition, methods=(), drive=Named()) != PLAIN
            if changed and not condition.name:
                raise ValueError("conditions: a name for each one that changes something; found none")
            if condition.follows and not self.source and PLAIN not in self.conditions:
                expected = "the plain comparison beside it, or a source that names their run"
                raise ValueError(f"conditions: {condition.name} uses trained avatars; {expected}")
            trains = condition.settings or condition.clip or condition.changes_budget
            if trains and condition.follows:
                expected = "nothing is trained for derive and views; derive or views alone"
                raise ValueError(f"conditions, {condition.name}: {expected}")
            if condition.drive and condition.views:
                raise ValueError(f"conditions, {condition.name}: drive or views; found both")
        if len({condition.drive.name for condition in self.conditions}) > 1:
            raise ValueError(
                "conditions: all are driven by one registered change, or none is; found a mixture"
            )
        for name in ("methods", "seeds", "tasks", "metrics", "metric_profiles"):
            values = getattr(self, name)
            if not values:
                raise ValueError(f"{name} is empty")
            if len(set(values)) != len(values):
                raise ValueError(f"{name} names something twice: {', '.join(map(str, values))}")
        if not re.fullmatch(DEVICES, self.device):
            raise ValueError(f"device is {self.device!r}; cpu, cuda, cuda:1 and the like")
        if min(self.seeds) < 0:
            raise ValueError(f"seeds has {min(self.seeds)}; whole numbers from 0")
        if self.divide < 1:
            raise ValueError(f"divide is {self.divide}; a whole number from 1")
        if self.frames_per_task is not None and self.frames_per_task < 1:
            raise ValueError(f"frames_per_task is {self.frames_per_task}; at least 1, or none for all")

    @property
    def drive(self) -> Named:
        """Registered change that replaces the scored frames, tasks and metrics."""
        return self.conditions[0].drive


def build_run_config(values: Mapping[str, Any], source: str) -> RunConfig:
    """Build `RunConfig` as `build` does; for a misplaced nested key, such as ``iterations``, the error names its full path."""
    names = {each.name for each in fields(RunConfig)}
    for key in values:
        if isinstance(key, str) and key not in names and not get_close_matches(key, names, 1, 0.8):
            places = _setting_places()
            near = get_close_matches(key, places, 1, 0.7)
            if near:
                raise InputError(
                    source, key, "a setting of a run", repr(key), f"Did you mean {places[near[0]]}?"
                )
    return build(RunConfig, values, source)


def _setting_places() -> dict[str, str]:
    """Dotted path of every nested setting, by its last part; METHOD stands for any method."""
    places: dict[str, str] = {}
    for name, plugin in discover("methods").items():
        if plugin.spec is not None and plugin.spec.config:
            for path in setting_paths(resolve(plugin.spec.config)):
                places.setdefault(path.rpartition(".")[2], f"settings.{name}.{path}")
    budget = {"budget": "settings.METHOD.budget.iterations"}
    return places | budget | {path: f"settings.METHOD.budget.{path}" for path in setting_paths(Budget)}


@dataclass(frozen=True)
class ResolvedMethod:
    """A method with its settings: spec, configuration and budget."""

    spec: MethodSpec
    config: Any
    budget: Budget

    def create(self) -> Any:
        """Import the implementation and create the `Method`."""
        implementation = resolve(self.spec.implementation)
        return implementation() if self.config is None else implementation(self.config)

    def record(self) -> dict[str, Any]:
        """Everything that determines the method's behaviour, for the manifest."""
        from .adaptation import MethodNeeds  # who only reads runs needs no adaptation

        needs = MethodNeeds.of(self.spec)
        code = code_digest(self.spec.implementation) if self.spec.implementation else ""
        return {
            "name": self.spec.name,
            "version": self.spec.version,
            "implementation": self.spec.implementation,
            "trivial": self.spec.trivial,
            "config": None if self.config is None else asdict(self.config),
            "budget": asdict(self.budget),
            **({} if needs == MethodNeeds() else {"needs": asdict(needs)}),
            **({"code": code} if code else {}),
        }

    def identity(self) -> dict[str, Any]:
        """The `record` for fingerprints, without settings that are paths on this machine.

        The code of a method of this package is left out: its version says whether results change.
        """
        record = self.record()
        if not is_outside(self.spec.implementation):
            record.pop("code", None)
        return {**record, "config": deciding_settings(self.config)}


def resolve_methods(config: RunConfig) -> list[ResolvedMethod]:
    """Resolve every method of a run."""
    forget_code()
    specs: list[MethodSpec] = [get("methods", name) for name in config.methods]
    for name, count in Counter(spec.name for spec in specs).items():
        check_name(name, "registry of methods", "name")
        if count > 1:
            raise InputError("methods", name, "each method once", f"{count} of that name")
    for spec in specs:
        if not spec.computes_on(config.device):
            expected, found = f"{' or '.join(spec.devices)} for method {spec.name}", repr(config.device)
            remedy = f"Leave {spec.name} out of this run, or run it by itself with device={spec.devices[0]}."
            raise InputError("settings", "device", expected, found, remedy)
    stray = set(config.settings) - {spec.name for spec in specs}
    if stray:
        raise unknown("settings", "method", min(stray), [spec.name for spec in specs])
    return [resolve_method(spec, config.preset, config.settings.get(spec.name, {})) for spec in specs]


def with_methods(config: RunConfig, names: Collection[str]) -> RunConfig:
    """Return the configuration restricted to some methods, their settings and their conditions."""
    return replace(
        config,
        methods=tuple(asked for asked in config.methods if get("methods", asked).name in names),
        settings={name: values for name, values in config.settings.items() if name in names},
        conditions=tuple(
            replace(condition, methods=tuple(name for name in condition.methods if name in names))
            for condition in config.conditions
            if not condition.methods or {*condition.methods} & {*names}
        ),
    )


def resolve_cells(config: RunConfig) -> list[tuple[ResolvedMethod, Condition]]:
    """Resolve every method of a run under each condition that applies to it, method by method."""
    methods = resolve_methods(config)
    names = [method.spec.name for method in methods]
    for change, kind in (
        (config.clip, "clip"),
        *((getattr(c, k), k) for c in config.conditions for k in KINDS),
    ):
        resolve_change(change, kind)
    for condition in config.conditions:
        for name in condition.methods:
            if name not in names:
                raise unknown("settings", f"conditions, methods of {condition.name}", name, names)
    cells, labels = [], set()
    for asked, method in zip(config.methods, methods):
        for condition in config.conditions:
            if not condition.applies_to(method.spec.name):
                continue
            changed = method
            if condition.settings:
                spec: MethodSpec = get("methods", asked)
                settings = merge(config.settings.get(spec.name, {}), condition.settings)
                changed = resolve_method(spec, config.preset, settings)
                changed = replace(changed, spec=replace(changed.spec, name=method.spec.name))
            if condition.as_tracked:
                changed = replace(changed, spec=_unconverted(changed.spec, condition.name))
            if condition.changes_budget and changed.budget == Budget():
                if condition.methods:
                    where = f"conditions, budget of {condition.name}"
                    raise InputError(
                        "settings", where, f"a budget of {method.spec.name} to take a part of", "none"
                    )
                continue  # a baseline without a budget to reduce
            label = check_name(label_of(method.spec.name, condition.name), "settings", "method and condition")
            if label in labels:
                raise InputError("settings", "conditions", "another name for a method or a condition", label)
            labels.add(label)
            cells.append((replace(changed, budget=condition.part_of(changed.budget)), condition))
    return cells


def _unconverted(spec: MethodSpec, condition: str) -> MethodSpec:
    """Return the method without its conversion of head model and views."""
    if spec.conversion == "required" and (spec.head_models or spec.monocular):
        expected = f"methods that work without the conversion of captures, for condition {condition}"
        raise InputError("settings", "conditions, methods", expected, spec.name)
    return replace(spec, head_models=(), monocular=False)


KINDS = ("clip", "derive", "drive", "views")


def resolve_change(change: Named, kind: str) -> Callable[..., Any]:
    """The function of a registered change with its parameters bound; the identity for no change."""
    if not change:
        return lambda value, *others: value
    where = f"conditions, {change.name}"
    spec: ConditionSpec = get("conditions", change.name)
    if spec.kind != kind:
        raise InputError(where, "kind", f"a change of kind {kind!r}", f"one of kind {spec.kind!r}")
    function = resolve(spec.implementation)
    signature = inspect.signature(function).parameters.values()
    given = [parameter.name for parameter in signature if parameter.kind != parameter.KEYWORD_ONLY]
    arguments = build_arguments(function, change.parameters, where, harness=given)
    lacking = [
        parameter.name
        for parameter in signature
        if parameter.kind == parameter.KEYWORD_ONLY
        and parameter.default is parameter.empty
        and parameter.name not in arguments
    ]
    if lacking:
        raise InputError(where, f"parameters.{lacking[0]}", "a value", "nothing")
    return partial(function, **arguments)


def resolve_method(spec: MethodSpec, preset: str, settings: Mapping[str, Any]) -> ResolvedMethod:
    """Apply ``settings`` over a preset. A method without presets accepts any preset name."""
    if spec.presets and preset not in spec.presets:
        raise unknown(f"method {spec.name}", "preset", preset, spec.presets)
    spec = spec.at_preset(preset)
    source = f"settings of {spec.name}"
    if not isinstance(settings, Mapping):
        raise InputError(source, "", "a group of settings", repr(settings))
    values = merge(spec.presets.get(preset, {}), settings)
    budget = build(Budget, values.pop("budget", {}), source, "budget.")
    if (budget.iterations is not None and budget.iterations < 1) or (
        budget.seconds is not None and budget.seconds <= 0
    ):
        raise InputError(source, "budget", "a positive number of iterations or seconds", str(asdict(budget)))
    if not spec.config:
        if values:
            raise InputError(source, next(iter(values)), "no settings: this method has none", "a setting")
        return ResolvedMethod(spec, None, budget)
    settings = build(resolve(spec.config), values, source)
    label = getattr(settings, "label", "")  # for a method whose settings change its name
    return ResolvedMethod(replace(spec, name=f"{spec.name} ({label})") if label else spec, settings, budget)


def resolve_metrics(config: RunConfig) -> list[MetricSpec]:
    """Resolve the metrics of a run by name, in every requested profile that defines them.

    Metrics of the avatar as a whole, and those that no profile defines, keep their registered definition. The
    metrics of the first profile are in the comparison table, those of each further profile in a table named
    after it.
    """
    forget_code()
    if config.drive:
        return list(get("conditions", config.drive.name).metrics)
    profiles: list[ProfileSpec] = [get("profiles", name) for name in config.metric_profiles]
    defined = {metric.name for metric in get("profiles", CANONICAL).metrics}
    specs: list[MetricSpec] = []
    for name in config.metrics:
        spec: MetricSpec = get("metrics", name)
        if spec.name not in defined:
            specs.append(spec)
            continue
        named = [f"{spec.name}@{profile.name}" for profile in profiles]
        of_profiles = [m for p in profiles for m in p.metrics if m.name == spec.name or m.name in named]
        if not of_profiles:
            expected = f"one that the profiles {', '.join(config.metric_profiles)} define"
            raise InputError("metrics", spec.name, expected, "none of them does", "Leave it out.")
        specs += of_profiles
    first = profiles[0].name
    for metric in specs:
        for name in (metric.name, *metric.tables):
            check_name(name, "registry of metrics", f"name and tables of {metric.name}")
    return [
        replace(m, tables=("comparison", *m.tables)) if m.profile == first != CANONICAL else m for m in specs
    ]


AVATAR_FOLDER = (
    "folder of an avatar: a cell of a run (RUN/SUBJECT/METHOD/seed-0), the folder avatar in it, or what `headbench import ga` "
    "or `headbench export compact` wrote"
)
AvatarFolder = Annotated[
    tyro.conf.Positional[str], tyro.conf.arg(help=f"{AVATAR_FOLDER[0].upper()}{AVATAR_FOLDER[1:]}.")
]
"""Argument of every command that takes a stored avatar; `bench.engine.stored.avatar_folder` resolves it."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Current locations of a run's files, and permission to import modules."""

    data: str | None = None
    """The run's capture, if it is no longer where the run found it."""

    head: str | None = None
    """The head model that the run's reader was given, if it is no longer where it was."""

    trust: bool = False
    """Import the modules that the run folder names for methods, metrics and readers which are not registered; they can
    run any code."""


CODED = "coded"
"""Name of the condition, and of its variant: avatars stored with the same codec for all methods."""
CODED_VARIANT = Named("variant", {"name": CODED})


def coded_conditions(methods: Collection[str]) -> tuple[Condition, ...]:
    """The condition `CODED` for the methods that derive variants; none if none of them does."""
    able = tuple(spec.name for spec in (get("methods", name) for name in methods) if spec.variants)
    return (Condition(CODED, able, derive=CODED_VARIANT),) if able else ()


def parse_size(text: str) -> tuple[int, int]:
    """Read ``WIDTHxHEIGHT``."""
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    if match is None or min(int(match[1]), int(match[2])) < 16:
        raise InputError("size", "", "WIDTHxHEIGHT in pixels, each at least 16, such as 275x401", repr(text))
    return int(match[1]), int(match[2])

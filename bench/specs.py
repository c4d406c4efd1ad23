"""What the registry lists: light descriptions of methods, readers, metrics, reports, benchmarks and commands.

Loading a spec imports neither torch nor what it describes; that is named as ``"package.module:Object"`` and
resolved when it is used. The behaviours behind the names are in `contracts`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any, Literal, NamedTuple, get_type_hints

MAX_LABEL = 120
LABEL = f"at most {MAX_LABEL} printable characters"
"""What names, units, versions and hashes are, in rows and manifests; see `is_label`."""


def is_label(text: str) -> bool:
    """Whether rows and manifests with this text can be read."""
    return len(text) <= MAX_LABEL and text.isprintable()


def _check_labels(**texts: str) -> None:
    for name, text in texts.items():
        if not is_label(text):
            raise ValueError(f"{name} is {text[:60]!r}; {LABEL}")


class Need(NamedTuple):
    """Something that a method, a metric or a reader uses, and whether this machine has it (``headbench doctor``).

    Attributes
    ----------
    what : its name: a kernel, a package, weights, a checkout, a GPU.
    found : what there is, such as a version; "" where it is missing.
    remedy : how to get it, if it is missing, and what happens meanwhile.
    required : nothing works without it; else it works more slowly, or in part.
    """

    what: str
    found: str
    remedy: str = ""
    required: bool = True


@dataclass(frozen=True)
class ResolutionRule:
    """The image size that a method works at, as declared by it. Metrics are taken at the protocol's size.

    Applied in this order: square, reduction, enlargement. A capture of 550x802 becomes the 2048x2048 that a method
    for 2K images wants by ``square="pad", size=(2048, 2048)``; one recorded at 2K loses the detail that other
    methods do not see by ``divide=4, multiply=4``.

    Attributes
    ----------
    square : "pad" to the longer side with background, "crop" to the shorter one, or "" for neither; centred.
        What a crop cuts off is scored as background.
    divide : reduce by this factor: block means where it divides both sides, else antialiased bicubic.
    multiply : enlarge by this factor, bicubic.
    size : (width, height) to resize to at the end, antialiased, in place of ``multiply``.
    speed_size : (width, height) at which frames per second are measured; None: the size rendered at.
    """

    square: Literal["", "pad", "crop"] = ""
    divide: int = 1
    multiply: int = 1
    size: tuple[int, int] | None = None
    speed_size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        sides = [self.divide, self.multiply, *(self.size or ()), *(self.speed_size or ())]
        if min(sides) < 1 or self.square not in ("", "pad", "crop"):
            raise ValueError(
                f"{self}: factors and sides are whole numbers from 1, square is pad, crop or nothing"
            )
        if self.size is not None and self.multiply != 1:
            raise ValueError(f"{self}: give multiply or size, not both")

    @property
    def native(self) -> bool:
        """Whether images stay as they are."""
        return self.divide == self.multiply == 1 and not self.square and self.size is None


@dataclass(frozen=True)
class MethodSpec:
    """What listing a method needs. Loading a spec imports neither torch nor the implementation.

    Attributes
    ----------
    name : as typed on the command line and shown in tables.
    summary : one sentence.
    implementation : "package.module:Class"; the class takes the resolved configuration.
    config : "package.module:Class" of the frozen dataclass with its settings, or "" for a method without any.
    presets : settings by preset name. The key "budget" holds `Budget` fields; the rest are config fields.
    head_models : versions the method accepts; empty means any.
    monocular : needs the views as one video, one frame at a timestep, the head's rigid motion in the cameras.
    resolution : the image size it works at.
    preset_resolutions : the same by preset name, for presets that work at another size; see `at_preset`.
    native : runs on our own implementation; False for an adapter to an official repository.
    version : of what the method makes. Raise it with each change of the code that changes results: a finished avatar is
        kept as long as version, settings and data are the same. For methods of this package a change of the code is a
        warning then; for plug-ins outside it, the run is refused.
    source : the paper.
    trivial : a trivial baseline, which every real method should beat; shown in tables, never ranked.
    default : a run that names no methods takes it.
    demo : ``headbench demo`` takes it.
    variants : "package.module:function" of ``(avatar folder, clip, device) -> Iterator[Variant]``: what can be derived
        from a trained avatar without training (``headbench sweep``); "" for nothing.
    devices : kinds of devices that it computes on, such as "cpu"; empty means any. A run on another refuses it.
    renders : "package.module:function" of ``(folder, clip, listing) -> {FrameKey: Render}``, see `bench.audit.naming`: which
        image that the method's own program left in a folder shows which frame (``headbench evaluate --names``); ``listing``
        is the capture's, see `DatasetSpec`. "" where no program numbers its renders.
    needs : "package.module:function" of ``(config, device) -> Iterable[Need]``: what a machine has to have, each looked
        for without long work, network or changes of the disk; "" for nothing but what headbench is installed with.
    """

    name: str
    summary: str
    implementation: str
    config: str = ""
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    head_models: tuple[str, ...] = ()
    monocular: bool = False
    native: bool = True
    version: str = "1"
    source: str = ""
    trivial: bool = False
    default: bool = False
    demo: bool = False
    variants: str = ""
    renders: str = ""
    devices: tuple[str, ...] = ()
    needs: str = ""
    resolution: ResolutionRule = ResolutionRule()
    preset_resolutions: Mapping[str, ResolutionRule] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what no results could be read with."""
        _check_labels(name=self.name, version=self.version)

    def computes_on(self, device: str) -> bool:
        """Tell whether it computes on a device such as "cuda:1"."""
        return not self.devices or device.split(":")[0] in self.devices

    def at_preset(self, preset: str) -> MethodSpec:
        """This method with the image size of a preset."""
        rule = self.preset_resolutions.get(preset, self.resolution)
        return self if rule == self.resolution else replace(self, resolution=rule)


MAX_DIGITS = 12
"""Digits behind the point that a table shows."""


MetricKind = Literal["frame", "regional", "temporal", "avatar", "training"]


@dataclass(frozen=True)
class MetricSpec:
    """What a table needs to know of a metric.

    Attributes
    ----------
    implementation : "package.module:function" of what ``kind`` says; a class there is made without arguments.
    kind : "frame", a `Metric`; "regional", a `RegionalMetric`; "temporal", a `TemporalMetric`; "avatar", an
        `AvatarMetric`; "training", a `TrainingMetric`.
    detail : which of the measurement's details is the value, in ``unit``; "" for its value. Metrics of an avatar that
        name the same implementation are measured once, together.
    tables : names of the tables that show it.
    machine_bound : the number says as much of the machine as of the avatar (speed, memory): it compares on one
        machine alone, and measuring it again gives another.
    profile : the set of definitions it belongs to, see `ProfileSpec`. Other profiles than the canonical one stand in
        the metric's name, too, behind an "@": a row names its profile, ``ssim@3dgs`` is never taken for ``ssim``.
    default : a run that names no metrics takes it. Not recorded in runs.
    needs : as of a method, called with None for the config. Not recorded in runs.
    """

    name: str
    label: str
    unit: str
    higher_is_better: bool
    digits: int
    implementation: str
    summary: str = ""
    kind: MetricKind = "frame"
    detail: str = ""
    tables: tuple[str, ...] = ("comparison",)
    machine_bound: bool = False
    profile: str = "canonical"
    default: bool = field(default=False, compare=False)
    needs: str = field(default="", compare=False)

    @property
    def per_frame(self) -> bool:
        """Whether there is a value for every frame; otherwise there is one for the avatar."""
        return self.kind in ("frame", "regional", "temporal")

    def __post_init__(self) -> None:
        """Refuse what no table could show, and no results could be read with."""
        _check_labels(name=self.name, label=self.label, unit=self.unit)
        if not 0 <= self.digits <= MAX_DIGITS:
            raise ValueError(f"digits is {self.digits}; from 0 to {MAX_DIGITS}")


@dataclass(frozen=True)
class ProfileSpec:
    """A named set of metric definitions: what a library or the code of a paper prints under the usual names.

    Attributes
    ----------
    name : as settings and metric names have it.
    summary : one sentence.
    source : which code, at which version, prints these numbers.
    metrics : of this profile by `MetricSpec.profile`, each named ``<metric>@<profile>`` and in a table of the
        profile's own, ``tables=(profile,)``; but for the canonical profile, whose names are bare.
    """

    name: str
    summary: str
    source: str
    metrics: tuple[MetricSpec, ...]

    def __post_init__(self) -> None:
        """Refuse what would be taken for another profile's metric."""
        for metric in self.metrics:
            if metric.profile != self.name:
                raise ValueError(f"{metric.name}: profile is {metric.profile!r}, not {self.name!r}")
            if self.name != "canonical" and (
                not metric.name.endswith(f"@{self.name}") or "comparison" in metric.tables
            ):
                wanted = f"a name that ends with @{self.name}, tables=({self.name!r},)"
                raise ValueError(
                    f"{metric.name} in tables {metric.tables}: metrics of a profile have {wanted}"
                )


@dataclass(frozen=True)
class DatasetSpec:
    """A reader: ``implementation`` names a function ``(path, **settings) -> Clip``.

    ``find`` names a function ``(root) -> list of paths`` that lists the captures under a folder. A reader with
    a keyword ``progress`` is given a `Progress`; one with a keyword ``remembered`` is given False where the bytes
    of every file have to be read, whatever it remembers of an earlier time. ``reads`` is False for one that
    makes captures instead: its function takes ``out`` and settings and writes what another reader reads.
    Settings whose annotation admits a `Path` name files; a run finds them again after it was moved together with them.
    ``listing`` names a function ``path -> {split: [(timestep, camera), ...]}``: the frames in the order in which the
    capture's own files list them, all of them, by which official repositories number their renders; "" for none.
    ``pose_files`` names a function ``path -> {timestep: file}``: the file with the tracking parameters of each timestep;
    "" where timesteps have no files of their own.
    ``needs`` is as that of a method, called with None for the config. ``errors`` names a function ``clip -> list of text``: what
    makes every result of the capture meaningless, which a run looks for before it trains; "" for none.
    """

    name: str
    summary: str
    implementation: str
    find: str = ""
    reads: bool = True
    listing: str = ""
    pose_files: str = ""
    needs: str = ""
    errors: str = ""


@dataclass(frozen=True)
class ConditionSpec:
    """A change that conditions of a run name, see `bench.condition.Condition`.

    Attributes
    ----------
    name, summary : str
        What conditions call it, and what it does.
    kind : str
        "clip": ``implementation`` names a function ``(clip, config, **parameters) -> clip``, where ``config`` is the
        `RunConfig`; what takes long it keeps in ``config.out``.
        "derive": a function ``(method spec, avatar folder, folder to write, clip, device, **parameters) -> Avatar``.
        "drive": a function ``(job, avatar, progress, **parameters) -> (Rows, details, files)`` that writes below the folder
        of the run: details are what JSON has, files those that have to be as they were for the rows to be kept.
    implementation : str
        "package.module:function".
    protocols : str
        "package.module:function" of a change of kind "drive": ``(jobs, **parameters) -> protocols``, one for all jobs of
        methods with equal needs; see `bench.protocol.protocol_name` for their names.
    metrics : tuple of MetricSpec
        What a change of kind "drive" measures.
    """

    name: str
    summary: str
    kind: Literal["clip", "derive", "drive"]
    implementation: str
    protocols: str = ""
    metrics: tuple[MetricSpec, ...] = ()


@dataclass(frozen=True)
class ReportSpec:
    """A view of stored results: ``implementation`` names a function ``(run_folder) -> files written``.

    Every such report is written at the end of a run. ``writes`` is False for one that returns text for printing
    instead, ``(run_folders, format, ...) -> text``.
    """

    name: str
    summary: str
    implementation: str
    writes: bool = True


class Findings(NamedTuple):
    """What a command, or a benchmark of the toolkit itself, found out."""

    text: str
    """Tables for a terminal."""
    data: Any
    """The same as plain values, for JSON."""
    passed: bool = True
    """False where something did not behave as expected."""
    code: int | None = None
    """Exit code of a command that has others than 0 (passed) and 1 (did not pass); None for those two."""


@dataclass(frozen=True)
class BenchmarkSpec:
    """Measurements of a part of the toolkit itself, as opposed to those of avatars.

    ``speed``, ``tradeoffs`` and ``stress`` each name a function ``(quick, progress) -> Findings``, or are "" where
    there is none: how fast it is, what settings that give up accuracy for speed buy, how it behaves at extremes.
    """

    name: str
    summary: str
    speed: str = ""
    tradeoffs: str = ""
    stress: str = ""


CommandFunction = Callable[..., Findings]


@dataclass(frozen=True)
class CommandSpec:
    """A command of the command line, as its entry point gives it: a function ``(settings, progress) -> Findings``.

    The module that defines the function must be light to import: every start of the command line loads it.

    Attributes
    ----------
    name : the entry point's; may have two words ("prepare nersemble").
    summary : the first line of the function's docstring.
    function : called with the settings and a `Progress`. The exit code is 0, or 1 where the findings did not pass,
        unless they give one.
    settings : annotation of the function's first parameter: a frozen dataclass whose attributes, described in
        docstrings, become the options.
    writes, kinds : the setting with the folder that the command writes, and the kinds of folder that it may continue in,
        see `writes`; "" for none.
    """

    name: str
    summary: str
    function: CommandFunction
    settings: type
    writes: str = ""
    kinds: tuple[str, ...] = ()

    @classmethod
    def of(cls, name: str, function: Any) -> CommandSpec:
        """Describe a function. Raises `TypeError` for what is no command."""
        parameters = list(inspect.signature(function).parameters)
        settings = get_type_hints(function).get(parameters[0]) if parameters else None
        if not isinstance(settings, type) or not is_dataclass(settings):
            raise TypeError(f"{function!r}: the first parameter of a command is annotated with a dataclass")
        try:
            inspect.signature(function).bind(settings, None)
        except TypeError as error:
            raise TypeError(
                f"{function!r}: a command is called with settings and a Progress: {error}"
            ) from error
        summary = (function.__doc__ or "").strip().partition("\n")[0]
        setting, kinds = getattr(function, "writes", ("", ()))
        return cls(name, summary, function, settings, setting, kinds)


def writes(setting: str, *kinds: str) -> Callable[[CommandFunction], CommandFunction]:
    """Declare the setting that names the folder a command writes: no other process works in it meanwhile.

    A folder that holds another kind of thing than ``kinds`` is refused, see `bench.io.files.check_kind`.
    """

    def declare(function: CommandFunction) -> CommandFunction:
        function.__dict__["writes"] = setting, kinds
        return function

    return declare

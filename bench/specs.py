"""Entries of the registry: light descriptions of methods, readers, metrics, reports, benchmarks and commands.

Loading a spec imports neither torch nor its implementation, which is named as ``"package.module:Object"`` and
resolved when it is used. The behaviours are defined in `contracts`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, make_dataclass, replace
from typing import Any, Literal, NamedTuple, TypeVar, get_args, get_type_hints

MAX_LABEL = 120
LABEL = f"at most {MAX_LABEL} printable characters"
"""Pattern of names, units, versions and hashes in rows and manifests; see `is_label`."""


def is_label(text: str) -> bool:
    """Whether a text is valid as a label in rows and manifests."""
    return len(text) <= MAX_LABEL and text.isprintable()


def _check_labels(**texts: str) -> None:
    for name, text in texts.items():
        if not is_label(text):
            raise ValueError(f"{name} is {text[:60]!r}; {LABEL}")


class Need(NamedTuple):
    """A requirement of a method, metric or reader, and whether this machine has it (``headbench doctor``)."""

    what: str
    """Name of a kernel, package, file of weights, checkout or GPU."""
    found: str
    """What was found, such as a version; "" if it is missing."""
    remedy: str = ""
    """How to install it if it is missing, and what happens without it."""
    required: bool = True
    """Whether nothing works without it. Otherwise some features are slower or missing."""


@dataclass(frozen=True)
class ResolutionRule:
    """The image size that a method works at. Metrics are computed at the protocol's size.

    Applied in this order: square, reduction, enlargement. ``square="pad", size=(2048, 2048)`` turns a capture
    of 550x802 into 2048x2048 for a method for 2K images; ``divide=4, multiply=4`` removes the detail of a 2K
    capture that other methods do not see.
    """

    square: Literal["", "pad", "crop"] = ""
    """"pad" to the longer side with background, "crop" to the shorter one, or "" for neither; centred. Pixels that a
    crop removes are scored as background."""
    divide: int = 1
    """Factor of reduction: block means if it divides both sides, else antialiased bicubic."""
    multiply: int = 1
    """Factor of enlargement, bicubic."""
    size: tuple[int, int] | None = None
    """(width, height) to resize to at the end, antialiased, instead of ``multiply``."""
    speed_size: tuple[int, int] | None = None
    """(width, height) at which frames per second are measured; None means the rendered size."""

    def __post_init__(self) -> None:
        """Refuse invalid combinations."""
        sides = [self.divide, self.multiply, *(self.size or ()), *(self.speed_size or ())]
        if min(sides) < 1 or self.square not in ("", "pad", "crop"):
            raise ValueError(
                f"{self}: factors and sides are whole numbers from 1, square is pad, crop or nothing"
            )
        if self.size is not None and self.multiply != 1:
            raise ValueError(f"{self}: give multiply or size, not both")

    @property
    def native(self) -> bool:
        """Whether images are not changed."""
        return self.divide == self.multiply == 1 and not self.square and self.size is None


@dataclass(frozen=True)
class Mechanism:
    """The learnt part of a method that its paper proposes, and that its avatars should show."""

    name: str
    """What it is called."""
    meaning: str
    """The quantities of `ChangingAvatar.changes` that it changes, and of what."""
    ablation: str
    """The one of `MethodSpec.ablations` that turns it off."""

    def told(self, dynamic: float, condition: str = "") -> str:
        """Its name, whether it is off or left out by the condition, and its meaning; ``dynamic`` is a value of `DYNAMIC`."""
        state = OFF if dynamic < ACTING else ""
        return f"{self.name}{' left out' if condition.startswith(self.ablation) else state}: {self.meaning}"


DYNAMIC = "dynamic_splats"
"""The metric that measures mechanisms."""
ACTING = 5.0
"""Percentage of dynamic splats below which a mechanism is off."""
OFF = " off"
"""What follows the name of such a mechanism."""


@dataclass(frozen=True)
class MethodSpec:
    """Description of a method. Loading it imports neither torch nor the implementation."""

    name: str
    """Name on the command line and in tables."""
    summary: str
    implementation: str
    """"package.module:Class"; the class takes the resolved configuration."""
    config: str = ""
    """"package.module:Class" of the frozen dataclass with its settings, or "" for a method without settings."""
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings by preset name. The key "budget" holds `Budget` fields; the rest are config fields."""
    head_models: tuple[str, ...] = ()
    """Versions that the method accepts; empty means any."""
    monocular: bool = False
    """Whether the method needs the views as one video, one frame per timestep, with the rigid head motion in the
    cameras."""
    conversion: Literal["required", "published"] = "required"
    """Why the method has ``head_models`` and ``monocular``: it works with nothing else, or they follow the
    publication alone and `Condition.as_tracked` may leave the conversion out."""
    native: bool = True
    """Whether it is an implementation of this package; False for an adapter to an official repository."""
    version: str = "1"
    """Version of the results. Raise it with each change of the code that changes results: a finished avatar is kept
    as long as version, settings and data are the same. After a change of the code, methods of this package give a
    warning; a run with an external plug-in is refused."""
    source: str = ""
    bibtex: str = ""
    """``source``, ``bibtex``: The paper that describes the method, as text and as a BibTeX entry; "" for none."""
    trivial: bool = False
    """Whether it is a trivial baseline that every method should beat; shown in tables, never ranked."""
    default: bool = False
    """Whether a run that names no methods includes it."""
    demo: bool = False
    variants: str = ""
    """"package.module:function" of ``(avatar folder, clip, device) -> Iterator[Variant]`` for ``headbench run
    sweep``: variants of a trained avatar that need no training; "" for none."""
    ablations: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings by name that leave out or change one part of the method, for ``headbench run suite --ablations``."""
    mechanism: Mechanism | None = None
    """What the metric `DYNAMIC` measures; None for a method whose avatars do not show it (`ChangingAvatar`)."""
    renders: str = ""
    """"package.module:function" of ``(folder, clip, listing) -> {FrameKey: Render}`` that maps images written by the
    method's own program to frames (``headbench evaluate --names``), see `bench.audit.naming`; ``listing`` is the
    capture's, see `DatasetSpec`. "" if no program numbers its renders."""
    devices: tuple[str, ...] = ()
    """Supported kinds of devices, such as "cpu"; empty means any. A run on another device is refused."""
    needs: str = ""
    """"package.module:function" of ``(config, device) -> Iterable[Need]``: requirements of the machine. The check
    takes little time, uses no network and writes nothing. "" if headbench's own dependencies suffice."""
    resolution: ResolutionRule = ResolutionRule()
    """The image size that the method works at."""
    preset_resolutions: Mapping[str, ResolutionRule] = field(default_factory=dict)
    """Resolution rules of presets that work at another size; see `at_preset`."""

    def __post_init__(self) -> None:
        """Refuse values that would make results unreadable."""
        _check_labels(name=self.name, version=self.version)

    def computes_on(self, device: str) -> bool:
        """Whether it supports a device such as "cuda:1"."""
        return not self.devices or device.split(":")[0] in self.devices

    def at_preset(self, preset: str) -> MethodSpec:
        """This method with the image size of a preset."""
        rule = self.preset_resolutions.get(preset, self.resolution)
        return self if rule == self.resolution else replace(self, resolution=rule)


MAX_DIGITS = 12
"""Decimals shown in tables."""


MetricKind = Literal[
    "frame", "regional", "face", "temporal", "sequence", "set", "avatar", "mechanism", "training"
]


@dataclass(frozen=True)
class MetricSpec:
    """Description of a metric."""

    name: str
    label: str
    unit: str
    higher_is_better: bool
    digits: int
    implementation: str
    """"package.module:function" for the given ``kind``; a class is instantiated without arguments."""
    summary: str = ""
    kind: MetricKind = "frame"
    """"frame", a `Metric`; "regional", a `RegionalMetric`; "face", a `VisibleFaceMetric`; "temporal", a `TemporalMetric`;
    "sequence", a `SequenceMetric`, whose value is assigned to each of the frames; "set", a `SetMetric`, likewise; "avatar", an `AvatarMetric`;
    "mechanism", one whose workload is the poses of training; "training", a `TrainingMetric`."""
    detail: str = ""
    """Key of the measurement's details that holds the value, in ``unit``; "" for the main value. Metrics of an avatar
    with the same implementation are measured once, together."""
    tables: tuple[str, ...] = ("comparison",)
    """Names of the tables that show it."""
    machine_bound: bool = False
    """Whether the value depends on the machine and its load (speed, memory). It is compared on one machine only, and
    another measurement gives another value."""
    profile: str = "canonical"
    """The set of definitions it belongs to, see `ProfileSpec`. Profiles other than the canonical one are appended to
    the metric's name after an "@", for example ``ssim@3dgs``."""
    default: bool = field(default=False, compare=False)
    """Whether a run that names no metrics includes it. Not recorded in runs."""
    needs: str = field(default="", compare=False)
    """As for a method, called with None for the config. Not recorded in runs."""
    suspect_above: float | None = field(default=None, compare=False)
    """Values of whole frames above it are marked as suspect in rows, tables and reports, since no measured method
    exceeds it without access to the test images. Not recorded in runs."""

    @property
    def per_frame(self) -> bool:
        """Whether every frame has a value; otherwise the avatar has one."""
        return self.kind in ("frame", "regional", "face", "temporal", "sequence", "set")

    @property
    def is_speed(self) -> bool:
        """Whether concurrent jobs on the machine would bias it, a metric of an avatar."""
        return self.machine_bound and self.kind == "avatar"

    def __post_init__(self) -> None:
        """Refuse values that tables cannot show or results cannot be read with."""
        _check_labels(name=self.name, label=self.label, unit=self.unit)
        if self.kind not in (kinds := get_args(MetricKind)):
            raise ValueError(f"kind is {self.kind!r}; one of {', '.join(kinds)}")
        if not 0 <= self.digits <= MAX_DIGITS:
            raise ValueError(f"digits is {self.digits}; from 0 to {MAX_DIGITS}")


@dataclass(frozen=True)
class ProfileSpec:
    """A named set of metric definitions: what a library or the code of a paper prints under the usual names."""

    name: str
    """Name in settings and metric names."""
    summary: str
    source: str
    """The code and version that computes these numbers."""
    metrics: tuple[MetricSpec, ...]
    """Metrics with this `MetricSpec.profile`, each named ``<metric>@<profile>`` and shown in the profile's own table,
    ``tables=(profile,)``. Names of the canonical profile have no suffix."""

    def __post_init__(self) -> None:
        """Refuse metrics that could be confused with those of another profile."""
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
    a keyword ``progress`` is given a `Progress`; one with a keyword ``use_cache`` is given False to read the bytes
    of every file, ignoring its cache. ``reads`` is False for an entry that makes captures instead: its function takes
    ``out`` and settings and writes a capture that another reader reads. Settings whose annotation admits a `Path` name
    files; a run records their absolute paths.
    ``listing`` names a function ``path -> {split: [(timestep, camera), ...]}``: all frames, in the order of the
    capture's own files, by which official repositories number their renders; "" for none.
    ``pose_files`` names a function ``path -> {timestep: file}``: the file with the tracking parameters of each timestep;
    "" if timesteps have no files of their own.
    ``truth`` names a function ``clip -> GroundTruth`` for clips of captures that this entry made; it raises
    `UnavailableError` for others. "" for none.
    ``needs`` is defined as for a method and called with None for the config. ``errors`` names a function
    ``clip -> list of text``: errors of the capture that change results, searched for before training; "" for none.
    """

    name: str
    summary: str
    implementation: str
    find: str = ""
    reads: bool = True
    listing: str = ""
    pose_files: str = ""
    truth: str = ""
    needs: str = ""
    errors: str = ""


@dataclass(frozen=True)
class ConditionSpec:
    """A registered change that the conditions of a run refer to by name, see `bench.condition.Condition`."""

    name: str
    summary: str
    """``name``, ``summary``: Name used in conditions, and description."""
    kind: Literal["clip", "derive", "drive", "views"]
    """"clip": ``implementation`` names a function ``(clip, config, **parameters) -> clip``, where ``config`` is the
    `RunConfig`; it stores results of slow steps in ``config.out``. "derive": a function ``(method spec, avatar
    folder, folder to write, clip, device, **parameters) -> Avatar``. "drive": a function ``(job, avatar, progress,
    **parameters) -> (Rows, details)`` that writes below the run folder. Details are JSON values. "views": a function
    ``(avatar, clip, key, background, **parameters) -> (camera, pose)`` of a scored frame, whose picture it can read;
    the values are not comparable with those of tracked views."""
    implementation: str
    """"package.module:function"."""
    protocols: str = ""
    """"package.module:function" for kind "drive": ``(jobs, **parameters) -> protocols``, called once for all jobs of
    methods with equal needs; see `bench.protocol.protocol_name` for their names."""
    metrics: tuple[MetricSpec, ...] = ()
    """Metrics that a change of kind "drive" measures."""


@dataclass(frozen=True)
class ReportSpec:
    """A view of results: ``implementation`` names a function ``(run) -> files written`` of a `FinishedRun`.

    Every such report is written at the end of a run. ``writes`` is False for one that returns text for printing
    instead, ``(runs, format, ...) -> text`` of run folders or finished runs.
    """

    name: str
    summary: str
    implementation: str
    writes: bool = True


class CommandResult(NamedTuple):
    """Result of a command or of a benchmark of the toolkit."""

    text: str
    """Tables for a terminal."""
    data: Any
    """The same results as JSON values."""
    passed: bool = True
    """False if a check did not pass."""
    code: int | None = None
    """Exit code of a command that has others than 0 (passed) and 1 (did not pass); None for those two."""
    verbatim: bool = False
    """Whether the text is that of a file format, whose lines are not wrapped."""


@dataclass(frozen=True)
class BenchmarkSpec:
    """A benchmark of the toolkit itself, as opposed to one of avatars.

    ``speed``, ``tradeoffs`` and ``stress`` each name a function ``(quick, progress) -> CommandResult``, or are "":
    speed, settings that trade accuracy for speed, and behaviour at extreme inputs.
    """

    name: str
    summary: str
    speed: str = ""
    tradeoffs: str = ""
    stress: str = ""


@dataclass(frozen=True)
class CommandSpec:
    """What `command` says about a command of the command line; ``settings`` and ``function`` are "package.module:name"."""

    name: str
    group: str
    summary: str
    settings: str
    function: str
    writes: str = ""
    kinds: tuple[str, ...] = ()
    programs: Mapping[str, str] = field(default_factory=dict)


_Function = TypeVar("_Function", bound=Callable[..., CommandResult])


def command(
    name: str,
    *,
    group: str,
    writes: str = "",
    kinds: tuple[str, ...] = (),
    programs: Mapping[str, str] | None = None,
) -> Callable[[_Function], _Function]:
    """Make a function with a parameter ``progress: Progress``, which returns a `CommandResult`, a command of the command line.

    Its summary is the first paragraph of the docstring. Its other parameters become options, and their section in the docstring
    the help. A parameter ``settings`` instead has a frozen dataclass as its type, which can check its values and be shared:
    its attributes become options, and the strings below them their help; a static method ``notes() -> str`` returns more help.
    The exit code is that of the result if it has one, otherwise 0 if it passed and 1 if it did not.

    Parameters
    ----------
    name : str
        One word, or two of which the first names a group of commands ("prepare nersemble"); also of the entry point.
    group : str
        Heading of ``headbench --help`` that lists it: one of `COMMAND_GROUPS`, or another, shown after them.
    writes : str
        Setting with the output folder, which other processes cannot use while the command runs; "" for none.
    kinds : tuple of str
        Kinds of folder in which the command may continue, see `bench.io.files.check_kind`.
    programs : mapping of str to str
        Programs of other authors that the command runs, by name: "package.module:function" of ``(settings, device) -> Iterator[Need]``,
        where ``settings`` is the mapping that ``headbench doctor --set settings.NAME.KEY=VALUE`` gives.
    """

    def describe(function: _Function) -> _Function:
        reference, text = f"{function.__module__}:{function.__qualname__}", inspect.getdoc(function) or ""
        summary = " ".join(text.partition("\n\n")[0].split())
        settings = get_type_hints(function).get("settings")
        if settings is None:
            function.options = _options(function)  # type: ignore[attr-defined]
            options = f"{reference}.options"
        else:
            options = f"{settings.__module__}:{settings.__qualname__}"
        function.spec = CommandSpec(name, group, summary, options, reference, writes, kinds, programs or {})  # type: ignore[attr-defined]
        return function

    return describe


def _options(function: Callable[..., CommandResult]) -> type:
    """A dataclass of the parameters of a command except ``progress``, with their descriptions as its docstring."""
    hints, members = get_type_hints(function, include_extras=True), []
    for name, parameter in inspect.signature(function).parameters.items():
        default = {} if parameter.default is parameter.empty else {"default": parameter.default}
        if name != "progress":
            members.append((name, hints[name], field(**default)))
    doc = (inspect.getdoc(function) or "").partition("\n\n")[2]
    return make_dataclass("Options", members, namespace={"__doc__": doc}, frozen=True, kw_only=True)


COMMAND_GROUPS = ("compare", "inspect", "data", "export", "validate")
"""Headings of ``headbench --help``, in this order."""

HELP = ("-h", "--help")
"""Words that ask for help."""

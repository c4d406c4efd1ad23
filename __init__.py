"""headbench: a benchmark suite for animatable 3D head avatars.

A script opens a capture, trains, renders and scores with `open_clip`, `train`, `load_avatar` and `evaluate`, runs whole
comparisons with `run`, and reads finished ones with `read_runs`. A plug-in finds here the specifications to register, the
values and protocols of the contracts, errors, and the checks of the conformance kit. Names are imported when first used,
so that ``import headbench`` is light.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

if _TYPE_CHECKING:
    from .bench.api import evaluate, list_methods, open_clip, run, train
    from .bench.condition import PLAIN, Condition, Named
    from .bench.conformance.command import check_clip, check_reader
    from .bench.conformance.methods import check_method, check_metric
    from .bench.contracts import (
        STAGES,
        Avatar,
        AvatarMetric,
        Budget,
        Camera,
        Changes,
        ChangingAvatar,
        CheckedMethod,
        Clip,
        CodedAvatar,
        DepthAvatar,
        Frame,
        FrameKey,
        GroundTruth,
        HarmonicAvatar,
        HeadAsset,
        HeadPose,
        ListedFrames,
        Measurement,
        Method,
        Metric,
        PreparedMethod,
        Progress,
        RegionalClip,
        RegionalMetric,
        SequenceMetric,
        SetMetric,
        SharingAvatar,
        SplatAvatar,
        Splats,
        StagedAvatar,
        StepRecord,
        TemporalMetric,
        TrainingMetric,
        TrueFrame,
        Variant,
        VisibleFaceMetric,
    )
    from .bench.engine.adaptation import AdaptedClip, MethodNeeds
    from .bench.engine.config import resolve_method
    from .bench.engine.stored import load_avatar
    from .bench.errors import HeadbenchError, InputError, LeftOutError, UnavailableError
    from .bench.options import DependentOptions
    from .bench.rows import ALL
    from .bench.specs import (
        BenchmarkSpec,
        CommandResult,
        ConditionSpec,
        DatasetSpec,
        Mechanism,
        MethodSpec,
        MetricSpec,
        Need,
        ProfileSpec,
        ReportSpec,
        ResolutionRule,
        command,
    )
    from .datasets.head.arrays import save_head
    from .datasets.head.loaders import load_head
    from .datasets.steps.exclude import exclude_given
    from .reports.runs import RunData
    from .reports.table_report import read_runs

__all__ = [
    "ALL",
    "PLAIN",
    "STAGES",
    "AdaptedClip",
    "Avatar",
    "AvatarMetric",
    "BenchmarkSpec",
    "Budget",
    "Camera",
    "Changes",
    "ChangingAvatar",
    "CheckedMethod",
    "Clip",
    "CodedAvatar",
    "CommandResult",
    "Condition",
    "ConditionSpec",
    "DatasetSpec",
    "DependentOptions",
    "DepthAvatar",
    "Frame",
    "FrameKey",
    "GroundTruth",
    "HarmonicAvatar",
    "HeadAsset",
    "HeadPose",
    "HeadbenchError",
    "InputError",
    "LeftOutError",
    "ListedFrames",
    "Measurement",
    "Mechanism",
    "Method",
    "MethodNeeds",
    "MethodSpec",
    "Metric",
    "MetricSpec",
    "Named",
    "Need",
    "PreparedMethod",
    "ProfileSpec",
    "Progress",
    "RegionalClip",
    "RegionalMetric",
    "ReportSpec",
    "ResolutionRule",
    "RunData",
    "SequenceMetric",
    "SetMetric",
    "SharingAvatar",
    "SplatAvatar",
    "Splats",
    "StagedAvatar",
    "StepRecord",
    "TemporalMetric",
    "TrainingMetric",
    "TrueFrame",
    "UnavailableError",
    "Variant",
    "VisibleFaceMetric",
    "check_clip",
    "check_method",
    "check_metric",
    "check_reader",
    "command",
    "evaluate",
    "exclude_given",
    "list_methods",
    "load_avatar",
    "load_head",
    "open_clip",
    "read_runs",
    "resolve_method",
    "run",
    "save_head",
    "train",
]

_HOMES = {
    "bench.api": ("evaluate", "list_methods", "open_clip", "run", "train"),
    "bench.engine.adaptation": ("AdaptedClip", "MethodNeeds"),
    "bench.condition": ("PLAIN", "Condition", "Named"),
    "bench.conformance.methods": ("check_method", "check_metric"),
    "bench.conformance.command": ("check_clip", "check_reader"),
    "bench.options": ("DependentOptions",),
    "bench.errors": ("HeadbenchError", "InputError", "LeftOutError", "UnavailableError"),
    "bench.engine.config": ("resolve_method",),
    "bench.engine.stored": ("load_avatar",),
    "bench.rows": ("ALL",),
    "bench.specs": tuple(name for name in __all__ if name.endswith("Spec"))
    + ("CommandResult", "Mechanism", "Need", "ResolutionRule", "command"),
    "datasets.head.arrays": ("save_head",),
    "datasets.head.loaders": ("load_head",),
    "datasets.steps.exclude": ("exclude_given",),
    "reports.runs": ("RunData",),
    "reports.table_report": ("read_runs",),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> _Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("headbench")
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(_import_module(f".{_HOME.get(name, 'bench.contracts')}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

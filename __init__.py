"""headbench: a benchmark suite for animatable 3D head avatars."""

from .bench.contracts import (
    Avatar,
    Budget,
    Camera,
    Clip,
    DatasetSpec,
    Frame,
    FrameKey,
    HeadPose,
    Method,
    MethodSpec,
    Metric,
    MetricSpec,
    ReportSpec,
)
from .bench.errors import HeadbenchError, InputError, UnavailableError

__all__ = [
    "Avatar",
    "Budget",
    "Camera",
    "Clip",
    "DatasetSpec",
    "Frame",
    "FrameKey",
    "HeadPose",
    "HeadbenchError",
    "InputError",
    "Method",
    "MethodSpec",
    "Metric",
    "MetricSpec",
    "ReportSpec",
    "UnavailableError",
]

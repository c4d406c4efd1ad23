"""headbench: a benchmark suite for animatable 3D head avatars."""

from .bench.contracts import Avatar, Budget, Camera, Clip, Frame, FrameKey, HeadPose, Method, Metric
from .bench.errors import HeadbenchError, InputError, UnavailableError
from .bench.specs import DatasetSpec, MethodSpec, MetricSpec, ReportSpec

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

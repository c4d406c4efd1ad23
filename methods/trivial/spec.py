"""The trivial baselines: specs and settings; no implementation is imported."""

from __future__ import annotations

from dataclasses import dataclass

from ...bench.specs import MethodSpec


@dataclass(frozen=True)
class NearestCameraConfig:
    """Nearest training image."""

    max_timesteps: int | None = None
    """Maximum number of stored timesteps, evenly spaced, which bounds the storage; None keeps all."""


PRESETS = {name: {"budget": {"iterations": 1}} for name in ("smoke", "quick", "demo", "fast", "gpu", "paper")}

MEAN_IMAGE = MethodSpec(
    name="mean-image",
    default=True,
    demo=True,
    summary="The mean of all training images for every frame: the trivial baseline of every table.",
    implementation="headbench.methods.trivial.method:MeanImage",
    trivial=True,
    presets=PRESETS,
)

NEAREST_CAMERA = MethodSpec(
    name="nearest-camera",
    default=True,
    demo=True,
    summary="The training image of the nearest pose and camera, unchanged: the result of pure memorisation.",
    implementation="headbench.methods.trivial.method:NearestCamera",
    trivial=True,
    config="headbench.methods.trivial.spec:NearestCameraConfig",
    presets=PRESETS,
)

TEXTURED_MESH = MethodSpec(
    name="textured-mesh",
    default=True,
    summary="The posed mesh with the median colours of the training images: what tracking alone is worth.",
    implementation="headbench.methods.trivial.method:TexturedMesh",
    trivial=True,
    presets=PRESETS,
)

ONE_PICTURE = MethodSpec(
    name="one-picture",
    summary="The textured mesh with the colours of one picture: a baseline of methods that are given one picture.",
    implementation="headbench.methods.trivial.method:OnePicture",
    trivial=True,
    presets=PRESETS,
)

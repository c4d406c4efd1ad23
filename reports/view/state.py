"""View requested by a browser: the pose from sliders and recordings, and the camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ...bench.contracts import Camera, FloatArray, HeadPose
from .scene import NEUTRAL


@dataclass(frozen=True)
class Sliders:
    """Offsets added to a pose. Angles in radians, added to axis-angle vectors.

    Attributes
    ----------
    expressions : Mapping[str, tuple[float, ...]]
        Coefficients by head model, in the model's units; only the leading ones if they are fewer.
    jaw, neck : tuple[float, ...]
        (3,) rotations about x, y and z.
    eyes : tuple[float, ...]
        (2,) rotations of both eyes about x and y.
    """

    expressions: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    jaw: tuple[float, ...] = (0.0, 0.0, 0.0)
    neck: tuple[float, ...] = (0.0, 0.0, 0.0)
    eyes: tuple[float, ...] = (0.0, 0.0)

    @property
    def at_rest(self) -> bool:
        """Whether nothing is added."""
        return not any(map(any, (*self.expressions.values(), self.jaw, self.neck, self.eyes)))

    def added(self, pose: HeadPose) -> HeadPose:
        """A pose with this added; it belongs to no timestep unless nothing is."""
        if self.at_rest:
            return pose
        expression = np.array(pose.expression, np.float64)
        given = self.expressions.get(pose.head_model, ())[: len(expression)]
        expression[: len(given)] += given
        x, y = self.eyes
        return replace(
            pose,
            expression=expression.astype(pose.expression.dtype),
            jaw=(pose.jaw + np.array(self.jaw)).astype(pose.jaw.dtype),
            neck=(pose.neck + np.array(self.neck)).astype(pose.neck.dtype),
            eyes=(pose.eyes + np.array([x, y, 0.0, x, y, 0.0])).astype(pose.eyes.dtype),
            timestep=None,
        )


@dataclass(frozen=True, eq=False)
class FreeView:
    """A camera that is orbited: its motion in the world of the first avatar, and the vertical field of view, radians."""

    world_to_camera: FloatArray
    fov: float

    def camera(self, width: int, height: int) -> Camera:
        """The view in an image of a size, pixels."""
        focal = height / 2 / np.tan(self.fov / 2)
        K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        return Camera("view", width, height, K, self.world_to_camera)

    @classmethod
    def of(cls, camera: Camera) -> FreeView:
        """The view of a camera whose principal point is taken for the middle."""
        return cls(camera.world_to_camera, float(2 * np.arctan(camera.height / 2 / camera.K[1, 1])))


@dataclass(frozen=True)
class State:
    """Everything that determines the image.

    Attributes
    ----------
    recording, timestep : str or int
        Sequence that animates the avatar and its timestep; `NEUTRAL` and 0 for none.
    camera : str
        Camera of the capture, drawn as for metrics, with the captured image next to it; "" for the
        free view.
    background : tuple[float, float, float]
        RGB, each in [0, 1].
    splats : bool
        Whether browsers render the splats.
    """

    sliders: Sliders = field(default_factory=Sliders)
    recording: str = NEUTRAL
    timestep: int = 0
    camera: str = ""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    splats: bool = False

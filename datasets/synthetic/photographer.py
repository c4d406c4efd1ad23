"""A subject in the studio: pose it, press the shutter of every camera, store the pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...bench.contracts import ByteArray, HeadPose
from .controls import CONTROLS, Activations
from .likeness import Likeness
from .rig import lights
from .scene import Studio, develop
from .take import Take


class Photographer:
    """One process's studio for one take. Rendering takes one thread: processes share the work better."""

    def __init__(self, take: Take):
        self._take = take
        self._likeness = Likeness(take.person, take.geometry, take.shape)
        self._studio = Studio(lights(), take.settings.samples_per_pixel, threads=1)
        rest = dict.fromkeys(CONTROLS, 0.0)
        pose = take.geometry.translation.pose(rest, take.person.name, None)
        surfaces = self._likeness.surfaces(pose, rest)
        for name, fixture in self._likeness.fixtures().items():
            self._studio.add(name, surfaces[name].vertices, fixture.faces, fixture.albedo, fixture.material)

    def shoot(self, sequence: str, timestep: int, cameras: Sequence[str]) -> None:
        """Render and store one moment as the named cameras see it."""
        self.pose(sequence, timestep)
        for camera in cameras:
            image, matte = self.picture(camera, self._take.render_seed(sequence, timestep, camera))
            self._take.writer.write_frame(sequence, timestep, camera, image, matte)

    def pose(self, sequence: str, timestep: int) -> None:
        """Bring the subject into a moment of its performance."""
        take = self._take
        self.show(take.poses[sequence][timestep], take.performed[sequence].activations[timestep])

    def show(self, pose: HeadPose, activations: Activations) -> None:
        """Bring the subject into any pose."""
        for name, surface in self._likeness.surfaces(pose, activations).items():
            self._studio.move(name, surface.vertices, surface.albedo)

    def picture(self, camera: str, seed: int) -> tuple[ByteArray, ByteArray]:
        """(H, W, 3) 8-bit picture on the capture's background and (H, W) matte."""
        rgb, alpha = self._studio.image(self._take.cameras[camera], seed)
        return develop(rgb, alpha, np.asarray(self._take.writer.plan.background))

"""A subject's frames: what `panels` renders of it, developed to pictures and masks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...bench.contracts import ByteArray, FloatArray, HeadPose
from .history import SkinState, over_time
from .panels import PanelTracer, panels, rig_middle
from .performance import CONTROLS, Activations
from .plan import FRONTAL, SubjectPlan
from .subject import RenderedSubject


def develop(rgb: FloatArray, alpha: FloatArray, background: FloatArray) -> tuple[ByteArray, ByteArray]:
    """Turn linear straight colour into an 8-bit sRGB picture on ``background`` and an 8-bit mask.

    Highlights above ``knee`` roll off towards 1 instead of clipping; below it the tone is untouched.
    """
    knee = 0.65
    over = np.maximum(rgb - knee, 0.0)
    tone = np.minimum(rgb, knee) + (1.0 - knee) * (1.0 - np.exp(-over / (1.0 - knee)))
    display = np.where(tone <= 0.0031308, 12.92 * tone, 1.055 * np.maximum(tone, 1e-8) ** (1 / 2.4) - 0.055)
    picture = display * alpha[..., None] + background * (1.0 - alpha[..., None])
    return np.round(255.0 * picture).astype(np.uint8), np.round(255.0 * alpha).astype(np.uint8)


class CaptureRenderer:
    """Renders the frames of one subject, on one thread: processes share the work better."""

    def __init__(self, plan: SubjectPlan):
        self._plan = plan
        self._subject = RenderedSubject(plan.person, plan.geometry, plan.shape)
        lights = panels(rig_middle(plan.cameras[FRONTAL]))
        self._tracer = PanelTracer(lights, plan.settings.samples_per_pixel, threads=1, seed=plan.person.seed)
        self._states: dict[str, list[SkinState]] = {}
        rest = dict.fromkeys(CONTROLS, 0.0)
        pose = plan.geometry.translation.pose(rest, plan.person.name, None)
        (skin,) = over_time([rest], 1.0, plan.person)
        posed = self._subject.posed_meshes(pose, rest, skin)
        for name, mesh in self._subject.rest_meshes().items():
            self._tracer.add(name, posed[name].vertices, mesh.faces, mesh.albedo, mesh.material)

    def render_frames(self, sequence: str, timestep: int, cameras: Sequence[str]) -> None:
        """Render and store one timestep as the named cameras see it."""
        plan = self._plan
        self.pose_at(sequence, timestep)
        for camera in cameras:
            image, mask = self.render(camera, plan.render_seed(sequence, timestep, camera))
            plan.writer.write_frame(sequence, timestep, camera, image, mask)

    def pose_at(self, sequence: str, timestep: int) -> None:
        """Move all meshes to where they are at a timestep, with the state of skin that the timesteps before led to."""
        plan, performed = self._plan, self._plan.performed[sequence]
        if sequence not in self._states:
            self._states[sequence] = over_time(performed.activations, performed.step, plan.person)
        self.set_pose(
            plan.poses[sequence][timestep], performed.activations[timestep], self._states[sequence][timestep]
        )

    def set_pose(self, pose: HeadPose, activations: Activations, skin: SkinState) -> None:
        """Move all meshes to a pose, with the tongue of the ``activations`` and skin in a state."""
        for name, mesh in self._subject.posed_meshes(pose, activations, skin).items():
            self._tracer.move(name, mesh.vertices, mesh.albedo, mesh.gloss)

    def render(self, camera: str, seed: int) -> tuple[ByteArray, ByteArray]:
        """(H, W, 3) 8-bit image on the capture's background and (H, W) foreground mask."""
        rgb, alpha = self._tracer.image(self._plan.cameras[camera], seed)
        return develop(rgb, alpha, np.asarray(self._plan.writer.plan.background))

"""Renders a subject's frames with `panels` and converts them to 8-bit images and masks.

Ground truth of a synthetic capture for poses and views without recorded images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from ...bench.contracts import BoolArray, ByteArray, Camera, Clip, FloatArray, HeadPose, IntArray, TrueFrame
from ...bench.engine.captures import synthesis_arguments
from ...bench.errors import UnavailableError
from ...bench.io.files import digest
from ..clip import HeadRegions, select
from ..head.geometry import COEFFICIENT_BITS, LENGTH_BITS, on_grid
from .anatomy import fractal_noise
from .history import SkinState, follow, over_time
from .panels import KERNEL, PanelTracer, default_samples, panels, rig_middle, sample_count
from .performance import CONTROLS, Activations, at_moments
from .plan import (
    CAMERA_DISTANCE,
    EDITION,
    FIRST_SUBJECT,
    FRONTAL,
    PROCEDURAL,
    SERIALS,
    SubjectPlan,
    SyntheticSettings,
    load_geometry,
    plan_subject,
)
from .subject import LatePoses, RenderedSubject

SHUTTER_SECONDS = 0.003
"""NeRSemble's exposure time."""
APART_PIXELS, MOST = 0.25, 16
"""Largest motion between two sub-frames, pixels, unless there would be more sub-frames than that."""

EXPOSURE, BALANCE, GAMMA = 0.05, 0.02, 0.03
"""Standard deviations of the logarithms of a camera's gain, of those of its channels, and of its exponent: what we take to be
left after a calibration with a colour chart."""

MATTE_METRES, MATTE_PERIOD = 0.004, 0.02
"""Largest displacement of the outline of hair, and the spacing of the smooth field that it follows, in the scene."""
_SOFT = _BETWEEN = (
    0.002  # metres of a matte's soft edge, and over which an outline of hair turns into one of skin
)
ROOM = 0.5
"""Colour (sRGB) of the room behind the head, visible where a mask is too wide."""


@dataclass(frozen=True, eq=False)
class Response:
    """A camera's ``gains`` (3,) of linear light, after an ``exponent``."""

    gains: FloatArray
    exponent: float

    def __call__(self, rgb: FloatArray) -> FloatArray:
        """Apply the camera's response to linear light (..., 3)."""
        return self.gains * np.maximum(rgb, 0.0) ** self.exponent


def draw_response(level: float, seed: int, camera: int) -> Response:
    """Response of camera number ``camera`` of the rig of a capture with ``seed``, the same for all subjects."""
    drawn = np.random.default_rng([seed, camera, 31]).standard_normal(5)
    gains = np.exp(level * (EXPOSURE * drawn[0] + BALANCE * drawn[1:4]))
    return Response(on_grid(gains, COEFFICIENT_BITS), float(on_grid(np.exp(level * GAMMA * drawn[4]), 20)))


def sub_frames(metres: float, focal: float, distance: float, shutter: float) -> FloatArray:
    """(K,) moments of an exposure of ``shutter`` seconds, relative to its middle, of what moves by ``metres`` meanwhile.

    One where that is less than `APART_PIXELS` at a ``distance`` (metres) from a camera of a ``focal`` length (pixels).
    """
    pixels = float(on_grid(metres, LENGTH_BITS)) * focal / distance
    count = int(np.clip(np.ceil(pixels / APART_PIXELS), 1, MOST))
    return shutter * ((np.arange(count) + 0.5) / count - 0.5)


def exposed(frames: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Mean over sub-frames of linear straight colour (H, W, 3) and coverage (H, W): light adds up where it is covered."""
    if len(frames) == 1:
        return frames[0]
    alpha = sum((coverage for _, coverage in frames), np.zeros(1)) / len(frames)
    light = sum((rgb * coverage[..., None] for rgb, coverage in frames), np.zeros(1)) / len(frames)
    return light / np.maximum(alpha, 1e-6)[..., None] * (alpha[..., None] > 0.0), alpha


def outline(camera: Camera, vertices: FloatArray, faces: IntArray) -> BoolArray:
    """(H, W) whether triangles cover a pixel, ignoring occlusion."""
    seen = vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = seen @ camera.K.T
    # Pixel centres lie at halves; OpenCV takes them at whole numbers, here of sixteenths.
    corners = np.round((pixels[:, :2] / pixels[:, 2:] - 0.5) * 16.0).astype(np.int32)[faces]
    covered = np.zeros((camera.height, camera.width), np.uint8)
    for corner in corners:
        cv2.fillConvexPoly(covered, corner, 1, shift=4)
    return covered > 0


def hair_pixels(hair: BoolArray, skin: BoolArray, metre: float) -> FloatArray:
    """(H, W) in [0, 1] how far pixels belong to hair: 0 where skin is nearer, by what hair and skin cover (H, W).
    ``metre`` is the number of pixels of a metre at the head."""
    return np.clip((_distance(skin) - _distance(hair)) / max(_BETWEEN * metre, 1.0), 0.0, 1.0)


def _distance(covered: BoolArray) -> FloatArray:
    """(H, W) distance in pixels to the nearest pixel that is ``covered`` (H, W); far where none is."""
    return distance_transform_edt(~covered) if covered.any() else np.full(covered.shape, 1e6)


def matte(alpha: FloatArray, hair: FloatArray, level: float, metre: float, seed: int) -> FloatArray:
    """(H, W) coverage as a matting network gives it: at ``hair`` (H, W) without single hairs, and displaced.

    ``alpha``: (H, W) coverage. ``level``: The outline of hair is displaced by up to `MATTE_METRES` times this; below 1, it
    also keeps a part of its hairs. ``seed``: Of the field that displaces.
    """
    reach = _SOFT * metre
    core = _distance(alpha <= 0.5) > reach
    if not core.any():
        return alpha
    inside = _distance(core) <= reach  # structures narrower than twice the reach are removed
    signed = np.where(inside, _distance(~inside) - 0.5, 0.5 - _distance(inside))
    rows, columns = np.indices(alpha.shape)
    place = np.stack([columns.ravel(), rows.ravel(), np.zeros(alpha.size)], axis=1).astype(np.float64)
    field = fractal_noise(place, MATTE_PERIOD * metre, seed, 2).reshape(alpha.shape)
    edge = signed + level * MATTE_METRES * metre * field
    alpha_mask = np.clip(0.5 + edge / max(reach, 1.0), 0.0, 1.0)
    return alpha + min(level, 1.0) * hair * (alpha_mask - alpha)


def develop(
    rgb: FloatArray, alpha: FloatArray, background: FloatArray, found: FloatArray | None = None
) -> tuple[ByteArray, ByteArray]:
    """Turn linear straight colour into an 8-bit sRGB picture on ``background`` and an 8-bit mask.

    Highlights above ``knee`` roll off towards 1 instead of clipping; below it the tone is untouched. The mask is ``alpha``, or
    what a matte ``found`` (H, W); the picture shows the room where the matte is too wide, and the background where it is not
    wide enough.
    """
    mask = alpha if found is None else found
    knee = 0.65
    over = np.maximum(rgb - knee, 0.0)
    tone = np.minimum(rgb, knee) + (1.0 - knee) * (1.0 - np.exp(-over / (1.0 - knee)))
    display = np.where(tone <= 0.0031308, 12.92 * tone, 1.055 * np.maximum(tone, 1e-8) ** (1 / 2.4) - 0.055)
    seen = display * np.minimum(alpha, mask)[..., None] + ROOM * np.maximum(mask - alpha, 0.0)[..., None]
    picture = seen + background * (1.0 - mask[..., None])
    return np.round(255.0 * picture).astype(np.uint8), np.round(255.0 * mask).astype(np.uint8)


class CaptureRenderer:
    """Renders the frames of one subject on one thread; processes scale better than threads."""

    def __init__(self, plan: SubjectPlan):
        self._plan = plan
        settings = plan.settings
        self._subject = RenderedSubject(plan.person, plan.geometry, plan.shape, settings.correctives)
        lights = panels(rig_middle(plan.cameras[FRONTAL]))
        self._tracer = PanelTracer(lights, settings.samples_per_pixel, threads=1, seed=plan.person.seed)
        self._states: dict[str, list[SkinState]] = {}
        rest = dict.fromkeys(CONTROLS, 0.0)
        (skin,) = over_time([rest], 1.0, plan.person)
        self._fixed = self._subject.rest_meshes()
        self._posed = self._subject.posed_meshes(self._pose(rest), rest, skin)
        for name, mesh in self._fixed.items():
            self._tracer.add(name, self._posed[name].vertices, mesh.faces, mesh.albedo, mesh.material)

    def render_frames(self, sequence: str, timestep: int, cameras: Sequence[str]) -> None:
        """Render and store one timestep as the named cameras see it."""
        plan = self._plan
        seeds = {camera: plan.render_seed(sequence, timestep, camera) for camera in cameras}
        frames: dict[str, list[tuple[FloatArray, FloatArray]]] = {camera: [] for camera in cameras}
        for offset in self.sub_frames(sequence, timestep):
            self.pose_at(sequence, timestep, offset)
            for camera in cameras:
                frames[camera].append(self._tracer.image(plan.cameras[camera], seeds[camera]))
        for camera in cameras:
            image, mask = self._developed(plan.cameras[camera], seeds[camera], *exposed(frames[camera]))
            plan.writer.write_frame(sequence, timestep, camera, image, mask)

    def sub_frames(self, sequence: str, timestep: int) -> FloatArray:
        """(K,) seconds from a timestep to the moments whose mean is its frame."""
        shutter = SHUTTER_SECONDS * self._plan.settings.motion_blur
        if not shutter:
            return np.zeros(1)
        ends = (
            self._subject.tracked(self._pose(self._activations(sequence, timestep, side * shutter)))
            for side in (-0.5, 0.5)
        )
        moved = np.linalg.norm(np.subtract(*ends), axis=1).max()
        return sub_frames(moved, float(self._plan.cameras[FRONTAL].K[0, 0]), CAMERA_DISTANCE, shutter)

    def pose_at(self, sequence: str, timestep: int, offset: float = 0.0) -> None:
        """Pose all meshes for a timestep, with the state of the skin that results from previous timesteps. ``offset``
        is the time from there in seconds: what moves in it is not the state of the skin."""
        plan, performed = self._plan, self._plan.performed[sequence]
        if sequence not in self._states:
            self._states[sequence] = over_time(performed.activations, performed.step, plan.person)
        late, amount = None, plan.settings.hair_lag
        if amount:
            moment = float(performed.moments[timestep]) + offset
            lagging = follow(performed, moment, amount, self._subject.hair_length)
            late = LatePoses(self._pose(lagging.hair), self._pose(lagging.neck))
        activations = self._activations(sequence, timestep, offset)
        pose = plan.poses[sequence][timestep] if offset == 0.0 else self._pose(activations)
        self.set_pose(pose, activations, self._states[sequence][timestep], late)

    def set_pose(
        self, pose: HeadPose, activations: Activations, skin: SkinState, late: LatePoses | None = None
    ) -> None:
        """Move all meshes to a pose, with the tongue of the ``activations`` and skin in a state."""
        self._posed = self._subject.posed_meshes(pose, activations, skin, late)
        for name, mesh in self._posed.items():
            self._tracer.move(name, mesh.vertices, mesh.albedo, mesh.gloss)

    def render(self, camera: str, seed: int) -> tuple[ByteArray, ByteArray]:
        """`render_view` of one of the capture's own cameras."""
        return self.render_view(self._plan.cameras[camera], seed)

    def render_view(
        self, view: Camera, seed: int, background: FloatArray | None = None
    ) -> tuple[ByteArray, ByteArray]:
        """(H, W, 3) 8-bit image on a background (3,), by default the capture's, and (H, W) foreground mask, without
        motion in an exposure. A camera that is not of the rig has no response of its own (`--camera-colour`)."""
        return self._developed(view, seed, *self._tracer.image(view, seed), background)

    def _developed(
        self,
        view: Camera,
        seed: int,
        rgb: FloatArray,
        alpha: FloatArray,
        background: FloatArray | None = None,
    ) -> tuple[ByteArray, ByteArray]:
        settings, estimate = self._plan.settings, None
        if settings.camera_colour and view.id in SERIALS:
            rgb = draw_response(settings.camera_colour, settings.seed, SERIALS.index(view.id))(rgb)
        if settings.mask_error:
            metre = float(view.K[0, 0]) / CAMERA_DISTANCE
            estimate = matte(alpha, self.hair_pixels(view), settings.mask_error, metre, seed)
        ground = self._plan.writer.plan.background if background is None else background
        return develop(rgb, alpha, np.asarray(ground), estimate)

    def hair_pixels(self, view: Camera) -> FloatArray:
        """(H, W) in [0, 1] how far pixels belong to hair on the head in the present pose."""
        skin, locks = (self._posed[name].vertices for name in ("skin", "hair"))
        faces = self._fixed["skin"].faces
        hairy = self._subject.hair_share[faces].mean(axis=1) > 0.5
        hair = outline(view, locks, self._fixed["hair"].faces) | outline(view, skin, faces[hairy])
        return hair_pixels(hair, outline(view, skin, faces[~hairy]), float(view.K[0, 0]) / CAMERA_DISTANCE)

    def _activations(self, sequence: str, timestep: int, offset: float) -> Activations:
        performed = self._plan.performed[sequence]
        if offset == 0.0:
            return performed.activations[timestep]
        (activations,) = at_moments(performed.curves(performed.moments[timestep : timestep + 1] + offset))
        return activations

    def _pose(self, activations: Activations) -> HeadPose:
        return self._plan.geometry.translation.pose(activations, self._plan.person.name, None)


_HELD_SECONDS = 60.0


class SyntheticTruth:
    """The person of a synthetic capture, rendered in any pose and view; a `GroundTruth`.

    Shape, skin, hair, lights, samples a pixel, tone curve and errors of masks are the capture's, the
    background is the clip's. Blood flow and wrinkles are in the steady state of the expression, and the tongue is inside.
    Effects that depend on time (`--hair-lag`, `--motion-blur`) and the response of single cameras (`--camera-colour`) are
    left out.

    The pose is taken as it is. If the capture's tracking has errors, an avatar that was trained with them is compared with
    the true person in the pose that it is given, not with the pictures that were tracked as that pose.

    Attributes
    ----------
    fingerprint : str
        Hex digest of everything that a picture depends on beside pose and camera.
    """

    def __init__(self, clip: Clip) -> None:
        self._posed: HeadPose | None = None
        self._subject, self._background = clip.subject, np.asarray(clip.background, np.float64)
        self._settings = _settings(clip)
        KERNEL.load()
        self._geometry = load_geometry(self._settings.head)
        version = self._geometry.head.version
        if clip.head.version != version:
            raise UnavailableError(
                f"The clip has poses of {clip.head.version}; the true person is rendered in poses of {version}.",
                "Make the capture with that head model (`headbench synth --head`).",
                f"poses are of {clip.head.version}, the truth is of {version}",
            )
        self.fingerprint = digest(
            asdict(self._settings), EDITION, clip.subject, self._geometry.head.fingerprint(), self._background
        )

    def render(self, camera: Camera, pose: HeadPose, seed: int = 0) -> TrueFrame:
        """Picture of the person, the same bytes for the same input. ``seed`` is that of the samples of the pixels."""
        if pose is not self._posed:  # light is computed once for all views of a pose
            activations = self._geometry.translation.activations(pose)
            (skin,) = over_time([activations], _HELD_SECONDS, self._plan.person)
            self._renderer.set_pose(pose, activations, skin)
            self._posed = pose
        rgb, mask = self._renderer.render_view(camera, seed, self._background)
        return TrueFrame(rgb, mask, select(self._regions.labels(camera, pose, mask), "face"))

    def depth(self, camera: Camera, pose: HeadPose) -> FloatArray:
        """(H, W) distance of the head's mesh along the camera's axis, metres; infinity beside it. Hair, beard and glasses have none."""
        return self._regions.depth(camera, pose)

    @cached_property
    def _plan(self) -> SubjectPlan:
        index = int(self._subject) - FIRST_SUBJECT
        return plan_subject(Path("unwritten"), index, self._geometry, self._settings)

    @cached_property
    def _regions(self) -> HeadRegions:
        return HeadRegions(self._geometry.head, self._plan.shape, self._plan.writer.plan.static_offset)

    @cached_property
    def _renderer(self) -> CaptureRenderer:
        return CaptureRenderer(self._plan)


def _settings(clip: Clip) -> SyntheticSettings:
    """Settings that a clip's capture was made with. Raises `UnavailableError` if they cannot be reproduced."""
    recorded = clip.steps[0].parameters.get("synthetic") if clip.steps else None
    if not recorded:
        raise UnavailableError(
            f"Subject {clip.subject} is recorded; only a synthetic capture has a truth for every pose and view.",
            "Use a capture of `headbench synth`.",
            "the capture is not synthetic",
        )
    if any(step.name == "mask_below_neck" for step in clip.steps):
        raise UnavailableError(
            "The clip's pictures are cut off below the neck; the truth shows the shoulders.",
            "Read the capture with its shoulders (`below_neck`).",
            "the pictures are cut off below the neck",
        )
    if recorded.get("edition") != EDITION:
        raise UnavailableError(
            f"The capture is of edition {recorded.get('edition', 1)}; this version renders edition {EDITION}.",
            "Make the capture again with this version (`headbench synth`).",
            f"the capture is of edition {recorded.get('edition', 1)}, not {EDITION}",
        )
    if recorded.get("head") not in PROCEDURAL:
        raise UnavailableError(
            f"The capture has the head model {recorded.get('head')}, whose file it does not name.",
            "Use a capture of the procedural head.",
            "the capture is not of the procedural head",
        )
    given = synthesis_arguments([asdict(step) for step in clip.steps], clip.subject)
    size = given["size"]
    wanted = given["samples_per_pixel"]
    values = {field.name: given[field.name] for field in fields(SyntheticSettings)}
    samples = default_samples(*size) if wanted is None else sample_count(wanted)
    return SyntheticSettings(**{**values, "size": (size[0], size[1]), "samples_per_pixel": samples})

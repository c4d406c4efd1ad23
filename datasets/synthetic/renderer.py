"""Rendering with Mitsuba 3: meshes, lights and a camera to an image and a foreground mask.

Mitsuba's own kernel (Embree rays, direct illumination) has nothing in common with the splat renderer, so an
error of projection or blending in one cannot hide in the other.

Embree chooses its instructions by the processor, takes approximate reciprocals and has no switch for either. On one
machine, 19 of 1.4 million 8-bit values differed, by up to 3, between its AVX-512 and its AVX2 code, and 310, by up to 4, between
AVX-512 and SSE4.2: 12 pictures of 144 x 208 pixels, 25 samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadPose, IntArray
from ...bench.errors import InputError
from .history import SkinState, over_time
from .performance import CONTROLS, Activations
from .plan import FRONTAL, Light, SubjectPlan, lights
from .subject import RenderedSubject

SAMPLE_COUNTS = (9, 25, 49, 121, 169, 289)
"""Squares of primes: what the orthogonal-array sampler takes. 25 divides evenly among five lights."""

VARIANT = "scalar_rgb"
_FILTER = 0.55  # standard deviation of the pixel filter, pixels
_FILTER_REACH = 3  # pixels beyond which it gives nothing


@dataclass(frozen=True)
class Material:
    """Surface of a mesh; its colour comes with the vertices. ``two_sided`` for strips and sheets."""

    roughness: float
    specular: float
    two_sided: bool = False


MATERIALS: Mapping[str, Material] = {
    "skin": Material(0.50, 0.40, two_sided=True),  # lids and lips show their inner side too
    "lips": Material(0.35, 0.45),
    "eye": Material(0.20, 0.5),
    "hair": Material(0.46, 0.32, two_sided=True),
    "lash": Material(0.6, 0.1, two_sided=True),
    "teeth": Material(0.22, 0.5, two_sided=True),
    "gums": Material(0.28, 0.5, two_sided=True),
    "tongue": Material(0.35, 0.45, two_sided=True),
    "mouth": Material(0.6, 0.2, two_sided=True),
    "frame": Material(0.25, 0.5, two_sided=True),
    "cloth": Material(0.9, 0.05, two_sided=True),
}


def sample_count(wanted: int) -> int:
    """The smallest count the sampler takes that is at least ``wanted``."""
    for count in SAMPLE_COUNTS:
        if count >= wanted:
            return count
    raise InputError("--samples", "", f"at most {SAMPLE_COUNTS[-1]} samples per pixel", str(wanted))


def default_samples(width: int, height: int) -> int:
    """Samples that hold two renders of a frame at 40 dB: the pixels of small images see more detail each.

    Measured on four subjects: 25 give 42 to 46 dB at 144 x 208 and 44 to 48 dB at 275 x 401.
    """
    return 25 if width * height >= 20_000 else 49


class PathTracer:
    """A lit scene whose meshes keep their triangles and colours may move from frame to frame.

    Not thread-safe; one per process. ``threads`` bounds Mitsuba's own pool.
    """

    def __init__(self, lights: Sequence[Light], samples: int, threads: int = 1):
        import drjit
        import mitsuba

        if mitsuba.variant() != VARIANT:
            mitsuba.set_variant(VARIANT)
        mitsuba.set_log_level(mitsuba.LogLevel.Error)  # it writes to the terminal, past Python's logging
        drjit.set_thread_count(threads)
        self._mitsuba: Any = mitsuba
        self._lights = lights
        self._samples = sample_count(samples)
        self._meshes: dict[str, Any] = {}
        self._places: dict[str, FloatArray] = {}
        self._scene: Any = None
        self._parameters: Any = None

    def add(
        self, name: str, vertices: FloatArray, faces: IntArray, albedo: FloatArray, material: str
    ) -> None:
        """Add a mesh: (n, 3) world positions, (m, 3) triangles, (n, 3) linear reflectance."""
        properties = self._mitsuba.Properties()
        properties["mesh_bsdf"] = self._mitsuba.load_dict(_bsdf(MATERIALS[material]))
        mesh = self._mitsuba.Mesh(name, len(vertices), len(faces), has_vertex_normals=True, props=properties)
        mesh.add_attribute("vertex_color", 3, _flat(albedo))
        parameters = self._mitsuba.traverse(mesh)
        parameters["vertex_positions"] = _flat(vertices)
        parameters["faces"] = np.ascontiguousarray(faces, np.uint32).ravel()
        parameters.update()
        self._meshes[name] = mesh
        self._places[name] = vertices
        self._scene = None

    def move(
        self,
        name: str,
        vertices: FloatArray,
        albedo: FloatArray | None = None,
        gloss: FloatArray | None = None,
    ) -> None:
        """Give a mesh new positions, and colours if they changed. Takes effect with the next image. No ``gloss`` is shown."""
        parameters = self._traverse()
        parameters[f"{name}.vertex_positions"] = _flat(vertices)
        self._places[name] = vertices
        if albedo is not None:
            parameters[f"{name}.vertex_color"] = _flat(albedo)

    def image(self, camera: Camera, seed: int) -> tuple[FloatArray, FloatArray]:
        """Render linear light, straight (not premultiplied) rgb (H, W, 3), and coverage (H, W) in [0, 1]."""
        self._traverse().update()
        pixels = np.zeros((camera.height, camera.width, 4))
        rows, columns = window(camera, np.concatenate(list(self._places.values())))
        if rows.start < rows.stop and columns.start < columns.stop:
            sensor = self._sensor(camera, rows, columns)
            pixels[rows, columns] = np.array(
                self._mitsuba.render(
                    self._scene, sensor=sensor, spp=self._samples, seed=self._mitsuba.UInt32(seed)
                )
            )
        alpha = np.clip(pixels[..., 3], 0.0, 1.0)
        return pixels[..., :3] / np.maximum(pixels[..., 3:], 1e-6) * (alpha[..., None] > 0), alpha

    def _traverse(self) -> Any:
        if self._scene is None:
            # The lamps are points of the sky: rays sampled from surfaces would never meet one.
            sampling = {"emitter_samples": 1, "bsdf_samples": 0}
            content: dict[str, Any] = {
                "type": "scene",
                "integrator": {"type": "direct", "hide_emitters": True, **sampling},
            }
            content |= self._meshes
            for index, light in enumerate(self._lights):
                content[f"light_{index}"] = {
                    "type": "directional",
                    "direction": [float(-value) for value in light.direction],
                    "irradiance": {"type": "rgb", "value": [float(value) for value in light.irradiance]},
                }
            self._scene = self._mitsuba.load_dict(content)
            self._parameters = self._mitsuba.traverse(self._scene)
        return self._parameters

    def _sensor(self, camera: Camera, rows: slice, columns: slice) -> Any:
        K = camera.K
        to_world = np.linalg.inv(camera.world_to_camera) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        return self._mitsuba.load_dict(
            {
                "type": "perspective",
                "fov": float(np.degrees(2.0 * np.arctan(0.5 * camera.width / K[0, 0]))),
                "fov_axis": "x",
                "near_clip": 0.01,
                "far_clip": 100.0,
                # Mitsuba offsets the film, not the point: the sign turns.
                "principal_point_offset_x": float(0.5 - K[0, 2] / camera.width),
                "principal_point_offset_y": float(0.5 - K[1, 2] / camera.height),
                "to_world": self._mitsuba.ScalarTransform4f(to_world.tolist()),
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width,
                    "height": camera.height,
                    "crop_offset_x": columns.start,
                    "crop_offset_y": rows.start,
                    "crop_width": columns.stop - columns.start,
                    "crop_height": rows.stop - rows.start,
                    "pixel_format": "rgba",
                    "component_format": "float32",
                    "rfilter": {"type": "gaussian", "stddev": _FILTER},
                },
                "sampler": {"type": "orthogonal", "sample_count": self._samples},
            }
        )


def window(camera: Camera, points: FloatArray) -> tuple[slice, slice]:
    """Rows and columns of the image that hold all of ``points`` (n, 3), with room for the pixel filter.

    The whole image where a point lies beside or behind the camera; empty where all lie outside.
    """
    # A row of all x, one of all y, one of all z: by columns this takes a sixth of the time of a whole render.
    seen = camera.world_to_camera[:3, :3] @ points.T + camera.world_to_camera[:3, 3:]
    size = np.array([camera.width, camera.height])
    low, high = np.zeros(2, int), size
    if seen[2].min() > 0.0:
        pixels = camera.K @ seen
        pixels = pixels[:2] / pixels[2]
        low = np.clip(np.floor(pixels.min(axis=1)).astype(int) - _FILTER_REACH, 0, size)
        high = np.clip(np.ceil(pixels.max(axis=1)).astype(int) + _FILTER_REACH, 0, size)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


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


def _bsdf(material: Material) -> dict[str, Any]:
    surface: dict[str, Any] = {
        "type": "principled",
        "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
        "roughness": material.roughness,
        "specular": material.specular,
    }
    return {"type": "twosided", "surface": surface} if material.two_sided else surface


def _flat(values: FloatArray) -> Any:
    return np.ascontiguousarray(values, np.float32).ravel()


class Tracer(Protocol):
    """What `PathTracer` and `panels.PanelTracer` share."""

    def add(
        self, name: str, vertices: FloatArray, faces: IntArray, albedo: FloatArray, material: str
    ) -> None: ...
    def move(
        self,
        name: str,
        vertices: FloatArray,
        albedo: FloatArray | None = None,
        gloss: FloatArray | None = None,
    ) -> None: ...
    def image(self, camera: Camera, seed: int) -> tuple[FloatArray, FloatArray]: ...


def _tracer(plan: SubjectPlan) -> Tracer:
    samples = plan.settings.samples_per_pixel
    if plan.settings.edition == 1:
        return PathTracer(lights(), samples, threads=1)
    from .panels import PanelTracer, panels, rig_middle  # which takes materials from here

    return PanelTracer(panels(rig_middle(plan.cameras[FRONTAL])), samples, threads=1, seed=plan.person.seed)


class CaptureRenderer:
    """Renders the frames of one subject, on one thread: processes share the work better."""

    def __init__(self, plan: SubjectPlan):
        self._plan = plan
        self._subject = RenderedSubject(plan.person, plan.geometry, plan.shape)
        self._tracer = _tracer(plan)
        self._states: dict[str, list[SkinState]] = {}
        rest = dict.fromkeys(CONTROLS, 0.0)
        posed = self._subject.posed_meshes(plan.geometry.translation.pose(rest, plan.person.name, None), rest)
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
        if sequence not in self._states and plan.settings.edition > 1:
            self._states[sequence] = over_time(performed.activations, performed.step, plan.person)
        skin = self._states[sequence][timestep] if plan.settings.edition > 1 else None
        self.set_pose(plan.poses[sequence][timestep], performed.activations[timestep], skin)

    def set_pose(self, pose: HeadPose, activations: Activations, skin: SkinState | None = None) -> None:
        """Move all meshes to a pose; skin is in the state given, or follows the ``activations`` at once."""
        for name, mesh in self._subject.posed_meshes(pose, activations, skin).items():
            self._tracer.move(name, mesh.vertices, mesh.albedo, mesh.gloss)

    def render(self, camera: str, seed: int) -> tuple[ByteArray, ByteArray]:
        """(H, W, 3) 8-bit image on the capture's background and (H, W) foreground mask."""
        rgb, alpha = self._tracer.image(self._plan.cameras[camera], seed)
        return develop(rgb, alpha, np.asarray(self._plan.writer.plan.background))

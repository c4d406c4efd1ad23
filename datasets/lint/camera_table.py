"""Measurements of each camera on a few timesteps, for the rules that compare cameras.

A point of the skin has nearly the same brightness in every camera that sees it. The brightness at the vertices of the
tracked face in one camera is therefore compared with the median over the other cameras: the image offset with the
highest correlation measures the error of the camera's calibration, the correlation shows whether the calibration
belongs to this camera, and the change of the offset with the head's motion shows whether the camera is synchronous.
Unlike outlines, this does not depend on hair outside of the mesh.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from ...bench.contracts import Camera, FloatArray
from ...bench.errors import InputError
from ...bench.protocol import evenly_with_ends
from ..ga.transforms import FrameEntry
from ..head.geometry import project, project_facing, vertex_normals
from .capture import Capture, TrackedSubject
from .views import BLANK_LEVELS, structure

WORKING_HEIGHT = 400
"""Maximum height of compared images, pixels."""

MAX_LAG = 3
"""Maximum number of frames by which a camera may be late or early."""

REACH = 0.1
"""Maximum searched offset, as a fraction of the working height."""

MOST_VERTICES, FEWEST_VERTICES = 1200, 40

FINE_SIGMAS = (1.0, 2.0)
"""Standard deviations of the Gaussian filters whose difference gives fine details, working pixels."""

FACING = 0.4
"""Minimum cosine between a vertex's normal and the direction to the camera."""

DOUBT_MATCH, DOUBT_OFFSET = 0.1, 0.01
"""Cameras with a correlation this much below the median, or an offset farther from it than this fraction of the
height, are compared with the others but not used as a reference; other cameras' calibrations are tested on them."""

STILL_SHARE, MOVING_LEVELS = 0.1, 2.0
"""A camera is frozen if its image changes by less than the first fraction of the others' median change, which must be
at least the second value."""

FEWEST_CAMERAS = 3
"""Minimum number of cameras; with two it is unknown which one is wrong."""

_CANDIDATES = 6


@dataclass(frozen=True)
class CameraFacts:
    """Measurements of one camera; NaN if not available."""

    frames: int
    level: float
    """Mean grey level, 0 to 255."""
    contrast: float
    """Largest `structure` of its images, grey levels: about 0 for images of one colour."""
    motion: float
    """Largest `structure` of the difference of two of its images, grey levels: about 0 for a frozen image."""
    match: float = np.nan
    """Correlation, -1 to 1, of the face's brightness with the other cameras', at the best offset."""
    offset: tuple[float, float] = (np.nan, np.nan)
    """(2,) pixels right and down from the projected face to the face in the image."""
    metres_per_pixel: float = np.nan
    degrees_per_pixel: float = np.nan
    """Pixel size at the head's distance, in both units."""
    height: int = 0
    scale: float = 1.0
    """Image height in pixels, and its ratio to the height of the images measured."""
    lag: int = 0
    """Frames by which its images are late (positive) or early, whole."""
    unsteady: float = np.nan
    unsteady_at_lag: float = np.nan
    """Median distance in pixels of the offsets over time from their median, without a lag and with it."""
    sharpness: float = np.nan
    """log2 of the contrast of fine details of the face relative to the other cameras."""
    fits: str = ""
    """If its own calibration is in doubt, the camera whose calibration matches the images better, otherwise ""."""
    fits_match: float = np.nan
    """Correlation under that calibration."""


class _Shot(NamedTuple):
    """An image at the working size."""

    entry: FrameEntry
    camera: Camera
    grey: FloatArray
    smooth: FloatArray
    fine: FloatArray  # squared contrast of fine details
    foreground: np.ndarray
    scale: float  # pixels of the image in one of the working size


class _Picked(NamedTuple):
    """Projection of the vertices (F,) into an image of the working size."""

    pixels: FloatArray  # (F, 2)
    seen: np.ndarray  # (F,) bool
    smooth: FloatArray  # the image


def measure_cameras(capture: Capture, timesteps: int) -> dict[str, CameraFacts]:
    """Measure every camera on up to ``timesteps`` timesteps: those in which the head moves most, spread over time."""
    entries = capture.imaged_entries
    cameras = sorted({entry.camera_id for entry in entries})
    chosen = _pick_timesteps(capture, entries, timesteps)
    wanted = [entry for entry in entries if entry.timestep in chosen]
    shots: dict[str, dict[int, _Shot]] = {camera: {} for camera in cameras}
    for done, entry in enumerate(wanted, start=1):
        capture.progress(done, len(wanted), "measuring cameras")
        try:
            shot = _shoot(capture, entry)
        except InputError:
            continue  # reported as a damaged file
        shots[entry.camera_id].setdefault(entry.timestep, shot)
    facts = {camera: _plain([*taken.values()]) for camera, taken in shots.items() if taken}
    live = [c for c, f in facts.items() if f.contrast >= BLANK_LEVELS and c not in frozen(facts)]
    if capture.subject is None or len(live) < FEWEST_CAMERAS or not any(map(capture.pose, chosen)):
        return facts
    table = _Table(capture, capture.subject, {camera: shots[camera] for camera in live}, chosen)
    compared = {camera: table.compared(camera, facts[camera], live) for camera in live}
    doubted = _doubted(compared)
    trusted = [camera for camera in live if camera not in doubted]
    if len(trusted) < FEWEST_CAMERAS - 1:
        trusted = live
    elif doubted:  # a faulty camera is no reference for the others
        compared = {camera: table.compared(camera, facts[camera], trusted) for camera in live}
    for camera in doubted:
        fits, match = table.fits(camera, trusted)
        compared[camera] = replace(compared[camera], fits=fits, fits_match=match)
    return facts | compared


def frozen(facts: Mapping[str, CameraFacts]) -> list[str]:
    """Cameras whose image never changes while the others' images change."""
    motion = {c: f.motion for c, f in facts.items() if f.contrast >= BLANK_LEVELS and np.isfinite(f.motion)}
    typical = float(np.median([*motion.values()])) if len(motion) >= FEWEST_CAMERAS else 0.0
    if typical < MOVING_LEVELS:
        return []
    return sorted(camera for camera, levels in motion.items() if levels < STILL_SHARE * typical)


def _doubted(facts: Mapping[str, CameraFacts]) -> list[str]:
    """Cameras that match worse, or at another offset, than most."""
    measured = {camera: f for camera, f in facts.items() if np.isfinite(f.match)}
    if not measured:
        return []
    typical = float(np.median([f.match for f in measured.values()]))
    usual = np.median([f.offset for f in measured.values()], axis=0)
    return [
        camera
        for camera, f in measured.items()
        if f.match < typical - DOUBT_MATCH
        or np.hypot(*(f.offset - usual)) > max(DOUBT_OFFSET * f.height, f.scale)
    ]


def _pick_timesteps(capture: Capture, entries: Sequence[FrameEntry], count: int) -> dict[int, list[int]]:
    """Timesteps to measure and, for each lag from -`MAX_LAG` to `MAX_LAG`, the timesteps of the poses. From each of
    ``count`` equal parts of the capture, the timestep with the fastest head motion is selected."""
    sequences: dict[str, set[int]] = defaultdict(set)
    for entry in entries:
        sequences[entry.sequence_folder].add(entry.timestep)
    around = {}
    for present in sequences.values():
        for timestep in present:
            steps = [timestep - lag for lag in range(-MAX_LAG, MAX_LAG + 1)]
            around[timestep] = [t if t in present and capture.pose(t) else -1 for t in steps]
    chosen = []
    for block in np.array_split(sorted(around), max(1, min(count, len(around)))):
        if len(block):
            few = evenly_with_ends(block.tolist(), _CANDIDATES)
            chosen.append(max(few, key=lambda t: _speed(capture, around[t])))
    return {timestep: around[timestep] for timestep in chosen}


def _speed(capture: Capture, around: Sequence[int]) -> float:
    """Mean motion of vertices over the timesteps around each one, metres; -1 at the ends of a sequence."""
    before, after = around[MAX_LAG + 1], around[MAX_LAG - 1]
    if capture.subject is None or before < 0 or after < 0:
        return -1.0
    poses = [pose for pose in (capture.pose(before), capture.pose(after)) if pose is not None]
    one, other = capture.subject.meshes(poses)
    return float(np.linalg.norm(one - other, axis=1).mean())


def _shoot(capture: Capture, entry: FrameEntry) -> _Shot:
    image, mask = capture.pixels.image(entry), capture.pixels.mask(entry)
    camera = capture.camera(entry)
    scale = min(1.0, WORKING_HEIGHT / camera.height)
    size = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    grey = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32).mean(axis=2)
    foreground = np.ones(grey.shape, dtype=bool)
    if mask is not None and (mask > 250).mean() > 0.02:
        foreground = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 250
    smooth = cv2.GaussianBlur(grey, (0, 0), FINE_SIGMAS[0])
    details = smooth - cv2.GaussianBlur(grey, (0, 0), FINE_SIGMAS[1])
    fine = cv2.GaussianBlur(details * details, (0, 0), FINE_SIGMAS[1])
    return _Shot(entry, camera.resized(*size), grey, smooth, fine, foreground, camera.height / size[1])


def _plain(shots: Sequence[_Shot]) -> CameraFacts:
    """Measurements of a camera's images that need no geometry."""
    first = shots[0]
    whole = np.ones(first.grey.shape, dtype=bool)
    motion = [
        structure(shot.grey - first.grey, whole) for shot in shots[1:] if shot.grey.shape == first.grey.shape
    ]
    return CameraFacts(
        frames=len(shots),
        level=float(np.mean([shot.grey.mean() for shot in shots])),
        contrast=max(structure(shot.grey, shot.foreground) for shot in shots),
        motion=max(motion, default=np.nan),
    )


class _Table:
    """Brightness at the face's vertices, by camera and timestep."""

    def __init__(
        self,
        capture: Capture,
        subject: TrackedSubject,
        shots: Mapping[str, Mapping[int, _Shot]],
        around: Mapping[int, Sequence[int]],
    ) -> None:
        self.members = subject.skin[:: max(1, -(-len(subject.skin) // MOST_VERTICES))]
        posed = self.around = {t: steps for t, steps in around.items() if steps[MAX_LAG] >= 0}
        self.shots = {c: {t: s for t, s in taken.items() if t in posed} for c, taken in shots.items()}
        self.shots = {camera: taken for camera, taken in self.shots.items() if taken}
        needed = sorted({t for steps in self.around.values() for t in steps if t >= 0})
        poses = [capture.pose(t) for t in needed]
        meshes = dict(zip(needed, subject.meshes([pose for pose in poses if pose is not None])))
        self.points = {t: mesh[self.members] for t, mesh in meshes.items()}
        self.normals = {t: vertex_normals(meshes[t], subject.head.faces)[self.members] for t in self.around}
        self.picked = {
            camera: {t: self.pick(shot, t) for t, shot in taken.items()}
            for camera, taken in self.shots.items()
        }
        self.values = {
            camera: _typical([(_sample(p.smooth, p.pixels), p.seen) for p in taken.values()])
            for camera, taken in self.picked.items()
        }
        self.fine = {
            camera: self._details(camera, dict.fromkeys(taken, 0.0)) for camera, taken in self.picked.items()
        }
        self._even_out()

    def pick(self, shot: _Shot, timestep: int, camera: Camera | None = None) -> _Picked:
        """Projection of the vertices into an image by the calibration of this or another camera."""
        camera = camera or shot.camera
        pixels, seen = project_facing(self.points[timestep], self.normals[timestep], camera, FACING)
        return _Picked(pixels, seen, shot.smooth)

    def _details(self, camera: str, offsets: Mapping[int, FloatArray | float]) -> FloatArray:
        """(F,) squared contrast of fine details in a camera, at offsets in pixels by timestep."""
        rows = []
        for timestep, offset in offsets.items():
            picked = self.picked[camera][timestep]
            rows.append((_sample(self.shots[camera][timestep].fine, picked.pixels + offset), picked.seen))
        return _typical(rows)

    def _even_out(self) -> None:
        """Equalise the cameras' exposures."""
        everything = _median(list(self.values.values()))
        for camera, values in self.values.items():
            both = np.isfinite(values) & np.isfinite(everything)
            if both.sum() >= FEWEST_VERTICES:
                gain = float(
                    (values[both] * everything[both]).sum() / max(1e-6, (everything[both] ** 2).sum())
                )
                self.values[camera] = values / max(gain, 1e-3)

    def compared(self, camera: str, plain: CameraFacts, trusted: Sequence[str]) -> CameraFacts:
        """The measurements of one camera against the trusted ones."""
        others = [other for other in trusted if other != camera and other in self.picked]
        if camera not in self.picked or not others:
            return plain
        wanted = _median([self.values[other] for other in others])
        results = {t: _register(picked, wanted) for t, picked in self.picked[camera].items()}
        registers = {t: register for t, register in results.items() if register is not None}
        if not registers:
            return plain
        shot = self.shots[camera][next(iter(registers))]
        centre = self.points[next(iter(registers))].mean(axis=0)
        focal = float(shot.camera.K[0, 0]) * shot.scale
        distance = float(np.linalg.norm(shot.camera.center - centre))
        lag, unsteady, at_lag, offset = self._lag(
            camera, {t: register.offset for t, register in registers.items()}
        )
        return replace(
            plain,
            match=float(np.median([register.score for register in registers.values()])),
            offset=(float(offset[0]) * shot.scale, float(offset[1]) * shot.scale),
            metres_per_pixel=distance / focal,
            degrees_per_pixel=float(np.degrees(1 / focal)),
            height=round(shot.camera.height * shot.scale),
            scale=shot.scale,
            lag=lag,
            unsteady=unsteady * shot.scale,
            unsteady_at_lag=at_lag * shot.scale,
            sharpness=self._sharpness(
                camera, others, {t: register.offset for t, register in registers.items()}
            ),
        )

    def _lag(self, camera: str, offsets: Mapping[int, FloatArray]) -> tuple[int, float, float, FloatArray]:
        """The lag with the most constant offsets over time, their variation without and with it, and their median."""
        residuals = {}
        for lag in range(-MAX_LAG, MAX_LAG + 1):
            rest = []
            for timestep, offset in offsets.items():
                delayed = self.around[timestep][lag + MAX_LAG]
                picked, view = self.picked[camera][timestep], self.shots[camera][timestep].camera
                if delayed < 0 or not picked.seen.any():
                    continue
                moved = project(self.points[delayed][picked.seen], view) - picked.pixels[picked.seen]
                rest.append(offset - np.median(moved, axis=0))
            if len(rest) > len(offsets) / 2:
                middle = np.median(rest, axis=0)
                residuals[lag] = (float(np.median(np.linalg.norm(rest - middle, axis=1))), middle)
        best = min(residuals, key=lambda lag: (residuals[lag][0], abs(lag)))
        return best, residuals[0][0], residuals[best][0], residuals[best][1]

    def fits(self, camera: str, trusted: Sequence[str]) -> tuple[str, float]:
        """The other camera whose calibration matches the camera's images best, and the correlation under it."""
        wanted = _median([v for other, v in self.values.items() if other in trusted and other != camera])
        scores: dict[str, list[float]] = defaultdict(list)
        for timestep in [*self.picked[camera]][::3]:
            for other, taken in self.shots.items():
                if other != camera and timestep in taken:
                    calibration = taken[timestep].camera
                    shot = self.shots[camera][timestep]
                    if (calibration.width, calibration.height) == (shot.camera.width, shot.camera.height):
                        picked = self.pick(shot, timestep, calibration)
                        register = _register(picked, wanted, 0.25 * REACH, levels=1)
                        if register is not None:
                            scores[other].append(register.score)
        if not scores:
            return "", np.nan
        best = max(scores, key=lambda other: float(np.median(scores[other])))
        return best, float(np.median(scores[best]))

    def _sharpness(self, camera: str, others: Sequence[str], offsets: Mapping[int, FloatArray]) -> float:
        fine = self._details(camera, offsets)
        typical = _median([self.fine[other] for other in others])
        both = np.isfinite(fine) & np.isfinite(typical)
        if both.sum() < FEWEST_VERTICES:
            return np.nan
        ratio = np.maximum(fine[both], 1e-6) / np.maximum(typical[both], 1e-6)
        return float(0.5 * np.median(np.log2(ratio)))


def _sample(image: FloatArray, pixels: FloatArray) -> FloatArray:
    """Values (..., ) of an image at pixels (..., 2)."""
    where = (pixels - 0.5).astype(np.float32)  # OpenCV's pixel centres are at integers
    shape = where.shape[:-1]
    flat = where.reshape(-1, 1, 2)
    rows = 1 + (len(flat) - 1) // 30000
    if rows > 1:
        pad = (-len(flat)) % rows
        flat = np.concatenate([flat, np.zeros((pad, 1, 2), np.float32)]).reshape(rows, -1, 2)
    out = cv2.remap(image, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out.ravel()[: int(np.prod(shape))].reshape(shape), dtype=np.float32)


def _typical(rows: Sequence[tuple[FloatArray, np.ndarray]]) -> FloatArray:
    return _median([np.where(seen, values, np.nan) for values, seen in rows])


def _median(rows: Sequence[FloatArray]) -> FloatArray:
    """Median over rows, ignoring NaN; NaN if all are."""
    if not rows:
        return np.empty(0)
    stack = np.sort(np.stack(rows), axis=0)  # NaN last
    count = np.isfinite(stack).sum(axis=0)
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    columns = np.arange(stack.shape[1])
    return 0.5 * (stack[low, columns] + stack[np.minimum(high, len(stack) - 1), columns])


class _Register(NamedTuple):
    """Maximum correlation of an image with a target brightness, and its offset in pixels."""

    score: float
    offset: FloatArray


def _register(picked: _Picked, wanted: FloatArray, reach: float = REACH, levels: int = 3) -> _Register | None:
    """Search offsets up to ``reach`` of the image's height, in ``levels`` successively finer grids."""
    usable = picked.seen & np.isfinite(wanted)
    if usable.sum() < FEWEST_VERTICES:
        return None
    pixels, target = picked.pixels[usable], wanted[usable]
    target = (target - target.mean()) / max(1e-6, float(target.std()))
    limit = reach * len(picked.smooth)
    best, score = np.zeros(2), -1.0
    for step, radius in ((limit / 8, 8), (limit / 32, 4), (limit / 128, 4))[:levels]:
        grid = step * np.arange(-radius, radius + 1)
        shifts = best + np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
        values = _sample(picked.smooth, pixels + shifts[:, None])
        values = values - values.mean(axis=1, keepdims=True)
        scores = (values @ target) / (len(target) * np.maximum(values.std(axis=1), 1e-6))
        best, score = shifts[int(np.argmax(scores))], float(scores.max())
    return _Register(score, best)

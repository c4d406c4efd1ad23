"""Track the head model of a clip in its images.

Replaces the tracking of a run's clips by one estimated from their images; a registered clip transform. Error of tracked
meshes by region of the head.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from ...bench.contracts import Clip, FloatArray, HeadAsset, IntArray, Progress, no_progress
from ...bench.engine.config import RunConfig
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, Member, cached_arrays, read_arrays
from ...bench.io.files import digest, digest_file
from ...bench.progress import progress
from ..clip import CaptureClip, as_capture
from ..ga.writer import save_npz
from ..head.geometry import fit_sphere
from ..head.model import PosedSubject
from ..open import open_clip
from .equations import HeadState, MotionPrior
from .fit import Fitter, LastPass, sampled_vertices, with_offset, with_shape
from .landmarks import ImageLandmarks, landmark_source
from .outline import outline_of
from .rig import FrameStack, PoseColumns, Views, outliers
from .settings import TRACKER_VERSION

LID_REACH = 1.25
"""Lids are the skin within this many radii of an eyeball's centre."""


class RegionError(NamedTuple):
    """Root mean square errors of a region over its vertices and all timesteps, millimetres."""

    absolute: float
    """Distance of the vertices."""
    affine: float
    """Distance after the best affine map of the region at each timestep."""
    motion: float
    """Change of the distance over time, in the frame of the head: the error after subtracting each vertex's mean error."""


def error_regions(head: HeadAsset) -> dict[str, IntArray]:
    """Vertices of face (without lips, lids and eyeballs), lips, lids, eyeballs, neck and scalp, as far as the head has them."""
    known = {name: np.asarray(members, np.int64) for name, members in head.regions.items() if len(members)}
    template = np.asarray(head.template, np.float64)
    none = np.zeros(0, np.int64)
    eyeballs, lids = none, none
    for side in ("left_eyeball", "right_eyeball"):
        if side in known:
            eyeballs = np.union1d(eyeballs, known[side])
            middle, radius = fit_sphere(template[known[side]])
            lids = np.union1d(
                lids, np.flatnonzero(np.linalg.norm(template - middle, axis=1) < LID_REACH * radius)
            )
    lids = np.setdiff1d(np.intersect1d(lids, known.get("eye_region", none)), eyeballs)
    lips = known.get("lips", none)
    inner = np.concatenate([eyeballs, lids, lips, known.get("mouth_socket", none), known.get("teeth", none)])
    regions = {
        "face": np.setdiff1d(known.get("face", none), inner),
        "lips": lips,
        "lids": lids,
        "eyeballs": eyeballs,
    }
    regions |= {name: known.get(name, none) for name in ("neck", "scalp")}
    return {name: members for name, members in regions.items() if len(members)}


def tracking_errors(tracked: Clip, exact: Clip) -> Mapping[str, RegionError]:
    """Errors of a clip's tracking against that of another clip of the same subject, by region."""
    where = f"clip of {tracked.subject}"
    if tracked.head.faces.shape != exact.head.faces.shape or not np.array_equal(
        tracked.head.faces, exact.head.faces
    ):
        raise InputError(where, "head", f"the topology of {exact.head.version}", tracked.head.version)
    timesteps = sorted({*tracked.poses} & {*exact.poses})
    if not timesteps:
        raise InputError(where, "poses", "timesteps of the other capture", "none of them")
    subjects = PosedSubject.of(tracked), PosedSubject.of(exact)
    assert isinstance(exact.head, HeadAsset)
    poses = [[clip.poses[timestep] for timestep in timesteps] for clip in (tracked, exact)]
    found, wanted = (subject.meshes(own) for subject, own in zip(subjects, poses))
    turns = subjects[1].motions(poses[1])[:, :3, :3]
    return {
        name: mesh_errors(found[:, members], wanted[:, members], turns)
        for name, members in error_regions(exact.head).items()
    }


def mesh_errors(found: FloatArray, wanted: FloatArray, turns: FloatArray) -> RegionError:
    """Errors of points (T, n, 3) relative to others, metres, for a head with rotations (T, 3, 3)."""

    def spread(gaps: FloatArray) -> float:
        return 1e3 * float(np.sqrt((gaps**2).sum(axis=-1).mean()))

    gaps = found - wanted
    local = np.einsum("tij,tni->tnj", turns, gaps)
    mapped = []
    for one, other in zip(found, wanted):
        terms = np.concatenate([one - one.mean(axis=0), np.ones((len(one), 1))], axis=1)
        mapped.append(terms @ np.linalg.lstsq(terms, other, rcond=None)[0] - other)
    return RegionError(spread(gaps), spread(np.stack(mapped)), spread(local - local.mean(axis=0)))


LEAST_TRACKED = 0.5
"""Minimum fraction of timesteps that must be tracked."""
MOST_TIMESTEPS, MOST_PIXELS = 64, 2.5e8
"""Timesteps, and pixels of all cameras, that are fitted together; this bounds the memory."""

LandmarkSource = Callable[[Sequence[int]], ImageLandmarks]
"""Finds the landmarks of some timesteps in all cameras."""


class TimestepResidual(NamedTuple):
    """Residual of a timestep after the fit."""

    timestep: int
    landmarks_px: float
    """Root mean square distance between landmarks and their projections, pixels; the median of the cameras."""
    colour_levels: float
    """Median difference of a colour from that of its surface point, 8-bit levels."""


@dataclass(frozen=True)
class TrackingReport:
    """Residuals and time of a tracking. Timesteps are those of the clip before it was tracked."""

    cameras: tuple[str, ...]
    residuals: tuple[TimestepResidual, ...]
    """Of the timesteps that are tracked."""
    without_landmarks: tuple[int, ...]
    """Timesteps that are left out because no camera shows landmarks that fit the head model."""
    outliers: tuple[int, ...]
    """Timesteps that are left out because their fit, also a second one, differs from that of their neighbours."""
    fitted_again: tuple[int, ...]
    """Timesteps whose fit was repeated from the pose of a neighbour and then agreed."""
    seconds: float
    """Time of the fit, including reading images but not landmark detection."""

    @property
    def left_out(self) -> list[int]:
        """Timesteps that the tracked clip does not have."""
        return sorted(self.without_landmarks + self.outliers)

    def to_json(self) -> dict[str, Any]:
        """The summary and every timestep as plain values."""
        return {**asdict(self), "residuals": [one._asdict() for one in self.residuals], **self.summary()}

    def summary(self) -> dict[str, float]:
        """Means over the timesteps."""
        return {
            "timesteps": len(self.residuals),
            "left_out": len(self.left_out),
            "seconds_per_timestep": self.seconds / len(self.residuals),
            "landmarks_px": float(np.mean([residual.landmarks_px for residual in self.residuals])),
            "colour_levels": float(np.mean([residual.colour_levels for residual in self.residuals])),
        }


class Tracked(NamedTuple):
    """A tracked clip and its report."""

    clip: CaptureClip
    report: TrackingReport


def check_cameras(clip: CaptureClip, cameras: Sequence[str]) -> None:
    """Raise `InputError` if there is no camera or one is unknown."""
    unknown = [name for name in cameras if name not in clip.cameras]
    if unknown or not cameras:
        expected = f"at least one of {', '.join(clip.cameras) or 'none'}"
        raise InputError(f"clip of {clip.subject}", "cameras", expected, ", ".join(unknown) or "none")


# The linear algebra uses many small matrices, for which threads cost more time than they save.
@threadpool_limits.wrap(limits=1)
def track(
    clip: CaptureClip,
    cameras: Sequence[str],
    source: LandmarkSource,
    *,
    notes: Mapping[str, Any] | None = None,
    store: Path | None = None,
    times: Mapping[int, float] | None = None,
    progress: Progress = no_progress,
) -> Tracked:
    """Estimate shape, static offset and poses from images; recorded as a step.

    Timesteps without landmarks, and those whose fit remains an outlier, are not in the clip that is returned.

    Neither shape, poses nor static offset of the clip are used, other than by ``source``. The shape is estimated with the
    first timesteps, spread over the clip, and kept for the others. ``times``: Seconds at which
    timesteps are, where they are known: neighbours then differ little.

    ``cameras``: Cameras whose images are used; one is enough. ``source``: Finds landmarks. ``notes``: Recorded with the
    step. ``store``: Folder that keeps the fit of every part, which a later call with the same images and landmarks does not
    repeat.
    """
    where = f"clip of {clip.subject}"
    check_cameras(clip, cameras)
    timesteps = sorted({timestep for timestep, _ in clip.frame_at})
    if not timesteps:
        raise InputError(where, "timesteps", "at least one frame", "none")
    missing = [(t, name) for t in timesteps for name in cameras if (t, name) not in clip.frame_at]
    if missing:
        found = f"none at timestep {missing[0][0]} of camera {missing[0][1]}"
        raise InputError(where, "frames", "an image of every camera at every timestep", found)

    views = Views([clip.cameras[name] for name in cameras])
    most = min(MOST_TIMESTEPS, max(1, int(MOST_PIXELS // views.sizes.prod(axis=1).sum())))
    blocks = -(-len(timesteps) // most)
    fits = _Fits(clip, [*cameras], views, store)
    pixels: dict[int, FloatArray] = {}
    for block in range(blocks):
        landmarks = source(chosen := timesteps[block::blocks])
        pixels |= dict(zip(chosen, landmarks.pixels))
        if landmarks.seen.any():
            chosen = [timestep for timestep, seen in zip(chosen, landmarks.seen) if seen]
            part_progress = partial(_part_progress, progress, block, blocks)
            fits.fit(f"part-{block:05d}", chosen, landmarks.of(landmarks.seen), chosen, part_progress)
    if not fits.poses:
        raise InputError(where, "landmarks", "a face in some image that fits the head model", "none")
    first = fits.outliers()
    good = sorted({*fits.poses} - first)
    half = max(1, most // 2)
    parts = [sorted(first)[start : start + half] for start in range(0, len(first), half)] if good else []
    for number, wrong in enumerate(parts):
        nearest = {timestep: min(good, key=lambda one: abs(one - timestep)) for timestep in wrong}
        fits.poses |= {timestep: fits.poses[one] for timestep, one in nearest.items()}
        # Others give the colours of the points.
        others = sorted(good, key=lambda one: min(abs(one - timestep) for timestep in wrong))[:half]
        refitted = sorted([*wrong, *others])
        marks = landmarks._replace(pixels=np.stack([pixels[timestep] for timestep in refitted]))
        part_progress = partial(_part_progress, progress, blocks + number, blocks + len(parts))
        fits.fit(f"again-{number:05d}", refitted, marks, wrong, part_progress)
    fits.finish({timestep: pixels[timestep] for timestep in fits.poses}, landmarks, times, progress)
    last = fits.outliers()
    kept = sorted({*fits.poses} - last)
    report = TrackingReport(
        tuple(cameras),
        tuple(TimestepResidual(timestep, *fits.residuals[timestep]) for timestep in kept),
        tuple(sorted({*timesteps} - {*fits.poses})),
        tuple(sorted(last)),
        tuple(sorted(first - last)),
        fits.seconds,
    )
    if len(kept) < LEAST_TRACKED * len(timesteps):
        expected = f"timesteps of which at least {LEAST_TRACKED:.0%} can be tracked"
        raise InputError(where, "", expected, f"{len(kept)} of {len(timesteps)}")
    state = HeadState(
        np.asarray(fits.shape, np.float32), np.stack([fits.poses[timestep] for timestep in kept])
    )
    tracked = PoseColumns.of(clip.head).poses(state.poses, clip.head, clip.subject, kept)
    parameters = {"cameras": [*cameras], **(notes or {}), "residual": report.summary()}
    del parameters["residual"]["seconds_per_timestep"]  # which is different each time
    derived = without_timesteps(clip, report.left_out).derive(
        "track",
        parameters,
        shape=state.shape,
        static_offset=np.asarray(fits.offset, np.float32),
        poses=dict(zip(kept, tracked)),
    )
    return Tracked(derived, report)


def without_timesteps(clip: CaptureClip, left_out: Collection[int]) -> CaptureClip:
    """A clip without the frames of some timesteps."""
    splits = {
        name: tuple(key for key in keys if key.timestep not in left_out) for name, keys in clip.splits.items()
    }
    if clip.splits["train"] and not splits["train"]:
        raise InputError(f"clip of {clip.subject}", "train", "frames that can be tracked", "none")
    kept = {key: files for key, files in clip.files.items() if key.timestep not in left_out}
    excluded = {key: why for key, why in clip.excluded.items() if key.timestep not in left_out}
    return replace(clip, splits=splits, files=kept, excluded=excluded)


def _part_progress(progress: Progress, part: int, parts: int, done: int, total: int, note: str = "") -> None:
    progress(part * total + done, parts * total, f"tracking, {note}")


@dataclass
class _Fits:
    """Fits of parts of a clip's timesteps with one shape and static offset, which the first part determines."""

    clip: CaptureClip
    cameras: list[str]
    views: Views
    store: Path | None
    shape: FloatArray | None = None
    offset: FloatArray | None = None
    seconds: float = 0.0
    textures: list[FloatArray] = field(default_factory=list)
    """`Fitted.texture` of each part."""
    poses: dict[int, FloatArray] = field(default_factory=dict)
    """(D,) each."""
    residuals: dict[int, tuple[float, float]] = field(default_factory=dict)

    def fit(
        self,
        name: str,
        part: list[int],
        landmarks: ImageLandmarks,
        taken: list[int],
        progress: Progress,
        last: LastPass | None = None,
    ) -> None:
        """Fit timesteps, from their poses if there are any, and take the results of some of them."""
        start = np.stack([self.poses[timestep] for timestep in part]) if part[0] in self.poses else None
        given = (
            *(self.clip, self.cameras, self.views, part, landmarks),
            *(self.shape, self.offset, start, last, progress),
        )
        if self.store is None:
            fitted = _fit_block(*given)
        else:
            seen = [[one.id, one.width, one.height, one.K, one.world_to_camera] for one in self.views.cameras]
            heads = self.clip.fingerprint, self.clip.head.fingerprint()
            ending = (last.texture, *(last.motion or ())) if last else ()
            mark = digest(
                TRACKER_VERSION, *heads, seen, part, *landmarks, self.shape, self.offset, start, *ending
            )
            file = self.store / f"{name}.npz"
            fitted = cached_arrays(file, mark, _PART, lambda: _fit_block(*given), {"T": len(part)})
        self.shape, self.offset = fitted["shape"], fitted["offset"]
        self.textures.append(fitted["texture"])
        self.seconds += float(fitted["seconds"])
        rows = zip(part, fitted["poses"], fitted["landmarks"].tolist(), fitted["colours"].tolist())
        for timestep, pose, *residual in rows:
            if timestep in taken:
                self.poses[timestep], self.residuals[timestep] = pose, (residual[0], residual[1])

    def finish(
        self,
        pixels: Mapping[int, FloatArray],
        landmarks: ImageLandmarks,
        times: Mapping[int, float] | None,
        progress: Progress,
    ) -> None:
        """Fit consecutive timesteps together, with the colours of all parts and small differences between neighbours, also from
        one part to the next. Timesteps that become outliers keep their former poses."""
        known = sorted({*self.poses} - self.outliers())
        former = {timestep: (self.poses[timestep], self.residuals[timestep]) for timestep in known}
        total = np.maximum(np.sum([one[:, 3:] for one in self.textures], axis=0), 1e-9)
        texture = np.sum([one[:, :3] * one[:, 3:] for one in self.textures], axis=0) / total
        most = max(1, int(MOST_PIXELS / 4 // self.views.sizes.prod(axis=1).sum()))
        parts = [part.tolist() for part in np.array_split(known, -(-len(known) // most) or 1) if len(part)]
        for number, part in enumerate(parts):
            marks = landmarks._replace(pixels=np.stack([pixels[timestep] for timestep in part]))
            part_progress = partial(_part_progress, progress, number, len(parts))
            motion = None
            if times is not None:
                before = parts[number - 1][-1] if number else part[0]
                seconds = np.diff([times[timestep] for timestep in [before, *part]])
                seconds[0] = seconds[0] if number else np.inf
                motion = MotionPrior.of(self.poses[before], seconds)
            self.fit(f"last-{number:05d}", part, marks, part, part_progress, LastPass(texture, motion))
        for timestep in self.outliers() & former.keys():
            self.poses[timestep], self.residuals[timestep] = former[timestep]

    def outliers(self) -> set[int]:
        """Timesteps whose fit is one of `outliers`."""
        fitted = sorted(self.poses)
        poses = np.stack([self.poses[timestep] for timestep in fitted])
        residuals = np.array([self.residuals[timestep] for timestep in fitted])
        wrong = outliers(poses, residuals, PoseColumns.of(self.clip.head), jumps=len(self.cameras) == 1)
        return {timestep for timestep, bad in zip(fitted, wrong) if bad}


_PART = {
    "shape": Member("f", ("S",)),
    "offset": Member("f", ("V", 3)),
    "texture": Member("f", ("P", 4)),
    "poses": Member("f", ("T", "D")),
    **dict.fromkeys(("landmarks", "colours"), Member("f", ("T",))),
    "seconds": Member("f", ()),
}


def _fit_block(
    clip: CaptureClip,
    cameras: Sequence[str],
    views: Views,
    part: Sequence[int],
    landmarks: ImageLandmarks,
    shape: FloatArray | None,
    offset: FloatArray | None,
    poses: FloatArray | None,
    last: LastPass | None,
    progress: Progress,
) -> dict[str, np.ndarray]:
    """Fit some timesteps with a given or a newly estimated shape and offset, from given poses or from those of the landmarks.
    Returns the arrays of `_PART`."""
    begin = time.perf_counter()
    keys = [clip.frame_at[timestep, name] for timestep in part for name in cameras]
    masks = [clip.mask(key) for key in keys]
    outlines = [None if mask is None else outline_of(mask) for mask in masks]
    stack = FrameStack([clip.image(key) for key in keys])
    head = clip.head
    if shape is not None and offset is not None:
        head = with_shape(with_offset(head, offset), shape)
    fitter = Fitter(head, views, landmarks, sampled_vertices(clip.head), outlines)
    state = fitter.start() if poses is None else HeadState(np.zeros(0), poses)
    if last is None:
        state = fitter.fit_landmarks(state)
    if shape is None or offset is None:
        fitted, offset = fitter.fit_subject(state, stack, progress)
        shape = fitted.state.shape
    else:
        fitted = fitter.fit_colours(state, stack, last=last, progress=progress)
    return {
        "shape": shape,
        "offset": offset,
        "texture": fitted.texture,
        "poses": fitted.state.poses,
        "landmarks": fitted.landmarks,
        "colours": fitted.colours,
        "seconds": np.array(time.perf_counter() - begin),
    }


FOLDER = "tracked"
"""Folder of a run with the parameters that were estimated."""


def with_tracking(
    clip: Clip, config: RunConfig, *, landmarks: str = "", embedding: str = "", seed: int = 0
) -> CaptureClip:
    """The clip with the tracking of ``headbench track``, estimated once and kept in ``config.out``.

    Training frames that the tracker leaves out are left out. Scored ones have the pose of the nearest timestep that is tracked.

    Parameters
    ----------
    landmarks, embedding : str
        File of the landmark network and capture to learn its embedding on; without them the landmarks are those of a known
        rig.
    seed : int
        Seed of the error of these.
    """
    capture = as_capture(clip)
    columns = PoseColumns.of(capture.head)
    teacher = as_capture(open_clip(embedding)) if embedding else None
    settings = {
        "landmarks": digest_file(Path(landmarks))[:16] if landmarks else "",
        "embedding": teacher.fingerprint if teacher else "",
        "seed": seed,
    }
    name = digest(TRACKER_VERSION, capture.fingerprint, settings)[:16]
    place = Path(config.out) / FOLDER / f"{capture.subject}-{name}.npz"
    if not place.exists():
        with progress(f"tracking {capture.subject}") as report:
            cameras = [*capture.cameras]
            source = landmark_source(capture, cameras, landmarks, teacher, seed)
            tracked = track(capture, cameras, source, progress=report).clip
        timesteps = sorted(tracked.poses)
        rows = columns.rows([tracked.poses[timestep] for timestep in timesteps])
        arrays = {"shape": np.asarray(tracked.shape), "offset": np.asarray(tracked.static_offset)}
        save_npz(place, {**arrays, "poses": rows, "timesteps": np.array(timesteps)})
    members = {
        "shape": Member("f", ("S",), MAX_MAGNITUDE),
        "offset": Member("f", ("V", 3), MAX_MAGNITUDE),
        "poses": Member("f", ("T", "D"), MAX_MAGNITUDE),
        "timesteps": Member("i", ("T",)),
    }
    sizes = {"S": capture.head.shape_basis.shape[2], "D": columns.size, "V": len(capture.head.template)}
    stored = read_arrays(place, members, sizes)
    timesteps = stored["timesteps"].tolist()
    poses = dict(zip(timesteps, columns.poses(stored["poses"], capture.head, capture.subject, timesteps)))
    sequence = {key.timestep: key.sequence for key in capture.files}
    for lost in sequence.keys() - poses.keys():
        near = [each for each in timesteps if sequence[each] == sequence[lost]] or timesteps
        poses[lost] = replace(poses[min(near, key=lambda timestep: abs(timestep - lost))], timestep=lost)
    train = tuple(key for key in capture.splits["train"] if key.timestep in timesteps)
    return capture.derive(
        "track",
        {**settings, "parameters": digest(stored["shape"], stored["offset"], stored["poses"])},
        shape=stored["shape"],
        static_offset=stored["offset"],
        poses=poses,
        splits={**capture.splits, "train": train},
    )

"""Fit a head model to images: landmarks first, then colours of surface points, outlines and landmarks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, cast

import cv2
import numpy as np
from scipy.sparse import csr_array

from ...bench.contracts import BoolArray, FloatArray, HeadAsset, IntArray, Progress, no_progress
from ...bench.errors import InputError
from ..head.arrays import HeadArrays
from .equations import HeadPrior, HeadState, MotionPrior, NormalEquations, continuous
from .landmarks import ImageLandmarks, spread_vertices
from .outline import Gaps, MeshOutline, Outline, OutlinePoints, gaps, static_offset
from .rig import (
    FrameStack,
    MeshInViews,
    Occlusion,
    PointRig,
    PoseColumns,
    PosedPoints,
    Projection,
    Views,
)


def with_offset(head: HeadArrays, offset: FloatArray) -> HeadArrays:
    """The head model with a static offset (V, 3) in its template."""
    return replace(head, template=np.asarray(head.template + offset, head.template.dtype))


def with_shape(head: HeadArrays, shape: FloatArray) -> HeadArrays:
    """The head model with a shape (S,) in its template instead of a shape basis: one that is kept."""
    return replace(with_offset(head, head.shape_basis @ shape), shape_basis=head.shape_basis[:, :, :0])


ANGLE_SPREAD = (np.inf,) * 3 + (0.15,) * 3 + (0.3, 0.03, 0.02) + (0.2, 0.3, 0.02) * 2
"""Standard deviations of the angles: rotation free, neck, jaw (which opens), eyes; radians."""
LANDMARK_MM = 2.5
"""Expected error of a landmark."""
ROBUST = 8.0
"""Multiple of it at which the weight of a landmark is a quarter."""
MISTAKEN_MM = 25.0
"""Median distance from which the landmarks of an image are left out."""
PARTS = (
    *(("lips", 400), ("eyeballs", 300), ("eye_region", 500), ("face", 900)),
    *(("ears", 150), ("neck", 200), ("scalp", 200)),
)
"""Regions of sampled vertices and their largest numbers; a vertex belongs to the first."""


_TRIED, _FEWEST = 4, 6  # cameras for the rigid pose, and landmarks of one
_RIGID, _STEPS = 8, 10  # on landmarks alone: of the rigid pose, and of all parameters


class BlurLevel(NamedTuple):
    """Steps at one blur of the images."""

    blur: float
    """Standard deviation on the head, millimetres; at least `SHARPEST` pixels."""
    steps: int
    tolerance: float
    """Squared difference of colours at which a weight is a quarter, relative to the usual one. All weights of colours are divided by
    it, so that they rise 16-fold over the levels."""
    landmarks: float
    """Weight of a landmark beside the prior, divided among the cameras."""
    reach: float = 1.0
    """Multiple of `OUTLINE_ROBUST` with several cameras, whose outlines show how far the mouth is open."""


LEVELS = (
    BlurLevel(5.0, 4, 64.0, 0.05, 6.0),
    BlurLevel(2.5, 5, 32.0, 0.03),
    BlurLevel(1.2, 5, 16.0, 0.02),
    BlurLevel(0.7, 6, 4.0, 0.01),
)
"""From coarse to fine. A narrow tolerance at coarse levels would reject the points that move most. All weights are small because
errors of landmarks are correlated over time and those of points in space, so that sums over them overstate certainty."""
LAST = BlurLevel(0.7, 3, 4.0, 0.01)
"""Of the final pass over all timesteps."""
COARSE = 2
"""Number of levels before the static offset is estimated."""
SHARPEST = 0.7
"""Minimum blur, pixels."""
WIDE_MM = 6.0
"""Blur that is subtracted from the images."""
COLOUR_WEIGHT = 0.1
"""Weight of a colour beside the prior."""
EMPHASIS = (("eye_region", 4.0), ("lips", 10.0))
"""Weights of landmarks of regions relative to others, with one camera."""
PAIR_MM, PAIR_WEIGHT = 1.0, 0.05
"""Expected error of the difference between the landmarks of a pair, and its weight, as of a landmark; with one camera."""
SHAPE_SPREAD = 0.3
"""Standard deviation of the prior of the identity coefficients; less than 1 for the same reason."""


class Observations(NamedTuple):
    """Observed colours of points: n observations of all timesteps, in order."""

    frame: IntArray  # (n,) timestep x cameras + camera
    point: IntArray  # (n,)
    weight: FloatArray  # (n,)


def sampled_vertices(head: HeadAsset) -> IntArray:
    """Vertices whose colours are compared, spread over the regions `PARTS`."""
    inner = ("mouth_socket", "teeth", "boundary")
    taken = np.concatenate([np.asarray(head.regions.get(name, ()), np.int64) for name in inner])
    chosen = []
    for name, count in PARTS:
        members = np.setdiff1d(head.regions.get(name, ()), taken).astype(np.int64)
        if len(members):
            chosen.append(members[spread_vertices(np.asarray(head.template)[members], count)])
            taken = np.concatenate([taken, members])
    if not chosen:
        names = ", ".join(name for name, _ in PARTS)
        raise InputError(f"head model {head.version!r}", "regions", f"one of {names}", "none")
    return np.unique(np.concatenate(chosen))


OUTLINE_MM, OUTLINE_ROBUST = 1.5, 4.0
"""Expected error of a point of an outline, and the multiple of it at which its weight is a quarter."""
OUTLINE_WEIGHT = 0.01
"""Weight of a point of an outline, as of a landmark."""


class OutlinedView(NamedTuple):
    """Points of the mesh on its outline in an image."""

    row: int
    """Of the timestep."""
    camera: int
    outline: Outline
    points: OutlinePoints
    rig: PointRig
    normals: FloatArray
    """(n, 2) outward, in the image."""


class LastPass(NamedTuple):
    """Inputs of the final pass."""

    texture: FloatArray
    """(P, 3) colours of the sampled vertices."""
    motion: MotionPrior | None
    """Of consecutive timesteps, where their times are known."""


class Fitted(NamedTuple):
    """Result of a fit."""

    state: HeadState
    landmarks: FloatArray
    """(T,) root mean square distance of the landmarks before the last step, pixels; 0 where none was used."""
    colours: FloatArray
    """(T,) median difference of a colour from that of its point, 8-bit levels."""
    texture: FloatArray
    """(P, 4) colour of each sampled vertex, and the weight of its observations."""


@dataclass(frozen=True, eq=False)
class Fitter:
    """Constant data of a fit."""

    head: HeadAsset
    views: Views
    """C cameras."""
    landmarks: ImageLandmarks
    """Landmarks of T timesteps."""
    vertices: IntArray
    """(P,) vertices whose colours are compared."""
    outlines: Sequence[Outline | None] = ()
    """Outlines of the subject in the images of T x C frames; none without masks."""

    def _prior(self) -> HeadPrior:
        """Weak prior of all parameters."""
        columns = PoseColumns.of(self.head)
        free = [np.inf] * 3
        coefficients = [1.0] * columns.expression_size + [0.5] * columns.eyelid_size
        shape = np.full(self.head.shape_basis.shape[2], SHAPE_SPREAD)
        return HeadPrior(np.array([*ANGLE_SPREAD, *free, *coefficients]), shape)

    def start(self) -> HeadState:
        """The mean shape in the rigid pose of the landmarks of one camera at each timestep. Of the
        cameras that saw most landmarks it is the one whose pose fits the landmarks of all cameras best."""
        columns = PoseColumns.of(self.head)
        poses = np.zeros((len(self.landmarks.pixels), columns.size))
        shape = np.zeros(self.head.shape_basis.shape[2])
        rig = self.landmark_rig()
        rest = rig.points(shape, poses[0]).astype(np.float64)
        root = np.asarray(self.head.joint_regressor[0], np.float64) @ self.head.template
        last = np.zeros(6)
        for row, pixels in enumerate(self.landmarks.pixels):
            seen = np.isfinite(pixels[..., 0])
            least = np.inf
            for camera in np.argsort(-seen.sum(axis=1), kind="stable")[:_TRIED]:
                kept = seen[camera]
                if kept.sum() < _FEWEST:
                    continue
                turn, moved = self._rigid(rest[kept], pixels[camera, kept], camera)
                gaps = np.linalg.norm(self.views.place(rest @ turn.T + moved)[0] - pixels, axis=2)
                if np.median(gaps[seen]) < least:
                    least = float(np.median(gaps[seen]))
                    last = np.concatenate([cv2.Rodrigues(turn)[0][:, 0], moved - root + turn @ root])
            poses[row, :3], poses[row, columns.translation] = last[:3], last[3:]
        return HeadState(shape, poses)

    def _rigid(self, rest: FloatArray, pixels: FloatArray, camera: int) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3) and shift (3,) that take points to the world such that they project onto pixels."""
        K = self.views.intrinsics[camera]
        _, turn, shift = cv2.solvePnP(rest, pixels, K, None, flags=cv2.SOLVEPNP_SQPNP)
        back = self.views.rotations[camera].T
        return back @ cv2.Rodrigues(turn)[0], back @ (shift[:, 0] - self.views.shifts[camera])

    def landmark_rig(self) -> PointRig:
        """The landmarks as points of the head."""
        return PointRig(self.head, self.landmarks.corners, self.landmarks.weights)

    def add_landmarks(
        self,
        equations: NormalEquations,
        rig: PointRig,
        state: HeadState,
        weight: float,
        leave_out: bool = True,
    ) -> FloatArray:
        """Add the landmarks to the equations with a weight; return their root mean square distance at each timestep, (T,) pixels, the
        median of the cameras, of which one may have found something else; 0 where none is used."""
        distance = np.zeros(len(state.poses))
        weight /= len(self.views.cameras)
        # Where cameras see the face together, their errors at lips and lids contradict one another.
        alone = len(self.views.cameras) == 1
        emphasis = self._emphasis() if alone else np.ones(len(self.landmarks.corners))
        for row, pixels in enumerate(self.landmarks.pixels):
            posed = rig.linearised(state.shape, state.poses[row])
            projected = self.views.project(posed.points)
            seen = np.isfinite(pixels[..., 0])
            gap = np.where(seen[..., None], pixels - projected.pixels, 0.0)
            per_metre = self.views.intrinsics[:, None, 0, 0] / np.maximum(projected.depth, 0.05)
            sigma = 1e-3 * LANDMARK_MM * per_metre
            square = (gap**2).sum(axis=2)
            # All landmarks of an image may be wrong if the network detects something else as a face.
            if leave_out:
                near = np.sqrt(square) / sigma < MISTAKEN_MM / LANDMARK_MM
                seen &= ((seen & near).sum(axis=1) > seen.sum(axis=1) / 2)[:, None]
            robust = seen * emphasis * weight / (sigma * (1 + square / (ROBUST * sigma) ** 2)) ** 2
            used = seen.any(axis=1)
            if used.any():
                distance[row] = np.median(np.sqrt((seen * square).sum(axis=1)[used] / seen.sum(axis=1)[used]))
            weighted = robust[..., None, None] * projected.derivative
            curvature = np.einsum("cpki,cpkj->pij", weighted, projected.derivative)
            slope = np.einsum("cpki,cpk->pi", weighted, gap)
            equations.add(row, posed, curvature, slope)
            if alone:
                self._add_pairs(equations, row, posed, projected, gap[0], sigma[0], seen[0])
        return distance

    def _emphasis(self) -> FloatArray:
        """(L,) weights of landmarks relative to one another."""
        weights = np.ones(len(self.landmarks.corners))
        for name, weight in EMPHASIS:
            members = np.isin(self.landmarks.corners, np.asarray(self.head.regions.get(name, ()), np.int64))
            weights[members.any(axis=1)] = weight
        return weights

    def _add_pairs(
        self,
        equations: NormalEquations,
        row: int,
        posed: PosedPoints,
        projected: Projection,
        gap: FloatArray,
        sigma: FloatArray,
        seen: BoolArray,
    ) -> None:
        """Add the differences between the landmarks of pairs in one camera, from the distances (L, 2) of all landmarks."""
        one, other = self.landmarks.pairs[seen[self.landmarks.pairs].all(axis=1)].T
        jacobian = np.concatenate([posed.by_pose, posed.by_shape], axis=2)
        by_pixel = projected.derivative[0]
        rows = by_pixel[one] @ jacobian[one] - by_pixel[other] @ jacobian[other]  # (n, 2, D + S)
        residual, scale = gap[one] - gap[other], sigma[one] * PAIR_MM / LANDMARK_MM
        square = (residual**2).sum(axis=1)
        weight = PAIR_WEIGHT / (scale * (1 + square / (ROBUST * scale) ** 2)) ** 2
        equations.add_residuals(row, rows.reshape(-1, rows.shape[2]), np.repeat(weight, 2), residual.ravel())

    def fit_landmarks(self, state: HeadState, weight: float = LEVELS[0].landmarks) -> HeadState:
        """Steps on the landmarks alone, the first of the rigid pose only."""
        rig, prior = self.landmark_rig(), self._prior()
        still = HeadPrior(np.where(np.isinf(prior.pose), np.inf, 0.0), np.zeros(len(prior.shape)))
        for step in range(_RIGID + _STEPS):
            equations = NormalEquations(state)
            self.add_landmarks(equations, rig, state, weight, leave_out=step >= _RIGID)
            state = equations.step(state, still if step < _RIGID else prior, 1e-3)
        return state

    def fit_subject(
        self, state: HeadState, stack: FrameStack, progress: Progress = no_progress
    ) -> tuple[Fitted, FloatArray]:
        """Shape, poses from those of the landmarks, and a static offset (V, 3), metres, that the head model does not have yet."""
        state = self.fit_colours(state, stack, levels=LEVELS[:COARSE], scalp=False, progress=progress).state
        offset = self.fit_offset(state)
        fine = replace(self, head=with_offset(cast(HeadArrays, self.head), offset))
        fitted = fine.fit_colours(state, stack, levels=LEVELS[COARSE:], progress=progress)
        return fitted, offset + fine.fit_offset(fitted.state)

    def fit_colours(
        self,
        state: HeadState,
        stack: FrameStack,
        *,
        levels: Sequence[BlurLevel] | None = None,
        scalp: bool = True,
        last: LastPass | None = None,
        progress: Progress = no_progress,
    ) -> Fitted:
        """Steps on colours of points, landmarks and outlines at the blurs of ``levels``, by default `LEVELS`, in the final pass `LAST`.

        ``stack`` holds the images of all timesteps, the cameras of each together. ``scalp``: Whether the outline of the scalp
        counts, which the static offset moves to that of the hair. ``last``: Inputs of the final pass, in which
        the head model has no shape basis.
        """
        texture, motion = last or (None, None)
        if levels is None:
            levels = LEVELS if last is None else [LAST]
        if motion is not None:
            state = state._replace(poses=continuous(np.vstack([motion.before, state.poses]))[1:])
        vertices = self.vertices
        rig = PointRig.at_vertices(self.head, vertices)
        mesh = PointRig.at_vertices(self.head, np.arange(len(self.head.template)))
        marks, prior = self.landmark_rig(), self._prior()
        scale = self._pixels_per_millimetre(mesh, state)
        alone = len(self.views.cameras) == 1
        total, done = sum(level.steps for level in levels), 0
        landmarks = colours = cast(FloatArray, np.zeros(len(state.poses)))
        found = cast(FloatArray, np.zeros((len(vertices), 4)))
        for level in levels:
            stack.filter(max(SHARPEST, level.blur * scale), WIDE_MM * scale)
            samples, outlined = self._seen(state, mesh, scalp)
            for _ in range(level.steps):
                progress(done, total, f"blur of {level.blur:g} mm")
                equations = NormalEquations(state)
                landmarks = self.add_landmarks(equations, marks, state, level.landmarks)
                colours, found = self._add_colours(
                    equations, rig, state, stack, samples, level.tolerance, texture
                )
                if motion is not None:
                    equations.link(state.poses, motion)
                self._add_outlines(equations, state, outlined, 1.0 if alone else level.reach)
                state = equations.step(state, prior)
                done += 1
        return Fitted(state, landmarks, colours, found)

    def _seen(self, state: HeadState, mesh: PointRig, scalp: bool) -> tuple[Observations, list[OutlinedView]]:
        """The vertices that each frame sees, and the outlines of the posed meshes."""
        frames, points, weights, outlined = [], [], [], []
        finder = MeshOutline(self.head, scalp)
        for row, surface in enumerate(self._surfaces(state, mesh)):
            cosine = surface.visible(self.vertices)
            camera, point = np.nonzero(cosine)
            frames.append(row * len(cosine) + camera)
            points.append(point)
            weights.append(cosine[camera, point])
            outlined += self._outlined(row, surface, mesh, finder)
        return Observations(np.concatenate(frames), np.concatenate(points), np.concatenate(weights)), outlined

    def _surfaces(self, state: HeadState, mesh: PointRig) -> Iterator[MeshInViews]:
        """The posed mesh of each timestep."""
        occlusion = Occlusion(self.head, mesh.points(state.shape, state.poses[0]), self.views)
        for pose in state.poses:
            yield occlusion.surface(mesh.points(state.shape, pose).astype(np.float64))

    def _outlined(
        self, row: int, surface: MeshInViews, mesh: PointRig, finder: MeshOutline
    ) -> list[OutlinedView]:
        """The outline of a posed mesh in images with masks."""
        cameras = len(self.views.cameras)
        outlines = self.outlines[row * cameras : (row + 1) * cameras]
        if not any(outlines):
            return []
        result = []
        for camera, (outline, points) in enumerate(zip(outlines, finder.points(surface), strict=True)):
            if outline is None or not len(points.corners):
                continue
            mixed = np.einsum("nk,nki->ni", points.weights, surface.normals[points.corners])
            outward = (mixed @ self.views.rotations[camera].T)[:, :2]
            outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
            result.append(OutlinedView(row, camera, outline, points, mesh.mixed(*points), outward))
        return result

    def _gaps(self, view: OutlinedView, points: FloatArray) -> tuple[Gaps, Projection, FloatArray]:
        """Distances of the posed points of a view from the outline, their projection, and its pixels per metre (n,)."""
        projected = self.views.project(points, np.full(len(points), view.camera))
        per_metre = self.views.intrinsics[view.camera, 0, 0] / projected.depth
        return gaps(view.outline, projected.pixels, view.normals), projected, per_metre

    def _add_outlines(
        self, equations: NormalEquations, state: HeadState, outlined: Sequence[OutlinedView], reach: float
    ) -> None:
        """Add the distances between both outlines to the equations. ``reach``: That of the level."""
        for view in outlined:
            posed = view.rig.linearised(state.shape, state.poses[view.row])
            found, projected, per_metre = self._gaps(view, posed.points)
            sigma = 1e-3 * OUTLINE_MM * per_metre
            robust = found.aligned * OUTLINE_WEIGHT
            robust /= (sigma * (1 + (found.distance / (reach * OUTLINE_ROBUST * sigma)) ** 2)) ** 2
            along = np.einsum("ni,nik->nk", found.normals, projected.derivative)
            curvature = robust[:, None, None] * along[:, :, None] * along[:, None]
            equations.add(view.row, posed, curvature, (robust * found.distance)[:, None] * along)

    def fit_offset(self, state: HeadState) -> FloatArray:
        """(V, 3) static offset, metres, that moves the outline of the mesh to those of the masks."""
        mesh = PointRig.at_vertices(self.head, np.arange(len(self.head.template)))
        parts, distances = [], []
        for view in self._seen(state, mesh, True)[1]:
            points = view.rig.points(state.shape, state.poses[view.row])
            found, _, per_metre = self._gaps(view, points)
            kept = found.aligned > 0
            parts.append(OutlinePoints(view.points.corners[kept], view.points.weights[kept]))
            distances.append((found.distance / per_metre)[kept])
        if not parts:
            return np.zeros(np.shape(self.head.template))
        neutral = np.asarray(self.head.template + self.head.shape_basis @ state.shape, np.float64)
        every = OutlinePoints(*map(np.concatenate, zip(*parts)))
        return static_offset(self.head, neutral, every, np.concatenate(distances))

    def _pixels_per_millimetre(self, mesh: PointRig, state: HeadState) -> float:
        depth = self.views.place(mesh.points(state.shape, state.poses[0]))[1]
        return float(np.median(1e-3 * self.views.intrinsics[:, 0, 0] / np.median(depth, axis=1)))

    def _add_colours(
        self,
        equations: NormalEquations,
        rig: PointRig,
        state: HeadState,
        stack: FrameStack,
        samples: Observations,
        tolerance: float,
        known: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray]:
        """Add the colours to the equations; return their median difference at each timestep, (T,) 8-bit levels, and the
        `Fitted.texture`, with the ``known`` colours (P, 3) if they are given."""
        cameras = len(self.views.cameras)
        bounds = np.searchsorted(samples.frame, np.arange(len(state.poses) + 1) * cameras)
        posed = [rig.points(state.shape, pose) for pose in state.poses]
        sampled = []
        for row, (start, end) in enumerate(pairwise(bounds)):
            frame, point = samples.frame[start:end], samples.point[start:end]
            projected = self.views.project(posed[row][point], frame - row * cameras)
            values, gradients = stack.sample(frame, projected.pixels)
            sampled.append((values, gradients @ projected.derivative.astype(np.float32)))
        values = np.concatenate([part[0] for part in sampled])
        texture, robust, total = _texture(values, samples, len(posed[0]), tolerance, known)
        residual = values - texture[samples.point]
        difference = np.zeros(len(state.poses))
        weight = COLOUR_WEIGHT * robust
        for row, (start, end) in enumerate(pairwise(bounds)):
            gap, by_point = residual[start:end], sampled[row][1]  # (n, 3), (n, 3, 3): channel, axis
            weighted = weight[start:end, None, None] * by_point
            curvature = np.einsum("nci,ncj->nij", weighted, by_point).reshape(-1, 9)
            slope = -np.einsum("nci,nc->ni", weighted, gap)
            count = end - start
            entries = (np.ones(count, np.float32), (samples.point[start:end], np.arange(count)))
            gather = csr_array(entries, shape=(len(posed[0]), count))
            linearised = rig.linearised(state.shape, state.poses[row])
            equations.add(row, linearised, (gather @ curvature).reshape(-1, 3, 3), gather @ slope)
            difference[row] = 255 * np.median(np.abs(gap)) if count else 0.0
        return difference, np.concatenate([texture, total[:, None]], axis=1)


def _texture(
    values: FloatArray, samples: Observations, points: int, tolerance: float, known: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Robust colour of every point (P, 3), the Geman-McClure weight of every observation (n,), over its variance, and the sum of
    the weights of every point (P,), not over it. ``known``: (P, 3) colours that are kept instead."""
    weight = samples.weight.astype(np.float32)
    robust = weight
    texture: FloatArray = np.zeros((points, 3)) if known is None else known
    for _ in range(4):
        total = np.maximum(np.bincount(samples.point, robust, points), 1e-9)
        if known is None:
            sums = [np.bincount(samples.point, robust * channel, points) for channel in values.T]
            texture = np.stack(sums, axis=1) / total[:, None]
        square = ((values - texture[samples.point]) ** 2).sum(axis=1)
        # Points whose colour changes with light or expression count less than those whose colour stays.
        mean_square = np.bincount(samples.point, robust * square, points) / total
        scale = tolerance * np.maximum(mean_square, max(float(np.median(square)), 1e-5))[samples.point]
        robust = weight / (1 + square / scale) ** 2
    return texture.astype(np.float32), (3 * robust / scale).astype(np.float32), total

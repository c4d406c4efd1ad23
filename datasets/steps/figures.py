"""Figures of jaw bases and expression clusters, similar to Figures 7 and 8 of the paper cited in `jaw_bases`."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from scipy.spatial.transform import Rotation

from ...bench.contracts import ByteArray, Clip, FloatArray, HeadPose, Progress, no_progress
from ...bench.io.figures import pixels
from ..clip import CaptureClip
from ..head.model import PosedSubject, frontal_key, pose_in_head_frame
from ..inspect.figure import HELD_OUT, LEAK, MUTED, TRAIN, bands, new_figure, shortened, show
from ..mesh_pictures import draw_mesh, portrait_camera
from .clusters import DEFAULT_COUNT, ExpressionClusters, jaw_bases, jaw_quaternions, jaw_weights, leaks

_YAW = 0.35  # radians; slightly from the side, to show the jaw's depth
_MESH_SIZE = (268, 352)  # width, height, pixels
_JAW_COLUMNS, _CLUSTER_COLUMNS = 8, 4


class JawFindings(NamedTuple):
    """Jaw bases of a clip, and their coverage of its poses."""

    bases: FloatArray
    """(n, 4) unit quaternions, real part first."""
    angles: FloatArray
    """(n, 3) their rotation vectors, degrees: opening, to the side, twist."""
    shares: FloatArray
    """(n,) fraction of the training timesteps whose largest weight is on the basis."""
    largest_gap: float
    """Largest angle, degrees, between a training pose and the basis nearest to it."""
    train: FloatArray
    """(T, 3) rotation vectors of the training timesteps, degrees."""
    held_out: FloatArray
    """The same of the held-out timesteps."""
    variant: str

    def record(self) -> dict[str, Any]:
        """The values as plain types."""
        return {
            "variant": self.variant,
            "leaks": list(leaks(self.variant)),
            "bases": self.bases.round(6).tolist(),
            "degrees": self.angles.round(2).tolist(),
            "shares": self.shares.round(4).tolist(),
            "largest_gap_degrees": round(self.largest_gap, 3),
            "train_timesteps": len(self.train),
            "held_out_timesteps": len(self.held_out),
        }


def find_jaw_bases(
    clip: CaptureClip, count: int = DEFAULT_COUNT, *, variant: Literal["paper", "official"] = "paper"
) -> JawFindings:
    """Find the bases of a clip and their coverage of its poses."""
    bases = jaw_bases(clip, count, variant=variant)
    train = clip.timesteps("train")
    held_out = [t for t in clip.timesteps("self_reenactment") if t not in set(train)]
    quaternions = jaw_quaternions([clip.poses[t] for t in train])
    weights = jaw_weights(quaternions, bases)
    shares = np.bincount(weights.argmax(axis=1), minlength=len(bases)) / len(train)
    likeness = np.abs(quaternions @ bases.T).max(axis=1).clip(0, 1)
    return JawFindings(
        bases,
        _degrees(bases),
        shares,
        float(np.degrees(2 * np.arccos(likeness.min()))),
        _degrees(quaternions),
        _degrees(jaw_quaternions([clip.poses[t] for t in held_out])),
        variant,
    )


def draw_jaw_bases(clip: CaptureClip, found: JawFindings) -> ByteArray:
    """(H, W, 3) figure: the bases as meshes, and their positions among the poses of the performance."""
    rows = -(-len(found.bases) // _JAW_COLUMNS)
    neutral = next(iter(clip.poses.values()))
    still = replace(neutral, expression=np.zeros_like(neutral.expression), eyes=np.zeros(6), eyelids=None)
    poses = [replace(still, jaw=np.radians(angle)) for angle in found.angles]
    meshes = draw_meshes(clip, unposed_meshes(clip, poses), *_MESH_SIZE)
    notes = leaks(found.variant)
    origin = f"Leak: {notes[0]}" if notes else "from training poses alone, the neutral jaw first"
    with new_figure(11, 0.5 + 2.2 * rows + 3.6) as figure:
        figure.suptitle(f"Jaw bases, subject {clip.subject}: {origin}", color=LEAK if notes else "black")
        top, bottom = bands(figure, [2.2 * rows, 3.6])
        grid = top.subplots(rows, _JAW_COLUMNS, squeeze=False).ravel()
        for number, axes in enumerate(grid):
            if number >= len(meshes):
                axes.axis("off")
                continue
            show(axes, meshes[number])
            opening, side, _ = found.angles[number]
            text = f"{number + 1}: {opening:.1f}° open,\n{side:+.1f}° side,\nnearest for {found.shares[number]:.0%}"
            axes.set_xlabel(text, fontsize=8)
        _scatter(bottom.subplots(), found)
        return pixels(figure)


def _scatter(axes: Axes, found: JawFindings) -> None:
    """Opening against sideways angle: training poses, held-out poses, bases by number."""
    near = found.bases[:, 0] > np.cos(np.pi / 4)  # a half turn would dominate the scale
    for angles, colour, name in ((found.held_out, HELD_OUT, "held-out"), (found.train, TRAIN, "training")):
        axes.scatter(angles[:, 0], angles[:, 1], s=14, color=colour, label=f"{len(angles)} {name} poses")
    axes.scatter(
        found.angles[near, 0],
        found.angles[near, 1],
        s=70,
        facecolors="none",
        edgecolors="black",
        label=f"{len(found.bases)} bases",
    )
    for number in np.flatnonzero(near):
        opening, side, _ = found.angles[number].tolist()
        axes.annotate(str(number + 1), (opening, side), (0, 6), textcoords="offset points", ha="center")
    axes.set(xlabel="opening (rotation about the ears' axis), degrees", ylabel="to the side, degrees")
    axes.grid()
    title = f"every training pose has a basis\nwithin {found.largest_gap:.1f}°"
    axes.legend(loc="upper left", bbox_to_anchor=(1, 1), title=title)


def draw_clusters(
    clip: CaptureClip, clusters: ExpressionClusters, progress: Progress = no_progress
) -> ByteArray:
    """(H, W, 3) picture: medoids as image and mesh, from the largest cluster to the smallest; clusters over time."""
    sizes = np.bincount(clusters.labels)
    order = np.argsort(-sizes, kind="stable")
    keys = [frontal_key(clip, timestep) for timestep in clusters.medoids[order].tolist()]
    meshes = draw_meshes(clip, unposed_meshes(clip, [clip.poses[key.timestep] for key in keys]), *_MESH_SIZE)
    rank = np.argsort(order)
    sequences = {name: rank[labels].tolist() for name, labels in _by_sequence(clip, clusters).items()}
    rows = -(-len(order) // _CLUSTER_COLUMNS)
    heights = [2.1 * rows, 0.6 + 0.28 * len(sequences)]
    with new_figure(12, sum(heights) + 0.5) as figure:
        figure.suptitle(f"Expression clusters, subject {clip.subject}: {_origin(clusters)}")
        top, bottom = bands(figure, heights)
        grid = top.subplots(rows, 2 * _CLUSTER_COLUMNS, squeeze=False).ravel()
        for axes in grid[2 * len(order) :]:
            axes.axis("off")
        for place, (label, key) in enumerate(zip(order, keys)):
            show(grid[2 * place], clip.image(key), frame=True)
            grid[2 * place].spines[:].set(color=cluster_colour(place), linewidth=3)
            show(grid[2 * place + 1], meshes[place])
            count = "1 timestep" if sizes[label] == 1 else f"{sizes[label]} timesteps"
            share = sizes[label] / len(clusters.labels)
            grid[2 * place].set_title(f"{count} ({share:.0%}), medoid {key.timestep}", fontsize=9)
            progress(place + 1, len(order), str(key))
        draw_strips(bottom.subplots(), sequences)
        return pixels(figure)


def draw_strips(axes: Axes, sequences: Mapping[str, Sequence[int]]) -> None:
    """Draw a strip for each sequence: its timesteps from left to right in the colours of their clusters' ranks."""
    longest = max(map(len, sequences.values()))
    strips = np.full((len(sequences), longest), np.nan)
    for row, ranks in enumerate(sequences.values()):
        strips[row, : len(ranks)] = ranks
    count = int(np.nanmax(strips)) + 1
    colours = ListedColormap([cluster_colour(rank) for rank in range(count)])
    axes.imshow(strips, colours, aspect="auto", interpolation="nearest", vmin=-0.5, vmax=count - 0.5)
    axes.hlines(np.arange(1, len(sequences)) - 0.5, -0.5, longest - 0.5, color="white", linewidth=4)
    axes.set_yticks(range(len(sequences)), [shortened(name, 24) for name in sequences], color="black")
    axes.set_xticks([])
    axes.spines[:].set_visible(False)
    axes.set_title("clusters over time, by training sequence", color=MUTED)


def cluster_colour(rank: int) -> tuple[float, float, float]:
    """Colour in [0, 1] of the cluster of this rank by size: hues a golden section apart, the largest one grey."""
    return (0.745,) * 3 if rank == 0 else colorsys.hsv_to_rgb(0.618034 * rank % 1, 0.62, 0.88)


def unposed_meshes(clip: Clip, poses: Sequence[HeadPose]) -> FloatArray:
    """(N, V, 3) meshes with expression, jaw, eyes and eyelids, without rotation, neck and translation."""
    return PosedSubject.of(clip, torch.float32).meshes([pose_in_head_frame(pose) for pose in poses])


def draw_meshes(clip: Clip, meshes: FloatArray, width: int, height: int) -> list[ByteArray]:
    """Draw each of (N, V, 3) meshes with a common camera that shows all faces."""
    face = meshes[:, clip.head.regions.get("face", np.arange(meshes.shape[1]))]
    camera = portrait_camera(face.reshape(-1, 3).astype(np.float64), width, height, yaw=_YAW)
    return [draw_mesh(mesh, np.asarray(clip.head.faces), camera) for mesh in meshes]


def _origin(clusters: ExpressionClusters) -> str:
    count = len(clusters.timesteps)
    if clusters.variant == "official":
        return f"the published clustering of {count} training timesteps"
    if clusters.landmarks == count:
        return f"all pairs of {count} training timesteps"
    return f"{clusters.landmarks} landmarks for {count} training timesteps, within {1000 * clusters.radius:.2f} mm"


def _by_sequence(clip: CaptureClip, clusters: ExpressionClusters) -> dict[str, list[int]]:
    """Cluster of each training timestep in order, by sequence."""
    sequence_of = {key.timestep: key.sequence for key in clip.splits["train"]}
    result: dict[str, list[int]] = {}
    for timestep, label in clusters.by_timestep.items():
        result.setdefault(sequence_of[timestep], []).append(label)
    return result


def _degrees(quaternions: FloatArray) -> FloatArray:
    """(N, 3) rotation vectors, degrees, of (N, 4) quaternions with the real part first."""
    rotations = Rotation.from_quat(quaternions.reshape(-1, 4)[:, [1, 2, 3, 0]])
    return np.degrees(rotations.as_rotvec())

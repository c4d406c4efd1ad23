"""``headbench bench clusters``: time and memory of the expression classes, and how well they agree."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import Any

import numpy as np
from sklearn.cluster import KMeans, SpectralClustering
from sklearn.metrics import adjusted_rand_score

from ...bench.contracts import FloatArray, FrameKey, HeadPose, IntArray, Progress
from ...bench.machine import peak_memory_bytes
from ...bench.specs import Findings
from ...datasets.clip import CaptureClip
from ...datasets.steps.clusters import (
    DEFAULT_CLASSES,
    LANDMARK_TOLERANCE,
    cluster_by_distance,
    cluster_expressions,
    expression_displacements,
    farthest_meshes,
    mean_vertex_distances,
    nystrom_embedding,
    similarities,
)
from ...datasets.synthetic.performance import HELD_OUT, perform, share_out
from ...datasets.synthetic.plan import load_geometry
from .refit import without_images

SIZES, QUICK_SIZES = (300, 1000, 2000, 5000), (300, 1000)
AGREEMENT_SIZE, AGREEMENT_LANDMARKS = 300, 150
PERFORMANCES, QUICK_PERFORMANCES = 5, 2
SEEDS = 4
_TAKE = 1000  # timesteps after which the subject performs everything again, a little differently
_WOBBLE = 0.02  # of a coefficient's standard deviation: tracked performances are not smooth


def measure(quick: bool, progress: Progress) -> Findings:
    """Cluster performances of several lengths, and compare landmarks with all pairs on short ones.

    Passed where the landmarks' classes agree with those of all pairs, on average, at least as well as the
    published method agrees with itself from seed to seed.
    """
    sizes = QUICK_SIZES if quick else SIZES
    count = QUICK_PERFORMANCES if quick else PERFORMANCES
    speed = []
    for index, size in enumerate(sizes):
        progress(index, len(sizes) + count, f"{size} timesteps")
        speed.append(measure_speed(size))
    agreement = []
    for seed in range(count):
        progress(len(sizes) + seed, len(sizes) + count, f"agreement, performance {seed}")
        agreement.append(_agreement(seed))
    means = {
        key: float(np.mean([row[key] for row in agreement])) for key in agreement[0] if key != "performance"
    }
    lines = [
        "Seconds of all threads together, and by the clock; peak memory of the whole process.",
        "timesteps  landmarks  radius mm  processor s  clock s  peak GB",
        *(
            f"{row['timesteps']:>9}  {row['landmarks']:>9}  {row['radius_mm']:>9.3f}  "
            f"{row['seconds']:>11.1f}  {row['wall_seconds']:>7.1f}  {row['peak_gb']:>7.2f}"
            for row in speed
        ),
        "",
        f"Adjusted Rand index on {AGREEMENT_SIZE} performed timesteps, {AGREEMENT_LANDMARKS} landmarks:",
        *(f"{label:<72}{means[key]:.3f}" for key, label in _LABELS.items()),
    ]
    passed = means["landmarks_with_all_pairs"] >= means["published_with_itself"]
    data = {"speed": speed, "agreement": agreement, "agreement_means": means}
    return Findings("\n".join(lines), data, passed)


_LABELS = {
    "published_with_itself": "published method, all pairs, between two seeds",
    "landmarks_with_all_pairs": "ours: landmarks with all pairs",
    "published_by_landmarks": "published label assignment: landmarks with all pairs, between two seeds",
    "ours_with_published": "ours, all pairs, with the published method",
}


def performed_clip(timesteps: int, seed: int) -> CaptureClip:
    """Training timesteps as subjects of the synthetic capture perform them; without images."""
    geometry = load_geometry("procedural")
    rng = np.random.default_rng(seed)
    poses: list[HeadPose] = []
    take = 0
    while len(poses) < timesteps:
        # A sixth of a performance is held out.
        for name, count in share_out(round(1.2 * min(_TAKE, timesteps)) + 1).items():
            if name != HELD_OUT:
                moments = perform(name, count, 100 * seed + take).activations
                poses += [geometry.translation.pose(moment, "s", 0) for moment in moments]
        take += 1
    noisy = {
        t: replace(
            pose, timestep=t, expression=pose.expression + _WOBBLE * rng.standard_normal(len(pose.expression))
        )
        for t, pose in enumerate(poses[:timesteps])
    }
    head = geometry.head
    return CaptureClip(
        subject="s",
        shape=np.zeros(head.shape_basis.shape[2]),
        splits={"train": tuple(FrameKey("s", "performed", t, "a") for t in noisy)},
        files={},
        **without_images(head, noisy),
    )


def measure_speed(timesteps: int) -> dict[str, Any]:
    """Cluster a performance: processor and clock seconds, peak memory of the process, and the step's record."""
    clip = performed_clip(timesteps, seed=0)
    start, wall = time.process_time(), time.perf_counter()
    record = cluster_expressions(clip).record()
    seconds, wall = time.process_time() - start, time.perf_counter() - wall
    return {**record, "seconds": seconds, "wall_seconds": wall, "peak_gb": peak_memory_bytes() / 1e9}


def _agreement(seed: int) -> dict[str, float]:
    clip = performed_clip(AGREEMENT_SIZE, seed)
    faces = expression_displacements(clip, sorted(clip.poses))
    distances = mean_vertex_distances(faces)
    largest = float(distances.max())
    affinity = similarities(distances, largest)
    published = [
        SpectralClustering(DEFAULT_CLASSES, affinity="precomputed", random_state=start).fit_predict(affinity)
        for start in range(SEEDS)
    ]
    exact, _ = cluster_by_distance(distances, DEFAULT_CLASSES)
    approximate, by_landmarks = [], []
    for start in range(SEEDS):
        found = farthest_meshes(faces, AGREEMENT_LANDMARKS, seed=start, tolerance=LANDMARK_TOLERANCE)
        approximate.append(cluster_by_distance(found.distances, DEFAULT_CLASSES, found.indices)[0])
        columns = similarities(found.distances, float(found.distances.max()))
        embedding = nystrom_embedding(columns, found.indices, DEFAULT_CLASSES)
        by_landmarks.append(_published_labels(embedding, SEEDS + start))
    return {
        "performance": seed,
        "published_with_itself": _mean_index(list(combinations(published, 2))),
        "landmarks_with_all_pairs": _mean_index([(exact, labels) for labels in approximate]),
        "published_by_landmarks": _mean_index(list(product(published, by_landmarks))),
        "ours_with_published": _mean_index([(exact, labels) for labels in published]),
    }


def _published_labels(embedding: FloatArray, seed: int) -> IntArray:
    """Labels as scikit-learn's `SpectralClustering` assigns them: unit eigenvectors, ten random starts."""
    return KMeans(DEFAULT_CLASSES, n_init=10, random_state=seed).fit_predict(embedding)


def _mean_index(pairs: Sequence[tuple[IntArray, IntArray]]) -> float:
    return float(np.mean([adjusted_rand_score(one, other) for one, other in pairs]))

"""Heads for refit tests: small ones, and one surface in two topologies; and a performance of any head."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from headbench.bench.contracts import FrameKey, HeadPose
from headbench.datasets.clip import CaptureClip, FrameFiles, without_images
from headbench.datasets.head.arrays import HeadArrays


def subdivided(head: HeadArrays) -> HeadArrays:
    """The same surface, every triangle cut in four at the middles of its edges, vertices in random order."""
    edges = np.sort(head.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, index = np.unique(edges, axis=0, return_inverse=True)
    old = len(head.template)
    middle = old + index.reshape(-1, 3)  # of edges 01, 12, 20
    a, b, c = head.faces.T
    ab, bc, ca = middle.T
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    faces = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
    order = np.random.default_rng(0).permutation(old + len(unique))
    place = np.argsort(order)  # new index of a vertex

    def along(values):
        values = np.asarray(values, dtype=np.float64)
        return np.concatenate([values, values[unique].mean(axis=1)])[order]

    def members(region):
        both = np.isin(unique, region).all(axis=1)
        return np.sort(place[np.concatenate([region, old + np.flatnonzero(both)])])

    regressor = np.concatenate([head.joint_regressor, np.zeros((5, len(unique)))], axis=1)[:, order]
    lids = None if head.eyelid_basis is None else along(head.eyelid_basis)
    return replace(
        head,
        version=f"{head.version}-subdivided",
        template=along(head.template),
        faces=place[faces],
        shape_basis=along(head.shape_basis),
        expression_basis=along(head.expression_basis),
        pose_basis=along(head.pose_basis),
        joint_regressor=regressor,
        skinning_weights=along(head.skinning_weights),
        eyelid_basis=lids,
        regions={name: members(region) for name, region in head.regions.items() if "ring" not in name},
        landmarks={},
    )


def performance(head: HeadArrays, timesteps: int, *, strength: float = 1.0) -> CaptureClip:
    """A clip without images in which everything moves; expression coefficients have the deviation ``strength``."""
    rng = np.random.default_rng(0)
    size = head.expression_basis.shape[2]
    clock = 0.1 * np.arange(timesteps)

    def curves(count: int) -> np.ndarray:
        return np.sin(clock[:, None] * rng.uniform(0.4, 2.5, count) + rng.uniform(0, 2 * np.pi, count))

    # Six motions that many coefficients share, as a face's do.
    expression = strength * np.sqrt(1 / 3) * curves(6) @ rng.normal(size=(6, size))
    jaw = np.column_stack([0.22 * (1 + curves(1)), 0.04 * curves(2)])
    rotation, neck, eyes, place = 0.3 * curves(3), 0.1 * curves(3), 0.25 * curves(6), 0.02 * curves(3)
    lids = 0.5 * (1 + curves(2))
    poses = {
        t: HeadPose(
            *(head.version, expression[t], rotation[t], neck[t], jaw[t], eyes[t], place[t]),
            eyelids=None if head.eyelid_basis is None else lids[t],
            timestep=t,
        )
        for t in range(timesteps)
    }
    keys = tuple(FrameKey("subject", "EMO", t, "camera") for t in range(timesteps))
    return CaptureClip(
        subject="subject",
        shape=np.asarray(0.8 * rng.normal(size=head.shape_basis.shape[2])),
        splits={"train": keys, "novel_view": (), "self_reenactment": ()},
        files={key: FrameFiles(Path("none"), None) for key in keys},
        **without_images(head, poses),
    )

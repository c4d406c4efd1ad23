"""Clips without images, for steps that only look at poses and splits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from headbench.bench.contracts import FrameKey, HeadPose
from headbench.datasets.clip import CaptureClip, FrameFiles
from headbench.datasets.images import ImageStore

from ..head.toy import toy_head

CAMERAS = ("a", "b")


def make_clip(train: int, test: int = 4, *, seed: int = 0, head=None) -> CaptureClip:
    """Random poses; camera "b" of the training timesteps is the novel view, later timesteps are the test."""
    head = head or toy_head(16)
    rng = np.random.default_rng(seed)
    poses = {
        t: HeadPose(
            head_model=head.version,
            expression=rng.normal(size=head.expression_basis.shape[2]),
            rotation=rng.normal(size=3),
            neck=rng.normal(size=3),
            jaw=0.3 * rng.normal(size=3),
            eyes=0.2 * rng.normal(size=6),
            translation=rng.normal(size=3),
            timestep=t,
        )
        for t in range(train + test)
    }

    def keys(timesteps, cameras):
        return tuple(FrameKey("s", "q", t, c) for t in timesteps for c in cameras)

    splits = {
        "train": keys(range(train), CAMERAS[:1]),
        "novel_view": keys(range(train), CAMERAS[1:]),
        "self_reenactment": keys(range(train, train + test), CAMERAS),
    }
    return CaptureClip(
        subject="s",
        head=head,
        shape=rng.normal(size=head.shape_basis.shape[2]),
        static_offset=0.001 * rng.normal(size=head.template.shape),
        cameras={},
        poses=poses,
        splits=splits,
        excluded={},
        background=np.ones(3),
        steps=(),
        files={key: FrameFiles(Path("none"), None) for part in splits.values() for key in part},
        source_fingerprint="0",
        store=ImageStore(),
    )


def with_poses(clip: CaptureClip, **fields) -> CaptureClip:
    """Copy whose poses have other values: each field a function of the timestep."""
    poses = {t: replace(p, **{k: f(t) for k, f in fields.items()}) for t, p in clip.poses.items()}
    return replace(clip, poses=poses)

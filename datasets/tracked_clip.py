"""The clips of a run with tracking from their images: a registered change of clips."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..bench.contracts import Clip
from ..bench.engine.config import RunConfig
from ..bench.io.arrays import MAX_MAGNITUDE, Member, read_arrays
from ..bench.io.files import digest
from ..bench.progress import progress
from .clip import CaptureClip, as_capture
from .ga.writer import save_npz
from .tracking.landmarks import known_rig_landmarks
from .tracking.network import LandmarkNetwork, NetworkLandmarks, learn_embedding
from .tracking.rig import PoseColumns
from .tracking.track import track

if TYPE_CHECKING:
    from .tracking.track import LandmarkSource

FOLDER = "tracked"
"""Folder of a run with the parameters that were estimated."""


def with_tracking(
    clip: Clip, config: RunConfig, *, landmarks: str = "", embedding: str = "", seed: int = 0
) -> CaptureClip:
    """The clip with the tracking of ``headbench track``, estimated once and kept in ``config.out``.

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
    timesteps = sorted({key.timestep for key in capture.files})
    settings = {"landmarks": Path(landmarks).name, "seed": seed}
    name = digest(capture.fingerprint, settings, embedding)[:16]
    place = Path(config.out) / FOLDER / f"{capture.subject}-{name}.npz"
    if not place.exists():
        with progress(f"tracking {capture.subject}") as report:
            source = _source(capture, landmarks, embedding, seed)
            found = track(capture, [*capture.cameras], source, progress=report).clip
        rows = columns.rows([found.poses[timestep] for timestep in timesteps])
        save_npz(place, {"shape": np.asarray(found.shape), "poses": rows})
    members = {"shape": Member("f", ("S",), MAX_MAGNITUDE), "poses": Member("f", ("T", "D"), MAX_MAGNITUDE)}
    sizes = {"S": capture.head.shape_basis.shape[2], "T": len(timesteps), "D": columns.size}
    stored = read_arrays(place, members, sizes)
    poses = columns.poses(stored["poses"], capture.head, capture.subject, timesteps)
    return capture.derive(
        "track",
        {**settings, "parameters": digest(stored["shape"], stored["poses"])},
        shape=stored["shape"],
        static_offset=np.zeros(capture.head.template.shape, np.float32),
        poses=dict(zip(timesteps, poses)),
    )


def _source(clip: CaptureClip, landmarks: str, embedding: str, seed: int) -> LandmarkSource:
    from .open import open_clip

    if not landmarks:
        return partial(known_rig_landmarks, clip, [*clip.cameras], seed=seed)
    network = LandmarkNetwork(Path(landmarks))
    return NetworkLandmarks(network, learn_embedding(network, open_clip(embedding)), clip, [*clip.cameras])

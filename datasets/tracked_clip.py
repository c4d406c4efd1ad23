"""Replaces the tracking of a run's clips by one estimated from their images; a registered clip transform."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..bench.contracts import Clip
from ..bench.engine.config import RunConfig
from ..bench.io.arrays import MAX_MAGNITUDE, Member, read_arrays
from ..bench.io.files import digest, digest_file
from ..bench.progress import progress
from .clip import CaptureClip, as_capture
from .ga.writer import save_npz
from .open import open_clip
from .tracking.network import landmark_source
from .tracking.rig import PoseColumns
from .tracking.track import track, without_timesteps
from .tracking.work import TRACKER_VERSION

FOLDER = "tracked"
"""Folder of a run with the parameters that were estimated."""


def with_tracking(
    clip: Clip, config: RunConfig, *, landmarks: str = "", embedding: str = "", seed: int = 0
) -> CaptureClip:
    """The clip with the tracking of ``headbench track``, without the frames that it leaves out; estimated once and kept in
    ``config.out``.

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
            found = track(capture, cameras, source, progress=report).clip
        timesteps = sorted(found.poses)
        rows = columns.rows([found.poses[timestep] for timestep in timesteps])
        save_npz(place, {"shape": np.asarray(found.shape), "poses": rows, "timesteps": np.array(timesteps)})
    members = {"shape": Member("f", ("S",), MAX_MAGNITUDE), "poses": Member("f", ("T", "D"), MAX_MAGNITUDE)}
    members["timesteps"] = Member("i", ("T",))
    sizes = {"S": capture.head.shape_basis.shape[2], "D": columns.size}
    stored = read_arrays(place, members, sizes)
    timesteps = stored["timesteps"].tolist()
    poses = columns.poses(stored["poses"], capture.head, capture.subject, timesteps)
    left_out = {key.timestep for key in capture.files}.difference(timesteps)
    return without_timesteps(capture, left_out).derive(
        "track",
        {**settings, "parameters": digest(stored["shape"], stored["poses"])},
        shape=stored["shape"],
        static_offset=np.zeros(capture.head.template.shape, np.float32),
        poses=dict(zip(timesteps, poses)),
    )

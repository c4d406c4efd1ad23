"""The code that stored results of ``headbench track`` depend on."""

from __future__ import annotations

from ...bench.source import code_digest

_MADE_BY = (
    "headbench.bench.landmark_network:LandmarkNetwork",
    "headbench.datasets.tracking.track:track",
    "headbench.datasets.video.clip:open_video",
)


def tracking_code() -> str:
    """Digest of the Python files in the folders of the landmark network, the tracker and the reader of videos.

    It is part of the key of stored results, so that another version of the code does not resume from them.
    """
    return "".join(map(code_digest, _MADE_BY))

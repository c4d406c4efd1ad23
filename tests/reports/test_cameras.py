from headbench.bench.contracts import FrameKey
from headbench.reports.cameras import explained


def keys(subject, cameras):
    return [FrameKey(subject, "FREE", timestep, camera) for camera in cameras for timestep in (0, 1)]


def test_cameras_are_counted_by_subject_if_all_have_as_many():
    frames = [*keys("s1", "abc"), *keys("s2", "abd")]
    text = explained(frames, {("s1", "c"), ("s2", "d")})
    assert text.startswith("Seen cameras (2 scored) have training frames")
    assert text.endswith("unseen cameras (1 scored) have none.")
    assert "scored" not in explained([*frames, *keys("s2", "e")], {("s1", "c"), ("s2", "d")})

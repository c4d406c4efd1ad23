import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.metrics.speed import fps, measure_speed


class Stage:
    """A renderer whose frames last as long as it is told, on a clock of its own."""

    def __init__(self, durations):
        self.now, self.seen, self.durations = 0.0, [], iter(durations)

    def clock(self):
        return self.now

    def render(self, camera, pose):
        self.seen.append((camera, pose))
        self.now += next(self.durations)


WALK = [("a", 0), ("b", 1), ("c", 2)]


def test_statistics_of_known_durations_without_the_warm_up():
    milliseconds = [2.0, 2.0, 2.0, 20.0]
    stage = Stage([5.0, 5.0, *(t / 1000 for t in milliseconds)])
    speed = measure_speed(stage.render, WALK, frames=4, warm_up=2, clock=stage.clock)
    assert speed.frames == 4
    assert speed.fps == pytest.approx(4 / 0.026)  # not 387, the mean of 1/t
    assert speed.median_ms == pytest.approx(2.0)
    assert (speed.p5_ms, speed.p95_ms) == pytest.approx(tuple(np.percentile(milliseconds, [5, 95])))


def test_every_frame_brings_a_new_camera_and_pose_across_the_warm_up():
    stage = Stage([0.001] * 12)
    measure_speed(stage.render, WALK, frames=8, warm_up=4, clock=stage.clock)
    assert stage.seen == [WALK[i % 3] for i in range(12)]


def test_a_slow_renderer_stops_at_the_limit_and_says_how_many():
    stage = Stage([1.0] * 100)
    assert measure_speed(stage.render, WALK, frames=99, warm_up=1, limit_s=2.5, clock=stage.clock).frames == 3


@pytest.mark.parametrize(
    "walk", [[], [("a", 0)], [("a", 0), ("a", 0), ("b", 1)], [("a", 0), ("b", 1), ("a", 0)]]
)
def test_a_workload_that_repeats_a_frame_is_refused(walk):
    with pytest.raises(InputError, match="workload"):
        measure_speed(lambda camera, pose: None, walk)


def test_no_frames_are_refused():
    with pytest.raises(InputError, match="frames"):
        measure_speed(lambda camera, pose: None, WALK, frames=0)


def test_the_metric_times_the_avatar():
    class Avatar:
        calls = 0

        def render(self, camera, pose):
            self.calls += 1

    avatar = Avatar()
    measured = fps(avatar, WALK)
    assert avatar.calls == measured.details["frames"] + 3 == 303
    assert measured.value == pytest.approx(1000 / measured.details["mean_ms"])

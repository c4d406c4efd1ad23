"""The measurement of speed against renderers of a given duration, on a clock of their own."""

import sys
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.contracts import STAGES, HeadPose, StagedAvatar
from headbench.bench.errors import InputError
from headbench.metrics.speed import (
    SpeedProtocol,
    WholeFrames,
    fps,
    fresh_frames,
    latencies,
    measure_speed,
    stage_times,
    throughput,
    warm_up,
)

ZERO = np.zeros(3)
POSES = [
    HeadPose("toy", np.array([i, 0.5]), ZERO, ZERO, ZERO, np.zeros(6), ZERO, None, "s", i) for i in range(3)
]
WORKLOAD = [("a", POSES[0]), ("b", POSES[1]), ("c", POSES[2])]


class Renderer:
    """An avatar whose frames have a given duration."""

    def __init__(self, durations):
        self.now, self.seen, self.durations = 0.0, [], iter(durations)

    def clock(self):
        return self.now

    def render(self, camera, pose):
        self.seen.append((camera, pose))
        self.now += next(self.durations)


class Staged(Renderer):
    """Every stage lasts its own time; a frame drawn is ready only 8 ms later, whoever waits for it."""

    def __init__(self):
        super().__init__([])
        self.costs = {"drive": 0.001, "deform": 0.002, "rasterize": 0.004}

    def draw(self, camera, pose, background, done):
        self.seen.append((camera, pose))
        for stage, cost in self.costs.items():
            self.now += cost
            done(stage)
        return self.now + 0.008

    def read_back(self, drawn):
        self.now = max(self.now, drawn)

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        self.read_back(self.draw(camera, pose, background, lambda stage: None))

    def files(self):
        return []


def constant(seconds):
    while True:
        yield seconds


def test_latencies_are_those_of_known_durations():
    renderer = Renderer([0.002, 0.002, 0.002, 0.020])
    found = latencies(WholeFrames(renderer), fresh_frames(WORKLOAD), 4, 99.0, renderer.clock)
    assert found == pytest.approx([2, 2, 2, 20])


def test_speed_is_that_of_the_mean_time_not_the_mean_of_rates():
    quick = SpeedProtocol(
        warm_up=2, warm_up_limit=2, latency=4, throughput=1, stages=1, one_thread=1, static=2
    )
    durations = [0.005, 0.005, 0.002, 0.002, 0.002, 0.020, 0.1, 0.05, 0.001, 0.003]
    renderer = Renderer(durations)
    measured = measure_speed(renderer, WORKLOAD, quick, renderer.clock)
    assert measured.value == pytest.approx(4 / 0.026)  # not 387
    details = measured.details
    expected = np.percentile([2, 2, 2, 20], [5, 50, 95, 99])
    assert [details[f"p{p}_ms"] for p in (5, 50, 95, 99)] == pytest.approx(list(expected))
    assert (details["frames"], details["max_ms"]) == (4, pytest.approx(20))
    assert details["throughput_fps"] == pytest.approx(10)
    assert details["one_thread_fps"] == pytest.approx(20)
    assert "without_head_fps" not in details
    assert details["static_ms"] == pytest.approx(2)  # of 1 and 3
    assert "raster_ms" not in details
    assert (details["warm_up_frames"], details["stationary"]) == (2, 0)


def test_only_static_frames_repeat_a_pose():
    quick = SpeedProtocol(warm_up=4, warm_up_limit=4, latency=8, throughput=3, one_thread=2, static=5)
    renderer = Renderer(constant(0.001))
    measure_speed(renderer, WORKLOAD, quick, renderer.clock)
    moving, static = renderer.seen[:-5], renderer.seen[-5:]
    assert len(moving) == 4 + 8 + 3 + 2
    assert [camera for camera, _ in moving] == [WORKLOAD[i % 3][0] for i in range(len(moving))]
    signals = {pose.expression.tobytes() for _, pose in moving}
    assert len(signals) == len(moving)
    assert len({id(pose) for _, pose in static}) == 1


@given(st.integers(2, 7), st.integers(1, 40))
def test_a_live_signal_is_new_every_frame_and_near_the_recorded(length, frames):
    workload = [(i, replace(POSES[0], expression=np.array([float(i), -1.0]))) for i in range(length)]
    found = [pair for pair, _ in zip(fresh_frames(workload), range(frames))]
    assert len({pose.expression.tobytes() for _, pose in found}) == frames
    for number, (camera, pose) in enumerate(found):
        assert camera == number % length
        assert np.abs(pose.expression - workload[camera][1].expression).max() < 1e-3
        assert (pose.subject, pose.timestep) == ("", None)
    assert all(a is not b for a, b in pairwise(found))


@pytest.mark.parametrize(
    ("durations", "frames", "steady"),
    [
        ([0.001] * 99, 30, True),
        ([0.1] * 25 + [0.001] * 99, 41, True),  # most of the earlier ten have to be of the new kind
        ([0.001 * 1.01**i for i in range(99)], 60, False),  # 10 % more from ten frames to the next
    ],
)
def test_warm_up_ends_when_times_are_stationary(durations, frames, steady):
    renderer = Renderer(durations)
    plan = SpeedProtocol(warm_up_limit=60, warm_up_s=99)
    assert warm_up(WholeFrames(renderer), fresh_frames(WORKLOAD), plan, renderer.clock) == (frames, steady)


def test_a_slow_renderer_stops_at_the_limits():
    renderer = Renderer([1.0] * 100)
    plan = SpeedProtocol(warm_up_s=1.5, latency_s=2.5, throughput_s=3.5, one_thread_s=1.5, static_s=0.5)
    measured = measure_speed(renderer, WORKLOAD, plan, renderer.clock)
    assert len(renderer.seen) == 2 + 3 + 4 + 2 + 1
    assert (measured.details["warm_up_frames"], measured.details["frames"]) == (2, 3)
    assert measured.value == pytest.approx(1)


def test_stages_are_told_apart_and_reading_back_is_the_last():
    renderer = Staged()
    assert isinstance(renderer, StagedAvatar)
    found = stage_times(renderer, fresh_frames(WORKLOAD), 5, 99.0, renderer.clock)
    assert found == pytest.approx({"drive": 1, "deform": 2, "rasterize": 4, "read_back": 8})
    measured = measure_speed(renderer, WORKLOAD, clock=renderer.clock)
    assert measured.details["p50_ms"] == pytest.approx(15)
    assert measured.details["deform_ms"] == pytest.approx(2)


def test_one_thread_has_rates_with_and_without_the_head_model(monkeypatch):
    threads = {"now": 4, "seen": []}
    torch = SimpleNamespace(
        get_num_threads=lambda: threads["now"],
        set_num_threads=lambda count: threads.update(now=count),
        cuda=SimpleNamespace(is_available=lambda: False),
    )
    monkeypatch.setitem(sys.modules, "torch", torch)

    class Parallel(Staged):
        """Each stage takes its time divided by the threads."""

        def draw(self, camera, pose, background, done):
            self.costs = {name: cost / threads["now"] for name, cost in Staged().costs.items()}
            return super().draw(camera, pose, background, done)

    staged = Parallel()
    found = measure_speed(staged, WORKLOAD, SpeedProtocol(warm_up_limit=3), staged.clock)
    assert threads["now"] == 4
    assert found.details["one_thread_fps"] == pytest.approx(1 / 0.015)
    assert found.value == pytest.approx(1 / (0.007 / 4 + 0.008))
    # Of 15 ms, of which 8 are for reading back, the first stage has 1.
    assert found.details["without_head_fps"] == pytest.approx(1 / 0.014)


def test_throughput_does_not_wait_for_each_frame():
    renderer = Staged()
    found = throughput(renderer, fresh_frames(WORKLOAD), 100, 99.0, 8, renderer.clock)
    assert found == pytest.approx(100 / (100 * 0.007 + 0.008))  # waiting for each: 1 / 0.015
    renderer = Staged()
    waiting = throughput(renderer, fresh_frames(WORKLOAD), 100, 99.0, 0, renderer.clock)
    assert waiting == pytest.approx(1 / 0.015)


def test_a_stage_of_another_name_is_refused():
    renderer = Staged()
    renderer.costs = {"think": 1.0}
    with pytest.raises(InputError, match=r"'think'") as error:
        stage_times(renderer, fresh_frames(WORKLOAD), 5, 99.0, renderer.clock)
    assert all(stage in str(error.value) for stage in STAGES)


@pytest.mark.parametrize(
    "workload",
    [[], WORKLOAD[:1], [WORKLOAD[0], WORKLOAD[0], WORKLOAD[1]], [WORKLOAD[0], WORKLOAD[1], WORKLOAD[0]]],
    ids=len,
)
def test_a_workload_that_repeats_a_frame_is_refused(workload):
    with pytest.raises(InputError, match="workload"):
        fps(Renderer(constant(0.001)), workload)


def test_the_metric_times_the_avatar_by_the_wall_clock():
    class Avatar:
        calls = 0

        def render(self, camera, pose):
            self.calls += 1

    avatar = Avatar()
    measured = fps(avatar, WORKLOAD)
    plan = SpeedProtocol()
    loops = plan.latency + plan.throughput + plan.one_thread + plan.static
    assert avatar.calls == measured.details["warm_up_frames"] + loops
    assert measured.value == pytest.approx(1000 / measured.details["mean_ms"])
    assert all(np.isfinite(value) for value in measured.details.values())

"""The benchmark of the expression classes, and the bounds it has to keep."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from headbench.bench.contracts import no_progress
from headbench.bench.registry import resolve
from headbench.tests.benchmarks.clusters import performed_clip
from headbench.tests.benchmarks.specs import CLUSTERS

MEASURE = """
import json, torch
from headbench.tests.benchmarks.clusters import measure_speed
torch.set_num_threads(2)
print(json.dumps(measure_speed(5000)))
"""


def test_performances_have_the_length_asked_for_and_differ():
    clip = performed_clip(70, seed=0)
    assert sorted(clip.poses) == [key.timestep for key in clip.splits["train"]] == list(range(70))
    again, other = performed_clip(70, seed=0), performed_clip(70, seed=1)
    expressions = [np.array([c.poses[t].expression for t in range(70)]) for c in (clip, again, other)]
    np.testing.assert_array_equal(expressions[0], expressions[1])
    assert not np.allclose(expressions[0], expressions[2])
    assert len(np.unique(expressions[0], axis=0)) == 70
    assert max(pose.jaw[0] for pose in clip.poses.values()) > 0.1  # somebody opens the mouth


@pytest.mark.slow
def test_five_thousand_timesteps_take_a_minute_of_two_cores_and_two_gigabytes_at_most():
    run = subprocess.run([sys.executable, "-c", MEASURE], capture_output=True, text=True, check=True)
    found = json.loads(run.stdout)
    assert found["timesteps"] == sum(found["class_sizes"]) == 5000
    assert found["seconds"] <= 2 * 60  # processor seconds of two threads
    assert found["peak_gb"] <= 2
    assert found["landmarks"] <= 500


@pytest.mark.slow
def test_quick_benchmark_passes():
    findings = resolve(CLUSTERS.speed)(True, no_progress)
    assert findings.passed
    assert [row["timesteps"] for row in findings.data["speed"]] == [300, 1000]

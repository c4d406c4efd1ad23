"""Every benchmark runs at its smallest and has every row, and what it compares computes the same."""

import pytest
import torch

from headbench.bench.contracts import no_progress
from headbench.bench.doctor import findings, table, take_turns
from headbench.bench.registry import discover
from headbench.methods.benchmarks import splats, training
from headbench.methods.benchmarks.splats import cloud
from headbench.methods.splats import available_backends, rasterize

KERNELS = [name for name in available_backends() if name.startswith("cpu-")]
SMALLEST = {
    splats.speed: ({"QUICK_GRID": ((300, 40, 30), (500, 33, 47))}, [*KERNELS, "33x47"]),
    splats.tradeoffs: ({"QUICK_TRADEOFF_SIZE": (600, 48, 40)}, ["exact", "float16", "8/255", "0.05"]),
    training.avatar_speed: ({"QUICK_SIZES": ((700, 40, 32),)}, ["ratio", "deform", "rasterize", "700", "ga"]),
    training.training_speed: ({"SIZE": (40, 32), "QUICK_ROUNDS": 2}, ["ga", "ours", "gbs", "_Rasterize"]),
}


@pytest.mark.commands
@pytest.mark.parametrize("measure", SMALLEST, ids=lambda f: f"{f.__module__}.{f.__name__}")
def test_a_benchmark_has_every_row(measure, monkeypatch):
    sizes, rows = SMALLEST[measure]
    if not KERNELS and "_Rasterize" in rows:
        pytest.skip("the splat kernel is not installed: no C++ compiler was found")
    for key, value in sizes.items():
        assert key in measure.__globals__
        monkeypatch.setitem(measure.__globals__, key, value)
    threads = torch.get_num_threads()
    found = measure(True, no_progress)
    assert [row for row in rows if row not in found.text] == []
    assert "differs by too much" not in found.text
    assert all(found.data.values())
    assert torch.get_num_threads() == threads


@pytest.mark.commands
def test_every_listed_benchmark_is_tried():
    specs = [plugin.spec for plugin in discover("benchmarks").values()]
    named = {name for spec in specs for name in (spec.speed, spec.tradeoffs, spec.stress) if name}
    tried = {f"{f.__module__}:{f.__name__}" for f in SMALLEST}
    others = {"headbench.methods.benchmarks.extremes:stress", "headbench.datasets.head.extremes:stress"}
    assert named == tried | others  # those two in test_extremes.py


def test_runs_take_turns_and_the_first_round_does_not_count():
    order, clock = [], iter(range(100))
    runs = {name: lambda name=name: order.append(name) for name in "ab"}
    assert take_turns(runs, 2, lambda: next(clock)) == {"a": [1, 1], "b": [1, 1]}
    assert order == [*"ababab"]


def test_rows_become_a_table():
    rows = [{"name": "a", "ms": 1.23456}, {"name": "long", "ms": 12345.6, "count": 7}]
    assert table(rows).splitlines() == [
        "name     ms  count",
        "----- ------ -----",
        "a      1.23      -",
        "long  12346      7",
    ]
    found = findings({"Title": rows, "None": []}, "A note.", ["a fault"])
    assert not found.passed
    assert found.data == {"Title": rows, "None": []}
    assert found.text.endswith("A note.\n\na fault")


@pytest.mark.skipif(not KERNELS, reason="the splat kernel is not installed: no C++ compiler was found")
def test_a_row_of_the_renderer_has_what_is_printed():
    row = splats.measure_backend(cloud(40, 33, 29, seed=3, size=0.1), KERNELS[0], 1e9, 1)
    assert row["both"] >= row["forward"] > 0
    assert row["Mpairs/s"] > 0
    assert {"project", "sort", "draw", "draw backward", "speed-up", "% of peak, draw"} <= set(row)


def test_a_contribution_is_the_light_a_splat_sends():
    scene = cloud(12, 20, 18, seed=1, size=0.1)
    weights = splats.contributions(scene, "reference")
    # A channel for each splat, black behind: what a channel sums to is that splat's weights.
    own = scene._replace(colors=torch.eye(12), background=torch.zeros(12))
    image = rasterize(*own[:9], background=own.background, backend="reference").image
    torch.testing.assert_close(weights, image.sum((0, 1)))
    assert weights.max() > 0

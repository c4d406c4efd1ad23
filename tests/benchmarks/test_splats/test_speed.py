"""The speed bench on small scenes: its counts against a brute-force count, its tables against its data."""

import json

import pytest
import torch

from headbench.bench.contracts import no_progress
from headbench.bench.io.files import plain
from headbench.methods.splats import available_backends, cpu
from headbench.tests.benchmarks.splats import anchor, speed
from headbench.tests.benchmarks.splats.layout import table
from headbench.tests.benchmarks.splats.passes import draw, leaves
from headbench.tests.benchmarks.splats.scenes import cloud

KERNELS = [name for name in available_backends() if name.startswith("cpu-")]
needs_kernel = pytest.mark.skipif(
    not KERNELS, reason="the splat kernel is not installed: no C++ compiler was found"
)


def test_tables_are_aligned():
    lines = table(("name", "ms"), [("a", "1.0"), ("longer", "12.5")]).split("\n")
    assert lines == ["name      ms", "------  ----", "a        1.0", "longer  12.5"]


@needs_kernel
@pytest.mark.parametrize("kernel", KERNELS)
def test_contributing_pairs_are_those_with_a_colour_gradient(kernel):
    # One channel per splat, one splat per channel: a pixel's channel is non-zero where its splat contributes.
    scene = cloud(32, 40, 30, seed=4, size=0.1)._replace(colors=torch.eye(32), background=torch.zeros(32))
    rendering = draw(scene, leaves(scene), backend=kernel, threads=1)
    tested, drawn = cpu.work(rendering.image.grad_fn)
    assert drawn == int((rendering.image > 0).sum())
    assert drawn < tested <= 32 * 48 * 32, "tested pairs come in whole blocks"


@needs_kernel
@pytest.mark.parametrize("kernel", KERNELS)
def test_stage_times_add_up(kernel):
    cell = speed.measure_kernel(cloud(400, 64, 64), kernel, 1e9, budget=0, least_runs=3)
    assert cell.stages is not None
    assert all(seconds > 0 for seconds in cell.stages.values())
    assert sum(cell.stages.values()) < cell.both.least * 1.05
    assert cell.forward.least < cell.both.least


@needs_kernel
def test_peak_grows_with_the_instruction_set():
    peaks = [cpu.peak_flops(name) for name in KERNELS]
    assert min(peaks) > 1e8
    assert sorted(peaks, reverse=True) == peaks


@needs_kernel
@pytest.mark.parametrize("with_anchor", [True, False])
def test_every_cell_is_reported(monkeypatch, with_anchor):
    if with_anchor:
        pytest.importorskip("numba", reason="the anchor needs numba, of the extra `bench`")
    else:
        monkeypatch.setattr(anchor, "load", _missing)
    monkeypatch.setattr(speed, "DIAGONAL", ((300, 40, 30), (500, 33, 47)))
    before = torch.get_num_threads()
    findings = speed.measure(True, no_progress)
    assert torch.get_num_threads() == before
    data = json.loads(json.dumps(findings.data, default=plain))
    names = [*KERNELS, *([speed.ANCHOR] if with_anchor else [])]
    assert [(c["splats"], c["backend"]) for c in data["cells"]] == [(n, b) for n in (300, 500) for b in names]
    assert bool(data["anchor_missing"]) != with_anchor
    for cell in data["cells"]:
        assert f"{1e3 * cell['both']['least']:.1f}" in findings.text
        assert (cell["ratio_to_anchor"] is not None) == with_anchor
        if cell["backend"] == speed.ANCHOR:
            assert cell["ratio_to_anchor"] == 1
        checked = cell["splats"] == 300 and cell["backend"] != speed.ANCHOR
        assert (cell["accuracy"] is not None) == checked, "all but the largest scene"
        if checked:
            assert 0 < cell["accuracy"]["image_mean"] < 1e-6
            assert f"{cell['accuracy']['image_mean']:.1e}" in findings.text
            assert 0 < max(cell["accuracy"]["gradients"].values()) < 1e-4
    assert [t["width"] for t in data["threads"]] == [40, 33]
    assert [t["splats"] for t in data["order"]] == [300, 500]
    assert "Threads." in findings.text
    assert "Order in memory" in findings.text


def _missing():
    raise speed.UnavailableError("The anchor needs numba.", "install it")

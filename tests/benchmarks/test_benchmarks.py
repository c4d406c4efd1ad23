"""Every benchmark runs at its smallest, its table has every row, and what it compares computes the same."""

import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import torch

from headbench.bench.contracts import no_progress
from headbench.bench.errors import UnavailableError
from headbench.bench.registry import resolve
from headbench.datasets.head.model import HeadModel
from headbench.datasets.head.procedural.model import procedural_head
from headbench.methods.splats import available_backends, rasterize
from headbench.tests.benchmarks import clusters, images, prepare, refit, statistics, training, viewer
from headbench.tests.benchmarks.avatar import speed as avatar
from headbench.tests.benchmarks.head import speed as head_speed
from headbench.tests.benchmarks.specs import CLUSTERS
from headbench.tests.benchmarks.splats import anchor, order, speed, tradeoffs
from headbench.tests.benchmarks.splats.scenes import cloud, draw, head_shell, leaves
from headbench.tests.benchmarks.statistics import Population

KERNELS = [name for name in available_backends() if name.startswith("cpu-")]
TINY_RECORDING = prepare._Size(64, 96, 2, 7, 1)
SIZES = ((300, 40, 30), (500, 33, 47))

SMALLEST = {
    "splats": (speed, {"DIAGONAL": SIZES}, ["Threads.", "Order in memory", *KERNELS, *("300", "500")]),
    "splats, tradeoffs": (tradeoffs, {"QUICK_SCENE": (600, 48, 40)}, ["exact", "float16", "8/255", "0.05"]),
    "avatar": (avatar, {"QUICK": ((700, 40, 32),)}, ["step of a frame", "saving", "700 splats"]),
    "training": (
        training,
        {"SIZE": (40, 32), "QUICK_SPLATS": 13_000},
        ["ga", "ours", "gbs", "rasterize, backward"],
    ),
    "head": (head_speed, {"FLAME_SIZES": (12, 8), "_QUICK_ROUNDS": 2}, [head_speed.OURS, "readable path"]),
    "metrics": (images, {"QUICK_SIZE": (40, 31)}, ["scikit-image", "torchmetrics", "numpy", "weights"]),
    "prepare": (prepare, {"_QUICK": TINY_RECORDING, "MEMORY_FRAMES": (6, 60)}, ["plain OpenCV loop"]),
    "refit": (
        refit,
        {"QUICK_TIMESTEPS": 3, "QUICK_SCIPY_FRAMES": 1, "FLAME_SIZES": (12, 8)},
        ["procedural 2023 to 2020", "300 + 100, other random bases"],
    ),
    "viewer": (viewer, {"QUICK_SPLATS": (700,), "QUICK_SECONDS": 0.1}, ["700", "images", "splats"]),
    "statistics": (statistics, {"QUICK_TRIALS": 3, "REPLICATES": 20}, list(statistics.CASES)),
}


@pytest.mark.parametrize("name", SMALLEST)
def test_a_benchmark_has_every_row(name, monkeypatch, bare_machine):
    module, sizes, rows = SMALLEST[name]
    if name.startswith("splats") and not KERNELS:
        pytest.skip("the splat kernel is not installed: no C++ compiler was found")
    for key, value in sizes.items():
        assert hasattr(module, key)
        monkeypatch.setattr(module, key, value)
    threads = torch.get_num_threads()
    measure = statistics.run if name == "statistics" else module.measure
    findings = measure(True, no_progress)
    assert [row for row in rows if row not in findings.text] == []
    assert findings.data
    assert torch.get_num_threads() == threads


@pytest.mark.skipif(not KERNELS, reason="the splat kernel is not installed: no C++ compiler was found")
def test_contributing_pairs_are_those_with_a_colour_gradient():
    scene = cloud(40, 33, 29, seed=3, size=0.1)
    for name in KERNELS:
        cell = speed.measure_kernel(scene, name, 1.0, budget=0.0, least_runs=1)
        assert cell.drawn is not None
        assert cell.tested is not None
        assert 0 < cell.drawn <= cell.tested


def test_a_contribution_is_the_light_a_splat_sends():
    scene = cloud(12, 20, 18, seed=1, size=0.1)
    weights = tradeoffs.contributions(scene, "reference")
    # A channel for each splat, black behind: what a channel sums to is that splat's weights.
    own = scene._replace(colors=torch.eye(12), background=torch.zeros(12))
    image = draw(own, leaves(own), backend="reference").image
    torch.testing.assert_close(weights, image.sum((0, 1)).detach())
    assert weights.max() > 0


def test_another_order_of_splats_draws_the_same():
    scene = order.bound_head(procedural_head(), 500, 40, 30)
    shuffled = order.reordered(scene, torch.randperm(500, generator=torch.Generator().manual_seed(0)))
    images = [draw(one, leaves(one), backend="reference").image for one in (scene, shuffled)]
    torch.testing.assert_close(*images, atol=1e-5, rtol=0)


def test_the_anchor_without_numba_names_what_to_install(monkeypatch):
    anchor.load.cache_clear()
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(UnavailableError, match=r"numba.*'\.\[bench\]'"):
        anchor.load()


@pytest.mark.parametrize("make", [head_shell, cloud])
def test_the_anchor_agrees_with_the_reference(make):
    pytest.importorskip("numba", reason="the anchor needs numba, of the extra `bench`")
    scene = make(150, 37, 29, seed=3)
    opacities, colors = (value.double().requires_grad_() for value in (scene.opacities, scene.colors))
    offset = torch.zeros(150, 2, dtype=torch.float64, requires_grad=True)
    geometry = [value.double() for value in scene[:3]]
    expected = rasterize(
        *geometry, opacities, colors, *scene[5:9], background=scene.background, means2d_offset=offset
    )
    upstream = torch.randn(expected.image.shape, generator=torch.Generator().manual_seed(0))
    expected.image.backward(upstream)
    passes = anchor.load()
    frame = passes.forward(scene)
    gradients = passes.backward(scene, frame, upstream.numpy())
    assert (torch.from_numpy(frame.image) - expected.image.detach()).abs().mean() < 1e-6
    for name, leaf in (("means2d", offset), ("opacities", opacities), ("colors", colors)):
        assert leaf.grad is not None
        value = torch.from_numpy(getattr(gradients, name))
        assert (value - leaf.grad).norm() < 1e-4 * leaf.grad.norm(), name


def test_smplx_agrees_with_the_head_model():
    pytest.importorskip("smplx")
    head = head_speed.sized_head("2023", 300, 100)
    theirs, model = head_speed.smplx_forward(head), HeadModel(head)
    shape, pose = head_speed._arguments(model, 2)
    with torch.no_grad():
        ours = model(shape=shape.expand(2, -1), **pose)
        for way in theirs:
            assert (way(shape.expand(2, -1), pose) - ours).abs().max() < 1e-6


def test_scipy_finds_the_meshes_of_the_refit():
    head = procedural_head("2020")
    row = refit.measure_case(head, head, 4, 2)
    assert row["mean_mm"] < 0.02
    assert row["scipy_difference_mm"] < 1e-3


def test_a_plain_opencv_loop_makes_the_pixels_of_prepare(tmp_path):
    recording = prepare._record(tmp_path / "recording", TINY_RECORDING, masks=False)
    loop, ours = tmp_path / "loop", tmp_path / "ours"
    assert prepare._plain_loop(recording, loop, TINY_RECORDING) == prepare._prepare(recording, ours, 2) == 6
    images = {path.name: path for path in ours.rglob("images/*.png")}
    for path in loop.iterdir():
        np.testing.assert_array_equal(cv2.imread(str(path)), cv2.imread(str(images[path.name])))


def test_all_ways_to_a_metric_have_one_value():
    with ThreadPoolExecutor(2) as pool:
        for ways in images.structural_ways(images.noisy_pairs(2, 40, 31), pool).values():
            values = [way() for way in ways.values()]
            assert values == pytest.approx([values[0]] * len(values), abs=1e-3)


def test_both_sides_of_each_saving_compute_the_same(head):
    bench = avatar.Bench(head, 700, 32, 40, budget=0.0, least_runs=1)
    parts = avatar._Parts(bench.avatar, bench.poses[0], bench.cameras[0])
    with torch.no_grad():
        offsets, colors = parts.offsets(), parts.colors()
        assert offsets.abs().max() > 0.01
        pairs = [
            (parts.offsets_by_splat(), offsets),
            (parts.offsets_by_line(), offsets),
            (parts.offsets_by_torch(), offsets),
            (parts.colors_direct(), colors),
            (parts.colors_by_planes(), colors),
            *zip(parts.world(), parts.world_by_torch()),
        ]
        for one, other in pairs:
            np.testing.assert_allclose(one, other, atol=1e-5)
        plain = parts.plain()
    drawn = bench.avatar.render(bench.cameras[0], bench.poses[0])
    np.testing.assert_allclose(plain.rgb, drawn.rgb, atol=1e-4)
    assert drawn.alpha.max() > 0.9


def test_a_few_simulations_keep_the_level_of_the_test():
    found = statistics.calibrate("", Population(7, sequences=2, timesteps=60, correlation=0.9), 80)
    assert found.as_promised
    assert found.rejected <= 0.12
    assert found.frame_test > 0.5
    assert statistics.calibrate("", Population(5, sequences=1, timesteps=10), 3).rejected is None
    assert statistics.best_set_errors(3, 5, 3) == (0, 1)


@pytest.mark.slow
def test_every_simulated_case_keeps_its_level():
    findings = statistics.run()
    assert findings.passed
    cases = {case["case"]: case for case in findings.data["cases"]}
    for name in ("7 subjects", "9 subjects", "9 subjects, 3 seeds", "20 subjects"):
        assert 0.03 <= cases[name]["rejected"] <= 0.07
        assert 0.93 <= cases[name]["covered"] <= 0.97


@pytest.mark.slow
def test_expression_clusters_at_their_quick_size():
    clip = clusters.performed_clip(70, seed=0)
    assert sorted(clip.poses) == list(range(70))
    findings = resolve(CLUSTERS.speed)(True, no_progress)
    assert findings.passed
    assert [row["timesteps"] for row in findings.data["speed"]] == [300, 1000]

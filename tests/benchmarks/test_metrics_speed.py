from concurrent.futures import ThreadPoolExecutor

import pytest

from headbench.tests.benchmarks.image_metrics.speed import measure
from headbench.tests.benchmarks.image_metrics.timing import in_turns
from headbench.tests.benchmarks.image_metrics.ways import noisy_pairs, structural_ways


def test_what_is_compared_has_one_value():
    with ThreadPoolExecutor(2) as pool:
        for ways in structural_ways(noisy_pairs(2, 40, 31), pool).values():
            values = [way() for way in ways.values()]
            assert values == pytest.approx([values[0]] * len(values), abs=1e-3)


def test_ways_take_turns_and_their_least_times_count_per_image():
    order = []
    ways = {name: lambda name=name: order.append(name) or float(len(order)) for name in "ab"}
    timed = in_turns(ways, runs=3, images=2)
    assert order == ["a", "b"] * 3
    assert [way.value for way in timed] == [5.0, 6.0]
    assert all(0 <= way.processor_ms and 0 <= way.wall_ms < 100 for way in timed)


def test_the_report_names_every_way_and_why_one_is_missing(bare_machine):
    findings = measure(quick=True)
    for name in ("scikit-image", "torchmetrics", "numpy and OpenCV", "weights"):
        assert name in findings.text
    assert set(findings.data["ways"]) == {"PSNR + SSIM, valid windows", "PSNR + SSIM, reflected border"}

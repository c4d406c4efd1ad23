"""The benchmark at toy size: both ways make the same images, and memory does not follow the length."""

import cv2
import numpy as np

from headbench.tests.benchmarks import prepare as benchmark

TINY = benchmark._Size(64, 96, 2, 7, 1)


def test_prepare_and_the_plain_loop_make_the_same_pixels(tmp_path):
    recording = benchmark._record(tmp_path / "recording", TINY, mattes=False)
    loop, ours = tmp_path / "loop", tmp_path / "ours"
    count = benchmark._plain_loop(recording, loop, TINY)
    assert count == benchmark._prepare(recording, ours, 2) == 2 * 3
    images = {path.name: path for path in ours.rglob("images/*.png")}
    # The loop numbers cameras by name, prepare by the calibration; a pair of frames differs by its camera's order.
    for path in loop.iterdir():
        twin = images[path.name]
        np.testing.assert_array_equal(cv2.imread(str(path)), cv2.imread(str(twin)))


def test_it_reports_rates_and_memory(monkeypatch):
    monkeypatch.setattr(benchmark, "_QUICK", TINY)
    monkeypatch.setattr(benchmark, "MEMORY_FRAMES", (6, 60))
    findings = benchmark.measure(True)
    assert findings.passed, findings.text
    rows = findings.data["rows"]
    assert len(rows) == 4
    assert all(row["images_per_s"] > 0 for row in rows.values())
    assert rows["video: plain OpenCV loop"]["ratio"] == 1
    assert set(findings.data["peaks"]) == {6, 60}
    assert min(findings.data["peaks"].values()) > 10e6

"""The kit finds what breaks the contract."""

from dataclasses import replace

import numpy as np
import pytest

from headbench import Measurement, UnavailableError, check_metric
from headbench.bench.conformance.methods import check_method
from headbench.bench.contracts import Frame
from headbench.bench.engine.config import resolve_method
from headbench.bench.registry import discover


@pytest.fixture
def metrics(outside):
    import outside_metric

    return outside_metric


def mean(image, truth):
    assert image.shape == truth.shape
    assert image.dtype == truth.dtype == np.uint8
    return float(np.abs(image.astype(int) - truth).mean())


class Counting:
    calls = 0

    def __call__(self, image, truth):
        self.calls += 1
        return mean(image, truth) + 1e-3 * self.calls


class Batched:
    values = staticmethod(lambda pairs: [mean(*pair) + 1 for pair in pairs])

    def __call__(self, image, truth):
        return mean(image, truth)

    def batched(self, pairs):
        return iter(self.values(pairs))


class Short(Batched):
    values = staticmethod(lambda pairs: [mean(*pair) for pair in pairs][1:])


def writing(image, truth):
    value = mean(image, truth)
    if image.flags.writeable:
        image[:] = 0
    return value


def by_layout(image, truth):
    return mean(image, truth) + (0 if image.flags.c_contiguous else 1)


FAULTS = {
    "the other direction": (lambda a, b: -mean(a, b), "higher_is_better is False, but"),
    "a constant": (lambda a, b: mean(a, b) * 0, "higher_is_better is False, but"),
    "infinity": (lambda a, b: mean(a, b) if (a != b).any() else float("inf"), "must be finite"),
    "no number": (lambda a, b: str(mean(a, b)), "a str, not a number"),
    "noise that helps": (
        lambda a, b: mean(a, b) if mean(a, b) < 20 else 5.0,
        "more noise does not give a worse value",
    ),
    "memory of calls": (Counting, "depends on what was compared before"),
    "a changed input": (writing, "changes its input"),
    "a memory layout": (by_layout, "memory layout"),
    "sizes that are cropped": (lambda a, b: mean(a[:, :40], b[:, :40]), "80x96 pixels was accepted"),
    "NaN that is cleaned": (
        lambda a, b: mean(*(np.nan_to_num(x).astype(np.uint8) for x in (a, b))),
        "NaN gives",
    ),
    "an exception": (lambda a, b: a.not_there, "AttributeError"),
    "a batch of other values": (Batched, "batched gives other values"),
    "a batch cut short": (Short, "batched gives 4 values for 5 pairs"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_metric_is_found(metrics, monkeypatch, fault):
    faulty, breach = FAULTS[fault]
    monkeypatch.setattr(metrics, "MeanError", faulty)
    found = check_metric(replace(metrics.ERROR, kind="frame"))
    assert any(breach in one for one in found), found


REGIONS = {
    "empty masks": (lambda values: {**values, "nothing": 0.0}, "in_regions names"),
    "a diluted error": (lambda values: {n: value / 9 for n, value in values.items()}, "far from the value"),
    "the frame's value": (
        lambda values: dict.fromkeys(values, values["everything"]),
        "a fault inside a region",
    ),
    "not a number": (lambda values: dict.fromkeys(values, float("nan")), "a region's value is not finite"),
}


@pytest.mark.parametrize("fault", REGIONS)
def test_a_fault_in_regions_is_found(metrics, monkeypatch, fault):
    change, breach = REGIONS[fault]
    original = metrics.MeanError.in_regions
    monkeypatch.setattr(metrics.MeanError, "in_regions", lambda *arguments: change(original(*arguments)))
    found = check_metric(metrics.ERROR)
    assert any(breach in one for one in found), found


@pytest.mark.parametrize(
    ("spec", "function", "faulty", "breach"),
    [
        ("JUMP", "jump", lambda a, b, c, d: -mean(a, b), "higher_is_better"),
        ("FACE", "face_error", lambda a, b, face: mean(a, b), "in the face does not change the value more"),
        ("FACE", "face_error", lambda a, b, face: mean(a, b), "a mask of another size was accepted"),
        ("FILES", "file_count", lambda avatar, workload: 1.0, "a float, not a Measurement"),
        ("FILES", "file_count", lambda avatar, workload: Measurement(np.inf, {}), "not a finite number"),
        ("HOURS", "hours", lambda record: Measurement(1.0, {}), "a record without any entry was accepted"),
    ],
)
def test_other_kinds_are_checked_by_their_own_protocols(metrics, monkeypatch, spec, function, faulty, breach):
    monkeypatch.setattr(metrics, function, faulty)
    found = check_metric(getattr(metrics, spec))
    assert any(breach in one for one in found), found


def test_what_is_not_installed_is_no_breach(metrics, monkeypatch):
    def absent(image, truth):
        raise UnavailableError("The weights are not here.", "Fetch them.")

    monkeypatch.setattr(metrics, "MeanError", absent)
    with pytest.raises(UnavailableError, match="not here"):
        check_metric(metrics.ERROR)


def own():
    """Metrics of ours that need no file or package from elsewhere; of those of one measurement of speed, the first."""
    specs = [plugin.spec for plugin in discover("metrics").values() if not plugin.spec.needs]
    return [spec for spec in specs if "speed" not in spec.implementation or spec.name == "fps"]


@pytest.mark.parametrize("spec", own(), ids=lambda spec: spec.name)
def test_our_own_metrics_conform(spec):
    assert check_metric(spec) == []


@pytest.fixture
def check(toy, tmp_path):
    def run():
        return check_method(
            resolve_method(toy.METHOD, "smoke", {}), toy.ToyClip(tmp_path / "s"), tmp_path / "out"
        )

    return run


COUNT = iter(range(100))


@pytest.mark.parametrize(
    ("change", "breach"),
    [
        (lambda f: Frame(f.rgb.astype(np.float64), f.alpha), "float32"),
        (lambda f: Frame(f.rgb[1:], f.alpha), "shape"),
        (lambda f: Frame(f.rgb * np.float32(np.nan), f.alpha), "not finite"),
        (lambda f: Frame(f.rgb * 3, f.alpha), "leaves [0, 1]"),
        (lambda f: Frame(f.rgb, f.alpha * 0), "background"),
        (lambda f: Frame(np.full_like(f.rgb, next(COUNT) / 100), f.alpha), "another order"),
    ],
)
def test_a_bad_frame_is_found(toy, monkeypatch, check, change, breach):
    original = toy.ToyAvatar.render
    monkeypatch.setattr(toy.ToyAvatar, "render", lambda *arguments: change(original(*arguments)))
    assert any(breach in found for found in check())


def test_a_file_outside_the_folder_is_found(toy, monkeypatch, check, tmp_path):
    (tmp_path / "elsewhere").write_text("")
    monkeypatch.setattr(toy.ToyAvatar, "files", lambda self: [tmp_path / "elsewhere"])
    assert any("outside" in found for found in check())


def test_progress_that_runs_backwards_is_found(toy, monkeypatch, check):
    original = toy.ToyMethod.fit

    def fit(self, clip, out, budget, *, progress, **rest):
        progress(2, 2)
        progress(1, 2)
        return original(self, clip, out, budget, progress=progress, **rest)

    monkeypatch.setattr(toy.ToyMethod, "fit", fit)
    assert any("backwards" in found for found in check())

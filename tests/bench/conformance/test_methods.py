"""The kit finds what breaks the contract."""

import numpy as np
import pytest

from headbench.bench.conformance.methods import check_method
from headbench.bench.contracts import Frame
from headbench.bench.engine.config import resolve_method


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

"""Coarser planes and lines, and fewer bits, against closed forms."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from headbench.methods.avatars.derived.recipes import (
    coarser_lines,
    coarser_planes,
    fitting_matrix,
    read_reduced,
    write_reduced,
)
from headbench.methods.ops.planes import PAIRS, sample_plane


def ramp_plane(side, channels=2):
    """Values linear over the plane: any resampling that keeps the corners keeps the function."""
    rows, columns = torch.meshgrid(*[torch.linspace(-1, 1, side)] * 2, indexing="ij")
    return torch.stack([1 + (c + 1) * columns - 2 * rows for c in range(channels)], dim=2).reshape(
        side**2, channels
    )


def test_a_linear_plane_reads_the_same_after_resampling():
    tensors = {f"plane_{name}": ramp_plane(33) for name, _, _ in PAIRS}
    coarse = coarser_planes(tensors, 9)
    points = 2 * torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) - 1
    for name, plane in coarse.items():
        assert plane.shape == (81, 2)
        fine = sample_plane(tensors[name], points, 33)
        torch.testing.assert_close(sample_plane(plane, points, 9), fine, atol=1e-5, rtol=0)
    assert coarser_planes(coarse, 9)["plane_xy"] is coarse["plane_xy"]


@given(st.integers(2, 12), st.integers(1, 20), st.integers(0, 99))
def test_what_fewer_samples_can_hold_is_kept_else_the_nearest(fewer, more, seed):
    rng = np.random.default_rng(seed)
    samples = fewer + more
    places = np.linspace(0, 1, samples)
    fit = fitting_matrix(samples, fewer).numpy()
    nodes = np.linspace(0, 1, fewer)

    def read(values):
        return np.interp(places, nodes, values)

    values = rng.standard_normal(fewer)
    np.testing.assert_allclose(fit @ read(values), values, atol=1e-9)
    target = rng.standard_normal(samples)
    best = np.sum((read(fit @ target) - target) ** 2)
    for _ in range(5):
        other = fit @ target + 0.1 * rng.standard_normal(fewer)
        assert best <= np.sum((read(other) - target) ** 2) + 1e-12


def test_lines_are_resampled_each_for_itself():
    lines = torch.randn(2, 3, 17, 4, generator=torch.Generator().manual_seed(2))
    coarse = coarser_lines({"lines": lines}, 5)["lines"]
    assert coarse.shape == (2, 3, 5, 4)
    fit = fitting_matrix(17, 5).float()
    for k, a, c in itertools.product(range(2), range(3), range(4)):
        torch.testing.assert_close(coarse[k, a, :, c], fit @ lines[k, a, :, c])
    same = {"other": lines}
    assert coarser_lines(same, 4) == same
    assert coarser_lines({"lines": coarse}, 5)["lines"] is coarse


@pytest.mark.parametrize(("kind", "bytes_each"), [("half", 2), ("8bit", 1)])
def test_reduced_tensors_come_back_within_their_rounding(tmp_path, kind, bytes_each):
    generator = torch.Generator().manual_seed(1)
    values = torch.randn(500, 4, generator=generator) * torch.tensor([1.0, 100.0, 1e-3, 0.0])
    exact, vector = torch.randn(3, 3, generator=generator), torch.randn(7, generator=generator)
    whole = torch.arange(70_000, dtype=torch.int32)[:, None]
    path = tmp_path / "x.safetensors"
    write_reduced(path, {"values": values, "box": exact, "bias": vector, "whole": whole}, kind, ("box",))
    read = read_reduced(path)
    assert set(read) == {"values", "box", "bias", "whole"}
    assert torch.equal(read["box"], exact)
    assert torch.equal(read["bias"], vector)
    assert torch.equal(read["whole"], whole)
    spread = values.amax(0) - values.amin(0)
    bound = values.abs() * 2**-11 + 2**-25 if kind == "half" else 0.5 * spread / 255 * 1.001 + 1e-9
    assert ((read["values"] - values).abs() <= bound).all()
    assert (read["values"] != values).any()
    assert path.stat().st_size < values.numel() * bytes_each + 4 * 70_000 + 2_000

"""What the benchmark compares: heads of any size, smplx's two ways, least times."""

import numpy as np
import pytest
import torch

from headbench.bench.contracts import no_progress
from headbench.datasets.head.model import HeadModel
from headbench.tests.benchmarks.head import speed
from headbench.tests.benchmarks.head.sized import sized_head
from headbench.tests.benchmarks.head.smplx_flame import smplx_forward


@pytest.fixture(scope="module")
def head():
    return sized_head("2023", 300, 100)


def test_bases_have_the_size_and_full_rank(head):
    assert (head.shape_basis.shape[2], head.expression_basis.shape[2]) == (300, 100)
    head.validate("sized head")
    face = head.expression_basis[head.regions["face"]].reshape(-1, 100).astype(float)
    assert np.linalg.matrix_rank(face) == 100
    assert head.pose_basis.any(axis=(0, 1)).all()
    rms = np.sqrt(np.square(head.shape_basis).sum(axis=1).mean(axis=0))
    assert (np.diff(rms[::30]) < 0).all()


def test_smplx_agrees_both_ways(head):
    pytest.importorskip("smplx")
    theirs, model = smplx_forward(head), HeadModel(head)
    shape, pose = speed._arguments(model, 2)
    with torch.no_grad():
        ours = model(shape=shape.expand(2, -1), **pose)
        for way in theirs:
            assert (way(shape.expand(2, -1), pose) - ours).abs().max() < 1e-6


def test_the_whole_measurement(monkeypatch):
    monkeypatch.setattr(speed, "FLAME_SIZES", (12, 8))
    monkeypatch.setattr(speed, "_QUICK_ROUNDS", 2)
    threads = torch.get_num_threads()
    findings = speed.measure(True, no_progress)
    ways = {row["way"] for row in findings.data["rows"]}
    assert speed.OURS in ways
    assert len(findings.data["rows"]) == len(ways) * len(speed.BATCHES)
    assert all(row["ms_per_frame"] > 0 for row in findings.data["rows"])
    assert torch.get_num_threads() == threads

"""Errors by region against displacements that are known."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.tracking.track import error_regions, mesh_errors, tracking_errors

from .head.toy import toy_head


def test_a_shift_is_absolute_and_a_shift_that_changes_is_motion():
    wanted = np.random.default_rng(0).standard_normal((4, 20, 3))
    motions = np.tile(np.eye(3), (4, 1, 1))
    found = mesh_errors(wanted + [0, 0.003, 0.004], wanted, motions)
    assert found == pytest.approx((5, 0, 0), abs=1e-9)
    moved = wanted[:2] + np.array([[[0.001, 0, 0]], [[-0.001, 0, 0]]])
    assert mesh_errors(moved, wanted[:2], motions[:2]).motion == pytest.approx(1)


def test_regions_do_not_overlap():
    regions = error_regions(toy_head(24))
    inner = [regions[name] for name in ("face", "lips", "lids", "eyeballs") if name in regions]
    together = np.concatenate(inner)
    assert len(together) == len(np.unique(together))
    assert {"face", "lips", "eyeballs"} <= set(regions)


def test_a_translated_clip(pristine_capture):
    exact = read_capture(pristine_capture.union)
    poses = {
        t: replace(p, translation=np.asarray(p.translation) + [0, 0, 0.002]) for t, p in exact.poses.items()
    }
    errors = tracking_errors(replace(exact, poses=poses), exact)
    for error in errors.values():
        assert error.absolute == pytest.approx(2, abs=1e-3)
        assert error.affine == pytest.approx(0, abs=1e-3)


def test_another_topology_is_refused(pristine_capture):
    clip = read_capture(pristine_capture.union)
    with pytest.raises(InputError, match="topology"):
        tracking_errors(replace(clip, head=toy_head(24)), clip)

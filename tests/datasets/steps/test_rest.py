"""Expressions that are not zero at rest: the same posed meshes from another mesh at zero."""

import numpy as np
import pytest

from headbench.bench.engine.config import RunConfig
from headbench.bench.errors import InputError
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.steps.rest import with_rest_expression

CONFIG = RunConfig(data="", out="")


def test_posed_meshes_are_equal_and_the_mesh_at_zero_is_not(clip):
    changed = with_rest_expression(clip, CONFIG, millimetres=2.0)
    poses = [*clip.poses.values()]
    before, after = PosedSubject.of(clip), PosedSubject.of(changed)
    assert np.abs(after.meshes([*changed.poses.values()]) - before.meshes(poses)).max() < 1e-6
    face = np.unique(clip.head.faces[np.isin(clip.head.faces, clip.head.regions["face"]).all(1)])
    moved = np.linalg.norm(changed.static_offset - clip.static_offset, axis=1)[face]
    assert np.median(moved) == pytest.approx(2e-3, rel=1e-3)
    assert changed.fingerprint != clip.fingerprint
    assert changed.image(next(iter(changed.files))) is not None


def test_a_distance_that_is_none_is_refused(clip):
    with pytest.raises(InputError, match="millimetres: expected a number above 0, found 0"):
        with_rest_expression(clip, CONFIG, millimetres=0)

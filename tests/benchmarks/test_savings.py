"""The benchmark compares ways to the same numbers; and says how long they take."""

import numpy as np
import pytest
import torch

from headbench.tests.benchmarks.avatar.savings import Bench, _Parts
from headbench.tests.benchmarks.avatar.untrained import cameras_around, random_poses, untrained_avatar


@pytest.fixture(scope="module")
def bench(head):
    return Bench(head, 700, 32, 40, budget=0.0, least_runs=1)


def test_both_sides_of_each_pair_give_the_same(bench):
    parts = _Parts(bench.avatar, bench.poses[0], bench.cameras[0])
    with torch.no_grad():
        offsets = parts.offsets()
        assert offsets.abs().max() > 0.01
        np.testing.assert_allclose(parts.offsets_by_splat(), offsets, atol=1e-5)
        np.testing.assert_allclose(parts.offsets_by_line(), offsets, atol=1e-5)
        assert bench.avatar.line_offsets is not None
        inside = offsets[bench.avatar.line_offsets.inside]
        np.testing.assert_allclose(parts.offsets_by_torch(), inside, atol=1e-5)
        assert 0.1 < parts.units_on() < 0.9
        for one, other in zip(parts.world(), parts.world_by_torch()):
            np.testing.assert_allclose(one, other, atol=1e-6)
        np.testing.assert_allclose(parts.colors_direct(), parts.colors(), atol=1e-5)
        np.testing.assert_allclose(parts.colors_by_planes(), parts.colors(), atol=1e-5)
        plain = parts.plain()
    drawn = bench.avatar.render(bench.cameras[0], bench.poses[0])
    np.testing.assert_allclose(plain.rgb, drawn.rgb, atol=1e-4)
    assert drawn.alpha.max() > 0.9


def test_every_step_and_saving_is_timed(bench):
    stages = dict(bench.stages())
    assert len(stages) == 6
    pairs = list(bench.pairs())
    assert len({pair.name for pair in pairs}) == len(pairs) == 11
    assert all(ms > 0 for ms in stages.values())
    assert all(pair.before > 0 < pair.after for pair in pairs)
    # What takes a hundredth of the multiplications is faster even at this size.
    by_line = next(pair for pair in pairs if "blended once" in pair.name)
    assert by_line.after < by_line.before


def test_the_head_is_in_view_of_every_camera(head):
    for camera in cameras_around(head, 3, 60, 80):
        points = head.template @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        pixels = (points @ camera.K.T)[:, :2] / points[:, 2:]
        assert points[:, 2].min() > 0
        assert pixels[:, 1].min() >= 0
        assert pixels[:, 1].max() <= 80
        assert np.ptp(pixels[:, 1]) > 0.7 * 80


def test_an_untrained_avatar_has_as_many_splats_as_asked_for(head):
    avatar = untrained_avatar(head, 123)
    first, second = random_poses(head, 2)
    assert len(avatar.splats(first).means) == 123
    assert np.abs(avatar.splats(first).opacities - avatar.splats(second).opacities).max() > 1e-3

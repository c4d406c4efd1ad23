"""A head with texture coordinates: where the methods that place splats on its chart put them."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.datasets.head.arrays import read_head
from headbench.methods.flashavatar.method import FlashAvatar, FlashAvatarTraining
from headbench.methods.flashavatar.spec import FlashAvatarConfig
from headbench.methods.rgbavatar.method import RGBAvatarTraining
from headbench.methods.rgbavatar.spec import RGBAvatarConfig

from .flashavatar.small import SMALL as FLASHAVATAR
from .rgbavatar.small import SMALL as RGBAVATAR

UNCHARTED = 10
"""Triangles without a place in the chart."""


@pytest.fixture(scope="module")
def charted(clip):
    uv = np.random.default_rng(0).random((len(clip.head.faces), 3, 2)).astype(np.float32)
    uv[:UNCHARTED] = 0
    border = np.unique(clip.head.faces[-5:])
    head = replace(clip.head, uv=uv, regions={**clip.head.regions, "boundary": border})
    return replace(clip, head=head)


@pytest.mark.parametrize(
    ("training", "config"),
    [
        (RGBAvatarTraining, RGBAvatarConfig(**RGBAVATAR)),
        (FlashAvatarTraining, FlashAvatarConfig(**FLASHAVATAR)),
    ],
)
def test_splats_are_on_the_texels_of_the_chart(charted, clip, training, config):
    points = training(charted, config, "cpu", 0).points
    assert len(points.triangles) == pytest.approx(config.samples, rel=0.3)
    assert points.triangles.min() >= UNCHARTED
    border = np.isin(charted.head.faces[points.triangles], charted.head.regions["boundary"]).any()
    assert border == (training is RGBAvatarTraining)
    off = training(charted, replace(config, uv_chart=False), "cpu", 0).points
    without = training(clip, config, "cpu", 0).points
    for one, other in zip(off, without):
        np.testing.assert_array_equal(one, other)


def test_an_avatar_keeps_its_points_and_the_chart(charted, tmp_path):
    method = FlashAvatar(FlashAvatarConfig(**FLASHAVATAR))
    avatar = method.fit(charted, tmp_path, Budget(iterations=2), device="cpu", seed=0, progress=no_progress)
    points = FlashAvatarTraining(charted, FlashAvatarConfig(**FLASHAVATAR), "cpu", 0).points
    np.testing.assert_array_equal(avatar.stored.points.triangles, points.triangles)
    heads = [read_head(path) for path in tmp_path.rglob("head*.npz")]
    assert heads
    assert all(np.array_equal(head.uv, charted.head.uv) for head in heads)

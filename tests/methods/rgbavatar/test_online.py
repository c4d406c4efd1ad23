"""Local-global sampling: images that have arrived, mostly the newest ones, and a uniform sample of the others."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chisquare

from headbench.methods.rgbavatar.method import GLOBAL, LOCAL, OnlineBatches, RGBAvatarTraining
from headbench.methods.rgbavatar.spec import RGBAvatarConfig
from headbench.methods.shared.schedule import Timeline

from .small import SMALL


def test_no_image_is_drawn_before_it_arrives_or_twice_in_a_batch():
    batches = OnlineBatches(range(3_000), 10, 25, seed=0)
    for iteration in (1, 2, 3, 50, 400, 2_000, 20_000):
        batch, arrived = batches.batch(iteration), min(3_000, 10 + (iteration - 1) * 10 // 25)
        assert batches.arrived(iteration) == arrived
        assert len(set(batch)) == len(batch) == 10
        assert max(batch) < arrived


def test_a_batch_depends_on_its_number_alone():
    one, other = (OnlineBatches(range(3_000), 10, 5, seed=0) for _ in range(2))
    numbers = [1_400, 3, 700, 1_400, 90]
    found = {number: one.batch(number) for number in sorted(set(numbers))}
    assert [other.batch(number) for number in numbers] == [found[number] for number in numbers]


@pytest.mark.parametrize(("arrived", "share"), [(150, 0.0), (450, 0.7 * 300 / 599), (749, 0.7), (2_000, 0.7)])
def test_the_share_of_older_images_rises_to_its_maximum(arrived, share):
    batches = OnlineBatches(range(arrived), 10, 1, seed=0)
    draws = [image for iteration in range(arrived, arrived + 400) for image in batches.batch(iteration)]
    older = np.mean(np.array(draws) < arrived - LOCAL)
    assert older == pytest.approx(share, abs=0.04)


def test_newer_ones_of_the_newest_are_more_probable():
    batches = OnlineBatches(range(LOCAL), 1, 1, seed=0)
    draws = Counter(batches.batch(iteration)[0] for iteration in range(LOCAL, LOCAL + 6_000))
    weights = np.exp(np.arange(LOCAL) / LOCAL)
    expected = 6_000 * weights / weights.sum()
    assert chisquare([draws[image] for image in range(LOCAL)], expected).pvalue > 1e-3


def test_the_kept_ones_are_a_uniform_sample():
    """Kept shares of the first, second and last third of the older images, over seeds."""
    count, kept = 3_000, np.zeros(3)
    for seed in range(20):
        places = np.array(OnlineBatches(range(count), 10, 1, seed=seed)._older(count))
        assert len(set(places.tolist())) == GLOBAL
        kept += np.bincount(places * 3 // count, minlength=3)
    assert chisquare(kept).pvalue > 1e-3


def test_the_first_batches_have_what_is_there():
    assert sorted(OnlineBatches((4, 2, 0), 10, 25, seed=0).batch(1)) == [0, 2, 4]


def test_timesteps_arrive_in_order(clip):
    config = RGBAvatarConfig(**{**SMALL, "online": True, "together": 1, "batch": 2, "join": 20})
    training = RGBAvatarTraining(clip, config, "cpu", 0)
    training.begin(Timeline(24, 24))
    assert {training.keys[image].timestep for image in training._batches.batch(1)} == {0}
    training.loss(1, 0).backward()
    assert training.optimiser["color_shapes"].grad is not None
    assert len(training.result().points.triangles) == len(training.colored)  # none is removed
    training.close()
    with pytest.raises(ValueError, match="together"):
        replace(config, together=2)

"""Random numbers as functions of seed, stream and position."""

import torch

from headbench.methods.shared.schedule import numpy_generator, torch_generator


def draw(*where):
    return torch.rand(4, generator=torch_generator(*where)).tolist()


def test_equal_places_give_equal_numbers_and_others_do_not():
    places = [(0, "a", 0), (1, "a", 0), (0, "b", 0), (0, "a", 1)]
    assert all(draw(*place) == draw(*place) for place in places)
    assert len({tuple(draw(*place)) for place in places}) == 4
    assert numpy_generator(0, "a").random() != numpy_generator(1, "a").random()


def test_the_global_generator_is_left_alone():
    torch.manual_seed(0)
    before = torch.random.get_rng_state()
    draw(0, "a", 0)
    assert torch.equal(torch.random.get_rng_state(), before)

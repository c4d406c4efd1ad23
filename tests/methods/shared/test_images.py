"""Training images: the right one, once, and faults reported where they are."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.methods.shared.loop import TrainingImages
from headbench.methods.shared.schedule import ShuffledEpochs


class Counting:
    """A clip that remembers who asked for what."""

    def __init__(self, clip):
        self.clip, self.cameras, self.asked, self.threads = clip, clip.cameras, [], set()

    def image(self, key):
        self.asked.append(key)
        self.threads.add(threading.get_ident())
        return self.clip.image(key)


def test_images_come_in_sampler_order_decoded_once_and_ahead(clip):
    keys = clip.splits["train"]
    sampler = ShuffledEpochs(len(keys), 0)
    counting = Counting(clip)
    images = TrainingImages(counting, keys, sampler, "cpu")
    for iteration in range(1, 10):
        image = images.get(iteration, sampler(iteration))
        expected = clip.image(keys[sampler(iteration)]) / np.float32(255)
        np.testing.assert_allclose(image, expected, atol=1e-7)
    images.close()
    assert counting.asked == [keys[sampler(i)] for i in range(1, 1 + len(counting.asked))]
    assert len(counting.asked) in (9, 10)  # the tenth was begun, or cancelled
    assert threading.get_ident() not in counting.threads


def test_a_jump_in_the_order_is_served(clip):
    keys = clip.splits["train"]
    images = TrainingImages(clip, keys, ShuffledEpochs(len(keys), 0), "cpu")
    for index in (3, 1, 1, 0):
        np.testing.assert_allclose(images.get(1, index), clip.image(keys[index]) / 255.0, atol=1e-7)
    images.close()


def test_mattes_come_as_a_fourth_channel(clip):
    keys = clip.splits["train"]
    images = TrainingImages(clip, keys, ShuffledEpochs(len(keys), 0), "cpu", masks=True)
    image = images.get(1, 2)
    images.close()
    np.testing.assert_allclose(image[:, :, :3], clip.image(keys[2]) / np.float32(255), atol=1e-7)
    np.testing.assert_allclose(image[:, :, 3], clip.mask(keys[2]) / np.float32(255), atol=1e-7)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("image", lambda c: {"cameras": {n: replace(v, width=v.width + 1) for n, v in c.cameras.items()}}),
        ("mask", lambda c: {"masks": dict.fromkeys(c.masks)}),
        ("mask", lambda c: {"masks": dict.fromkeys(c.masks, np.zeros((3, 3), np.uint8))}),
    ],
)
def test_pixels_that_are_missing_or_do_not_fit_are_input_errors(clip, name, change):
    keys = clip.splits["train"]
    images = TrainingImages(replace(clip, **change(clip)), keys, ShuffledEpochs(1, 0), "cpu", masks=True)
    with pytest.raises(InputError) as caught:
        images.get(1, 0)
    images.close()
    assert caught.value.key == name

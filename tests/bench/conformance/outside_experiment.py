"""A change of clips as somebody outside writes it: noise in the training images."""

import zlib

import numpy as np

from headbench import ConditionSpec


class NoisyClip:
    """A clip whose images have Gaussian noise; all else is the clip's own."""

    def __init__(self, clip, deviation):
        self._clip, self._deviation = clip, deviation
        self.fingerprint = f"{clip.fingerprint}-noise-{deviation:g}"

    def __getattr__(self, name):
        return getattr(self._clip, name)

    def image(self, key):
        """(H, W, 3) 8-bit sRGB with noise, the same each time."""
        image = self._clip.image(key)
        random = np.random.default_rng(zlib.crc32(str(key).encode()))
        return np.rint(image + random.normal(0, self._deviation, image.shape)).clip(0, 255).astype(np.uint8)


def with_noise(clip, config, *, deviation):
    return NoisyClip(clip, deviation)


NOISE = ConditionSpec("noise", "Noise in training images.", "clip", "outside_experiment:with_noise")

"""An experiment as somebody outside writes it: how much noise in training images a method tolerates.

A registered change of clips, and a run with a condition for each level of noise.
"""

import zlib
from dataclasses import dataclass

import numpy as np

import headbench as hb
from headbench import PLAIN, CommandResult, CommandSpec, Condition, ConditionSpec, Named, Progress


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
    """The clip with noise of a standard deviation, in levels of 255."""
    return NoisyClip(clip, deviation)


NOISE = ConditionSpec(
    name="noise",
    summary="Trains on images with Gaussian noise.",
    kind="clip",
    implementation="outside_experiment:with_noise",
)


@dataclass(frozen=True)
class NoiseSettings:
    """Quality over the noise of the training images. The scored frames have none."""

    data: str
    """Capture."""

    out: str
    """Folder of the run."""

    methods: tuple[str, ...] = ("ours",)
    """Methods to train."""

    deviations: tuple[float, ...] = (5.0, 20.0)
    """Standard deviations of the noise, in levels of 255."""

    preset: str = "fast"
    """How much training."""


COMMAND = CommandSpec(
    name="noise",
    group="compare",
    summary="Train on images with noise and measure on images without.",
    settings="outside_experiment:NoiseSettings",
    function="outside_experiment:noise",
)


def noise(settings: NoiseSettings, progress: Progress) -> CommandResult:
    """Train under each condition, by the engine that runs every comparison; print the table."""
    conditions = [PLAIN] + [
        Condition(f"noise-{each:g}", clip=Named("outside_experiment:NOISE", {"deviation": each}))
        for each in settings.deviations
    ]
    run = hb.run(
        settings.data,
        settings.out,
        methods=settings.methods,
        preset=settings.preset,
        conditions=conditions,
    )
    table = hb.read_runs([run]).table()
    return CommandResult(table.to_string(), table.to_dict())

"""RGBAvatar: splats on a tracked mesh with a few learnt blendshapes.

Li et al., "RGBAvatar: Reduced Gaussian Blendshapes for Online Modeling of Head Avatars", CVPR 2025, arXiv 2503.12886.

Training is on batches of images. Colours are taken from them at the start, and blendshapes join later.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Changes, Clip, FloatArray, HeadPose
from ...bench.native.dispatch import to_device
from ..avatars.compact.layouts import read_coded, reduced
from ..avatars.harmonics import DEGREE
from ..ops.photometric import photometric_loss
from ..ops.planes import C0, coefficient_count
from ..ops.splats import TriangleFrames, WorldSplats
from ..shared.loop import recomposited
from ..shared.optimisation import initial_network, tracked_inputs
from ..shared.rendering import PlacedSplats, View, changes_of, pixel_sums, rasterize_view
from ..shared.schedule import Batches, GroupedBatches, log_linear, numpy_generator
from ..shared.splat_training import initial_shapes
from ..shared.surface_splats import SurfaceAvatar, SurfaceMethod, SurfaceTrainer
from .model import PER_SPLAT, SHAPES, StoredShapes, blend_weights, blended, seen_colors
from .spec import LOCAL, OFFICIAL_LEAST, RGBAvatarConfig
from .spec import RGBAVATAR as SPEC

GLOBAL = 1_000
"""Size of the global pool: frames kept of those older than the newest `LOCAL`."""
MOST_GLOBAL, RAMP = 0.7, 599
"""Maximum share of draws from the global pool, and the number of older frames at which it is reached."""


class OnlineBatches(Batches):
    """Batches of the images that have arrived so far, mostly the newest.

    Each draw is from the global pool with a probability that rises with the number of older images, else from the newest
    `LOCAL`, where newer ones are more probable. The global pool is a uniform sample of `GLOBAL` older images
    (reservoir sampling; Vitter, ACM TOMS 1985, algorithm R).

    - ``order``: indices of the images in the order of their arrival.
    - ``size``: images of a batch, at most `LOCAL`; fewer before that many have arrived.
    - ``trained``: images trained on for each that arrives.
    """

    def __init__(self, order: Sequence[int], size: int, trained: int, seed: int):
        super().__init__(size)
        self._images, self._trained, self._seed = tuple(order), trained, seed
        self._kept: list[int] = []
        self._passed = 0

    def arrived(self, iteration: int) -> int:
        """Number of images available to a batch; those of the first batch are available from the start."""
        return min(len(self._images), self._size + (iteration - 1) * self._size // self._trained)

    def batch(self, iteration: int) -> tuple[int, ...]:
        """The images of a batch, each once."""
        random, arrived = numpy_generator(self._seed, "online", iteration), self.arrived(iteration)
        older = max(arrived - LOCAL, 0)
        size = min(self._size, arrived)
        share = MOST_GLOBAL * min(older / RAMP, 1.0)
        kept = self._older(older)
        from_older = min(int((random.random(size) < share).sum()), len(kept))
        newest = np.arange(older, arrived)
        weights = np.exp((np.arange(len(newest)) + LOCAL - len(newest)) / LOCAL)
        places = random.choice(newest, size - from_older, replace=False, p=weights / weights.sum()).tolist()
        places += random.choice(kept, from_older, replace=False).tolist() if from_older else []
        return tuple(self._images[place] for place in places)

    def _older(self, count: int) -> list[int]:
        """Places of the kept images among the first ``count``."""
        if count < self._passed:
            self._kept, self._passed = [], 0
        for place in range(self._passed, count):
            if place < GLOBAL:
                self._kept.append(place)
                continue
            replaced = int(numpy_generator(self._seed, "reservoir", place).integers(place + 1))
            if replaced < GLOBAL:
                self._kept[replaced] = place
        self._passed = count
        return self._kept


class RGBAvatarTraining(SurfaceTrainer[RGBAvatarConfig]):
    """A `Trainable`: neutral splats, grey and of equal size at first, their blendshapes, and the network of the weights.

    ``colored``: (N,) bool, splats with a colour initialised from images.
    """

    stored_class = StoredShapes

    def __init__(self, clip: Clip, config: RGBAvatarConfig, device: str, seed: int):
        keys, together = clip.splits["train"], config.together
        batches: Batches = GroupedBatches([key.timestep for key in keys], config.batch, together, seed)
        if config.online:
            order = sorted(range(len(keys)), key=lambda index: (keys[index].timestep, keys[index].camera))
            batches = OnlineBatches(order, config.batch, config.trained_per_arrival, seed)
        super().__init__(clip, config, batches, config.inputs, device, seed, masks=True)
        self._batches, self._sampler = batches, lambda iteration: batches.batch(iteration)[0]
        count = len(self.rest)
        self.colored = torch.zeros(count, dtype=torch.bool, device=device)
        self._official = config.color_init_variant == "official"
        self._seen: list[tuple[WorldSplats, Tensor, View, Tensor]] = []
        self._unfinished = False
        splats = {
            "means": (torch.zeros(count, 3), config.position_lr),
            "colors": (torch.zeros(count, 3), config.color_lr),
            **initial_shapes(np.full(count, config.initial_scale(count)), config),
        }
        shares = config.position_share, config.rotation_share, config.color_share
        for (name, shapes), share in zip(SHAPES.items(), shares):
            value, rate = splats[name]
            splats[shapes] = torch.zeros(config.blendshapes, *value.shape), share * rate
        sizes = self._inputs.shape[1], config.hidden, config.hidden, config.blendshapes
        network = initial_network(sizes, seed)
        self._optimise(splats | {name: (value, config.network_lr) for name, value in network.items()})

    def loss(self, iteration: int, index: int) -> Tensor:
        """Mean loss of the images of a batch; ``index`` is that of the first."""
        self._finish_step()
        self._seen = []
        images, splats = self._batches.positions(iteration), self.tensors()
        rows = sorted({self._tracked.row[self.keys[image].timestep] for _, image in images})
        posed = [splats] * len(rows)
        if self._config.online or iteration > self._timeline.at(self._config.join):
            posed = blended(splats, blend_weights(splats, self._inputs[rows]))
        placed = {
            row: (self._surface.place(self._frames(row), each), seen_colors(each["colors"]))
            for row, each in zip(rows, posed)
        }
        opacities = splats["opacities"].sigmoid()
        total = opacities.new_zeros(())
        for position, image in images:
            key = self.keys[image]
            view, (world, colors) = self._views[key.camera], placed[self._tracked.row[key.timestep]]
            pixels = self._images.get(position, image)
            truth, background = self._on_background(pixels, iteration, image)
            rendering = rasterize_view(world, opacities, colors, view, background)
            total = total + photometric_loss(rendering.image, truth, self._config.ssim_weight)
            self._seen.append((world, opacities, view, pixels))
        return total / len(images)

    def after_backward(self, iteration: int) -> None:
        """Initialise colours of splats seen for the first time; set the learning rates."""
        config = self._config
        due = config.color_weight > 0 and (iteration - 1) % config.color_every == 0
        if not due or bool(self.colored.all()):
            self._seen = []
        self._unfinished = self._official
        if not self._official:
            self._still(self._take_colors())
        # Online, time counts from the first image, regardless of the run's length. The first step has the initial rate.
        settles = config.position_settles if config.online else self._timeline.at(config.position_settles)
        rate = log_linear(config.position_lr, config.position_lr_final, (iteration - 1) / max(settles, 1))
        self.optimiser.set_learning_rate("means", rate)
        self.optimiser.set_learning_rate(SHAPES["means"], config.position_share * rate)
        self._decay_rates(iteration, apart=("means", SHAPES["means"]))

    def state(self) -> dict[str, Any]:
        """Parameters, moments, and which splats have a colour."""
        self._finish_step()
        return {**super().state(), "colored": self.colored}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        super().load_state(state)
        self.colored = state["colored"]

    def result(self) -> StoredShapes:
        """The trained avatar without splats never seen: those that never had a gradient, or never got a colour ("official")."""
        self._finish_step()
        moments = self.optimiser.moments("colors")
        visible = self.colored
        if not self._official:
            visible = visible | (moments["exp_avg_sq"] > 0).any(1) if moments else torch.ones_like(visible)
        kept = torch.ones_like(visible) if self._config.online or not bool(visible.any()) else visible
        tensors = self.tensors()
        tensors |= {name: tensors[name][kept] for name in PER_SPLAT}
        tensors |= {name: tensors[name][:, kept] for name in SHAPES.values()}
        return StoredShapes(tensors, self.points.rows(kept.cpu().numpy()), self._config)

    def _on_background(self, pixels: Tensor, iteration: int, image: int) -> tuple[Tensor, Tensor]:
        """(H, W, 3) colours, on a random background if there are masks, and that background."""
        if not self._masked or not self._config.random_background:
            return pixels[:, :, :3], self._background
        random = numpy_generator(self._seed, "background", iteration * len(self.keys) + image).random(3)
        background = to_device(torch.from_numpy(random.astype(np.float32)), self._background.device)
        return recomposited(pixels[:, :, :3], pixels[:, :, 3:], self._background, background), background

    def _finish_step(self) -> None:
        """Set the colours found in the last step if the variant sets them after it; none without a step, as in timing."""
        if self._unfinished:
            self._unfinished = False
            self._take_colors()

    def _take_colors(self) -> Tensor:
        """Set colours of splats whose weights over the batch's foreground add up to enough for the first time; return their rows.

        The colour is the mean over pixels, weighted by the splat's blending weight.
        """
        seen, self._seen = self._seen, []
        sums = torch.zeros(len(self.colored), 4, device=self.colored.device)
        for world, opacities, view, pixels in seen:
            colors, coverage = pixels[:, :, :3], pixels[:, :, 3:]
            if self._masked and self._official:  # without the background
                colors = (colors - (1 - coverage) * self._background) / coverage.clamp(min=0.5)
            truth = torch.cat([colors, torch.ones_like(pixels[:, :, :1])], dim=2)
            if self._masked:
                truth = truth * (coverage > 0.5)
            sums += pixel_sums(world, opacities, view, truth, OFFICIAL_LEAST if self._official else 0.0)
        new = (sums[:, 3] > self._config.color_weight) & ~self.colored
        rows = new.nonzero().squeeze(1)
        self.optimiser["colors"].data[rows] = (sums[rows, :3] / sums[rows, 3:] - 0.5) / C0
        self.colored = self.colored | new
        return rows

    def _still(self, rows: Tensor) -> None:
        """Prevent the next optimiser step from changing the colours of some splats."""
        gradient = self.optimiser["colors"].grad
        if gradient is not None:
            gradient[rows] = 0
        moments = self.optimiser.moments("colors")
        if moments:
            moments["exp_avg"][rows] = 0


class RGBAvatarAvatar(SurfaceAvatar[StoredShapes]):
    """A trained head; see `SurfaceAvatar` for its files."""

    stored_class, read_coded = StoredShapes, partial(read_coded, layout=reduced)

    @torch.no_grad()
    def harmonics(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """Colours of a pose, equal in all directions; see `HarmonicAvatar`."""
        colors = self._blended(self.mesh.arguments([pose]))["colors"].cpu().numpy()
        return colors, np.zeros((*colors.shape, coefficient_count(DEGREE) - 1), np.float32)

    @torch.no_grad()
    def changes(self, pose: HeadPose) -> Changes:
        """Effect of the blendshapes."""
        splats = self._blended(self.mesh.arguments([pose]))
        return changes_of({"position": 1000 * splats["means"], "color": seen_colors(splats["colors"])})

    def _blended(self, arguments: Mapping[str, Tensor]) -> dict[str, Tensor]:
        inputs = tracked_inputs(arguments, self.stored.settings.inputs)
        return blended(self.stored.tensors, blend_weights(self.stored.tensors, inputs))[0]

    def _placed(self, frames: TriangleFrames, arguments: Mapping[str, Tensor]) -> PlacedSplats:
        splats = self._blended(arguments)
        world, colors = self.surface.place(frames, splats), seen_colors(splats["colors"])
        return PlacedSplats(world, splats["opacities"].sigmoid(), lambda center: colors)


class RGBAvatar(SurfaceMethod[RGBAvatarConfig, RGBAvatarAvatar]):
    """See the module docstring."""

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class, training_class = RGBAvatarConfig, RGBAvatarAvatar, RGBAvatarTraining

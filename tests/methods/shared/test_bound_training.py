"""What one iteration of mesh-bound training adds up and changes; the scene's extent; what clips are checked for."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from headbench.bench.contracts import Camera
from headbench.bench.errors import InputError
from headbench.methods.ops.splats import to_world
from headbench.methods.shared.config import SplatTraining
from headbench.methods.shared.loop import TrainingImages, check_training_split
from headbench.methods.shared.rendering import scene_extent
from headbench.methods.shared.schedule import ShuffledEpochs, Timeline
from headbench.methods.shared.splat_training import BoundTraining, ShadedSplats
from headbench.methods.shared.surface_points import SubjectMesh
from headbench.methods.splats import rasterize


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


PENALTY = 7.0


class Grey:
    """An `Appearance` of grey splats, with a penalty of its own."""

    def __init__(self, clip):
        self.mesh, self._poses = SubjectMesh(clip.head, clip.shape, clip.static_offset, "cpu"), clip.poses

    def splat_parameters(self, count):
        return {}

    def parameters(self):
        return {}

    def begin(self, timeline):
        pass

    def frames(self, timestep, optimiser):
        return self.mesh.frames(self.mesh.posed(self.mesh.arguments([self._poses[timestep]])))

    def place(self, frames, binding, view, timestep, optimiser, iteration):
        world = to_world(frames, binding, *(optimiser[name] for name in ("means", "log_scales", "quats")))
        colors = torch.full((len(binding), 3), 0.5)
        return ShadedSplats(world, colors, torch.sigmoid(optimiser["opacities"]), torch.tensor(PENALTY))


def make(clip, length, **settings):
    appearance, settings = Grey(clip), SplatTraining(densify_gradient=1e9, **settings)
    made = BoundTraining(clip, settings, appearance, lambda _: 0, len(appearance.mesh.faces), "cpu", 0)
    made.begin(Timeline(length, length))
    return made


@pytest.fixture
def training(clip):
    """Training of grey splats in a run of the published length, with local scales and means of all sizes."""
    training = make(clip, 600_000)
    generator = torch.Generator().manual_seed(0)
    for name in ("means", "log_scales", "opacities"):
        training.optimiser[name].data.normal_(generator=generator)
    yield training
    training.close()


def test_the_loss_is_the_papers_sum_over_what_is_seen(training, clip):
    index = 2
    training.optimiser["means"].data[::3] *= 1000  # far away: unseen, and so not asked to stay
    # Too faint to be drawn: seen all the same, as published.
    training.optimiser["opacities"].data[1::3] = -8.0
    found = float(training.loss(1, index).detach())
    key = clip.splits["train"][index]
    camera, truth = clip.cameras[key.camera], clip.image(key) / 255.0
    means, log_scales, quats, logits = (
        training.optimiser[name].detach() for name in ("means", "log_scales", "quats", "opacities")
    )
    world = to_world(Grey(clip).frames(key.timestep, None), training.binding, means, log_scales, quats)
    rendering = rasterize(
        *(*world, torch.sigmoid(logits), torch.full((len(means), 3), 0.5)),
        *(camera.world_to_camera, camera.K, camera.width, camera.height),
        background=clip.background,
    )
    seen = rendering.radii.numpy() > 0
    assert 0 < seen.sum() < len(seen)
    assert seen[1::3].any()
    image = rendering.image.double().numpy()
    expected = 0.8 * np.abs(image - truth).mean() + PENALTY
    # Zeros outside the image, as training has it: pad, compare, and keep the windows centred on its pixels.
    padded = [np.pad(x, ((10, 10), (10, 10), (0, 0))) for x in (image, truth)]
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, similarity = structural_similarity(*padded, channel_axis=2, full=True, **options)
    expected += 0.2 * (1 - similarity[10:-10, 10:-10].mean())
    local, scales = means.double().numpy()[seen], np.exp(log_scales.double().numpy()[seen])
    expected += 0.01 * np.maximum(np.linalg.norm(local, axis=1) - 1, 0).mean()
    expected += np.linalg.norm(np.maximum(scales - 0.6, 0), axis=1).mean()
    assert found == pytest.approx(expected, rel=1e-4)


def step(training, iteration):
    training.loss(iteration, 0).backward()
    training.after_backward(iteration)
    training.optimiser.zero_grad()


def rates(training):
    return {name: group["lr"] for name, group in training.optimiser.state().items()}


def test_positions_move_with_the_scene_and_ever_slower(training, clip):
    extent = scene_extent({k.camera: clip.cameras[k.camera] for k in clip.splits["train"]})
    assert rates(training)["means"] == pytest.approx(5e-3 * extent)
    for iteration, expected in ((300_000, 5e-4), (600_000, 5e-5)):
        step(training, iteration)
        assert rates(training)["means"] == pytest.approx(expected * extent)


@pytest.mark.parametrize(
    ("iteration", "white", "cut"),
    [(59_999, True, False), (60_000, False, True), (10_000, True, True), (10_000, False, False)],
)
def test_opacities_are_reset_when_the_schedule_says(training, iteration, white, cut):
    """The first reset is for white backgrounds alone, as published."""
    training._background[0] = 1.0 if white else 0.5
    training.begin(Timeline(600_000, 600_000))
    step(training, iteration)
    largest = float(torch.sigmoid(training.optimiser["opacities"].detach()).max())
    assert (largest <= 0.0100001) == cut


def test_rounds_prune_what_is_faint(training):
    before = len(training.binding)
    extra = {name: training.optimiser[name].detach()[:1] for name in training.splat_names}
    training._densifier._append({**extra, "opacities": torch.tensor([-9.0])}, training.binding[:1])
    training._densifier._restart()
    step(training, 11_999)
    assert len(training.binding) == before + 1
    step(training, 12_000)
    assert len(training.binding) == before


def test_splats_too_faint_to_be_drawn_count_as_seen(training):
    """As published: the rasteriser's radii know no opacity, and views are counted by them."""
    training.optimiser["opacities"].data[::2] = -9.0
    training.optimiser["means"].data[1] *= 1000
    step(training, 11_999)
    views = training.state()["densifier"]["views"]
    assert views[::2].all()
    assert not views[1]


def camera_at(*center):
    world_to_camera = np.eye(4)
    world_to_camera[:3, 3] = -np.array(center)
    return Camera("x", 4, 4, np.eye(3), world_to_camera)


def test_extent_is_the_largest_distance_from_the_mean_centre():
    centers = [(0, 0, 0), (4, 0, 0), (2, 3, 0)]
    found = scene_extent({str(i): camera_at(*c) for i, c in enumerate(centers)})
    assert found == pytest.approx(1.1 * np.linalg.norm(np.array(centers) - [2, 1, 0], axis=1).max())
    # A single camera has one, too.
    assert scene_extent({"a": camera_at(0, 0, 2)}) == pytest.approx(1.1)
    assert scene_extent({"a": camera_at(0, 0, 0)}) > 0
    assert scene_extent({"a": camera_at(7, 0, 2)}, np.array([7.0, 0, 0])) == pytest.approx(1.1)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: {"splits": {}}, "at least one frame"),
        (lambda c: {"poses": {}}, "tracked pose"),
        (lambda c: {"cameras": {}}, "known camera"),
        (lambda c: {"poses": {t: replace(p, head_model="x") for t, p in c.poses.items()}}, "head_model"),
    ],
)
def test_an_unsound_clip_is_refused(clip, change, says):
    with pytest.raises(InputError, match=says):
        check_training_split(replace(clip, **change(clip)))


def test_rates_are_constant_as_published_and_fall_in_a_short_run(clip):
    def course(final_rate):
        training, found = make(clip, 100, final_rate=final_rate), {}
        for iteration in (1, 50, 75, 100):
            step(training, iteration)
            found[iteration] = rates(training)
        training.close()
        return found

    published, falling = course(1.0), course(0.01)
    for name in ("opacities", "log_scales", "quats"):
        assert len({row[name] for row in published.values()}) == 1
        start = published[1][name]
        expected = [start, start, 0.1 * start, 0.01 * start]
        assert [row[name] for row in falling.values()] == pytest.approx(expected, rel=1e-9)
    for iteration, row in falling.items():
        assert row["means"] == published[iteration]["means"]

"""RGBAvatar's own part: blendshapes, their weights, splats on a moving surface, colours from images, batches."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.stats import chisquare

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.datasets.head.rotations import axis_angle_to_matrix
from headbench.methods.avatars.compact.codecs import parts_of, write_coded
from headbench.methods.avatars.settings import EXACT
from headbench.methods.ops.planes import C0
from headbench.methods.rgbavatar.method import GLOBAL, LOCAL, OnlineBatches, RGBAvatar, RGBAvatarTraining
from headbench.methods.rgbavatar.model import SHAPES, StoredShapes, blend_weights, blended, seen_colors
from headbench.methods.rgbavatar.spec import INPUTS, RGBAvatarConfig
from headbench.methods.shared.avatar_files import AVATAR_FILE
from headbench.methods.shared.optimisation import initial_network, input_count, tracked_inputs
from headbench.methods.shared.schedule import Timeline
from headbench.methods.shared.surface_points import SubjectMesh, point_tensors, poisson_disk
from headbench.methods.shared.tensor_files import read_safetensors, write_tensors
from headbench.methods.splats import pixel_weights, rasterize

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


TINY = {"samples": 400, "hidden": 8, "blendshapes": 3, "schedule_length": 40, "join": 4}


def make(clip, **settings):
    training = RGBAvatarTraining(clip, RGBAvatarConfig(**{**TINY, **settings}), "cpu", 0)
    training.begin(Timeline(40, 40))
    return training


@pytest.fixture
def splats():
    """Five random splats with three blendshapes and the network of their weights, in double precision."""
    generator = torch.Generator().manual_seed(0)
    widths = {"means": 3, "quats": 4, "colors": 3}
    tensors = {name: torch.randn(5, width, generator=generator) for name, width in widths.items()}
    tensors |= {SHAPES[name]: torch.randn(3, 5, width, generator=generator) for name, width in widths.items()}
    tensors |= initial_network((7, 8, 8, 3), 0)
    return {name: value.double() for name, value in tensors.items()}


def test_blendshapes_are_added_in_proportion_to_their_weights(splats):
    weights = torch.tensor([[0.0, 0.0, 0.0], [2.0, -1.0, 0.5]], dtype=torch.float64)
    neutral, posed = blended(splats, weights)
    for name, shapes in SHAPES.items():
        assert torch.equal(neutral[name], splats[name])
        expected = splats[name].numpy() + np.einsum("k,knc->nc", weights[1].numpy(), splats[shapes].numpy())
        np.testing.assert_allclose(posed[name], expected, rtol=1e-12)


def test_the_network_is_three_layers_with_relu_between(splats):
    inputs = np.random.default_rng(0).normal(size=(2, 7))
    values = inputs
    for layer in range(3):
        weight, bias = (splats[f"network_{part}_{layer}"].numpy() for part in ("weight", "bias"))
        values = (np.maximum(values, 0) if layer else values) @ weight.T + bias
    np.testing.assert_allclose(blend_weights(splats, torch.from_numpy(inputs)), values, rtol=1e-12)


def test_gradients_of_blending_are_those_of_differences(splats):
    inputs = torch.randn(2, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    names = [*SHAPES, *SHAPES.values(), "network_weight_0", "network_bias_2"]

    def posed(*values):
        changed = {**splats, **dict(zip(names, values))}
        return tuple(
            each[name] for each in blended(changed, blend_weights(changed, inputs)) for name in SHAPES
        )

    assert torch.autograd.gradcheck(posed, tuple(splats[name].requires_grad_() for name in names))


def test_inputs_are_coefficients_and_two_rows_of_each_rotation(clip, head):
    mesh = SubjectMesh(head, clip.shape, clip.static_offset, "cpu")
    pose = clip.poses[0]
    (found,) = tracked_inputs(mesh.arguments([pose]), INPUTS).numpy()
    expected = [pose.expression]
    for vector in (pose.neck, pose.jaw, pose.eyes[:3], pose.eyes[3:]):
        expected.append(axis_angle_to_matrix(torch.tensor(vector))[:2].flatten().numpy())
    expected += (
        [] if head.eyelid_basis is None else [pose.eyelids if pose.eyelids is not None else np.zeros(2)]
    )
    np.testing.assert_allclose(found, np.concatenate([*expected, pose.translation]), atol=1e-6)
    assert len(found) == input_count(head, INPUTS)


def charted(head):
    """The head with a chart in which every triangle has its own place and another shape than on the head."""
    uv = np.random.default_rng(0).random((len(head.faces), 3, 2)).astype(np.float32)
    return replace(head, uv=uv)


@pytest.mark.parametrize("variant", ["orthonormal", "official"])
def test_splats_sit_on_the_surface_and_turn_with_the_head(clip, head, variant):
    """Means turn exactly with the head, and covariances if the axes are orthonormal."""
    head, settings = charted(head), RGBAvatarConfig(frame_variant=variant)
    mesh = SubjectMesh(head, clip.shape, clip.static_offset, "cpu")
    vertices, faces = mesh.canonical.double().numpy(), np.asarray(head.faces)
    points = poisson_disk(vertices, faces, np.arange(len(faces)), 200, 0)
    surface, count = StoredShapes.surface(mesh, points, head, settings), len(points.triangles)
    generator = torch.Generator().manual_seed(0)
    splats = {
        "means": 0.01 * torch.randn(count, 3, generator=generator),
        "quats": torch.randn(count, 4, generator=generator),
        "log_scales": torch.randn(count, 3, generator=generator) - 6,
    }
    still = replace(clip.poses[0], rotation=np.zeros(3, np.float32), translation=np.zeros(3, np.float32))
    arguments = mesh.arguments([still])
    posed = mesh.posed(arguments).double().numpy()
    on_surface = surface.place(surface.posed(arguments), {**splats, "means": torch.zeros(count, 3)})
    np.testing.assert_allclose(on_surface.means, points.positions(posed, faces), atol=1e-6)

    vector, shift = np.array([0.3, -0.5, 0.2], np.float32), np.array([0.1, 0.2, -0.3], np.float32)
    moved = mesh.arguments([replace(still, rotation=vector, translation=shift)])
    one, other = (surface.place(surface.posed(each), splats) for each in (arguments, moved))
    turn = axis_angle_to_matrix(torch.from_numpy(vector))
    root = mesh.model.rest_joints(mesh.canonical[None], arguments["expression"])[0, 0]
    expected = (one.means - root) @ turn.t() + root + torch.from_numpy(shift)
    np.testing.assert_allclose(other.means, expected, atol=2e-6)

    def covariance(world):
        w, x, y, z = world.quats.unbind(1)
        rows = [
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ]
        axes = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
        return axes @ torch.diag_embed(world.scales**2) @ axes.mT

    turned = turn @ covariance(one) @ turn.t()
    assert np.allclose(covariance(other), turned, atol=1e-5) == (variant == "orthonormal")


def test_axes_along_a_chart_need_one(clip):
    with pytest.raises(InputError, match=r"uv: expected texture coordinates.*orthonormal"):
        make(clip, frame_variant="official")
    with pytest.raises(ValueError, match="uv_chart"):
        RGBAvatarConfig(frame_variant="official", uv_chart=False)
    flat = replace(clip.head, uv=np.zeros((len(clip.head.faces), 3, 2), np.float32))
    mesh = SubjectMesh(flat, clip.shape, clip.static_offset, "cpu")
    points = poisson_disk(mesh.canonical.numpy(), flat.faces, np.arange(len(flat.faces)), 50, 0)
    with pytest.raises(InputError, match="uv: expected an area"):
        StoredShapes.surface(mesh, points, flat, RGBAvatarConfig(frame_variant="official"))


def test_files_tell_the_axes_of_their_splats(clip, tmp_path):
    """An avatar and its coded file are drawn with the axes of the training."""
    clip = replace(clip, head=charted(clip.head))
    method = RGBAvatar(RGBAvatarConfig(**{**TINY, "frame_variant": "official"}))
    avatar = method.fit(clip, tmp_path, Budget(8), device="cpu", seed=0, progress=no_progress)
    assert avatar.stored.text().endswith("translation;frame_variant=official")
    coded = tmp_path / "coded"
    write_coded(parts_of(avatar, clip.head, None), clip.head, coded, EXACT, tmp_path / "driving.npz")
    means = avatar.splats(clip.poses[1]).means
    for other in (method.load(tmp_path, device="cpu"), method.load(coded, device="cpu")):
        assert other.stored.settings.frame_variant == "official"
        assert cKDTree(other.splats(clip.poses[1]).means).query(means)[0].max() < 1e-6
    orthonormal = replace(
        avatar.stored, settings=replace(avatar.stored.settings, frame_variant="orthonormal")
    )
    assert orthonormal.text() == ",".join(INPUTS)


def test_a_batch_has_the_mean_gradient_of_its_images(clip):
    together = make(clip, batch=3, random_background=False)
    (batch,) = {together._batches.batch(5)}
    together.loss(5, 0).backward()
    gradients = []
    for image in batch:
        single = make(clip, batch=1, random_background=False)
        single._batches.batch = lambda iteration, image=image: (image,)
        single.loss(5, 0).backward()
        gradients.append({name: single.optimiser[name].grad for name in SHAPES.values()})
        single.close()
    for name in SHAPES.values():
        mean = sum(each[name] for each in gradients) / len(batch)
        np.testing.assert_allclose(together.optimiser[name].grad, mean, atol=1e-6)
    together.close()


def test_blendshapes_join_after_their_step(clip):
    training = make(clip)
    for iteration in (4, 5):
        training.loss(iteration, 0).backward()
        assert (training.optimiser["color_shapes"].grad is not None) == (iteration == 5)
    training.close()


def test_the_defaults_are_the_values_of_the_authors_program():
    """``config/offline.yaml``, whose iterations are images, ten for each step."""
    config = RGBAvatarConfig()
    positions = config.position_lr, config.position_lr_final, 10 * config.position_settles
    assert positions == (0.0008, 0.000008, 30_000)
    others = config.opacity_lr, config.scale_lr, config.rotation_lr, config.color_lr, config.network_lr
    assert others == (0.25, 0.025, 0.005, 0.0125, 0.001)
    assert (config.position_share, config.rotation_share, config.color_share) == (0.05, 0.5, 0.5)
    steps = config.batch, config.batch * config.schedule_length, config.batch * config.join
    assert steps == (10, 50_000, 3_000)
    assert (config.blendshapes, config.hidden, config.initial_scale_mm, config.initial_opacity) == (
        20,
        128,
        0.8,
        0.5,
    )
    assert (config.ssim_weight, config.final_rate, config.random_background) == (0.0, 1.0, True)


@pytest.mark.parametrize(("online", "length"), [(False, 40), (False, 80), (True, 40), (True, 80)])
def test_positions_and_their_blendshapes_decay_together(clip, online, length):
    """Relative to the length of the run, from the initial rate in the first step; while images arrive, from the first of them."""
    training = make(clip, position_settles=20, position_lr=1e-2, position_lr_final=1e-4, online=online)
    training.begin(Timeline(length, 40))
    settles = 20 if online else length // 2
    for iteration, rate in ((1, 1e-2), (settles // 2 + 1, 1e-3), (settles + 1, 1e-4), (length + 1, 1e-4)):
        training.loss(iteration, 0).backward()
        training.after_backward(iteration)
        groups = training.optimiser.state()
        assert groups["means"]["lr"] == pytest.approx(rate)
        assert groups["mean_shapes"]["lr"] == pytest.approx(0.05 * rate)
        assert groups["colors"]["lr"] == 0.0125
        training.optimiser.zero_grad()
    training.close()


def test_splats_without_a_gradient_alone_are_removed(clip):
    training = make(clip, samples=2_000, batch=1, color_weight=0.0, initial_opacity=0.99)
    shown = torch.zeros_like(training.colored)
    for iteration in (1, 2):
        training.loss(iteration, 0).backward()
        shown |= training.optimiser["colors"].grad.abs().sum(1) > 0
        training.after_backward(iteration)
        training.optimiser.step()
        training.optimiser.zero_grad()
    assert 0 < int(shown.sum()) < len(shown)
    assert len(training.result().points.triangles) == int(shown.sum())
    training.close()


def test_colours_are_those_of_the_foreground(clip):
    """Splats take no colour from pixels outside of the mask, whether or not backgrounds are random."""
    empty = {key: np.zeros_like(mask) for key, mask in clip.masks.items()}
    for random_background in (False, True):
        training = make(replace(clip, masks=empty), random_background=random_background)
        training.loss(1, 0).backward()
        training.after_backward(1)
        assert not training.colored.any()
        training.close()


def test_colours_of_images_are_taken_once(clip):
    red = np.array([200, 30, 90], np.uint8)
    plain = replace(
        clip, images={key: np.broadcast_to(red, image.shape) for key, image in clip.images.items()}
    )
    training = make(plain, random_background=False, color_weight=0.6)
    training.loss(1, 0).backward()
    training.after_backward(1)
    seen = training.colored.clone()
    assert 0 < int(seen.sum()) < len(seen)
    colors = seen_colors(training.optimiser["colors"].detach())
    np.testing.assert_allclose(colors[seen], np.broadcast_to(red / 255, (int(seen.sum()), 3)), atol=1e-4)
    assert (colors[~seen] == 0.5).all()
    training.optimiser["colors"].data[seen] = 0.25 / C0
    training.loss(11, 0).backward()
    training.after_backward(11)
    assert (training.optimiser["colors"].detach()[seen] == 0.25 / C0).all()
    training.close()


def test_a_colour_is_weighted_by_what_a_splat_contributes(clip):
    """Against the sum over pixels of weight times colour, the weights from renderings of single splats in order."""
    training = make(clip, random_background=False, samples=60, color_weight=1e-3, batch=1)
    training.loss(1, 0).backward()
    (world, opacities, view, pixels), *_ = training._seen
    count, camera = len(opacities), view.camera
    depth = world.means.detach() @ view.world_to_camera[2, :3] + view.world_to_camera[2, 3]
    transmittance = np.ones((camera.height, camera.width))
    sums = np.zeros((count, 4))
    for index in depth.argsort().tolist():
        one = [value.detach()[index : index + 1] for value in (*world, opacities)]
        drawn = rasterize(*one, torch.ones(1, 1), view.world_to_camera, view.K, camera.width, camera.height)
        weight = transmittance * drawn.alpha.double().numpy() * (pixels[:, :, 3] > 0.5).numpy()
        sums[index] = [*np.einsum("hw,hwc->c", weight, pixels.double().numpy()[:, :, :3]), weight.sum()]
        transmittance = transmittance * (1 - drawn.alpha.double().numpy())
    training.after_backward(1)
    enough = sums[:, 3] > 1
    assert enough.sum() > 10
    found = seen_colors(training.optimiser["colors"].detach()).numpy()
    np.testing.assert_allclose(found[enough], sums[enough, :3] / sums[enough, 3:], atol=5e-3)
    training.close()


def test_files_that_do_not_fit_are_refused(clip, head, tmp_path):
    training = make(clip)
    training.colored[:] = True
    stored = training.result()
    training.close()
    path = tmp_path / AVATAR_FILE
    stored.write(path)
    again = StoredShapes.of(path, *read_safetensors(path), head, "cpu")
    assert all(torch.equal(again.tensors[name], value) for name, value in stored.tensors.items())
    broken = {
        "triangles": replace(
            stored, points=stored.points._replace(triangles=stored.points.triangles + 10**6)
        ),
        "network_weight_0": replace(stored, settings=replace(stored.settings, inputs=("neck",))),
        "color_shapes": replace(
            stored, tensors={**stored.tensors, "color_shapes": stored.tensors["color_shapes"][:-1]}
        ),
    }
    for text in ("expression,smile", "expression;frame_variant=skewed"):
        write_tensors(path, stored.tensors | point_tensors(stored.points), {"inputs": text})
        with pytest.raises(InputError, match="inputs|frame_variant"):
            StoredShapes.of(path, *read_safetensors(path), head, "cpu")
    for name, each in broken.items():
        each.write(path)
        with pytest.raises(InputError, match=name):
            StoredShapes.of(path, *read_safetensors(path), head, "cpu")


def test_official_colours_are_set_after_the_step(clip):
    """Only pixels in which the weight is above 0.1 count; the moments stay; what has no colour is removed."""
    official = {"color_init_variant": "official", "random_background": False, "batch": 1, "samples": 60}
    partly = {key: np.where(mask > 0, np.uint8(204), mask) for key, mask in clip.masks.items()}
    training = make(replace(clip, masks=partly), **official)
    training.loss(1, 0).backward()
    (world, opacities, view, pixels), *_ = training._seen
    camera = view.world_to_camera, view.K, view.camera.width, view.camera.height
    splats, places, weights = (part.numpy() for part in pixel_weights(*world, opacities, *camera))
    sums, values = np.zeros((len(opacities), 4)), pixels.double().numpy().reshape(-1, pixels.shape[2])
    for splat, place, weight in zip(splats, places, weights):
        if weight > 0.1 and values[place, 3] > 0.5:
            straight = (values[place, :3] - 0.2) / 0.8  # without the white background
            sums[splat] += weight * np.array([*straight, 1])
    found = sums[:, 3] > 0.1
    assert 0 < found.sum() < len(found)
    gradient = training.optimiser["colors"].grad.clone()
    training.after_backward(1)
    assert not training.colored.any()
    training.optimiser.step()
    training.optimiser.zero_grad()
    state = training.state()
    np.testing.assert_array_equal(training.colored, found)
    colors = seen_colors(training.optimiser["colors"].detach()).numpy()
    np.testing.assert_allclose(colors[found], sums[found, :3] / sums[found, 3:], atol=1e-5)
    moments = state["optimiser"]["colors"]["moments"]["exp_avg"]
    assert moments[found].abs().max() > 0
    torch.testing.assert_close(moments, 0.1 * gradient)
    assert len(training.result().points.triangles) == found.sum()
    training.close()


@pytest.mark.parametrize("variant", ["paper", "official"])
def test_timed_steps_give_no_colours(clip, variant):
    """Steps that only estimate the number of iterations are without effect on the first step."""
    found = []
    for timed in ((2, 3), ()):
        training = make(clip, color_init_variant=variant)
        for iteration in timed:
            training.loss(iteration, 0).backward()
            training.optimiser.zero_grad()
        training.loss(1, 0).backward()
        assert not training.colored.any()
        training.after_backward(1)
        found.append((training.state()["colored"], training.optimiser["colors"].detach()))
        training.close()
    assert found[0][0].any()
    torch.testing.assert_close(*found, rtol=0, atol=0)

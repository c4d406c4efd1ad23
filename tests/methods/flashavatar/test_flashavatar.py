"""FlashAvatar: what the network does to splats, the loss, and that the head's motion is the camera's."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.engine.config import resolve_method
from headbench.bench.errors import InputError
from headbench.methods.flashavatar.method import FlashAvatar, FlashAvatarTraining, image_loss
from headbench.methods.flashavatar.model import (
    INPUTS,
    TrainedSplats,
    changed,
    layer_of_points,
    network_outputs,
    network_sizes,
)
from headbench.methods.flashavatar.spec import FLASHAVATAR, FlashAvatarConfig
from headbench.methods.official.video import six_numbers
from headbench.methods.ops.planes import C0, encode, sh_basis
from headbench.methods.shared.avatar_files import clip_mesh
from headbench.methods.shared.optimisation import initial_network, input_count, layer_names, tracked_inputs
from headbench.methods.shared.tensor_files import read_safetensors

from ...datasets.head.toy import toy_head
from ..toy_clip import first_view, toy_clip
from .small import SMALL

CONFIG = FlashAvatarConfig(**SMALL)


def random_splats(count=6, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    shapes = {"log_scales": (count, 3), "quats": (count, 4), "outputs": (count, 10)}
    drawn = {name: torch.randn(shape, generator=generator, dtype=dtype) for name, shape in shapes.items()}
    return {**drawn, "log_scales": drawn["log_scales"] - 6, "outputs": drawn["outputs"].tanh()}


def test_a_size_becomes_its_power_or_its_multiple():
    splats = {"log_scales": torch.tensor([[1e-3, 1e-3, 2.0]]).log(), "quats": torch.tensor([[1.0, 0, 0, 0]])}
    outputs = torch.zeros(1, 10)
    outputs[0, 7:] = torch.tensor([-1.0, 1.0, 1.0])
    official, product = (
        changed(splats, outputs, replace(CONFIG, scale_variant=variant))["log_scales"].exp()
        for variant in ("official", "product")
    )
    # A millimetre becomes 79 mm at c = 1 / e and 7 nm at c = e.
    torch.testing.assert_close(official, torch.tensor([[1e-3 ** (1 / np.e), 1e-3**np.e, 2**np.e]]).float())
    torch.testing.assert_close(product, torch.tensor([[1e-3 / np.e, 1e-3 * np.e, 2 * np.e]]).float())


def test_offsets_are_bounded_and_turns_come_after_the_splats_own():
    splats = random_splats()
    outputs = splats["outputs"]
    found = changed(splats, outputs, replace(CONFIG, offset_m=0.2))
    offsets, quats = found["means"], found["quats"]
    torch.testing.assert_close(offsets, 0.2 * outputs[:, :3])
    own = Rotation.from_quat(splats["quats"].roll(-1, 1).numpy())
    added = torch.cat([outputs[:, 4:7], outputs[:, 3:4].exp()], 1)
    expected = own * Rotation.from_quat(added.numpy())
    found = Rotation.from_quat(quats.roll(-1, 1).numpy())
    assert (found * expected.inv()).magnitude().max() < 1e-7


def test_the_encoding_is_that_of_the_publication():
    points = torch.tensor([[0.0, 0.0, 0.0], [0.1, -0.05, 0.02]], dtype=torch.float64)
    encoded = encode(points, FlashAvatarConfig().frequencies)
    assert encoded.shape == (2, 51)
    assert encoded[0].tolist() == [0.0] * 3 + 8 * ([0.0] * 3 + [1.0] * 3)
    assert float(encoded[1, 3 + 6 * 7]) == pytest.approx(np.sin(128 * 0.1))
    assert float(encoded[1, -2]) == pytest.approx(np.cos(128 * -0.05))


@pytest.fixture(scope="module")
def lidded():
    """A clip of a head with eyelids."""
    return toy_clip(toy_head(16, eyelids=True), timesteps=2, cameras=2, width=28, height=36)


def test_the_network_has_the_published_size(clip, lidded):
    sizes = network_sizes(FlashAvatarConfig(), 120)  # FLAME's 100 expressions, jaw, eyes and eyelids
    assert sum(value.numel() for value in initial_network(sizes, 0).values()) == 375_562
    for each, lids in ((clip, 0), (lidded, 2)):
        poses = [replace(each.poses[0], eyelids=np.array([0.3, 0.7])), each.poses[1]]
        found = tracked_inputs(clip_mesh(each, "cpu").arguments(poses), INPUTS)
        pose = poses[0]
        turns = six_numbers(np.concatenate([pose.jaw, pose.eyes]))
        expected = np.concatenate([pose.expression, turns, pose.eyelids[:lids]])
        np.testing.assert_allclose(found[0], expected, atol=1e-6)
        assert found.shape[1] == input_count(each.head, INPUTS) == 8 + 18 + lids


def test_the_split_first_layer_is_the_concatenated_one():
    generator = torch.Generator().manual_seed(1)
    points, inputs = (torch.randn(shape, generator=generator) for shape in ((7, 3), (5,)))
    network = initial_network(network_sizes(CONFIG, 5), 3)
    encoded = encode(points, CONFIG.frequencies)
    found = network_outputs(network, layer_of_points(network, encoded), inputs, CONFIG)
    layers = []
    for weight, bias in zip(*layer_names(3)):
        layer = torch.nn.Linear(*network[weight].t().shape)
        layer.load_state_dict({"weight": network[weight], "bias": network[bias]})
        layers += [layer, torch.nn.ReLU()]
    whole = torch.nn.Sequential(*layers[:-1], torch.nn.Tanh())
    expected = whole(torch.cat([encoded, inputs.expand(7, -1)], 1))
    torch.testing.assert_close(found, expected.detach())


def test_gradients_are_those_of_differences():
    """Of the network and of what it changes, in float64, by central differences."""
    config = replace(CONFIG, hidden=4)
    network = {name: value.double() for name, value in initial_network(network_sizes(config, 3), 0).items()}
    splats = random_splats(3)
    splats = {name: splats[name] for name in ("log_scales", "quats")}
    generator = torch.Generator().manual_seed(1)
    points, inputs = (torch.randn(size, generator=generator, dtype=torch.float64) for size in ((3, 3), (3,)))
    encoded = encode(points, config.frequencies)
    names = [*network, *splats]

    def means_sizes_turns(*values):
        tensors = dict(zip(names, values))
        outputs = network_outputs(tensors, layer_of_points(tensors, encoded), inputs, config)
        return tuple(changed(tensors, outputs, config).values())

    values = [value.requires_grad_() for value in (*network.values(), *splats.values())]
    assert torch.autograd.gradcheck(means_sizes_turns, values)


def test_the_loss_is_quadratic_up_to_a_tenth():
    blank, config = torch.zeros(4, 6, 3), replace(CONFIG, ssim_weight=0.0)
    for error, expected in ((0.05, 0.00125), (0.1, 0.005), (1.0, 0.095)):
        assert float(image_loss(blank + error, blank, None, config)) == pytest.approx(expected)


def test_an_error_in_the_mouth_counts_41_times():
    truth, mouth = torch.zeros(4, 6, 3), torch.zeros(4, 6, dtype=torch.bool)
    mouth[1, 2:4] = True
    image = truth + 0.05 * mouth[:, :, None]
    assert float(image_loss(image, truth, mouth, CONFIG)) == pytest.approx(41 * 0.00125 * 2 / 24)
    assert float(image_loss(image, truth, ~mouth, CONFIG)) == pytest.approx(0.00125 * 2 / 24)


@pytest.fixture(scope="module")
def avatar(clip, tmp_path_factory):
    """With offsets of millimetres, turns and colours that depend on the direction."""
    folder = tmp_path_factory.mktemp("flashavatar")
    budget = Budget(iterations=30)
    config = replace(CONFIG, network_lr=0.01, sh_rest_lr=0.05)
    return FlashAvatar(config).fit(clip, folder, budget, device="cpu", seed=0, progress=no_progress)


def test_moving_the_head_is_moving_the_camera(avatar, clip):
    """Also with a bent neck, which is not part of the rigid motion."""
    camera, pose = first_view(clip)
    head, turn, shift = clip.head, np.array([0.3, -0.5, 0.2]), np.array([0.02, -0.01, 0.03])
    still = replace(pose, neck=np.array([0.2, 0.3, -0.1]), rotation=np.zeros(3), translation=np.zeros(3))
    shaped = head.template + head.shape_basis @ clip.shape + head.expression_basis @ pose.expression
    root, rotation = head.joint_regressor[0] @ shaped, Rotation.from_rotvec(turn).as_matrix()
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, root - rotation @ root + shift
    seen = avatar.render(camera, replace(still, rotation=turn, translation=shift))
    moved = replace(camera, world_to_camera=camera.world_to_camera @ motion)
    np.testing.assert_allclose(seen.rgb, avatar.render(moved, still).rgb, atol=2e-3)
    assert np.abs(seen.rgb - avatar.render(camera, still).rgb).max() > 0.1
    splats = avatar.splats(still)
    surface = avatar.surface.posed(avatar.mesh.arguments([still]))
    assert np.linalg.norm(splats.means - surface.center.numpy(), axis=1).max() > 1e-3


def test_exported_harmonics_give_the_colours_that_are_drawn(avatar, clip):
    camera, pose = first_view(clip)
    splats = avatar.splats(pose, camera)
    dc, rest = map(torch.from_numpy, avatar.harmonics(pose))
    along = torch.nn.functional.normalize(torch.from_numpy(splats.means - camera.center).float(), dim=1)
    colors = 0.5 + C0 * dc + torch.einsum("nck,nk->nc", rest, sh_basis(along, 3)[:, 1:])
    np.testing.assert_allclose(colors.relu(), splats.colors, atol=1e-4)
    assert rest.abs().max() > 0.05


def test_defaults_are_the_published_values():
    config = FlashAvatarConfig()
    assert resolve_method(FLASHAVATAR, "paper", {}).config == config
    rates = (config.sh_dc_lr, config.sh_rest_lr, config.opacity_lr, config.scale_lr, config.rotation_lr)
    assert rates == (0.0025, 0.0025 / 20, 0.05, 0.005, 0.001)
    assert (config.network_lr, config.initial_opacity, config.sh_degree) == (1e-4, 0.1, 3)


def test_the_network_has_the_epsilon_of_pytorch_s_adam(clip):
    """Its gradients are small, so that a step shows the epsilon."""
    training = FlashAvatarTraining(clip, CONFIG, "cpu", 0)
    training.close()
    for name, epsilon in (("network_weight_0", 1e-8), ("log_scales", 1e-15)):
        tensor = training.optimiser[name]
        tensor.grad, before = torch.full_like(tensor, 1e-8), tensor.detach().clone()
        training.optimiser.step()
        training.optimiser.zero_grad()
        expected = before - training._rates[name] * 1e-8 / (1e-8 + epsilon)
        torch.testing.assert_close(tensor.detach(), expected)


@pytest.mark.parametrize(
    "change",
    [
        {"layers": 10**9},
        {"layers": 3},
        {"frequencies": 3},
        {"sh_degree": 2},
        {"offset_m": -1.0},
        {"samples": 1},
    ],
)
def test_settings_that_do_not_fit_the_tensors_are_refused(avatar, clip, tmp_path, change):
    path = tmp_path / "avatar.safetensors"
    avatar.stored.write(path)
    tensors, metadata = read_safetensors(path)
    save_file(tensors, path, {"settings": json.dumps({**json.loads(metadata["settings"]), **change})})
    with pytest.raises(InputError, match=r"avatar\.safetensors"):
        TrainedSplats.of(path, *read_safetensors(path), clip.head, "cpu")

"""The teacher of motion says what the head model does, and a network follows it."""

import numpy as np
import torch

from headbench.datasets.head.model import HeadModel
from headbench.methods.gha.driving import bounds, training_scene
from headbench.methods.gha.mesh_head import Controllers
from headbench.methods.gha.mesh_training import TrackedMotion
from headbench.methods.ops.planes import encode

from .small import small_config


def vertices(scene, code):
    """(V, 3) canonical vertices of an expression code, from the head model itself."""
    head = scene.clip.head
    model, raw = HeadModel(head), code * scene.expression_scale
    count = head.expression_basis.shape[2]
    zeros = torch.zeros(1, 3)
    posed = model(
        shape=torch.tensor(scene.clip.shape, dtype=torch.float32)[None],
        static_offset=torch.tensor(scene.clip.static_offset, dtype=torch.float32),
        expression=raw[None, :count],
        jaw=raw[None, count : count + 3],
        eyes=raw[None, count + 3 : count + 9],
        **dict.fromkeys(("rotation", "neck", "translation"), zeros),
    )[0]
    return (posed - scene.driver.origin) / scene.driver.unit


def test_moves_are_the_head_models_near_landmarks(clip):
    config = small_config(neutral_jaw=0.1, angle_unit=0.2)
    scene = training_scene(clip, config, "cpu", 0)
    motion = TrackedMotion.of(scene, config)
    opened = torch.zeros_like(scene.code_low)
    opened[clip.head.expression_basis.shape[2]] = 0.1 / 0.2
    rest = vertices(scene, opened)
    torch.testing.assert_close(scene.rest, rest, atol=1e-5, rtol=1e-5)
    landmarks = rest[torch.as_tensor(scene.landmark_rows)]
    ruled = torch.cdist(rest, landmarks).amin(1).square() <= config.near_squared
    for name in ("left_eyeball", "right_eyeball"):
        ruled[torch.as_tensor(clip.head.regions[name])] = False
    torch.testing.assert_close(motion.encoded, encode(rest[ruled]))
    for row in (0, 300, 511):
        expected = (vertices(scene, motion.codes[row]) - rest)[ruled]
        torch.testing.assert_close(motion.moves[row], expected, atol=1e-5, rtol=1e-4)


def test_a_network_learns_to_move_like_the_head_model(clip):
    """Also by expressions that no timestep shows."""
    config = small_config(zero_initialised=True, expression_deform_hidden=(32, 32), angle_unit=0.2)
    scene = training_scene(clip, config, "cpu", 0)
    motion = TrackedMotion.of(scene, config)
    network = Controllers.of(config, len(scene.code_low)).expression_deform
    initial = network.initial(torch.Generator().manual_seed(0))
    weights = motion.fitted(network, initial, 250, seed=0)
    rows = torch.as_tensor(scene.landmark_rows)
    unseen = torch.randn(5, len(scene.code_low), generator=torch.Generator().manual_seed(9))
    still = lost = 0.0
    for code in unseen:
        expected = (vertices(scene, code) - scene.rest)[rows]
        found = config.displacement_scale * torch.tanh(network(weights, encode(scene.rest[rows]), code))
        still += expected.square().sum().item()
        lost += (found - expected).square().sum().item()
    assert lost < 0.25 * still


def test_errors_count_relative_to_a_vertexs_motion(clip):
    """A network at rest errs by all the motion there is: 1, but for what hardly moves."""
    config = small_config(zero_initialised=True)
    scene = training_scene(clip, config, "cpu", 0)
    motion = TrackedMotion.of(scene, config)
    network = Controllers.of(config, len(scene.code_low)).expression_deform
    weights = network.initial(torch.Generator().manual_seed(0))
    errors = [motion.error(network, weights, torch.Generator().manual_seed(s)).item() for s in range(20)]
    squared = motion.moves.square().sum(2).mean(0)
    np.testing.assert_allclose(np.mean(errors), (squared / (squared + 4e-4)).mean(), rtol=0.05)


def test_bounds_widen_the_range_of_training():
    codes = torch.tensor([[0.0, -1.0], [2.0, 3.0], [1.0, 0.0]])
    low, high = bounds(codes, 0.25)
    torch.testing.assert_close(low, torch.tensor([-0.5, -2.0]))
    torch.testing.assert_close(high, torch.tensor([2.5, 4.0]))
    low, high = bounds(codes, None)
    assert (low < -1e38).all()
    assert (high > 1e38).all()


def test_a_margin_bounds_the_avatar_by_its_training_expressions(clip):
    margin = training_scene(clip, small_config(appearance_margin=0.5), "cpu", 0)
    count = clip.head.expression_basis.shape[2]
    seen = np.array([clip.poses[t].expression for t in margin.timesteps])
    span = seen.max(0) - seen.min(0)
    np.testing.assert_allclose(margin.code_high[:count], seen.max(0) + 0.5 * span, rtol=1e-5)

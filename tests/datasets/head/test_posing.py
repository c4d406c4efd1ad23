"""The fast path against the readable one, in both precisions, batches and combinations of joints at rest."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.datasets.head.model import FastPosing, HeadModel, joint_motions
from headbench.datasets.head.procedural.model import procedural_head

from .toy import toy_head

HEAD = toy_head(16)
PARTS = ("rotation", "neck", "jaw", "left eye", "right eye")


def both(model, neutral, expression, angles, translation):
    """Vertices by the fast and by the readable path."""
    inputs = (neutral, expression, angles, translation)
    return model._fast(*inputs), model._pose(*inputs)


def draw(model, batch, seed=0, scale=1.0):
    generator = torch.Generator().manual_seed(seed)
    like = {"generator": generator, "dtype": model.template.dtype}
    neutral = model.canonical(torch.randn(1, model.shape_size, **like))
    expression = torch.randn(batch, model.expression_size, **like)
    angles = scale * torch.randn(batch, 5, 3, **like)
    return neutral, expression, angles, torch.randn(batch, 3, **like)


@pytest.mark.parametrize("head", [HEAD, procedural_head("2020")], ids=["toy", "procedural"])
@pytest.mark.parametrize(("dtype", "close"), [(torch.float64, 1e-14), (torch.float32, 2e-6)])
def test_the_paths_agree(head, dtype, close):
    model = HeadModel(head, dtype=dtype)
    for batch in (1, 5):
        fast, readable = both(model, *draw(model, batch))
        assert fast.shape == readable.shape
        assert fast.is_contiguous()
        assert (fast - readable).abs().max() < close


@pytest.mark.parametrize("moving", [m for n in range(6) for m in itertools.combinations(range(5), n)])
def test_joints_at_rest_may_be_left_out(moving):
    """Every combination of turned joints: what is skipped must not have mattered."""
    model = HeadModel(HEAD, dtype=torch.float64)
    neutral, expression, angles, translation = draw(model, 3, seed=len(moving))
    for joint in set(range(5)) - set(moving):
        angles[:, joint] = 0
    fast, readable = both(model, neutral, expression, angles, translation)
    assert (fast - readable).abs().max() < 1e-14


def test_one_pose_at_rest_does_not_rest_the_others():
    model = HeadModel(HEAD, dtype=torch.float64)
    neutral, expression, angles, translation = draw(model, 2)
    angles[0] = 0
    fast, readable = both(model, neutral, expression, angles, translation)
    assert (fast - readable).abs().max() < 1e-14


@pytest.mark.parametrize("still", [(), (0, 1, 2, 3, 4), (1, 2)], ids=["moving", "at rest", "eyes moving"])
@pytest.mark.parametrize("ones", [m for n in range(5) for m in itertools.combinations(range(4), n)])
def test_batches_of_one_stand_for_all(ones, still):
    model = HeadModel(HEAD, dtype=torch.float64)
    neutral, expression, angles, translation = draw(model, 4)
    angles[:, list(still)] = 0
    inputs = [neutral * torch.linspace(1, 1.1, 4)[:, None, None].double(), expression, angles, translation]
    for one in ones:
        inputs[one] = inputs[one][:1]
    fast, readable = both(model, *inputs)
    assert fast.shape == readable.shape
    assert (fast - readable).abs().max() < 1e-14


def test_gradients_take_the_readable_path_and_agree_with_differences():
    model = HeadModel(HEAD, dtype=torch.float64)
    neutral, expression, angles, translation = draw(model, 1)
    arguments = {"canonical": neutral, "expression": expression, "translation": translation}
    flat = angles.flatten(1)

    def weighted(flat):
        parts = {"rotation": flat[:, :3], "neck": flat[:, 3:6], "jaw": flat[:, 6:9], "eyes": flat[:, 9:]}
        return (model(**arguments, **parts) * torch.linspace(-1, 1, neutral.numel()).view_as(neutral)).sum()

    (gradient,) = torch.autograd.grad(weighted(flat.requires_grad_()), flat)
    with torch.no_grad():
        step = 1e-6 * torch.eye(15, dtype=torch.float64)[:, None]
        numeric = torch.stack([(weighted(flat + s) - weighted(flat - s)) / 2e-6 for s in step])
    assert (gradient[0] - numeric).abs().max() < 1e-6 * gradient.abs().max()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000))
def test_joint_motions_are_products_of_rotations_about_joints(seed):
    rng = np.random.default_rng(seed)
    parents = (-1, 0, 1, 1, 1)
    local = np.linalg.qr(rng.normal(size=(2, 5, 3, 3)))[0]
    joints = rng.normal(size=(2, 5, 3))
    turns, shifts = joint_motions(local, joints, parents)
    for row in range(2):
        for joint in range(5):
            point, at = rng.normal(size=3), joint
            moved = turns[row, joint] @ point + shifts[row, joint]
            while at >= 0:
                point = local[row, at] @ (point - joints[row, at]) + joints[row, at]
                at = parents[at]
            np.testing.assert_allclose(moved, point, atol=1e-12)


def test_weights_that_sum_to_one_only_nearly_count_as_they_are():
    weights = HEAD.skinning_weights * np.linspace(1 - 1e-4, 1 + 1e-4, len(HEAD.template))[:, None]
    model = HeadModel(replace(HEAD, skinning_weights=weights), dtype=torch.float64)
    fast, readable = both(model, *draw(model, 2))
    assert (fast - readable).abs().max() < 1e-14


def test_directions_that_are_zero_are_left_out():
    head = procedural_head("2023")
    used = head.pose_basis.any(axis=(0, 1)).sum()
    assert used < head.pose_basis.shape[2]
    posing = FastPosing(head, dtype=torch.float32)
    assert len(posing.directions) == head.expression_basis.shape[2] + used

"""Differences added up, and splats carried by a pose: against dense float64 sums, the head model and scipy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.datasets.head.model import HeadModel
from headbench.methods.gbs.blend import LARGEST_SCALE, Entries, difference_widths, place
from headbench.methods.gbs.rig import PARTS, Carried, Rig
from headbench.methods.gbs.surface import SurfacePoints, full_barycentric

from ...datasets.head.toy import toy_head
from ..toy_clip import toy_pose


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_entries_add_up_as_a_dense_table_does(seed):
    rng = np.random.default_rng(seed)
    count, expressions, width = 7, 5, 3
    mask = rng.random((count, expressions)) * (rng.random((count, expressions)) < 0.5)
    owners, moving = np.nonzero(mask)
    entries = Entries.of(
        torch.from_numpy((mask > 0).sum(1)), torch.from_numpy(moving), torch.from_numpy(mask[mask > 0])
    )
    assert entries.owners.tolist() == owners.tolist()
    table = rng.normal(size=(len(owners), width))
    coefficients = rng.normal(size=expressions)
    dense = np.zeros((count, expressions, width))
    dense[owners, moving] = table
    found = entries.sum(torch.from_numpy(table), torch.from_numpy(coefficients))
    np.testing.assert_allclose(found, np.einsum("nk,k,nkc->nc", mask, coefficients, dense), atol=1e-12)


def test_gradients_by_the_differences_are_exact():
    generator = torch.Generator().manual_seed(0)
    counts, moving = torch.tensor([2, 0, 1, 3]), torch.tensor([0, 2, 1, 0, 1, 2])
    weights = torch.rand(6, generator=generator, dtype=torch.float64)
    entries = Entries.of(counts, moving, weights)
    table = torch.randn(6, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    coefficients = torch.randn(3, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda values: entries.sum(values, coefficients), (table,))


def random_points(head, count, seed=0):
    rng = np.random.default_rng(seed)
    inside = rng.dirichlet(np.ones(3), count)[:, 1:].astype(np.float32)
    return SurfacePoints(rng.integers(0, len(head.faces), count), full_barycentric(inside))


def neutral_of(rig, degree=1):
    count, generator = len(rig.rest), torch.Generator().manual_seed(1)
    return {
        "means": rig.rest.clone(),
        "log_scales": torch.full((count, 3), -5.0) + torch.randn(count, 3, generator=generator),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        "opacities": torch.randn(count, generator=generator),
        "sh_dc": torch.randn(count, 3, generator=generator),
        "sh_rest": torch.randn(count, 3, (degree + 1) ** 2 - 1, generator=generator),
    }


def no_differences(count, degree=0):
    return torch.zeros(count, sum(difference_widths(degree).values()))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("eyelids", [False, True])
def test_before_training_splats_ride_on_the_mesh_of_the_head_model(seed, eyelids):
    """Positions: initial differences, correctives, joints, eyelids and translation, whatever the pose."""
    head = toy_head(16, eyelids=eyelids)
    rng = np.random.default_rng(seed)
    shape, offset = (
        rng.standard_normal(head.shape_basis.shape[2]),
        0.001 * rng.standard_normal(head.template.shape),
    )
    points = random_points(head, 200, seed)
    rig = Rig(head, shape, offset, points, 50, "cpu")
    pose = toy_pose(head, rng, 0, "toy")
    pose = replace(pose, eyelids=np.array([0.7, -0.4])) if eyelids else pose
    arguments = rig.arguments([pose])
    placed = place(neutral_of(rig), no_differences(200), Carried.of(rig.carry(arguments)))
    model = HeadModel(head, dtype=torch.float64)
    mesh = model(
        shape=torch.from_numpy(shape), static_offset=torch.from_numpy(offset), **model.pose_arguments([pose])
    )[0].numpy()
    expected = points.positions(mesh, head.faces)
    # Between corners that hang on the joints alike, skinning and interpolation commute.
    weights = head.skinning_weights[head.faces[points.triangles]]
    alike = np.ptp(weights, axis=1).max(1) < 1e-9
    assert alike.sum() > 20
    assert (~alike).sum() > 20
    np.testing.assert_allclose(placed.world.means[alike], expected[alike], atol=2e-6)
    np.testing.assert_allclose(placed.world.means, expected, atol=1e-3)


def test_splats_turn_with_the_head_and_their_colours_with_them(head):
    """A pose that differs by a rotation of everything looks the same to a camera that turns along."""
    rig = Rig(head, np.zeros(6), np.zeros_like(head.template), random_points(head, 100), 50, "cpu")
    neutral = neutral_of(rig)
    pose = toy_pose(head, np.random.default_rng(0), 0, "toy")
    still = replace(pose, rotation=np.zeros(3))
    turned = replace(pose, rotation=np.array([0.3, -0.8, 0.2]))
    center = torch.tensor([0.1, 0.2, 0.6])
    found = []
    for one in (still, turned):
        carried = Carried.of(rig.carry(rig.arguments([one])))
        found.append((place(neutral, no_differences(100), carried), one))
    (before, _), (after, _) = found
    turn = Rotation.from_rotvec(turned.rotation)
    model = HeadModel(head, dtype=torch.float64)
    arguments = model.pose_arguments([pose])
    root = model.joints(torch.zeros(1, 6).double(), arguments["expression"])[0, 0].numpy()
    move = root + pose.translation
    moved_center = turn.apply(center.numpy() - move) + move
    np.testing.assert_allclose(
        after.world.means, turn.apply(before.world.means.numpy() - move) + move, atol=1e-5
    )
    quats = [Rotation.from_quat(p.world.quats.numpy(), scalar_first=True) for p in (before, after)]
    assert ((turn * quats[0]).inv() * quats[1]).magnitude().max() < 1e-3
    one = before.colors(center, 1)
    other = after.colors(torch.from_numpy(moved_center).float(), 1)
    torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)
    assert (one - before.colors(-center, 1)).abs().max() > 0.01


def test_every_attribute_is_the_sum_that_the_paper_gives(head):
    rig = Rig(head, np.zeros(6), np.zeros_like(head.template), random_points(head, 60), 50, "cpu")
    neutral = neutral_of(rig, degree=2)
    generator = torch.Generator().manual_seed(2)
    widths = difference_widths(1)
    table = 0.1 * torch.randn(60, sum(widths.values()), generator=generator)
    parts = dict(zip(widths, table.split(list(widths.values()), dim=1)))
    # A pose at rest but for the shift and turn of the differences.
    columns = {name: torch.zeros(60, width) for name, width in PARTS.items()}
    columns["linear"] = columns["rotation"] = torch.eye(3).flatten().repeat(60, 1)
    columns["product"] = torch.eye(4).flatten().repeat(60, 1)
    columns["shift"], columns["turn"] = torch.full((60, 3), 0.01), torch.full((60, 4), 0.02)
    placed = place(neutral, table, Carried(**columns))
    torch.testing.assert_close(placed.world.means, neutral["means"] + 0.01 + parts["means"])
    raw = neutral["quats"] + 0.02 + parts["quats"]
    torch.testing.assert_close(placed.world.quats, raw / raw.norm(dim=1, keepdim=True))
    scales = torch.exp(neutral["log_scales"] + parts["log_scales"]).clamp_max(LARGEST_SCALE)
    torch.testing.assert_close(placed.world.scales, scales)
    logits = neutral["opacities"] + parts["opacities"][:, 0]
    torch.testing.assert_close(placed.opacities, 1 / (1 + torch.exp(-logits)))
    torch.testing.assert_close(placed.sh_dc, neutral["sh_dc"] + parts["sh_dc"])
    rest = neutral["sh_rest"].clone()
    rest[:, :, :3] += parts["sh_rest"].view(60, 3, 3)
    torch.testing.assert_close(placed.sh_rest, rest)


def test_an_expression_beyond_those_kept_moves_joints_alone(head):
    rng = np.random.default_rng(0)
    points = random_points(head, 50)
    rig = Rig(head, np.zeros(6), np.zeros_like(head.template), points, 3, "cpu")
    pose = toy_pose(head, rng, 0, "toy")
    rest = replace(pose, rotation=np.zeros(3), neck=np.zeros(3), jaw=np.zeros(3), eyes=np.zeros(6))
    kept, other = rest.expression.copy(), rest.expression.copy()
    kept[3:] = 0
    one, same = (Carried.of(rig.carry(rig.arguments([replace(rest, expression=e)]))) for e in (kept, other))
    torch.testing.assert_close(one.shift, same.shift)
    # At rest joints turn nothing, so where they are does not matter.
    torch.testing.assert_close(one.offset, same.offset, atol=1e-6, rtol=0)
    turned = replace(rest, jaw=np.array([0.3, 0, 0]))
    opened = [Carried.of(rig.carry(rig.arguments([replace(turned, expression=e)]))) for e in (kept, other)]
    assert (opened[0].offset - opened[1].offset).abs().max() > 1e-5

"""Splats on a head's triangles: where they lie, and that their order in memory is all that the bench changes."""

import pytest
import torch

from headbench.datasets.head.procedural.model import procedural_head
from headbench.methods.splats import available_backends
from headbench.tests.benchmarks.splats import order
from headbench.tests.benchmarks.splats.order import (
    Ordering,
    bound_head,
    measure_order,
    order_table,
    reordered,
)
from headbench.tests.benchmarks.splats.passes import draw, leaves


@pytest.fixture(scope="module")
def head():
    return procedural_head()


def test_splats_lie_on_their_triangles_in_the_order_of_triangles(head):
    count = 3 * len(head.faces)
    scene = bound_head(head, count, 96, 128)
    corners = torch.as_tensor(head.template, dtype=torch.float32)[torch.as_tensor(head.faces).long()]
    triangle = torch.arange(count) // 3
    reach = (corners - corners.mean(1, keepdim=True)).norm(dim=2).amax(1)
    distance = (scene.means - corners.mean(1)[triangle]).norm(dim=1)
    assert (distance < 4 * reach[triangle]).all()
    assert (distance > 0.02 * reach[triangle]).float().mean() > 0.95, "several on a triangle are apart"


def test_the_face_is_seen_and_fills_the_image(head):
    scene = bound_head(head, len(head.faces), 96, 128)
    alpha = draw(scene, leaves(scene), backend=available_backends()[0]).alpha.detach()
    rows = (alpha > 0.5).any(1).nonzero().flatten()
    assert 0.75 * 128 <= len(rows) < 128
    assert 0 < rows[0]
    assert rows[-1] < 127
    camera = -scene.viewmat[:3, :3].T @ scene.viewmat[:3, 3]
    assert camera[2] > scene.means[:, 2].max(), "in front of the face, which looks along z"
    # The projection of what is up in the world is up in the image, where y points down.
    assert scene.viewmat[1, 1] < 0


def test_another_order_draws_the_same(head):
    scene = bound_head(head, 4000, 64, 96)
    shuffle = torch.randperm(4000, generator=torch.Generator().manual_seed(1))
    backend = available_backends()[0]
    images = [draw(s, leaves(s), backend=backend).image for s in (scene, reordered(scene, shuffle))]
    torch.testing.assert_close(images[0], images[1], rtol=0, atol=1e-6)


@pytest.mark.skipif(
    "cpu" not in available_backends(), reason="the splat kernel is not installed: no C++ compiler was found"
)
def test_both_orders_are_timed_and_the_least_taken(head, monkeypatch):
    seen = []
    genuine = order.take_turns

    def take_turns(runs, **options):
        seen.append({name: len(seconds) for name, seconds in genuine(runs, **options).items()})
        return {"by triangle": [3.0, 2.0], "shuffled": [5.0, 4.0]}

    monkeypatch.setattr(order, "take_turns", take_turns)
    result = measure_order(bound_head(head, 500, 40, 30), budget=0, least_runs=2)
    assert seen == [{"by triangle": 2, "shuffled": 2}]
    assert result == Ordering(500, 40, 30, 2.0, 4.0)
    assert order_table([result]).split("\n")[-1].split() == ["500", "40x30", "2000.0", "4000.0", "2.00"]

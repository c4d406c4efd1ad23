"""What the order of the splats in memory is worth: by triangle, as a bound avatar begins, against none at all.

The sort by depth and the gathering of gradients reach for splats in the order in which they are drawn. Neighbours on the
surface are often drawn one after the other; where they are neighbours in memory too, they are found in the cache.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ....bench.contracts import HeadAsset
from ....methods.ops.mesh import triangle_frames
from ....methods.ops.splats import to_world
from ..timing import milliseconds, table, take_turns
from .scenes import Scene, passes


@dataclass(frozen=True)
class Ordering:
    """Seconds of processor time of both passes on one thread, the least of runs that take turns."""

    splats: int
    width: int
    height: int
    by_triangle: float
    shuffled: float


def bound_head(head: HeadAsset, count: int, width: int, height: int, *, seed: int = 0) -> Scene:
    """Splats on the triangles of a head's mesh, as many on each as on any other, in the order of the triangles.

    Their sizes shrink with their number as in `head_shell`; the whole mesh fills 80 % of the image height.
    """
    rng = torch.Generator().manual_seed(seed)
    vertices = torch.as_tensor(head.template, dtype=torch.float32)
    faces = torch.as_tensor(head.faces, dtype=torch.int64)
    binding = torch.arange(count) * len(faces) // max(count, 1)
    local = torch.randn(count, 3, generator=rng) * torch.tensor([0.25, 0.02, 0.25])
    size = 0.4 * (len(faces) / max(count, 1)) ** 0.5 * torch.exp(0.55 * torch.randn(count, 1, generator=rng))
    flat = torch.cat([size, 0.2 * size, size * torch.exp(0.45 * torch.randn(count, 1, generator=rng))], dim=1)
    turns = torch.tensor([1.0, 0, 0, 0]) + 0.2 * torch.randn(count, 4, generator=rng)
    world = to_world(triangle_frames(vertices, faces), binding, local, flat.log(), turns)

    distance = 1.0
    low, high = vertices.amin(0), vertices.amax(0)
    focal = 0.8 * height * distance / float(high[1] - low[1])
    K = torch.tensor([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])
    viewmat = torch.diag(
        torch.tensor([1.0, -1, -1, 1])
    )  # in front of the face, which looks along z with y up
    viewmat[:3, 3] = torch.tensor([0, 0, distance]) - viewmat[:3, :3] @ (0.5 * (low + high))
    return Scene(
        world.means,
        world.quats,
        world.scales,
        torch.sigmoid(0.4 + 1.8 * torch.randn(count, generator=rng)),
        torch.rand(count, 3, generator=rng),
        viewmat,
        K,
        width,
        height,
        torch.tensor([0.2, 0.5, 0.9]),
    )


def reordered(scene: Scene, order: Tensor) -> Scene:
    """The same splats in another order (N,)."""
    return scene._replace(**{field: getattr(scene, field)[order] for field in Scene._fields[:5]})


def measure_order(scene: Scene, *, budget: float, least_runs: int, seed: int = 0) -> Ordering:
    """Time a scene as it is stored, by triangle, and with its splats shuffled."""
    count = len(scene.means)
    shuffle = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    runs = {"by triangle": _both(scene), "shuffled": _both(reordered(scene, shuffle))}
    least = {name: min(s) for name, s in take_turns(runs, budget=budget, least_runs=least_runs).items()}
    return Ordering(count, scene.width, scene.height, least["by triangle"], least["shuffled"])


def order_table(orderings: Sequence[Ordering]) -> str:
    """Lay out the results."""
    rows = [
        (
            *(str(one.splats), f"{one.width}x{one.height}"),
            *(milliseconds(one.by_triangle), milliseconds(one.shuffled)),
            f"{one.shuffled / one.by_triangle:.2f}",
        )
        for one in orderings
    ]
    header = ("splats", "image", "by triangle", "shuffled", "shuffled/by triangle")
    return (
        "Order in memory of splats bound to a head's mesh. Processor time of both passes, ms, one thread, least of runs "
        "that take\nturns.\n\n" + table(header, rows)
    )


def _both(scene: Scene) -> Callable[[], float]:
    run = passes(scene, "cpu", threads=1)
    return lambda: float(run(time.thread_time)[1])

"""Splats of a pose on a GPU: `Rig.motions` and `apply_pose` in few operations, see `shared.device_frame`."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...bench.contracts import HeadPose
from ..shared import device_frame
from ..shared.binding import WorldSplats
from ..shared.rendering import PlacedSplats
from .blendshapes import LARGEST_SCALE, SMALLEST_SCALE, Entries, Rig, difference_widths

SQUARINGS = 4
"""Of `device_frame.quaternions`: joints that differ by 100 degrees are blended to 1e-6."""


class DeviceSplats:
    """Places an avatar's splats in a pose.

    Parameters
    ----------
    neutral, entries, differences : as those of `avatar.Stored`.
    """

    def __init__(self, rig: Rig, neutral: dict[str, Tensor], entries: Entries, differences: Tensor):
        mesh, expressions = rig.mesh, rig.expressions
        self._rig, self._entries = rig, entries
        self._numbers = device_frame.PoseNumbers(mesh.model, mesh.canonical[None])
        self._rows = rig.at_points(self._numbers.rows())
        model = mesh.model
        # The joints follow all expressions, the splats only the leading ones.
        followed = model.expression_matrix.clone()
        followed[expressions:] = 0
        self._directions = torch.cat([followed, model.pose_matrix]).t().contiguous()
        self._at_points = device_frame.WeightedRows(rig.corners.view(3, -1).t(), rig.barycentric[:, :, 0].t())
        own = sum(difference_widths(0).values()) - 3
        changed = (differences.shape[1] - own) // 3 - 1
        # Harmonics of degree 0 beside the others of their channel, as `device_frame.shade` takes them.
        harmonics = device_frame.coefficients_of(neutral["sh_dc"], neutral["sh_rest"])
        columns = [neutral[name] for name in ("means", "log_scales", "quats")]
        columns += [neutral["opacities"][:, None], harmonics[:, :, : 1 + changed].flatten(1)]
        self._neutral = torch.cat(columns, dim=1)
        self._unchanged = harmonics[:, :, 1 + changed :].contiguous()
        self._differences = differences
        places = torch.arange(differences.shape[1])
        dc, rest = places[own : own + 3, None], places[own + 3 :].view(3, changed)
        order = torch.cat([places[:own], torch.cat([dc, rest], dim=1).flatten()])
        self._order = order.to(differences.device)

    def __call__(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        """Splats of a pose. Raises `InputError` for another head model's pose."""
        rig = self._rig
        sent = device_frame.to_device(self._numbers(pose), self._rows.device)
        coefficients, joints = self._numbers.split(sent)
        motions = self._rows @ joints
        shift = self._at_points(torch.mv(self._directions, coefficients).view(-1, 3))
        quaternions = device_frame.quaternions(motions[:, :9], SQUARINGS)
        rotation, product = device_frame.quaternion_products(quaternions)
        coefficients = coefficients[: rig.expressions]
        turn = torch.mv(rig.turns, coefficients).view(-1, 4).index_select(0, rig.turned)
        end_stage("drive")
        changes = self._entries.sum(self._differences, coefficients)
        attributes = self._neutral + changes.index_select(1, self._order)
        local, log_scales, quats, logits, harmonics = attributes.split(
            [3, 3, 4, 1, attributes.shape[1] - 11], dim=1
        )
        linear, offset = motions[:, :9].unflatten(1, (3, 3)), motions[:, 9:]
        means = (linear * (local + shift)[:, :, None]).sum(1) + offset
        units = normalize(quats + turn, dim=1)
        turned = (product.view(-1, 4, 4) * units[:, None]).sum(2)
        world = WorldSplats(means, turned, log_scales.exp().clamp_(SMALLEST_SCALE, LARGEST_SCALE))
        harmonics = harmonics.unflatten(1, (3, -1))
        if self._unchanged.shape[2]:
            harmonics = torch.cat([harmonics, self._unchanged], dim=2)

        def colors(center: Tensor) -> Tensor:
            own = ((means - center)[:, :, None] * rotation.view(-1, 3, 3)).sum(1)
            return device_frame.shade(harmonics, normalize(own, dim=1))

        return PlacedSplats(world, torch.sigmoid(logits[:, 0]), colors)

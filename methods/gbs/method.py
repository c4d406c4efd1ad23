"""GaussianBlendshapes: a head as linear blendshapes of splats, skinned like FLAME.

Ma et al., "3D Gaussian Blendshapes for Head Avatar Animation", SIGGRAPH 2024, arXiv 2404.19398.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Changes, Clip, FloatArray, HeadPose, no_stage
from ..avatars.compact.layouts import blended, read_coded
from ..avatars.harmonics import turn_harmonics
from ..ops.planes import C0, sh_degree
from ..shared.avatar_files import AVATAR_FILE, Subject, clip_mesh, finish_fit, read_stored
from ..shared.capacity import CapacityPlan, CapacityPlanner
from ..shared.loop import Fit
from ..shared.method import TrainedMethod
from ..shared.rendering import LastPose, PlacedSplats, StoredSplatAvatar, changes_of
from ..shared.schedule import ShuffledEpochs
from .blendshapes import (
    PointMotions,
    PosedAttributes,
    Rig,
    Stored,
    apply_pose,
    difference_widths,
    stored_of,
    write_avatar,
)
from .spec import GBS as SPEC
from .spec import GBSConfig
from .training import GBSTraining, padded_offset, with_mouth


class GBSAvatar(StoredSplatAvatar):
    """A trained head: neutral splats, differences for expressions, and the joints that move them.

    Files: ``avatar.safetensors`` and ``subject.npz``, or the coded file in place of both, count as storage. The folder also
    has the shared head model with teeth. Values derived from the mesh are computed when the avatar is loaded.
    """

    def __init__(self, files: Sequence[Path], subject: Subject, rig: Rig, stored: Stored, device: str):
        super().__init__(files, self._placed, device)
        self._rig, self.subject, self.stored = rig, subject, stored
        self._last = LastPose(self._posed)

    @classmethod
    def read(cls, folder: Path, device: str) -> GBSAvatar:
        """Read an avatar from its folder. Raises `InputError` for damaged or incompatible files."""
        content_of, coded = partial(stored_of, device=device), partial(read_coded, layout=blended)
        files, head, subject, stored = read_stored(folder, AVATAR_FILE, content_of, coded)
        rig = Rig(head, subject.shape, subject.static_offset, stored.points, stored.expressions, device)
        return cls(files, subject, rig, stored, device)

    @torch.no_grad()
    def harmonics(self, pose: HeadPose) -> tuple[FloatArray, FloatArray]:
        """Colours of a pose; see `HarmonicAvatar`. They are stored along the splats' axes, which turn with the surface."""
        posed = self._last(pose, no_stage)
        return turn_harmonics(posed.sh_dc, posed.sh_rest, posed.rotation)

    @torch.no_grad()
    def changes(self, pose: HeadPose) -> Changes:
        """Effect of the learnt differences."""
        widths = difference_widths(0)
        columns = self._differences(self._rig.arguments([pose]))[:, : sum(widths.values())]
        learnt = dict(zip(widths, columns.split([*widths.values()], dim=1)))
        opacity = torch.sigmoid(self.stored.neutral["opacities"] + learnt["opacities"][:, 0])
        return changes_of(
            {"position": 1000 * learnt["means"], "opacity": opacity, "color": C0 * learnt["sh_dc"]}
        )

    def _posed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PosedAttributes:
        arguments = self._rig.arguments([pose])
        motions = PointMotions.of(self._rig.motions(arguments))
        end_stage("drive")
        return apply_pose(self.stored.neutral, self._differences(arguments), motions)

    def _differences(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(N, C) learnt differences of a pose."""
        return self.stored.entries.sum(self.stored.differences, self._rig.coefficients(arguments))

    def _placed(self, pose: HeadPose, end_stage: Callable[[str], None]) -> PlacedSplats:
        posed = self._last(pose, end_stage)
        degree = sh_degree(self.stored.neutral["sh_rest"])
        return PlacedSplats(posed.world, posed.opacities, lambda center: posed.colors(center, degree))


class GBS(TrainedMethod[GBSConfig, GBSAvatar]):
    """See the module docstring."""

    name, version = SPEC.name, SPEC.version
    config_class, avatar_class = GBSConfig, GBSAvatar

    def _planned(self, clip: Clip, config: GBSConfig, device: str) -> CapacityPlan:
        planner = CapacityPlanner(clip, clip_mesh(clip, device), config.capacity)
        planner.expressions("expressions", config.expressions)
        planner.splats("splats.max_splats", config.splats.max_splats, config.samples)
        return planner.plan()

    def _train(self, fit: Fit, config: GBSConfig) -> None:
        clip, seed = fit.clip, fit.seed
        head = with_mouth(clip.head, config)
        offset = padded_offset(np.asarray(clip.static_offset, np.float32), len(head.template))
        subject = Subject(clip.subject, head.version, np.asarray(clip.shape, np.float32), offset)
        sampler = ShuffledEpochs(len(clip.splits["train"]), seed)
        training = GBSTraining(clip, config, subject, head, sampler, fit.device, seed)
        outcome = training.run(fit)
        self._write(fit.out / AVATAR_FILE, training)
        counts = {"splats": len(training.binding), "differences": len(training.entries.owners)}
        finish_fit(fit, outcome, subject, head, **counts, teeth="teeth" in head.regions)

    def _write(self, path: Path, training: GBSTraining) -> None:
        binding = training.binding.cpu().numpy()
        points = training.points.rows(binding)
        neutral = {name: training.optimiser[name].detach() for name in training.splat_names}
        differences = training.merged_differences()
        write_avatar(path, neutral, points, training.rig.expressions, training.entries, differences)

"""The tensorial method at toy size, with parameters that make every part of it matter."""

from dataclasses import replace

import torch
from torch import nn

from headbench.methods.ours.appearance import OursAppearance
from headbench.methods.ours.config import Lines, OursConfig, Planes
from headbench.methods.shared.avatar_files import Subject
from headbench.methods.shared.optimisation import Optimiser
from headbench.methods.shared.rendering import view_of
from headbench.methods.shared.schedule import Timeline
from headbench.methods.shared.subject_mesh import SubjectMesh

SMALL = OursConfig(
    hidden=8, planes=Planes(resolution=8, channels=(4, 2, 2)), lines=Lines(resolution=6, channels=3)
)


def changed(config, **settings):
    """The configuration with other settings; those of a group as a dict."""
    groups = {name: value for name, value in settings.items() if isinstance(value, dict)}
    return replace(
        config, **settings | {name: replace(getattr(config, name), **value) for name, value in groups.items()}
    )


def make(clip, config=SMALL):
    subject = Subject.of(clip)
    mesh = SubjectMesh(clip.head, subject.shape, subject.static_offset, "cpu")
    appearance = OursAppearance(mesh, clip, config, "cpu", 0)
    appearance.begin(Timeline(600_000, 600_000))
    count = len(mesh.faces)
    values = {name: value for name, (value, _) in appearance.parameters().items()}
    values["means"] = 0.1 * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    values["opacities"] = torch.zeros(count)
    values["log_scales"], values["quats"] = torch.zeros(count, 3), torch.ones(count, 4)
    values |= {name: value for name, (value, _) in appearance.splat_parameters(count).items()}
    if "lines" in values:
        values["lines"] = torch.randn(values["lines"].shape, generator=torch.Generator().manual_seed(1))
    optimiser = Optimiser({n: nn.Parameter(v) for n, v in values.items()}, dict.fromkeys(values, 0.1))
    return appearance, optimiser, torch.arange(count)


def place(clip, appearance, optimiser, binding, iteration):
    key = clip.splits["train"][0]
    frames = appearance.frames(key.timestep, optimiser)
    view = view_of(clip.cameras[key.camera], "cpu")
    return appearance.place(frames, binding, view, key.timestep, optimiser, iteration)

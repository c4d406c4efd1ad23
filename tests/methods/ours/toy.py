"""The tensorial method at toy size, with parameters that make every part of it matter."""

from dataclasses import replace

import torch
from torch import nn

from headbench.methods.ours.appearance import OursAppearance
from headbench.methods.ours.field import FIELD_FILE, write_field
from headbench.methods.ours.spec import Lines, OursConfig, Planes
from headbench.methods.shared.avatar_files import SUBJECT_FILE, Subject, save_shared_head, write_subject
from headbench.methods.shared.optimisation import Optimiser
from headbench.methods.shared.rendering import view_of
from headbench.methods.shared.schedule import Timeline
from headbench.methods.shared.surface_points import SubjectMesh

from ..recorded import recorded

SMALL = OursConfig(
    hidden=8,
    planes=Planes(resolution=8, channels=(4, 2, 2)),
    lines=Lines(resolution=6, channels=3, bounds="head"),
)


GEOMETRY = ("means", "log_scales", "quats", "opacities")


def changed(config, **settings):
    """The configuration with other settings; those of a group as a dict."""
    groups = {name: value for name, value in settings.items() if isinstance(value, dict)}
    return replace(
        config, **settings | {name: replace(getattr(config, name), **value) for name, value in groups.items()}
    )


REPAIRED = changed(SMALL, planes={"residual_lr": 0.01, "move_splats": False})
CASES = {
    "opacity": SMALL,
    "others": changed(SMALL, lines={"dynamic": ("position", "rotation", "scale", "color")}),
    "repaired": REPAIRED,
    "harmonics": replace(SMALL, color="sh", sh_degree=2),
    "no lines": changed(SMALL, lines={"enabled": False}),
}
"""Configurations whose avatars are stored and drawn in other ways."""


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


def write(folder, clip, config, appearance, values, binding):
    """Put an avatar of these tensors by name, trained or not, into a folder."""
    write_field(
        folder / FIELD_FILE,
        {name: values[name] for name in (*GEOMETRY, *appearance.splat_parameters(1))},
        binding,
        {name: values[name] for name in appearance.parameters()},
        *(appearance.plane_box, appearance.line_box, appearance.jaw_bases, config.lines.dynamic),
    )
    write_subject(folder / SUBJECT_FILE, Subject.of(clip))
    save_shared_head(folder, clip.head)
    return recorded(folder, "ours", clip, config)


def place(clip, appearance, optimiser, binding, iteration):
    key = clip.splits["train"][0]
    frames = appearance.frames(key.timestep, optimiser)
    view = view_of(clip.cameras[key.camera], "cpu")
    return appearance.place(frames, binding, view, key.timestep, optimiser, iteration)


def store(clip, folder, config=SMALL, change=lambda values: None, copies=1):
    """Write an avatar of parameters that make every part matter; ``change`` edits its tensors by name in place before, ``copies`` splats sit on a triangle."""
    appearance, optimiser, binding = make(clip, config)
    own = appearance.splat_parameters(1)
    generator = torch.Generator().manual_seed(3)
    count = copies * len(binding)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    values = {name: optimiser[name].detach().clone() for name in appearance.parameters()}
    for name, value in values.items():
        if name.startswith("plane_"):
            value.mul_(5)
    values |= {
        "means": 0.3 * normal(count, 3),
        "log_scales": -1.5 + 0.5 * normal(count, 3),
        "quats": normal(count, 4),
        "opacities": 2 * normal(count),
    }
    values |= {name: 0.3 * normal(count, *optimiser[name].shape[1:]) for name in own}
    change(values)
    triangles = torch.randint(0, len(binding), (count,), generator=generator)
    return write(folder, clip, config, appearance, values, triangles)

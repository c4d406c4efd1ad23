"""A stored avatar of ours at toy size, without training: parameters that make every part matter, written to a folder."""

import torch

from headbench.methods.ours.storage import FIELD_FILE, write_field
from headbench.methods.shared.avatar_files import SUBJECT_FILE, Subject, save_shared_head, write_subject

from .ours.toy import SMALL, make


def store(clip, folder, config=SMALL, change=lambda values: None, copies=1):
    """Write the avatar; ``change`` edits its tensors by name in place before, ``copies`` splats sit on a triangle."""
    appearance, optimiser, binding = make(clip, config)
    own = appearance.splat_parameters(1)
    names = ["means", "log_scales", "quats", "opacities", *own]
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
    shared = {name: values[name] for name in appearance.parameters()}
    write_field(
        folder / FIELD_FILE,
        {name: values[name] for name in names},
        torch.randint(0, len(binding), (count,), generator=generator),
        shared,
        appearance.plane_box,
        appearance.line_box,
        appearance.jaw_bases,
        config.lines.dynamic,
    )
    write_subject(folder / SUBJECT_FILE, Subject.of(clip))
    save_shared_head(folder, clip.head)
    return folder

"""What the lines may change: each part by hand, and training and stored avatar alike for every ablation."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.bench.errors import InputError
from headbench.methods.ours.field import LocalSplats, apply_offsets, changed_colors, offset_width
from headbench.methods.ours.method import OursAvatar

from .toy import REPAIRED, SMALL, changed, make, place, write

OTHERS = ("position", "rotation", "scale", "color")


def splats(count=4):
    generator = torch.Generator().manual_seed(0)
    return LocalSplats(*(torch.randn(count, *shape, generator=generator) for shape in ((3,), (3,), (4,), ())))


def test_each_part_gets_its_own_columns():
    order = ("scale", "opacity", "color", "rotation", "position")
    offsets = torch.arange(4.0 * offset_width(order)).view(4, -1)
    before = splats()
    after = apply_offsets(before, offsets, order)
    np.testing.assert_allclose(after.log_scales, before.log_scales + offsets[:, 0:3])
    np.testing.assert_allclose(after.logits, before.logits + offsets[:, 3])
    np.testing.assert_allclose(after.quats, before.quats + offsets[:, 7:11])
    np.testing.assert_allclose(after.means, before.means + offsets[:, 11:14])
    np.testing.assert_allclose(changed_colors(torch.zeros(4, 3), after), offsets[:, 4:7])


def test_colours_do_not_fall_below_zero():
    dark = splats()._replace(color_change=torch.full((4, 3), -2.0))
    assert changed_colors(torch.ones(4, 3), dark).abs().max() == 0


CASES = {
    "opacity": SMALL,
    "others": changed(SMALL, lines={"dynamic": OTHERS}),
    "everything": changed(SMALL, lines={"dynamic": ("color", "opacity", "position")}),
    "repaired": changed(REPAIRED, lines={"dynamic": ("color", "opacity")}),
    "harmonics": replace(SMALL, color="sh", sh_degree=2),
    "harmonics, others": changed(SMALL, color="sh", lines={"dynamic": OTHERS}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_stored_avatar_places_its_splats_as_training_does(case, clip, tmp_path):
    appearance, optimiser, binding = make(clip, CASES[case])
    for name in appearance.splat_parameters(1):
        optimiser[name].data.normal_(generator=torch.Generator().manual_seed(2))
    key = clip.splits["train"][0]
    placed = place(clip, appearance, optimiser, binding, 600_000)
    stored = OursAvatar.read(write(tmp_path, clip, CASES[case], appearance, optimiser, binding), "cpu")
    stored = stored.splats(clip.poses[key.timestep], clip.cameras[key.camera])
    for name in ("means", "quats", "scales"):
        np.testing.assert_allclose(getattr(stored, name), getattr(placed.world, name).detach(), atol=1e-5)
    np.testing.assert_allclose(stored.opacities, placed.opacities.detach(), atol=1e-5)
    np.testing.assert_allclose(stored.colors, placed.colors.detach(), atol=2e-5)


def test_the_others_change_geometry_and_leave_opacity(clip):
    appearance, optimiser, binding = make(clip, CASES["others"])
    before = place(clip, appearance, optimiser, binding, 60_000)
    after = place(clip, appearance, optimiser, binding, 60_001)
    assert torch.equal(before.opacities, after.opacities)
    for name in ("means", "quats", "scales"):
        assert not torch.equal(getattr(before.world, name), getattr(after.world, name))
    assert after.penalty > 0


def test_a_foreign_name_in_a_file_is_refused(clip, tmp_path):
    foreign = changed(SMALL, lines={"dynamic": ("opacity", "velocity")})
    write(tmp_path, clip, foreign, *make(clip))
    with pytest.raises(InputError, match="velocity"):
        OursAvatar.read(tmp_path, "cpu")

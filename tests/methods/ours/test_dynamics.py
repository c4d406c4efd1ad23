"""What the lines may change: each part by hand, and training and stored avatar alike for every ablation."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.bench.errors import InputError
from headbench.methods.ours.avatar import OursAvatar
from headbench.methods.ours.config import Lines, OursConfig
from headbench.methods.ours.field import WIDTHS, LocalSplats, apply_offsets, changed_colors, offset_width
from headbench.methods.ours.storage import FIELD_FILE, write_field
from headbench.methods.shared.avatar_files import SUBJECT_FILE, Subject, save_shared_head, write_subject

from .toy import SMALL, changed, make, place

OTHERS = ("position", "rotation", "scale", "color")


def splats(count=4):
    generator = torch.Generator().manual_seed(0)
    return LocalSplats(*(torch.randn(count, *shape, generator=generator) for shape in ((3,), (3,), (4,), ())))


def test_each_part_gets_its_own_columns():
    order = ("scale", "opacity", "color", "rotation", "position")
    offsets = torch.arange(4.0 * offset_width(order)).view(4, -1)
    before = splats()
    after = apply_offsets(before, offsets, order)
    np.testing.assert_array_equal(after.log_scales - before.log_scales, after.log_scales - before.log_scales)
    np.testing.assert_allclose(after.log_scales, before.log_scales + offsets[:, 0:3])
    np.testing.assert_allclose(after.logits, before.logits + offsets[:, 3])
    np.testing.assert_allclose(after.quats, before.quats + offsets[:, 7:11])
    np.testing.assert_allclose(after.means, before.means + offsets[:, 11:14])
    np.testing.assert_allclose(changed_colors(torch.zeros(4, 3), after), offsets[:, 4:7])


@pytest.mark.parametrize("name", WIDTHS)
def test_one_part_leaves_the_others_alone(name):
    before = splats()
    after = apply_offsets(before, torch.ones(4, WIDTHS[name]), (name,))
    attribute = dict(zip(WIDTHS, ("logits", "means", "quats", "log_scales", "color_change")))[name]
    for field in ("logits", "means", "quats", "log_scales"):
        assert torch.equal(getattr(before, field), getattr(after, field)) == (field != attribute)
    assert (after.color_change is None) == (name != "color")


def test_colours_do_not_fall_below_zero():
    dark = splats()._replace(color_change=torch.full((4, 3), -2.0))
    assert changed_colors(torch.ones(4, 3), dark).abs().max() == 0


CASES = {
    "opacity": SMALL,
    "others": changed(SMALL, lines={"dynamic": OTHERS}),
    "everything": changed(SMALL, lines={"dynamic": ("color", "opacity", "position")}),
    "harmonics": replace(SMALL, color="sh", sh_degree=2),
    "harmonics, others": changed(SMALL, color="sh", lines={"dynamic": OTHERS}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_stored_avatar_places_its_splats_as_training_does(case, clip, tmp_path):
    appearance, optimiser, binding = make(clip, CASES[case])
    for name in ("sh_dc", "sh_rest"):
        if name in appearance.splat_parameters(1):
            optimiser[name].data.normal_(generator=torch.Generator().manual_seed(2))
    key = clip.splits["train"][0]
    placed = place(clip, appearance, optimiser, binding, 600_000)
    names = ["means", "log_scales", "quats", "opacities", *appearance.splat_parameters(1)]
    write_field(
        tmp_path / FIELD_FILE,
        {name: optimiser[name] for name in names},
        binding,
        {name: optimiser[name] for name in appearance.parameters()},
        appearance.plane_box,
        appearance.line_box,
        appearance.jaw_bases,
        CASES[case].lines.dynamic,
    )
    write_subject(tmp_path / SUBJECT_FILE, Subject.of(clip))
    save_shared_head(tmp_path, clip.head)
    stored = OursAvatar.read(tmp_path, "cpu").splats(clip.poses[key.timestep], clip.cameras[key.camera])
    for name in ("means", "quats", "scales"):
        np.testing.assert_allclose(
            getattr(stored, name), getattr(placed.world, name).detach(), atol=1e-5, err_msg=name
        )
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


@pytest.mark.parametrize("dynamic", [(), ("opacity", "opacity")])
def test_a_choice_that_means_nothing_is_refused(dynamic):
    with pytest.raises(ValueError, match="dynamic"):
        OursConfig(lines=Lines(dynamic=dynamic))


def test_a_foreign_name_in_a_file_is_refused(clip, tmp_path):
    appearance, optimiser, binding = make(clip)
    arguments = [appearance.plane_box, appearance.line_box, appearance.jaw_bases, ("opacity", "velocity")]
    splats = {name: optimiser[name] for name in ("means", "log_scales", "quats", "opacities")}
    shared = {name: optimiser[name] for name in appearance.parameters()}
    write_field(tmp_path / FIELD_FILE, splats, binding, shared, *arguments)
    write_subject(tmp_path / SUBJECT_FILE, Subject.of(clip))
    save_shared_head(tmp_path, clip.head)
    with pytest.raises(InputError, match="velocity"):
        OursAvatar.read(tmp_path, "cpu")

"""Compact avatars: what is kept, what is lost, what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors import safe_open

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.methods.avatars.compact.container import read_content, write_content
from headbench.methods.avatars.compact.file import encode, part_sizes
from headbench.methods.avatars.compact.precision import EXACT, Precision
from headbench.methods.avatars.compact.simplify import simplify
from headbench.methods.ours.avatar import OursAvatar
from headbench.methods.ours.config import Lines, OursConfig, Planes
from headbench.methods.ours.method import Ours
from headbench.methods.ours.storage import FIELD_FILE, RESIDUAL
from headbench.methods.shared.avatar_files import COMPACT_FILE, read_shared_head
from headbench.methods.shared.capacity import training_poses
from headbench.methods.shared.config import SplatTraining

from ...ours.toy import CASES, SMALL, store
from ...toy_clip import first_view


def compacted(folder, precision, poses=(), weights=None):
    """The avatar of a folder before, and after a compact file was written beside it."""
    before = OursAvatar.read(folder, "cpu", exact=True)
    field = simplify(before, poses, precision)
    content = encode(field, before.subject, read_shared_head(folder), precision, weights)
    write_content(folder / COMPACT_FILE, content)
    return before, OursAvatar.read(folder, "cpu")


@pytest.mark.parametrize("case", CASES)
def test_without_rounding_only_the_order_of_splats_changes(case, clip, tmp_path):
    camera, pose = first_view(clip)
    before, after = compacted(store(clip, tmp_path, CASES[case], copies=2), EXACT)
    order = torch.argsort(before.field.tensors["splats"][:, -1], stable=True)
    one, other = before.splats(pose, camera), after.splats(pose, camera)
    for name in ("means", "scales", "quats", "opacities", "colors"):
        np.testing.assert_array_equal(getattr(one, name)[order], getattr(other, name), err_msg=name)
    np.testing.assert_allclose(before.render(camera, pose).rgb, after.render(camera, pose).rgb, atol=1e-6)
    assert [path.name for path in after.files()] == [COMPACT_FILE]
    assert {path.name for path in before.files()} == {FIELD_FILE, "subject.npz"}


@pytest.mark.parametrize("case", CASES)
def test_rounding_stays_within_its_steps(case, clip, tmp_path):
    precision = Precision()
    before, after = compacted(store(clip, tmp_path, CASES[case]), precision)
    one, other = before.field.tensors, after.field.tensors
    order = torch.argsort(one["splats"][:, -1], stable=True)
    columns = [3, 1, 3, 4, 1]
    means, logits, scales, quats, triangles = one["splats"][order].split(columns, dim=1)
    means2, logits2, scales2, quats2, triangles2 = other["splats"].split(columns, dim=1)
    assert torch.equal(triangles, triangles2)
    assert (logits - logits2).abs().max() <= 0.5 * precision.opacities + 1e-5
    assert (scales - scales2).abs().max() <= 0.5 * precision.scales + 1e-5
    size = scales2.mean(1, keepdim=True).exp().clamp_min(0.02)
    assert ((means - means2).abs() / size).max() <= 0.5 * precision.positions + 1e-4
    if case == "others":
        assert (quats - quats2).abs().max() <= 0.5 * precision.rotations + 1e-5
    if "sh_dc" in one:
        # Mean squared colour over all directions is the sum of squared coefficients over 4 pi.
        squares = sum((one[n][order] - other[n]).flatten(1).square().sum(1) for n in ("sh_dc", "sh_rest"))
        count = 3 * (1 + one["sh_rest"].shape[2])
        assert (squares / (4 * math.pi)).mean() <= count * precision.harmonics**2
    if RESIDUAL in one:
        assert (one[RESIDUAL][order] - other[RESIDUAL]).abs().max() <= 2 * precision.colors
    if "line_direction_1" in one:
        weights = one["line_direction_1"]
        largest = weights.abs().amax(1, keepdim=True)
        assert ((weights - other["line_direction_1"]).abs() / largest).max() <= 2 * precision.networks
    assert np.abs(before.subject.static_offset - after.subject.static_offset).max() <= 0.5 * precision.subject


@pytest.mark.parametrize("case", CASES)
def test_defaults_cost_little_and_each_coarser_part_costs_more(case, clip, tmp_path):
    camera, pose = first_view(clip, "self_reenactment")
    folder = store(clip, tmp_path, CASES[case], copies=2)

    def error(precision):
        before, after = compacted(folder, precision)
        return float(np.mean((before.render(camera, pose).rgb - after.render(camera, pose).rgb) ** 2))

    assert -10 * np.log10(error(Precision())) > 35
    stored = part_sizes(read_content(folder / COMPACT_FILE))
    for part in EXACT.parts:
        if part not in ("subject", "lines") and part in stored:
            fine, coarse = (error(replace(EXACT, **{part: step})) for step in (0.01, 0.3))
            assert coarse > 2 * fine, part


def test_fewer_bytes_than_a_tenth_at_a_trained_avatars_numbers(clip, tmp_path):
    """Sizes whose plane numbers, as in training, need few steps; the ratio is a floor, measured at 19 on a real one."""
    config = OursConfig(planes=Planes(resolution=64), lines=Lines(enabled=False))
    folder = store(clip, tmp_path, config, lambda values: values["color_weight_0"].mul_(0.3), copies=4)
    before, after = compacted(folder, Precision())
    exact, compact = (sum(path.stat().st_size for path in avatar.files()) for avatar in (before, after))
    assert compact < exact / 10
    head = read_shared_head(folder)
    content = encode(simplify(before, [], Precision()), before.subject, head, Precision())
    assert sum(part_sizes(content).values()) < compact


def test_splats_that_no_pose_shows_are_left_out_and_not_missed(clip, tmp_path):
    hide = lambda values: values["opacities"][::3].fill_(-60.0)
    before, after = compacted(store(clip, tmp_path, change=hide, copies=3), EXACT, training_poses(clip))
    count = len(before.field.tensors["splats"])
    assert len(after.field.tensors["splats"]) <= count - (count + 2) // 3
    for split in ("train", "novel_view"):
        camera, pose = first_view(clip, split)
        np.testing.assert_allclose(before.render(camera, pose).rgb, after.render(camera, pose).rgb, atol=1e-6)


def test_a_splat_that_one_expression_shows_stays(clip, tmp_path):
    before = OursAvatar.read(store(clip, tmp_path), "cpu")
    poses = training_poses(clip)
    seen = np.array([before.splats(pose).opacities >= 1 / 255 for pose in poses])
    field = simplify(before, poses, EXACT)
    assert len(field.tensors["splats"]) == seen.any(0).sum()
    assert len(simplify(before, [], EXACT).tensors["splats"]) == seen.shape[1]


def test_lines_of_zeros_become_a_part_of_the_opacities(clip, tmp_path):
    before, after = compacted(store(clip, tmp_path, change=lambda v: v["lines"].zero_()), EXACT)
    assert not any(name.startswith("line_d") or name == "lines" for name in after.field.tensors)
    camera, pose = first_view(clip)
    order = torch.argsort(before.field.tensors["splats"][:, -1], stable=True)
    one, other = before.splats(pose, camera), after.splats(pose, camera)
    np.testing.assert_allclose(one.opacities[order], other.opacities, atol=1e-6)
    # They do change opacities: without them, the logits alone would show another avatar.
    logits = before.field.tensors["splats"][:, 3]
    assert (torch.sigmoid(logits) - torch.from_numpy(one.opacities)).abs().max() > 1e-3


def test_single_lines_of_zeros_cost_nothing(clip, tmp_path):
    folder = store(clip, tmp_path, change=lambda values: values["lines"][::2].zero_())
    before, after = compacted(folder, Precision())
    assert not after.field.tensors["lines"][::2].any()
    np.testing.assert_allclose(after.field.tensors["lines"], before.field.tensors["lines"], atol=0.2)
    assert before.field.tensors["lines"].abs().max() > 1
    with safe_open(tmp_path / COMPACT_FILE, "np") as file:
        assert "line_direction_0" in file.keys()  # noqa: SIM118 - not a mapping


def test_a_fit_leaves_exact_files_and_a_coded_one_is_enough(clip, tmp_path):
    method = Ours(replace(SMALL, splats=SplatTraining(min_settle=4)))
    exact = method.fit(clip, tmp_path, Budget(iterations=12), device="cpu", seed=0, progress=no_progress)
    assert {path.name for path in exact.files()} == {FIELD_FILE, "subject.npz"}
    assert not (tmp_path / COMPACT_FILE).exists()
    _, avatar = compacted(tmp_path, Precision(), training_poses(clip))
    camera, pose = first_view(clip)
    difference = avatar.render(camera, pose).rgb - exact.render(camera, pose).rgb
    assert 0 < np.mean(difference**2) < 1e-3
    # The coded file and the shared head model are enough.
    (tmp_path / FIELD_FILE).unlink()
    (tmp_path / "subject.npz").unlink()
    alone = method.load(tmp_path, device="cpu")
    assert list(alone.files()) == [tmp_path / COMPACT_FILE]
    np.testing.assert_array_equal(alone.render(camera, pose).rgb, avatar.render(camera, pose).rgb)


def test_hidden_splats_are_rounded_more_coarsely(clip, tmp_path):
    """Errors grow as visibility falls, and the coarser avatar takes fewer bytes."""
    folder = store(clip, tmp_path, CASES["harmonics"], copies=8)
    weights = np.where(
        np.arange(len(OursAvatar.read(folder, "cpu", exact=True).neutral.means)) % 2, 1.0, 2.0**-8
    )
    before, after = compacted(folder, Precision(), weights=weights)
    order = torch.argsort(before.field.tensors["splats"][:, -1], stable=True)
    error = (before.field.tensors["splats"][order] - after.field.tensors["splats"])[:, 4:7].abs().amax(1)
    assert error[::2].max() > 1.5 * error[1::2].max()
    plain = (folder / COMPACT_FILE).stat().st_size
    compacted(folder, Precision(step=4), weights=weights)
    assert (folder / COMPACT_FILE).stat().st_size < plain


def test_an_array_of_a_later_method_is_kept_as_it_is(clip, tmp_path):
    before = OursAvatar.read(store(clip, tmp_path), "cpu")
    extra = torch.arange(6.0).view(2, 3)
    path, person = tmp_path / COMPACT_FILE, (before.subject, read_shared_head(tmp_path))
    with pytest.raises(ValueError, match="sorted by triangle"):
        encode(before.field, *person, EXACT)
    tensors = simplify(before, [], EXACT).tensors
    field = before.field._replace(tensors={**tensors, "projection": extra})
    write_content(path, encode(field, *person, Precision()))
    found = OursAvatar.read(tmp_path, "cpu").field.tensors["projection"]
    assert torch.equal(found, extra)


@pytest.fixture(scope="module")
def sound(clip, tmp_path_factory):
    """A folder with a compact avatar, and its content."""
    folder = tmp_path_factory.mktemp("sound")
    compacted(store(clip, folder), Precision())
    return folder, read_content(folder / COMPACT_FILE)


def without(name):
    return lambda content: replace(content, arrays={k: v for k, v in content.arrays.items() if k != name})


def with_array(name, change):
    return lambda content: replace(content, arrays={**content.arrays, name: change(content.arrays[name])})


def with_text(**text):
    return lambda content: replace(content, text={**content.text, **text})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        *((without(name), name) for name in ("triangles", "positions", "rotations", "logits", "log_scales")),
        *((without(name), name) for name in ("plane_xy_mean", "plane_xz_used", "lines_kept", "line_bias_0")),
        *((without(name), name) for name in ("plane_box", "jaw_bases", "shape", "static_offset", "plane_yz")),
        (with_array("triangles", lambda a: a + np.uint8(200)), "triangle"),
        (with_array("triangles", lambda a: a.astype(np.float32)), "whole numbers"),
        (with_array("positions", lambda a: a[:, 1:]), "positions"),
        (with_array("rotations", lambda a: a[:2]), "rotations"),
        (with_array("logits", lambda a: np.full(a.shape, np.inf, np.float32)), "logits"),
        (with_array("lines_kept", lambda a: a[:-2]), "lines"),
        (with_array("lines", lambda a: a[..., :1]), "lines"),
        (with_array("lines_samples", lambda a: a + np.uint32(1)), "lines"),
        (with_array("classes", lambda a: a[1:]), "classes"),
        (with_array("plane_xy_used", lambda a: a[:-1]), "plane_xy"),
        (with_array("plane_xy_mean", lambda a: a * np.float32(np.nan)), "plane_xy_mean"),
        (with_array("color_weight_0_steps", lambda a: a[1:]), "color_weight_0"),
        (with_array("plane_box", lambda a: a.astype(np.uint8)), "plane_box"),
        (with_array("shape", lambda a: a[1:]), "shape"),
        (with_text(head_model="another"), "head_model"),
        (with_text(dynamic="velocity"), "velocity"),
        (with_text(dynamic=""), "dynamic"),
        (lambda content: replace(content, text={}), "name"),
        (lambda content: replace(content, steps={}), "steps"),
    ],
)
def test_nothing_can_be_missing_foreign_or_of_another_size(sound, tmp_path, change, says):
    folder, content = sound
    (tmp_path / "head_model.npz").write_bytes((folder / "head_model.npz").read_bytes())
    write_content(tmp_path / COMPACT_FILE, change(content))
    with pytest.raises(InputError, match=says):
        OursAvatar.read(tmp_path, "cpu")


def test_steps_outside_their_range_are_refused():
    for value in (-0.1, 1.0, float("nan")):
        with pytest.raises(ValueError, match="planes"):
            Precision(planes=value)
    for value in (0.0, -1.0, 1e9, float("nan")):
        with pytest.raises(ValueError, match="step"):
            Precision(step=value)


def test_one_factor_changes_all_steps():
    half = Precision(step=0.5).scaled
    assert half.step == 1
    for part in half.parts:
        assert getattr(half, part) == 0.5 * getattr(Precision(), part)
    assert all(getattr(EXACT.scaled, part) == 0 for part in EXACT.parts)

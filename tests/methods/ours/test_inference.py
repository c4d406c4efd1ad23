"""The fast ways of a stored avatar against the slow ones, and what it keeps from frame to frame."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.bench.errors import InputError
from headbench.methods.ops.planes import Bounds, line_offsets
from headbench.methods.ours.avatar import LineOffsets, OursAvatar
from headbench.methods.ours.field import blend_lines, line_table, normalised_weight, offset_layers
from headbench.methods.shared.subject_mesh import pose_key

from ..toy_clip import first_view
from .toy import CASES, store


def directions(count, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=1)


def test_offsets_are_those_of_training(clip, tmp_path):
    tensors = OursAvatar.read(store(clip, tmp_path), "cpu").field.tensors
    low, high = tensors["line_box"]
    generator = torch.Generator().manual_seed(4)
    points = low + (high - low) * (1.4 * torch.rand(15000, 3, generator=generator) - 0.2)
    jaw = torch.rand(len(tensors["jaw_bases"]), generator=generator)
    expression = torch.randn(len(tensors["lines"]) - len(jaw), generator=generator)
    found = LineOffsets(tensors, points)(torch.cat([expression, jaw]))
    table = line_table(blend_lines(tensors["lines"], expression, jaw), normalised_weight(tensors, 0))
    expected = line_offsets(points, Bounds(low, high), table, offset_layers(tensors))
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert 1000 < (found == 0).all(1).sum() < 14000
    exact = {name: value.double() for name, value in tensors.items()}
    slow = LineOffsets(exact, points.double())(torch.cat([expression, jaw]).double())
    np.testing.assert_allclose(found, slow, atol=1e-5)


@pytest.mark.parametrize("case", CASES)
def test_frames_do_not_depend_on_what_was_drawn_before(case, clip, tmp_path):
    """Any walk over poses and cameras gives each frame bit for bit as a fresh avatar does."""
    folder = store(clip, tmp_path, CASES[case])
    avatar = OursAvatar.read(folder, "cpu")
    cameras, poses = list(clip.cameras.values()), list(clip.poses.values())
    walk = [(0, 0), (1, 0), (1, 0), (1, 1), (0, 1), (0, 0), (2, 3), (2, 2)]
    fresh = {step: OursAvatar.read(folder, "cpu").render(cameras[step[0]], poses[step[1]]) for step in walk}
    for step in walk:
        found = avatar.render(cameras[step[0]], poses[step[1]])
        np.testing.assert_array_equal(found.rgb, fresh[step].rgb)
        np.testing.assert_array_equal(found.alpha, fresh[step].alpha)


def test_colours_are_kept_for_the_same_pose_and_place_alone(clip, tmp_path, monkeypatch):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    asked, usual = [], avatar.colors
    monkeypatch.setattr(avatar, "colors", lambda *seen: asked.append(seen) or usual(*seen))
    one, other = list(clip.cameras.values())[:2]
    first, second = list(clip.poses.values())[:2]
    counts = []
    for camera, pose in ((one, first), (one, first), (other, first), (one, first), (one, second)):
        avatar.render(camera, pose)
        counts.append(len(asked))
    assert counts == [1, 1, 2, 3, 4]


def test_what_an_avatar_hands_out_is_not_what_it_keeps(clip, tmp_path):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    camera, pose = first_view(clip)
    before = avatar.render(camera, pose).rgb.copy()
    splats = avatar.splats(pose, camera)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        getattr(splats, name)[:] = 0
    avatar.render(camera, pose).rgb[:] = 0
    np.testing.assert_array_equal(avatar.render(camera, pose).rgb, before)


def test_a_pose_is_known_by_its_numbers_and_not_by_its_timestep(clip, tmp_path):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    pose = clip.poses[0]
    camera = next(iter(clip.cameras.values()))
    first = avatar.render(camera, pose).rgb
    for name in ("expression", "jaw", "rotation", "neck", "eyes", "translation"):
        other = replace(pose, **{name: np.asarray(getattr(pose, name)) + np.float32(0.02)})
        assert pose_key(other) != pose_key(pose)
        if name != "eyes":  # the toy's eyes are small
            assert np.abs(avatar.render(camera, other).rgb - first).max() > 0
    with pytest.raises(InputError, match="head_model"):
        avatar.render(camera, replace(pose, head_model="another"))
    assert pose_key(replace(pose, eyelids=np.zeros(2))) != pose_key(pose)
    assert pose_key(replace(pose, subject="b", timestep=99)) == pose_key(pose)

"""The method from clip to avatar: resumed bit for bit, stored in the published bytes, bounded at extremes."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.engine.stored import TRAINING_FILE
from headbench.bench.errors import InputError
from headbench.bench.io.documents import read_json
from headbench.methods.gha.gaussian_head import feature_camera
from headbench.methods.gha.method import DRIVING_FILE, GHA, GHAAvatar, parted, within
from headbench.methods.shared.avatar_files import AVATAR_FILE

from ..toy_clip import check_frame, first_view, look_at
from .small import SMALL, small_config

BUDGET = Budget(iterations=30)  # 12 of the mesh phase


def fit(clip, folder, progress=no_progress, seed=3, **more):
    small = GHA(small_config(**more))
    return small.fit(clip, folder, BUDGET, device="cpu", seed=seed, progress=progress)


@pytest.fixture(scope="module")
def trained(clip, tmp_path_factory):
    folder = tmp_path_factory.mktemp("gha")
    return fit(clip, folder), folder


def test_a_gaussian_is_stored_in_its_floats_and_no_more(trained):
    avatar, folder = trained
    table = load_file(folder / AVATAR_FILE)["table"]
    assert table.shape[1] == 11 + SMALL["features"]
    with safe_open(folder / AVATAR_FILE, framework="pt") as file:
        floats = sum(file.get_tensor(name).numel() for name in file.keys())  # noqa: SIM118 - not a mapping
    overhead = (folder / AVATAR_FILE).stat().st_size - 4 * floats
    assert 0 < overhead < 8_000  # names, shapes and settings
    assert [path.name for path in avatar.files()] == [AVATAR_FILE, "subject.npz"]
    assert (
        read_json(folder / TRAINING_FILE)["splats"]
        == len(table)
        <= SMALL["max_points"] + SMALL["mouth_points"]
    )


def test_head_pose_corrections_serve_their_timestep_alone(trained, clip):
    avatar, folder = trained
    _, pose = first_view(clip)
    driving = np.load(folder / DRIVING_FILE)
    assert not np.array_equal(driving["refined_rotation"], driving["tracked_rotation"])
    assert np.array_equal(driving["refined_expression"], driving["tracked_expression"])
    foreign = avatar.splats(replace(pose, timestep=None)).means
    assert not np.array_equal(avatar.splats(pose).means, foreign)
    np.testing.assert_allclose(avatar.splats(pose).means, foreign, atol=1e-2)


def test_a_turned_and_shifted_head_takes_its_splats_along(trained, clip):
    """Where expression alone rules, head pose is a rigid motion and nothing else."""
    avatar, folder = trained
    tensors = load_file(folder / AVATAR_FILE)
    points = tensors["table"][:, :3]
    near = (torch.cdist(points, tensors["landmarks"]).amin(1).square() < 0.1).numpy()
    assert near.sum() > 20
    _, pose = first_view(clip)
    plain = replace(pose, subject="", timestep=None)
    moved = replace(plain, translation=np.asarray(plain.translation) + np.array([0.0, 0.0, 0.5], np.float32))
    before, after = avatar.splats(plain), avatar.splats(moved)
    shift = after.means[near] - before.means[near]
    np.testing.assert_allclose(shift, np.broadcast_to([0, 0, 0.5], shift.shape), atol=2e-5)


def test_splats_have_unit_quaternions_of_the_rotations_drawn(trained, clip):
    avatar, _ = trained
    _, pose = first_view(clip)
    raw, given = avatar._posed(pose).world.quats.detach().numpy(), avatar.splats(pose).quats
    lengths = np.linalg.norm(raw, axis=1, keepdims=True)
    assert np.abs(lengths - 1).max() > 1e-3
    np.testing.assert_allclose(np.linalg.norm(given, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(given * lengths, raw, atol=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (640, 360)])
@pytest.mark.parametrize(
    "change",
    [
        {},
        {"jaw": np.array([40.0, -3.0, 7.0])},
        {"jaw": np.array([1e8, 0.0, 0.0])},
        {"eyes": np.full(6, -9.0)},
        {"expression": np.full(8, 3.0)},
        {"expression": np.full(8, -300.0)},
        {"translation": np.array([0.0, 0.0, 0.45])},
        {"rotation": np.array([0.0, np.pi, 0.0])},
    ],
)
def test_frames_stay_bounded_at_extremes(trained, clip, size, change):
    avatar, _ = trained
    camera, pose = first_view(clip)
    check_frame(avatar.render(camera.resized(*size), replace(pose, **change), (0.2, 0.4, 0.6)), *size)


def test_the_feature_camera_sees_the_same_points():
    camera = look_at(np.array([0.1, 0.2, 0.6]), np.zeros(3), "c", 37, 50)
    small = feature_camera(camera, 4)
    assert (small.width, small.height) == (10, 13)
    points = np.random.default_rng(0).normal(size=(9, 3)) * 0.05
    seen = [c.K @ (c.world_to_camera[:3, :3] @ points.T + c.world_to_camera[:3, 3:]) for c in (camera, small)]
    full, quarter = (s[:2] / s[2] for s in seen)
    np.testing.assert_allclose(full / 4, quarter)


class Ticking:
    """A clock on which every look takes a second."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        self.now += 1
        return self.now


def fit_in_seconds(clip, folder, clock, seconds, progress=no_progress):
    small = GHA(small_config(), clock)
    return small.fit(clip, folder, Budget(seconds=seconds), device="cpu", seed=0, progress=progress)


def test_seconds_bound_a_run_and_the_avatar_is_whole(clip, tmp_path):
    """Both stages use their seconds, whatever their trial steps promised."""
    clock, seen = Ticking(), []
    avatar = fit_in_seconds(clip, tmp_path, clock, 100.0, lambda d, t, n="": seen.append((d, t)))
    assert seen == sorted(seen)
    record = read_json(tmp_path / TRAINING_FILE)
    done, planned, mesh = (record[name] for name in ("iterations", "planned_iterations", "mesh_iterations"))
    assert 0 < mesh < done <= planned
    assert 70 < record["seconds"] < 110
    assert clock.now < 110
    assert avatar.render(*first_view(clip)).rgb.shape[2] == 3


def test_budgets_are_parted_and_overspent_seconds_are_taken_off():
    assert parted(Budget(iterations=600_000), 0.05) == (Budget(iterations=30_000), Budget(iterations=570_000))
    assert parted(Budget(seconds=10.0), 0.25) == (Budget(seconds=2.5), Budget(seconds=7.5))
    whole, part = Budget(iterations=9, seconds=10.0), Budget(iterations=5, seconds=7.5)
    assert within(part, whole, 2.0) == part
    assert within(part, whole, 4.0) == Budget(iterations=5, seconds=6.0)
    assert 0 < within(part, whole, 40.0).seconds < 0.01
    assert within(Budget(iterations=5), Budget(iterations=9), 40.0) == Budget(iterations=5)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("table", lambda tensor: tensor[:, :-1]),
        ("table", lambda tensor: tensor.fill_(float("nan"))),
        ("landmarks", lambda tensor: tensor[:0]),
        ("expression_color.weight_0", lambda tensor: tensor[:-1]),
        ("sr.color", lambda tensor: None),
        ("expression_scale", lambda tensor: tensor * 0),
        ("background", lambda tensor: tensor.double()),
        *(("config", text) for text in ("", "{", "[]", '{"unit": 0.1}', "null")),
    ],
)
def test_a_damaged_file_is_refused_by_name(trained, tmp_path, name, change):
    shutil.copytree(trained[1], tmp_path, dirs_exist_ok=True)
    tensors = load_file(tmp_path / AVATAR_FILE)
    with safe_open(tmp_path / AVATAR_FILE, framework="pt") as file:
        metadata = file.metadata()
    if name == "config":
        metadata = {"config": change}
    else:
        changed = change(tensors.pop(name))
        tensors |= {} if changed is None else {name: changed.contiguous()}
    save_file(tensors, tmp_path / AVATAR_FILE, metadata)
    with pytest.raises(InputError, match=name):
        GHAAvatar.read(tmp_path, "cpu")


def test_training_moves_everything_it_should(trained, clip, tmp_path):
    """No tensor that an avatar keeps is left as it was started."""
    _, folder = trained
    more = load_file(folder / AVATAR_FILE)
    short = GHA(small_config())
    short.fit(clip, tmp_path, Budget(iterations=13), device="cpu", seed=3, progress=no_progress)
    less = load_file(tmp_path / AVATAR_FILE)
    fixed = {"origin", "center", "background", "expression_scale", "code_low", "code_high"}
    for name in set(more) - fixed - {"table", "landmarks"}:
        assert not torch.equal(more[name], less[name]), name

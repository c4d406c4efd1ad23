"""The splat avatars: what is on disk, what comes back, what is refused; and that they learn."""

import struct
from contextlib import nullcontext
from dataclasses import replace
from shutil import copytree

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from headbench.bench.contracts import STAGES, Budget, SharingAvatar, StagedAvatar, no_progress
from headbench.bench.errors import InputError
from headbench.methods.flashavatar.method import FlashAvatar
from headbench.methods.flashavatar.spec import FlashAvatarConfig
from headbench.methods.ga.method import COLUMNS, GA, read_ga_splats, write_ga_splats
from headbench.methods.ga.spec import GAConfig
from headbench.methods.gbs.method import GBS
from headbench.methods.gbs.spec import BlendshapeTraining, GBSConfig
from headbench.methods.ours.method import Ours
from headbench.methods.rgbavatar.method import RGBAvatar
from headbench.methods.rgbavatar.spec import RGBAvatarConfig
from headbench.methods.shared.config import SplatTraining

from .flashavatar.small import SMALL as SMALL_FLASHAVATAR
from .ours.toy import SMALL, changed
from .rgbavatar.small import SMALL as SMALL_RGBAVATAR
from .toy_clip import first_view

FAST = SplatTraining(max_splats=1200, min_densify_every=16, min_settle=8)
BLENDSHAPES = BlendshapeTraining(
    max_splats=1200, densify_from=0, densify_gradient=1e-4, min_densify_every=16, min_settle=8
)
CONFIGS = {
    "ga": lambda: GA(GAConfig(splats=FAST)),
    "flashavatar": lambda: FlashAvatar(FlashAvatarConfig(**SMALL_FLASHAVATAR)),
    "ours": lambda: Ours(changed(SMALL, splats=FAST, hidden=16, planes={"resolution": 16})),
    "gbs": lambda: GBS(GBSConfig(splats=BLENDSHAPES, samples=600, teeth_samples=40, min_sh_every=12)),
    "rgbavatar": lambda: RGBAvatar(RGBAvatarConfig(**SMALL_RGBAVATAR)),
}
STORED = {name: "point_cloud.ply" if name == "ga" else "avatar.safetensors" for name in CONFIGS}


@pytest.fixture(scope="module", params=[*CONFIGS])
def fitted(request, clip, tmp_path_factory):
    """Method name, folder and avatar after a few iterations with a densification."""
    folder = tmp_path_factory.mktemp(request.param)
    method = CONFIGS[request.param]()
    avatar = method.fit(clip, folder, Budget(iterations=36), device="cpu", seed=0, progress=no_progress)
    return request.param, method, folder, avatar


def test_splats_of_a_pose(fitted, clip):
    _, _, _, avatar = fitted
    camera, pose = first_view(clip)
    splats = avatar.splats(pose)
    assert splats.colors is None
    count = len(splats.means)
    assert splats.quats.shape == (count, 4)
    assert splats.scales.min() > 0
    np.testing.assert_allclose(np.linalg.norm(splats.quats, axis=1), 1, atol=1e-5)
    assert avatar.splats(pose, camera).colors.shape == (count, 3)


def test_a_frame_drawn_by_stages_is_the_rendered_one(fitted, clip):
    _, method, folder, avatar = fitted
    assert isinstance(avatar, StagedAvatar)
    fresh, stages = method.load(folder, device="cpu"), []
    camera, pose = first_view(clip)
    drawn = fresh.draw(camera, pose, (0.0, 0.5, 1.0), stages.append)
    assert tuple(stages) == STAGES
    fresh.draw(*first_view(clip, "self_reenactment"), (1.0, 1.0, 1.0), stages.append)  # changes nothing
    expected = avatar.render(camera, pose, (0.0, 0.5, 1.0))
    assert all(np.array_equal(a, b) for a, b in zip(fresh.read_back(drawn), expected))


def test_shared_files_are_the_rest_of_what_rendering_needs(fitted, clip, tmp_path):
    name, method, _, avatar = fitted
    assert isinstance(avatar, SharingAvatar)
    assert not set(avatar.files()) & set(avatar.shared_files())
    for path in (*avatar.files(), *avatar.shared_files()):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    moved = method.load(tmp_path, device="cpu")
    assert {path.name for path in moved.files()} == {STORED[name], "subject.npz"}
    camera, pose = first_view(clip, "self_reenactment")  # that of training is refined driving signal
    np.testing.assert_array_equal(moved.render(camera, pose).rgb, avatar.render(camera, pose).rgb)
    (tmp_path / avatar.shared_files()[0].name).unlink()
    with pytest.raises(InputError):
        method.load(tmp_path, device="cpu")


def test_a_finished_run_is_kept_and_another_run_is_refused(fitted, clip):
    _, method, folder, _ = fitted

    def fail(*_):
        raise AssertionError("trained again")

    for seed, refusal in ((0, nullcontext()), (1, pytest.raises(InputError, match="another run"))):
        with refusal:
            method.fit(clip, folder, Budget(iterations=36), device="cpu", seed=seed, progress=fail)


def test_damaged_files_are_input_errors(fitted, tmp_path):
    name, method, folder, _ = fitted
    copytree(folder, tmp_path, dirs_exist_ok=True)
    stored = tmp_path / STORED[name]
    whole = stored.read_bytes()
    for damage in (lambda: stored.write_bytes(whole[: len(whole) // 2]), stored.unlink):
        damage()
        with pytest.raises(InputError, match=STORED[name]):
            method.load(tmp_path, device="cpu")


@pytest.mark.parametrize("fitted", ["ours"], indirect=True)
def test_no_tensor_of_ours_can_be_of_another_size(fitted, tmp_path):
    _, method, folder, _ = fitted
    copytree(folder, tmp_path, dirs_exist_ok=True)
    whole = load_file(folder / "avatar.safetensors")
    # Fewer splats, or lines of fewer expressions, make another sound avatar.
    for key in sorted(set(whole) - {"splats", "lines"}):
        save_file({**whole, key: whole[key][:-1].contiguous()}, tmp_path / "avatar.safetensors")
        with pytest.raises(InputError, match="avatar.safetensors"):
            method.load(tmp_path, device="cpu")
    coarse = {**whole, "plane_yz": whole["plane_yz"][:64].contiguous()}
    flat = {**whole, "plane_box": torch.zeros(2, 3)}
    for tensors, says in ((coarse, "plane_yz"), (flat, "plane_box")):
        save_file(tensors, tmp_path / "avatar.safetensors")
        with pytest.raises(InputError, match=says):
            method.load(tmp_path, device="cpu")


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("head_model", lambda value: np.array("another")),
        ("shape", lambda value: value[:-1]),
        ("shape", lambda value: value * np.float32(np.nan)),
        ("static_offset", lambda value: value[:, :2]),
        ("static_offset", lambda value: value.astype(np.int64)),
    ],
)
def test_a_subject_that_does_not_fit_the_head_is_refused(fitted, tmp_path, key, change):
    _, method, folder, _ = fitted
    copytree(folder, tmp_path, dirs_exist_ok=True)
    subject = dict(np.load(folder / "subject.npz"))
    np.savez(tmp_path / "subject.npz", **{**subject, key: change(subject[key])})
    with pytest.raises(InputError, match=key):
        method.load(tmp_path, device="cpu")


def test_a_clip_without_training_frames_is_refused_before_work(clip, tmp_path):
    empty = replace(clip, splits={**clip.splits, "train": ()})
    with pytest.raises(InputError, match="at least one frame"):
        GA().fit(empty, tmp_path, Budget(iterations=1), device="cpu", seed=0, progress=no_progress)


def test_ga_ply_has_the_published_layout_byte_for_byte(clip, tmp_path):
    method = CONFIGS["ga"]()
    avatar = method.fit(clip, tmp_path, Budget(iterations=2), device="cpu", seed=0, progress=no_progress)
    content = (tmp_path / "point_cloud.ply").read_bytes()
    header, body = content.split(b"end_header\n", 1)
    names = [line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property float")]
    assert names == list(COLUMNS)
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    scales, rotations = (f"scale_{i}" for i in range(3)), (f"rot_{i}" for i in range(4))
    assert names[54:] == ["opacity", *scales, *rotations, "binding_0"]
    faces = len(clip.head.faces)
    assert len(body) == 252 * faces
    # One splat per triangle at the start, in order; normals zero; quaternions real part first.
    rows = [struct.unpack("<63f", body[252 * i : 252 * (i + 1)]) for i in range(faces)]
    assert [row[62] for row in rows] == list(range(faces))
    assert all(row[3:6] == (0, 0, 0) for row in rows)
    assert all(abs(row[58] - 1) < 0.01 for row in rows)
    assert len(avatar.splats(clip.poses[0]).means) == faces


def test_ga_harmonics_are_stored_channel_by_channel(clip, tmp_path):
    count = 4
    generator = torch.Generator().manual_seed(0)
    widths = {
        "means": (3,),
        "log_scales": (3,),
        "quats": (4,),
        "opacities": (),
        "sh_dc": (3,),
        "sh_rest": (3, 15),
    }
    splats = {name: torch.randn(count, *shape, generator=generator) for name, shape in widths.items()}
    path, binding = tmp_path / "x.ply", torch.tensor([3, 1, 0, 2])
    write_ga_splats(path, splats, binding)
    body = path.read_bytes().split(b"end_header\n", 1)[1]
    table = np.frombuffer(body, "<f4").reshape(count, 63)
    # 15 red, then 15 green, then 15 blue.
    np.testing.assert_array_equal(table[:, 9:24], splats["sh_rest"][:, 0])
    np.testing.assert_array_equal(table[:, 39:54], splats["sh_rest"][:, 2])
    found, faces = read_ga_splats(path, 4, "cpu")
    assert torch.equal(faces, binding)
    assert all(torch.equal(found[name], splats[name]) for name in splats)
    with pytest.raises(InputError, match="binding"):
        read_ga_splats(path, 3, "cpu")


def test_ours_costs_48_bytes_per_splat_beside_what_is_fixed(clip, tmp_path):
    sizes = {}
    for iterations in (2, 36):
        folder = tmp_path / str(iterations)
        avatar = CONFIGS["ours"]().fit(
            clip, folder, Budget(iterations=iterations), device="cpu", seed=0, progress=no_progress
        )
        sizes[len(avatar.splats(clip.poses[0]).means)] = (folder / "avatar.safetensors").stat().st_size
    (few, small), (many, large) = sorted(sizes.items())
    assert many > few
    # The header pads to 8 bytes and spells the number of splats out.
    assert abs((large - small) - 48 * (many - few)) <= 32

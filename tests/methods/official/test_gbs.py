"""GaussianBlendshapes' adapter: the video that their loader reads, placeholders, renders on black read back by key."""

import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from headbench.bench.contracts import Budget
from headbench.bench.errors import InputError
from headbench.bench.io.documents import read_json
from headbench.bench.io.images import read_pixels
from headbench.datasets.head.subject import PosedSubject
from headbench.datasets.images import write_image
from headbench.methods.official.checkout import Checkout
from headbench.methods.official.gbs.export import GRIDS
from headbench.methods.official.gbs.method import SHRINK, GBSOfficial
from headbench.methods.official.method import TRAINING_LOG
from headbench.methods.official.video import six_numbers
from headbench.methods.official.workplace import Listed, Workplace, check_export
from headbench.methods.shared.schedule import ShuffledEpochs

from .helpers import export, fit, pixels_of, views, workplace, world_points
from .repository import CYLINDER, HELD_OUT

NAME = "gbs"


@pytest.fixture
def moving_clip(official_clip):
    """With eyelids in its poses, and jaws that differ."""
    poses = {t: replace(pose, eyelids=np.array([0.1 * t, 0.5])) for t, pose in official_clip.poses.items()}
    return replace(official_clip, poses=poses)


@pytest.fixture
def exported(method, moving_clip, tmp_path):
    return export(method, moving_clip, tmp_path / "work")


def read_frame(work, number):
    with torch.serialization.safe_globals([np.ndarray]):
        return torch.load(work.input / f"checkpoint/{number:05d}.frame", weights_only=True)


def test_images_are_taken_in_the_native_order(method, official_clip, tmp_path):
    method.config = replace(method.config, order="native")
    fit(method, official_clip, tmp_path / "a")
    log = (tmp_path / "a" / TRAINING_LOG).read_text()
    taken = [int(number) for number in re.search(r"taken \[(.*)\]", log)[1].split(",")]
    keys = official_clip.splits["train"]
    numbers = {key: n for n, key in enumerate(sorted(keys, key=lambda key: (key.timestep, key.camera)))}
    sampler = ShuffledEpochs(len(keys), 0)
    assert taken == [numbers[keys[sampler(i)]] for i in range(1, 21)]
    record = read_json(tmp_path / "a" / "training.json")
    assert any("images_in_order" in line for line in record["differences"])


def test_a_commit_before_the_authors_fix_is_told(method, official_clip):
    assert "5017124" not in " ".join(method.differences(official_clip, 0))
    assert "5017124" in " ".join(GBSOfficial().differences(official_clip, 0))


def test_the_schedule_keeps_its_fractions_of_a_shorter_run(method, official_clip, tmp_path):
    fit(method, official_clip, tmp_path / "a", budget=Budget(iterations=2_000))
    log = (tmp_path / "a" / TRAINING_LOG).read_text()
    for name, value in {
        "position_lr_max_steps": 1_500,
        "densify_from_iter": 25,
        "densify_until_iter": 750,
        "opacity_reset_interval": 150,
        "test_iterations": 0,
    }.items():
        assert f"'{name}': '{value}'" in log


def test_frames_hold_pose_and_both_cameras_in_the_heads_frame(exported, moving_clip):
    work, images = exported
    for number, key in enumerate(images.values()):
        camera, pose = moving_clip.cameras[key.camera], moving_clip.poses[key.timestep]
        found = {
            part: {k: v[0] for k, v in values.items()} for part, values in read_frame(work, number).items()
        }
        flame, seen, drawn = found["flame"], found["opencv"], found["camera"]
        assert np.array_equal(flame["exp"][:8], pose.expression)
        assert not flame["exp"][8:].any()
        assert flame["shape"][:6] == pytest.approx(moving_clip.shape)
        assert flame["eyelids"] == pytest.approx(pose.eyelids)
        rotation = np.cross(flame["jaw"][:3], flame["jaw"][3:])
        assert rotation[2] == pytest.approx(np.cos(pose.jaw[0]), abs=1e-6)
        points, world = world_points(moving_clip, pose)
        pixels = pixels_of(world, camera)
        theirs = (points @ seen["R"].T + seen["t"]) @ seen["K"].T
        assert np.abs(theirs[:, :2] / theirs[:, 2:] - pixels).max() < 1e-3
        rows = drawn["R"].reshape(2, 3)
        turn = np.vstack([rows, np.cross(*rows)])
        right = points @ turn + drawn["t"]
        flat = drawn["fl"] * right[:, :2] / right[:, 2:] + drawn["pp"]
        size = np.array([camera.width, camera.height])
        assert np.abs(size / 2 - flat * min(size) / 2 - pixels).max() < 1e-3


def test_the_end_that_their_loader_holds_out_is_placeholders(exported, moving_clip):
    work, images = exported
    count = len(images)
    assert len(list((work.input / "checkpoint").iterdir())) == count + HELD_OUT
    first = read_frame(work, 0)
    for number in range(count, count + HELD_OUT):
        assert read_pixels(work.input / f"images/{number:05d}.png").tolist() == [[[0, 0, 0, 0]]]
        again = read_frame(work, number)
        assert all(np.array_equal(again[p][k], first[p][k]) for p in first for k in first[p])
    check_export(work, images, moving_clip)


@pytest.mark.parametrize("shape", [(1, 2, 4), (36, 28, 3)])
def test_the_guard_takes_one_pixel_for_a_placeholder_alone(exported, moving_clip, shape):
    work, images = exported
    write_image(work.input / f"images/{len(images):05d}.png", np.zeros(shape, np.uint8))
    with pytest.raises(InputError, match="another image"):
        check_export(work, images, moving_clip)


def test_another_head_brings_its_own_lists_and_mouth(exported, moving_clip):
    work, _ = exported
    head = moving_clip.head
    back = np.loadtxt(work.program / "data/FLAME2020/back_of_head.txt").astype(int)
    assert np.isin(head.faces[back], head.regions["scalp"]).all()
    neck = np.loadtxt(work.program / "data/FLAME2020/neck_exclude_vertex.txt").astype(int)
    assert np.array_equal(np.sort(neck), np.sort(head.regions["neck"]))
    middle = np.loadtxt(work.input / "offset.txt") + CYLINDER
    lips = PosedSubject.of(moving_clip).neutral[head.regions["lips"]]
    assert (lips.min(0)[:2] < middle[:2]).all()
    assert (middle[:2] < lips.max(0)[:2]).all()
    assert middle[2] < lips.max(0)[2]


def test_a_head_of_flames_topology_keeps_theirs(method, repository, moving_clip, tmp_path):
    for side in "lr":
        basis = np.zeros((len(moving_clip.head.template), 3))
        np.save(repository[0] / f"FLAME/blendshapes/{side}_eyelid.npy", basis)
    work, _ = export(method, moving_clip, tmp_path / "work")
    assert not (work.input / "offset.txt").exists()
    for name in ("back_of_head", "neck_exclude_vertex"):
        path = work.program / f"data/FLAME2020/{name}.txt"
        assert path.read_text() == "3\n1\n2\n"


def test_grids_that_nobody_reads_have_one_node(method, avatar, official_clip, tmp_path):
    work = workplace(method, tmp_path / "work")
    listed = [next(iter(views(official_clip, "novel_view").values()))]
    frames = [Listed(0, official_clip.splits["novel_view"][0], *listed[0])]
    method.render_command(tmp_path / "avatar", frames, (1, 1, 1), work)
    for file, name in GRIDS.items():
        assert torch.load(work.input / file, weights_only=True)[name].numel() == 1
    assert (work.model / "fix_chkpnt1.pth").resolve() == avatar.files()[0].resolve()


def test_checkpoints_lose_their_optimiser_and_nothing_else(tmp_path, monkeypatch):
    values = torch.nn.Parameter(torch.arange(3.0))
    optimiser = torch.optim.Adam([values])
    values.sum().backward()
    optimiser.step()
    before = values.detach().clone()
    path = tmp_path / "fix_chkpnt40.pth"
    torch.save(((3, values, {"kept": 1}, optimiser.state_dict(), 1.0), 40), path)
    monkeypatch.setattr(sys, "argv", ["-c", str(path)])
    exec(SHRINK, {})  # noqa: S102 - as their interpreter runs it
    (degree, found, other, state, scale), iteration = torch.load(path, weights_only=True)
    assert (degree, other, state, scale, iteration) == (3, {"kept": 1}, {}, 1.0, 40)
    assert isinstance(found, torch.nn.Parameter)
    assert torch.equal(found, before)


def test_what_rendering_never_reads_is_left_out_by_their_python(official_clip, tmp_path):
    fit = SimpleNamespace(budget=Budget(iterations=2_000), clip=official_clip)
    checkout = Checkout(tmp_path, ("conda", "run", "python"), {})
    command = GBSOfficial().shrink_command(fit, Workplace(tmp_path, checkout))
    assert command[:4] == ["conda", "run", "python", "-c"]
    names = [f"{name}2000.pth" for name in ("fix_chkpnt", "mouth0_chkpnt", "mouth1_chkpnt")]
    assert command[5:] == [str(tmp_path / "model" / name) for name in names]


def test_rotations_of_a_refitted_clip_may_be_read_only():
    turns = np.array([0.3, -0.2, 0.1, 0.0, 0.0, np.pi / 2])
    turns.flags.writeable = False
    found = six_numbers(turns).reshape(2, 2, 3)
    for rows, turn in zip(found, turns.reshape(2, 3)):
        matrix, _ = cv2.Rodrigues(turn.copy())
        np.testing.assert_allclose(rows, matrix[:2], atol=1e-12)

"""GaussianBlendshapes' adapter: the video that their loader reads, placeholders, renders on black read back by key."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from headbench.bench.contracts import Budget
from headbench.bench.errors import InputError
from headbench.bench.io.images import read_pixels
from headbench.datasets.images import write_image
from headbench.methods.official.gbs.method import SHRINK
from headbench.methods.official.workplace import check_export

from .helpers import export, pixels_of, world_points
from .repository import HELD_OUT

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


def test_the_schedule_keeps_its_fractions_of_a_shorter_run(method, exported):
    run = SimpleNamespace(budget=Budget(iterations=2_000))
    words = method.train_command(run, exported[0])[2:]
    options = dict(zip(words[::2], words[1::2], strict=True))
    expected = {
        "position_lr_max_steps": 1_500,
        "densify_from_iter": 25,
        "densify_until_iter": 750,
        "opacity_reset_interval": 150,
        "test_iterations": 0,
    }
    assert {name: int(options[f"--{name}"]) for name in expected} == expected


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
    write_image(work.input / f"images/{count:05d}.png", np.zeros((1, 2, 4), np.uint8))
    with pytest.raises(InputError, match="another image"):
        check_export(work, images, moving_clip)


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

"""Test frames fitted to themselves, on an avatar of coloured blobs whose true view is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.contracts import Camera, Frame, FrameKey, HeadPose
from headbench.bench.experiments.extremes import head_center
from headbench.bench.experiments.refit import FrameFit, refit
from headbench.bench.io.images import quantise
from headbench.reports.table_report import table_text

from ...world import rows_of, run_on

SIDE, KEY = 40, FrameKey("blobs", "FREE", 9, "front")
RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-0.1, 0.1, (12, 3))
COLOURS = RNG.uniform(0.0, 0.8, (12, 3))
BASIS = np.zeros((12, 3, 3))
BASIS[0, 1, 0] = BASIS[1, 0, 1] = BASIS[2, 2, 2] = 0.02


class Blobs:
    """Smooth spots, some of which expression and jaw move; it knows nothing of the timestep."""

    def pixels(self, camera, pose):
        points = POINTS + BASIS @ pose.expression
        points[3:5, 1] += 0.1 * pose.jaw[0]
        local = (points + pose.translation) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        seen = local @ camera.K.T
        return seen[:, :2] / seen[:, 2:]

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        rgb = np.ones((camera.height, camera.width, 3)) * background
        for (x, y), colour in zip(self.pixels(camera, pose), COLOURS):
            weight = np.exp(-((u - x) ** 2 + (v - y) ** 2) / (0.005 * camera.width**2))[..., None]
            rgb = rgb * (1 - weight) + weight * colour
        return Frame(rgb.astype(np.float32), np.ones(rgb.shape[:2], np.float32))


class Fixed(Blobs):
    """It shows the same whatever the view is."""

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        return Frame(np.full((camera.height, camera.width, 3), 0.5, np.float32), None)


@pytest.fixture
def clip():
    """Tracked, with training poses that vary in all three coefficients and the jaw; pictures are set by tests."""
    K = np.array([[100.0, 0, SIDE / 2], [0, 100.0, SIDE / 2], [0, 0, 1]])
    place = np.eye(4)
    place[2, 3] = 0.6
    zero = np.zeros(3)
    poses = {
        t: HeadPose(
            "blobs", RNG.normal(size=3), zero, zero, np.array([RNG.uniform(0, 0.2), 0, 0]), zero, zero
        )
        for t in range(9)
    }
    tracked = replace(poses[4], subject="blobs", timestep=9)
    head = SimpleNamespace(
        template=POINTS, shape_basis=np.zeros((12, 3, 1)), joint_regressor=np.full((1, 12), 1 / 12)
    )
    return SimpleNamespace(
        head=head,
        shape=np.zeros(1),
        cameras={"front": Camera("front", SIDE, SIDE, K, place)},
        poses={**poses, 9: tracked},
        splits={"train": [KEY._replace(timestep=t) for t in poses]},
    )


def test_a_view_with_an_error_is_recovered(clip):
    avatar, camera, tracked = Blobs(), clip.cameras["front"], clip.poses[9]
    frame = FrameFit(avatar, camera, tracked, None, (1, 1, 1), head_center(clip), np.eye(6)[:4])
    parameters = np.array([0.5, -0.5, 0.5, 0.6, -0.6, 0.6, 0.5, 0, 0, 0.3, -0.3, 0.3, 0])
    true = frame.view(parameters)
    picture = quantise(avatar.render(*true).rgb)
    clip.image = lambda key: picture if key == KEY else pytest.fail("another picture was read")

    def error(view):
        return np.linalg.norm(avatar.pixels(*view) - avatar.pixels(*true), axis=1).mean()

    def psnr(view):
        return -10 * np.log10(np.mean((quantise(avatar.render(*view).rgb) / 255.0 - picture / 255.0) ** 2))

    fitted = refit(avatar, clip, KEY, (1.0, 1.0, 1.0))
    assert error((camera, tracked)) > 0.5
    assert error(fitted) < error((camera, tracked)) / 10
    assert psnr(fitted) > psnr((camera, tracked)) + 10
    assert fitted[1].timestep is None


@pytest.mark.parametrize("avatar", [Blobs(), Fixed()])
def test_the_tracked_view_is_kept_if_none_is_better(clip, avatar):
    tracked = clip.cameras["front"], clip.poses[9]
    clip.image = lambda key: quantise(avatar.render(*tracked).rgb)
    assert all(a is b for a, b in zip(refit(avatar, clip, KEY, (1.0, 1.0, 1.0)), tracked))


def test_rows_name_the_condition_and_no_frame_becomes_worse(balls, tmp_path, monkeypatch):
    monkeypatch.setattr(balls.Ball, "render", Blobs.render)  # instead of a hard edge
    monkeypatch.setattr(balls.Ball, "pixels", Blobs.pixels, raising=False)
    views = Condition("test-refit", views=Named("test-refit", {"iterations": 1}))
    names = ("ball_plugin:BALL", "ball_plugin:LISTED")
    how = {"reader": "ball_plugin:READER", "metrics": ("psnr",), "conditions": (PLAIN, views)}
    run = run_on(tmp_path / "data", tmp_path / "run", *names, subjects=("ball-a",), **how)
    rows = rows_of(run).query("metric == 'psnr' and region == 'full'")
    own = rows.pivot_table("value", ["task", "timestep", "camera"], ["method", "condition"])
    assert list(own.columns) == [("ball", ""), ("ball", "test-refit"), ("listed", "")]
    assert (own["ball", "test-refit"] >= own["ball", ""]).all()
    assert (own["ball", "test-refit"] > own["ball", ""]).any()
    refused = rows[(rows["method"] == "listed") & (rows["condition"] == "test-refit")]
    assert refused["reason"].str.contains("Frames come in lists alone").all()
    assert not run.cell("ball-a", "ball+test-refit", 0).avatar.exists()
    assert "ball+test-refit, listed+test-refit: each scored frame was fitted to its own" in table_text(
        [run.root]
    )

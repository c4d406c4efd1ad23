"""A rig, a head and avatars simple enough to know what a trial must find: a ball that bears anything, or bursts."""

from functools import partial
from types import SimpleNamespace

import numpy as np

from headbench.bench.contracts import Camera, Frame, FrameKey, HeadPose
from headbench.bench.errors import UnavailableError
from headbench.bench.experiments.viewpoints import look_at
from headbench.bench.specs import DatasetSpec, MethodSpec

RADIUS = 0.1
SIZE = (24, 30)


class BallClip:
    """Five cameras around a head whose vertices are the corners of a cube; two coefficients of the expression and the jaw
    vary, one at a time."""

    static_offset = np.zeros((8, 3))
    shape = np.zeros(1)
    background = np.ones(3)
    steps = ()

    def __init__(self, path, progress=None):
        self.subject = path.name
        self.excluded = {}
        self.fingerprint = f"ball-{path.name}"
        corners = RADIUS * np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(8, 3)
        self.head = SimpleNamespace(
            version="ball",
            template=corners,
            shape_basis=np.zeros((8, 3, 1)),
            expression_basis=np.zeros((8, 3, 3)),
            joint_regressor=np.full((2, 8), 1 / 8),
            skinning_weights=np.tile([1.0, 0.0], (8, 1)),
            faces=np.array([[0, 1, 2]]),
            regions={},
        )
        K = np.array([[100.0, 0, SIZE[0] / 2], [0, 100.0, SIZE[1] / 2], [0, 0, 1]])
        place = len(path.name) + np.zeros(3)  # every subject stands somewhere else
        self.cameras = {
            f"{i}": Camera(
                f"{i}", *SIZE, K, look_at(place + [np.sin(a), 0, np.cos(a)], place, np.array([0.0, 1, 0]))
            )
            for i, a in enumerate(np.radians([-60, -30, 0, 30, 60]))
        }
        zero = np.zeros(3)
        expressions = [[-1, 0, 0.5], [1, 0, 0.5], [0, -0.2, 0.5], [0, 0.2, 0.5], [0, 0, 0.5], [1, 0.2, 0.5]]
        self.poses = {
            t: HeadPose("ball", np.array(e), zero, zero, jaw, np.zeros(6), place, None, self.subject, t)
            for t, e in enumerate(expressions)
            for jaw in [np.array([0.3 * (t == 3), 0.0, 0.0])]
        }

        def keys(sequence, timesteps, cameras):
            return tuple(FrameKey(self.subject, sequence, t, c) for t in timesteps for c in cameras)

        self.splits = {
            "train": keys("EMO", range(4), "0134"),
            "novel_view": keys("EMO", range(4), "2"),
            "self_reenactment": keys("FREE", (4, 5), "01234"),
        }

    def image(self, key):
        return np.full((SIZE[1], SIZE[0], 3), 40 * key.timestep, np.uint8)

    def mask(self, key):
        return None


def find(root):
    return sorted(path for path in root.iterdir() if path.name.startswith("ball"))


def is_extreme(pose):
    """Whether the first coefficient passes 1.5, or 0.3 with the jaw open, which training has on their own alone."""
    return abs(pose.expression[0]) > (0.3 if pose.jaw[0] > 0.1 else 1.5)


class Ball:
    """A ball at the pose's translation. ``bursts`` names what happens in an extreme pose."""

    def __init__(self, path, bursts=""):
        self.path, self.bursts = path, bursts

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        extreme = is_extreme(pose)
        center = camera.world_to_camera @ [*pose.translation, 1.0]
        radius = RADIUS * (3.0 if extreme and self.bursts == "size" else 1.0)
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        x = (u - camera.K[0, 2]) / camera.K[0, 0] * center[2] - center[0]
        y = (v - camera.K[1, 2]) / camera.K[1, 1] * center[2] - center[1]
        alpha = (np.hypot(x, y) < radius).astype(np.float32)
        rgb = np.repeat(1.0 - alpha[..., None] / 2, 3, axis=2)
        if extreme and self.bursts == "nan":
            rgb[0, 0, 0] = np.nan
        return Frame(rgb, alpha)

    def files(self):
        return [self.path / "ball.txt"]


class Splatty(Ball):
    """Gives splats too, one of which grows."""

    def splats(self, pose, camera=None):
        grown = 0.2 if is_extreme(pose) else 0.002
        return SimpleNamespace(
            means=np.asarray(pose.translation, np.float32)[None],
            quats=np.array([[1.0, 0, 0, 0]]),
            scales=np.array([[0.001, 0.001, grown]]),
            opacities=np.array([0.9]),
            colors=None if camera is None else np.array([[0.5, 0.5, 0.5]]),
        )


class BallMethod:
    avatar = staticmethod(Ball)

    def fit(self, clip, out, budget, *, device, seed, progress):
        out.mkdir(parents=True, exist_ok=True)
        (out / "ball.txt").write_text("ball")
        return self.load(out, device=device)

    def load(self, path, *, device):
        return self.avatar(path)


class BurstingMethod(BallMethod):
    avatar = staticmethod(partial(Ball, bursts="size"))


class BrokenMethod(BallMethod):
    avatar = staticmethod(partial(Ball, bursts="nan"))


class Listed(Ball):
    """One that another program renders."""

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        raise UnavailableError("Frames come in lists alone.", "Ask for a list.")

    def render_listed(self, views, background, progress):
        for key, view in views.items():
            yield key, super().render(*view, background)


class ListedMethod(BallMethod):
    avatar = staticmethod(Listed)


class SplattyMethod(BallMethod):
    avatar = staticmethod(Splatty)


READER = DatasetSpec("balls", "balls", "ball_plugin:BallClip", find="ball_plugin:find")
BALL, BURSTING, BROKEN, SPLATTY, LISTED = (
    MethodSpec(name, name, f"ball_plugin:{name.capitalize()}Method")
    for name in ("ball", "bursting", "broken", "splatty", "listed")
)
FLOOR = MethodSpec("floor", "a floor", "ball_plugin:BallMethod", trivial=True)

"""A reader, three methods and three metrics small enough to see through, for the harness's own tests."""

import copy
import time
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from headbench.bench.contracts import Camera, Frame, FrameKey, HeadPose, Measurement, StepRecord, Variant
from headbench.bench.engine.adaptation import AdaptedClip
from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.specs import DatasetSpec, MethodSpec, MetricSpec

SIZE = (8, 6)  # width, height


class ToyClip:
    """Two cameras, four timesteps; image brightness tells camera and timestep apart."""

    head = None
    shape = np.zeros(1)
    static_offset = np.zeros((1, 3))
    background = np.ones(3)
    steps = ()

    def __init__(self, path):
        self.subject = Path(path).name
        self.fingerprint = f"toy-{self.subject}"
        self.cameras = {
            name: Camera(name, *SIZE, np.eye(3), np.diag([1.0, 1, 1, 1 + i])) for i, name in enumerate("ab")
        }
        zero = np.zeros(3)
        self.poses = {
            t: HeadPose("toy", np.array([t / 10]), zero, zero, zero, np.zeros(6), zero, None, self.subject, t)
            for t in range(4)
        }
        sequence = {0: "EMO", 1: "EMO", 2: "EMO", 3: "FREE"}

        def key(t, c):
            return FrameKey(self.subject, sequence[t], t, c)

        self.splits = {
            "train": tuple(key(t, "a") for t in range(3)),
            "novel_view": tuple(key(t, "b") for t in range(3)),
            "self_reenactment": tuple(key(3, c) for c in "ab"),
        }
        self.excluded = {FrameKey(self.subject, "FREE", 4, "a"): "tongue out"}

    def image(self, key):
        return np.full((SIZE[1], SIZE[0], 3), 40 + 10 * key.timestep + (key.camera == "b"), np.uint8)

    def mask(self, key):
        return None


def read(path, shift=0):
    return ToyClip(path)


def find(root):
    return sorted(p for p in Path(root).iterdir() if p.is_dir() and p.name.startswith("subject"))


def listed(path):
    """As a capture's files may list frames: in no order of keys, those that are left out among them."""
    return {"val": [(2, "b"), (0, "b"), (1, "b")], "test": [(3, "b"), (4, "a"), (3, "a")]}


READER = DatasetSpec(
    "toy",
    "toy captures",
    "toy_plugin:read",
    find="toy_plugin:find",
    listing="toy_plugin:listed",
    errors="toy_plugin:errors",
)


def errors(clip):
    """Of a subject named so; the linter's own, which a reader has otherwise, want a head."""
    return ["HB701: no head is seen."] if clip.subject == "subject-wall" else []


ADAPTED: list[str] = []


def adapt(clip, needs, heads):
    """Twice the size, timesteps numbered from 100 on, darker poses: everything a method could be given anew."""
    if "impossible" in needs.head_models:
        raise InputError(f"clip {clip.subject}", "head_models", "another head model", "none")

    def work(folder, progress):
        ADAPTED.append(clip.subject)
        changed = copy.copy(clip)
        changed.head = SimpleNamespace(version=(*needs.head_models, "toy")[0])
        changed.fingerprint = f"{clip.fingerprint}-adapted"
        changed.steps = (*clip.steps, StepRecord("adapt", {"heads": dict(heads)}, clip.fingerprint))
        reduction = needs.resolution.divide
        if reduction > 1:
            sizes = [side // reduction for side in SIZE]
            changed.cameras = {name: camera.resized(*sizes) for name, camera in clip.cameras.items()}
            changed.image = lambda key: clip.image(key)[::reduction, ::reduction]
            return AdaptedClip(changed)
        size = needs.resolution.size or SIZE
        changed.cameras = {name: camera.resized(*size) for name, camera in clip.cameras.items()}
        changed.poses = {
            100 + t: replace(pose, expression=pose.expression + 0.5) for t, pose in clip.poses.items()
        }
        changed.splits = {name: tuple(renumbered(key) for key in keys) for name, keys in clip.splits.items()}
        step = size[0] // SIZE[0]
        return AdaptedClip(changed, renumbered, lambda key, render: render[::step, ::step])

    return work


def renumbered(key):
    return key._replace(timestep=100 + key.timestep)


@dataclass(frozen=True)
class ToyConfig:
    level: float = 0.5
    fail: bool = False


class ToyAvatar:
    def __init__(self, path):
        self.path = path
        self.level = float((path / "level.txt").read_text())

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        rgb = np.full((camera.height, camera.width, 3), self.level, np.float32)
        return Frame(rgb, np.ones(rgb.shape[:2], np.float32))

    def files(self):
        return [self.path / "level.txt"]


class MirrorAvatar(ToyAvatar):
    """Shows the expression coefficient it is driven with."""

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        rgb = np.full((camera.height, camera.width, 3), pose.expression[0], np.float32)
        return Frame(rgb, np.ones(rgb.shape[:2], np.float32))


FITS: list[str] = []


class ToyMethod:
    avatar = ToyAvatar

    def __init__(self, config):
        self.config = config

    def fit(self, clip, out, budget, *, device, seed, progress):
        FITS.append(clip.subject)
        if self.config.fail:
            raise RuntimeError("the training diverged")
        out.mkdir(parents=True, exist_ok=True)
        (out / "level.txt").write_text(str(self.config.level))
        for i in range(budget.iterations or 1):
            progress(i + 1, budget.iterations or 1)
        return self.load(out, device=device)

    def load(self, path, *, device):
        return self.avatar(path)


class MirrorMethod(ToyMethod):
    avatar = MirrorAvatar


LISTS: list[list[FrameKey]] = []


class ListingAvatar(MirrorAvatar):
    """The mirror, for lists of frames alone."""

    short = False

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        raise UnavailableError("Frames come in lists alone.", "Ask for a list.")

    def render_listed(self, views, background, progress):
        LISTS.append(list(views))
        progress(1, len(views))
        for key, view in list(reversed(views.items()))[self.short :]:
            yield key, super().render(*view, background)


class ListingMethod(ToyMethod):
    avatar = ListingAvatar


class CheckingMethod(ToyMethod):
    def check(self, clip, budget):
        raise InputError(
            "settings.checking", "checkout", f"a folder, for {budget.iterations} steps", "no checkout"
        )


class PeekingMethod(ToyMethod):
    def fit(self, clip, out, budget, **arguments):
        clip.image(clip.splits["train"][0])
        clip.image(clip.splits["novel_view"][0])
        return super().fit(clip, out, budget, **arguments)


PRESETS = {"smoke": {"budget": {"iterations": 2}}, "fast": {"budget": {"iterations": 9}, "level": 0.25}}
MIRROR = MethodSpec(
    "mirror", "the driving signal", "toy_plugin:MirrorMethod", "toy_plugin:ToyConfig", PRESETS
)
METHOD = MethodSpec("toy", "one grey level", "toy_plugin:ToyMethod", "toy_plugin:ToyConfig", PRESETS)


LISTING = replace(MIRROR, name="listing", implementation="toy_plugin:ListingMethod", native=False)
CHECKING = replace(METHOD, name="checking", implementation="toy_plugin:CheckingMethod")


def levels(folder, clip, device):
    """Other grey levels, as variants."""

    def make(out, level):
        out.mkdir(parents=True, exist_ok=True)
        (out / "level.txt").write_text(str(level))
        MADE.append(level)
        return ToyAvatar(out)

    for name, level in (("dark", 0.25), ("light", 0.75)):
        yield Variant(name, f"level {level}", partial(make, level=level))


MADE: list[float] = []
VARYING = replace(METHOD, name="varying", variants="toy_plugin:levels")
SAME_NAME = MethodSpec("toy", "another of that name", "toy_plugin:ToyMethod", "toy_plugin:ToyConfig", PRESETS)
PEEKING = MethodSpec(
    "peeking", "looks at held-out frames", "toy_plugin:PeekingMethod", "toy_plugin:ToyConfig"
)
FAILING = MethodSpec(
    "failing", "always fails", "toy_plugin:ToyMethod", "toy_plugin:ToyConfig", {"smoke": {"fail": True}}
)


def mean_error(image, truth):
    return float(np.abs(image.astype(float) - truth).mean())


def not_here(image, truth):
    raise UnavailableError("The toy weights are not here.", "Put them there.")


WORKLOAD_SIZES: set[tuple[int, int]] = set()


def files_in_avatar(avatar, workload):
    assert all(a is not b for a, b in pairwise(workload))
    WORKLOAD_SIZES.update((camera.width, camera.height) for camera, _ in workload)
    return Measurement(float(len(avatar.files())), {"frames": len(workload)})


ERROR = MetricSpec("error", "Error", "levels", False, 2, "toy_plugin:mean_error")
NOT_HERE = MetricSpec("not_here", "Absent", "", True, 2, "toy_plugin:not_here")
NOT_THERE = replace(NOT_HERE, name="not_there", label="Lacking")
FILES = MetricSpec("files", "Files", "", False, 0, "toy_plugin:files_in_avatar", kind="avatar")
FILES_LOAD = replace(FILES, name="files_load", detail="frames")
FILES_NONE = replace(FILES, name="files_none", detail="not told")


def clock_time(avatar, workload):
    """Another number each time, as speeds are."""
    return Measurement(time.perf_counter(), {})


CLOCK = replace(FILES, name="clock", implementation="toy_plugin:clock_time", machine_bound=True)


def training_steps(record):
    return Measurement(record["method"]["budget"]["iterations"], {"peak": record["peak_memory_bytes"]})


STEPS = MetricSpec(
    "steps", "Steps", "", False, 0, "toy_plugin:training_steps", kind="training", tables=("cost",)
)


def report(run):
    path = run.folder.root / "mine.txt"
    path.write_text("mine")
    return [path]


def failing_report(run):
    raise RuntimeError("no ink")

"""Scene of a viewer: avatars with their captures, the recordings that animate them, and the view that a browser requests."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from ...bench.condition import PLAIN
from ...bench.contracts import Avatar, Camera, Clip, FloatArray, FrameKey, HeadPose
from ...bench.engine.adaptation import AdaptedClip, MethodNeeds, adapt
from ...bench.engine.captures import open_clips, open_run_clips, reader_of, run_configuration
from ...bench.engine.config import ResolvedMethod, RunConfig, RunOptions, resolve_methods
from ...bench.engine.plan import make_jobs
from ...bench.engine.store import RunFolder
from ...bench.engine.stored import avatar_folder, open_avatar
from ...bench.errors import HeadbenchError, InputError
from ...bench.experiments.reenactment import AT_ORIGIN, RigidMean, check_heads, retarget
from ...bench.experiments.viewpoints import head_center, training_poses
from ...bench.expressions import Expression, expressions_of
from ...bench.options import DependentOptions

STANDARD_INPUT = "-"
"""Value of ``--live`` for standard input."""


@dataclass(frozen=True)
class ViewSettings(RunOptions):
    """View avatars in a browser: side by side, from any view, with sliders and with recorded sequences. Images are rendered on
    this machine, at a smaller size while something moves. Ends with Ctrl-C. Needs viser (extra `view`).
    """

    avatars: tyro.conf.Positional[tuple[str, ...]]
    """Folders of runs, or of avatars as `headbench render` takes them; an imported avatar needs --data, its capture."""
    methods: tuple[str, ...] = ()
    """Only these methods of runs; by default all but the trivial baselines."""
    subjects: tuple[str, ...] = ()
    """Only these subjects of runs; by default the first."""
    source: str | None = None
    """Capture of another subject, with the same head model, whose sequences drive the avatars too."""
    live: str = ""
    """Live signal that drives all avatars: lines of JSON, each a frame as `headbench drive` reads them, on standard input (-) or on
    a port of this machine (a number), at which only programs of this machine can connect."""
    signal_head: str = ""
    """With --live: head model of the signal, as of `headbench drive`."""
    expressions: int = 10
    """Number of sliders for expressions of each head model: the named ones, else the single coefficients, that move it farthest."""
    method: str = ""
    """Method of an avatar outside of runs as package.module:SPEC, where it is not registered."""
    device: str = ""
    """Rendering device; by default that of the training."""
    port: int = 8080
    """Port of this machine to listen at; 0 takes a free one. Only browsers of this machine can connect."""
    seconds: float | None = None
    """Stop after this time; by default when interrupted."""

    dependent = (DependentOptions(("signal_head",), "live"),)

    def __post_init__(self) -> None:
        is_port = self.live.isascii() and self.live.isdigit() and 0 < int(self.live) < 65536
        if self.live not in ("", STANDARD_INPUT) and not is_port:
            raise ValueError(f"live is {self.live!r}; - or a port from 1 to 65535")
        if not self.avatars:
            raise ValueError("avatars: at least one folder")
        if not 0 <= self.port < 65536:
            raise ValueError(f"port is {self.port}; from 0 to 65535")
        if self.expressions < 0:
            raise ValueError(f"expressions is {self.expressions}; at least 0")
        if self.seconds is not None and self.seconds < 0:
            raise ValueError(f"seconds is {self.seconds}; at least 0")


log = logging.getLogger(__name__)
LIVE = "live signal"
"""Name of the live signal among recordings."""
NEUTRAL = "neutral"
"""Name of the neutral pose, without a recording."""
MOST_SHOWN = 12
"""Avatars at once; more would be drawn too small to see."""


Recording = dict[int, dict[str, FrameKey]]
"""The frames of one sequence of a subject: keys by timestep and camera."""


@dataclass(frozen=True)
class Sliders:
    """Offsets added to a pose. Angles in radians, added to axis-angle vectors.

    ``expressions`` are coefficients by head model, in the model's units; only the leading ones if they are fewer.
    """

    expressions: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    jaw: tuple[float, ...] = (0.0, 0.0, 0.0)  # rotations about x, y and z
    neck: tuple[float, ...] = (0.0, 0.0, 0.0)
    eyes: tuple[float, ...] = (0.0, 0.0)  # rotations of both eyes about x and y

    @property
    def at_rest(self) -> bool:
        """Whether nothing is added."""
        return not any(map(any, (*self.expressions.values(), self.jaw, self.neck, self.eyes)))

    def added(self, pose: HeadPose) -> HeadPose:
        """A pose with this added; it belongs to no timestep unless nothing is."""
        if self.at_rest:
            return pose
        expression = np.array(pose.expression, np.float64)
        leading = self.expressions.get(pose.head_model, ())[: len(expression)]
        expression[: len(leading)] += leading
        x, y = self.eyes
        return replace(
            pose,
            expression=expression.astype(pose.expression.dtype),
            jaw=(pose.jaw + np.array(self.jaw)).astype(pose.jaw.dtype),
            neck=(pose.neck + np.array(self.neck)).astype(pose.neck.dtype),
            eyes=(pose.eyes + np.array([x, y, 0.0, x, y, 0.0])).astype(pose.eyes.dtype),
            timestep=None,
        )


@dataclass(frozen=True, eq=False)
class FreeView:
    """A camera that is orbited: its motion in the world of the first avatar, and the vertical field of view, radians."""

    world_to_camera: FloatArray
    fov: float

    def camera(self, width: int, height: int) -> Camera:
        """The view in an image of a size, pixels."""
        focal = height / 2 / np.tan(self.fov / 2)
        K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        return Camera("view", width, height, K, self.world_to_camera)

    @classmethod
    def of(cls, camera: Camera) -> FreeView:
        """The view of a camera whose principal point is taken for the middle."""
        return cls(camera.world_to_camera, float(2 * np.arctan(camera.height / 2 / camera.K[1, 1])))


@dataclass(frozen=True)
class State:
    """Everything that determines the image."""

    sliders: Sliders = field(default_factory=Sliders)
    recording: str = NEUTRAL  # sequence that animates the avatar
    timestep: int = 0
    camera: str = ""  # of the capture, drawn as for metrics beside the captured image; "" for the free view
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)  # RGB, each in [0, 1]
    splats: bool = False  # whether browsers render the splats


@dataclass(frozen=True, eq=False)
class ShownAvatar:
    """An avatar, its clip, and that clip adapted to its method."""

    label: str  # unique
    avatar: Avatar
    clip: Clip
    form: AdaptedClip
    sources: Mapping[str, AdaptedClip]  # clips of other subjects, adapted to its method, by subject
    live: Any = None  # the `server.LivePoses` of the live signal, if there is one

    @property
    def version(self) -> str:
        """Of the head model that its poses are of."""
        return self.form.clip.head.version

    @cached_property
    def neutral(self) -> HeadPose:
        """The neutral face, with the head pose of the first training timestep."""
        pose = self.form.clip.poses[self.form.key(self._first).timestep]
        none = {name: np.zeros_like(getattr(pose, name)) for name in ("expression", "neck", "jaw", "eyes")}
        lids = None if pose.eyelids is None else np.zeros_like(pose.eyelids)
        return replace(pose, **none, eyelids=lids, timestep=None)

    @cached_property
    def center(self) -> FloatArray:
        """(3,) the middle of the head in the world of `clip`, metres."""
        return head_center(self.clip)

    def pose(self, key: FrameKey | None) -> HeadPose:
        """The recorded pose of a frame, retargeted if it is of another subject; None: neutral."""
        if key is None:
            return self.neutral
        if key.subject == self.clip.subject:
            return self.form.clip.poses[self.form.key(key).timestep]
        source = self.sources[key.subject]
        poses = source.clip.poses[source.key(key).timestep]
        return retarget(poses, self._means[key.subject], self._means[""], self.clip.subject)

    def live_pose(self) -> HeadPose:
        """The latest pose of the live signal, at the mean head position; neutral before the first."""
        pose = self.live.pose(self.version) if self.live else None
        return self.neutral if pose is None else retarget(pose, AT_ORIGIN, self._means[""], self.clip.subject)

    def camera(self, view: Camera, key: FrameKey | None) -> Camera:
        """Convert a camera from the world of `clip` to that of the method at a timestep.

        For a method with one video, the head is fixed and the camera moves.
        """
        frame = key if key is not None and key.subject == self.clip.subject else self._first
        adapted = self.form.clip.cameras[self.form.key(frame).camera].world_to_camera
        to_world = np.linalg.inv(self.clip.cameras[frame.camera].world_to_camera)
        return replace(view, world_to_camera=view.world_to_camera @ to_world @ adapted)

    @property
    def _first(self) -> FrameKey:
        return min(self.clip.splits["train"], key=lambda key: (key.timestep, key.camera))

    @cached_property
    def _means(self) -> dict[str, RigidMean]:
        clips = {"": self.form.clip, **{name: form.clip for name, form in self.sources.items()}}
        return {name: RigidMean.of(training_poses(clip)) for name, clip in clips.items()}


@dataclass(frozen=True, eq=False)
class Scene:
    """The avatars shown, in order, and the recordings by name."""

    shown: Sequence[ShownAvatar]
    recordings: Mapping[str, Recording]
    missing: Sequence[str]  # avatars of the runs that are missing, each with the reason

    @property
    def first(self) -> ShownAvatar:
        """The avatar in whose world the viewer's camera is."""
        return self.shown[0]

    def expressions(self, count: int) -> dict[str, list[Expression]]:
        """The strongest expressions of each head model, by its version; ranges are those of the training of the first avatar."""
        first = {shown.version: shown.form.clip for shown in reversed(self.shown)}
        versions = dict.fromkeys(shown.version for shown in self.shown)
        return {v: expressions_of(first[v].head, count, training_poses(first[v])) for v in versions}


def open_scene(settings: ViewSettings, kept: Path) -> Scene:
    """Load the requested avatars, at most `MOST_SHOWN`; ``kept`` is a folder for tracking that has to be refitted."""
    missing: list[str] = []
    shown: list[ShownAvatar] = []
    for number, name in enumerate(settings.avatars):
        shown += _opened(Path(name), settings, kept / str(number), missing)
    folders = " ".join(settings.avatars)
    if not shown:
        reasons = "; ".join(missing) or "none"
        raise InputError(folders, "", "a trained avatar", reasons, "Start the run again.")
    if len(shown) > MOST_SHOWN:
        expected, remedy = f"at most {MOST_SHOWN} avatars", "Choose with --methods and --subjects."
        raise InputError(folders, "", expected, str(len(shown)), remedy)
    for reason in missing:
        log.warning("not shown: %s", reason)
    if len({avatar.label for avatar in shown}) < len(shown):
        shown = [replace(avatar, label=f"{n}: {avatar.label}") for n, avatar in enumerate(shown, 1)]
    return Scene(shown, _recordings(shown), missing)


def _opened(path: Path, settings: ViewSettings, kept: Path, missing: list[str]) -> Iterator[ShownAvatar]:
    if not path.is_dir():
        raise InputError(path, "", "the folder of a run or of an avatar", "no such folder")
    run, cell = _run_of(path)
    if run is None:
        yield _imported(path, settings, kept)
        return
    options = replace(settings, avatars=(str(run),))
    methods = _chosen(run, resolve_methods(run_configuration(run, options)), settings, cell)
    config, clips = open_run_clips(run, options, out=kept)
    names = [clip.subject for clip in clips]
    wanted = (cell[0],) if cell else settings.subjects or tuple(names[:1])
    if unknown := sorted({*wanted} - {*names}):
        raise InputError(run, "--subjects", f"those of the run: {', '.join(names)}", ", ".join(unknown))
    clips = [clip for clip in clips if clip.subject in wanted]
    config = replace(config, device=settings.device or config.device)
    source = _source(settings, config)
    seeds = (cell[2],) if cell else config.seeds
    cells = [(method, PLAIN) for method in methods]
    for job in make_jobs(replace(config, seeds=seeds), cells, clips, {}, RunFolder(run), kept):
        if not job.cell.is_trained:
            why = "its training did not end" if "state" in job.cell.record else "not trained"
            missing.append(f"{job.name}: {why}")
            continue
        try:
            avatar = job.load()
        except HeadbenchError as error:
            missing.append(f"{job.name}: {error}")
            continue
        label = job.method.spec.name
        label += f" {job.clip.subject}" * (len(wanted) > 1 or len(settings.avatars) > 1)
        label += f" seed {job.seed}" * (len(seeds) > 1)
        sources = _driving(source, job.clip, job.method, config, kept)
        yield ShownAvatar(label, avatar, job.clip, job.form, sources)


def _run_of(path: Path) -> tuple[Path | None, tuple[str, str, int] | None]:
    """The run of a folder, with subject, method and seed of a cell; None for an avatar outside of runs."""
    if (path / "run.json").is_file():
        return path, None
    home = avatar_folder(path).resolve()
    if len(home.parents) > 3 and home.name == "avatar" and (home.parents[3] / "run.json").is_file():
        seed = home.parent.name.removeprefix("seed-")
        if seed.isdigit():
            return home.parents[3], (home.parents[2].name, home.parents[1].name, int(seed))
    return None, None


def _chosen(
    run: Path, methods: Sequence[ResolvedMethod], settings: ViewSettings, cell: tuple[str, str, int] | None
) -> list[ResolvedMethod]:
    names = [method.spec.name for method in methods]
    asked = (cell[1],) if cell else settings.methods
    if unknown := sorted({*asked} - {*names}):
        raise InputError(run, "--methods", f"those of the run: {', '.join(names)}", ", ".join(unknown))
    return [m for m in methods if (m.spec.name in asked if asked else not m.spec.trivial)]


def _imported(path: Path, settings: ViewSettings, kept: Path) -> ShownAvatar:
    stored = open_avatar(path, settings.method)
    method = stored.method
    if settings.data is None:
        expected = "the capture that the avatar was made from, with its cameras and poses"
        raise InputError("command line", "--data", expected, "none, and the avatar belongs to no run")
    config = _config(settings.data, settings, kept)
    clips = open_clips(config)
    if len(clips) > 1:
        names = ", ".join(clip.subject for clip in clips)
        raise InputError(settings.data, "", "one capture", names, "Name one capture.")
    form = _form(clips[0], MethodNeeds.of(method.spec), stored.heads, kept)
    avatar = stored.load(config.device)
    sources = _driving(_source(settings, config), clips[0], method, config, kept)
    return ShownAvatar(method.spec.name, avatar, clips[0], form, sources)


def _config(data: str, settings: ViewSettings, kept: Path) -> RunConfig:
    return RunConfig(
        data=data,
        out=str(kept),
        reader=reader_of(data),
        reader_settings={} if settings.head is None else {"head": settings.head},
        device=settings.device or "cpu",
    )


def _form(clip: Clip, needs: MethodNeeds, heads: Mapping[str, str], kept: Path) -> AdaptedClip:
    return adapt(clip, needs, heads, kept / "adapted" / clip.subject)


def _source(settings: ViewSettings, config: RunConfig) -> list[Clip]:
    if settings.source is None:
        return []
    source = _config(settings.source, settings, Path(config.out))
    return open_clips(replace(source, reader_settings=source.reader_settings or config.reader_settings))


def _driving(
    source: Sequence[Clip], clip: Clip, method: ResolvedMethod, config: RunConfig, kept: Path
) -> dict[str, AdaptedClip]:
    others = [other for other in source if other.subject != clip.subject]
    for other in others:
        check_heads(other.head, clip.head, f"clip {other.subject}")
    needs = MethodNeeds.of(method.spec)
    return {other.subject: _form(other, needs, config.heads, kept / "sources") for other in others}


def _recordings(shown: Sequence[ShownAvatar]) -> dict[str, Recording]:
    """Sequences by subject and name, those held out last and marked; of subjects that drive every avatar."""
    recordings: dict[str, Recording] = {}
    clips = {avatar.clip.subject: avatar.clip for avatar in shown}
    sources = [form.clip for form in shown[0].sources.values()]
    for clip in [*(clips.values() if len(clips) == 1 else ()), *sources]:
        for split, mark in (("train", ""), ("novel_view", ""), ("self_reenactment", ", held out")):
            for key in sorted(clip.splits.get(split, ())):
                name = f"{key.subject}: {key.sequence}{mark}"
                recordings.setdefault(name, {}).setdefault(key.timestep, {})[key.camera] = key
    return recordings

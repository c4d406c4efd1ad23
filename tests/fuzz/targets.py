"""Everything that reads files from outside: which sample it reads, which files of it may be damaged, and how it is called.

A reader is called in a folder that holds a copy of the sample. It is a command line, or a function where the command
behind it would take too long for thousands of cases; a share of the cases goes through the commands in any case.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from headbench.bench import cli
from headbench.bench.io.documents import read_yaml
from headbench.bench.registry import get
from headbench.bench.runner.config import resolve_method
from headbench.datasets.colmap.model import read_model
from headbench.datasets.colmap.reader import model_cameras
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.loaders import load_head
from headbench.datasets.monocular.reader import read_video
from headbench.datasets.steps.exclude import read_exclusions
from headbench.methods.shared.checkpoint import load_checkpoint
from headbench.metrics.lpips_network import SQUEEZE, load_backbone

from .cases import ExitCode
from .samples import AVATAR, BACKBONE, CHECKPOINT, METHODS, PREPARE, SETTINGS, SYNTH

EXCLUSIONS = "reviewed/tongue.yaml"


@dataclass(frozen=True)
class Target:
    """A reader. ``share`` is how many of 20,000 cases it gets, ``files`` are patterns of what may be damaged."""

    name: str
    sample: str
    read: Callable[[], object]
    files: tuple[str, ...] = ("**/*",)
    share: int = 100


def command(line: str) -> Callable[[], None]:
    """A call of the command line; a code that is not 0 is raised."""

    def call() -> None:
        try:
            code = cli.main(line.split())
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        if code:
            raise ExitCode(code)

    return call


def read_clip() -> None:
    """Open a capture and decode a frame of each split."""
    _look_at(read_capture("capture"))


def read_video_clip(folder: str) -> Callable[[], None]:
    """Open a tracked video, as `read_clip` does a capture."""
    return lambda: _look_at(read_video(folder))


def _look_at(clip) -> None:
    for keys in clip.splits.values():
        if keys:
            clip.image(keys[0])
            clip.mask(keys[0])


def draw(method: str, folder: str) -> Callable[[], None]:
    """Load an avatar and draw the capture's first training frame."""

    def call() -> None:
        clip = _sound_clip()
        avatar = resolve_method(get("methods", method), "smoke", SETTINGS.get(method, {})).create()
        key = clip.splits["train"][0]
        avatar.load(Path(folder), device="cpu").render(clip.cameras[key.camera], clip.poses[key.timestep])

    return call


_clips: list = []


def _sound_clip():
    """The capture of the sample, read once: what is damaged here is the avatar."""
    if not _clips:
        _clips.append(read_capture("capture"))
    return _clips[0]


def colmap(folder: str) -> Callable[[], object]:
    """Read a sparse model and its cameras."""
    return lambda: model_cameras(read_model(folder), distortion="left to the images")


RUN = ("run/run.json", "run/protocols/*.json", "run/rows.parquet")
CELLS = (*RUN, "run/901/**/*")
LAYOUTS = ("insta", "imavatar")
MEAN = "--methods mean-image --preset smoke --set metrics=psnr --set frames_per_task=1"
GATE = "gate run --baseline baseline.json"
OURS = AVATAR.format("ours")


def reader(
    name: str,
    sample: str,
    read: str | Callable[[], object],
    files: str | tuple[str, ...] = "**/*",
    share: int = 100,
) -> Target:
    """A target; ``read`` may be a command line, ``files`` one pattern."""
    call = command(read) if isinstance(read, str) else read
    return Target(name, sample, call, (files,) if isinstance(files, str) else files, share)


TARGETS = [
    reader("capture", "capture", read_clip, share=3000),
    reader("capture run", "capture", f"run --data capture --out out {MEAN}"),
    reader("capture lint", "capture", "lint capture", share=200),
    reader("capture inspect", "capture", "inspect capture --out out", share=60),
    reader("capture tongue", "capture", "tongue capture --out out", share=60),
    reader("capture steps", "capture", "steps capture --out out", share=40),
    reader("capture colmap", "capture", "export colmap capture --out out"),
    reader("capture refit", "capture", "refit capture --target 2020 --out out", share=10),
    reader("head npz", "heads", lambda: load_head("head.npz"), "head.npz", 800),
    reader("head eyelids", "heads", lambda: load_head("eyelids.npz"), "eyelids.npz", 200),
    reader("head flame2023", "heads", lambda: load_head("flame2023.pkl"), "flame2023.pkl", 800),
    reader("head flame2020", "heads", lambda: load_head("flame2020.pkl"), "flame2020.pkl", 400),
    reader(
        "head masks", "heads", lambda: load_head("head.npz", masks="FLAME_masks.pkl"), "FLAME_masks.pkl", 600
    ),
    reader(
        "head regions", "heads", lambda: load_head("head.npz", regions="regions.json"), "regions.json", 400
    ),
    reader("recording check", "recording", f"{PREPARE} --out out --check", share=800),
    reader("recording", "recording", f"{PREPARE} --out out", share=300),
    reader("videos", "videos", f"{PREPARE} --out out", "recording/**/*", 200),
    *(
        reader(f"monocular {name}", "monocular", read_video_clip(name), f"{name}/**/*", 600)
        for name in LAYOUTS
    ),
    reader("monocular run", "monocular", f"run --data imavatar --out out {MEAN}", "imavatar/**/*"),
    reader("run table", "run", "table run", RUN, 1200),
    reader("run table cost", "run", "table run --layout cost --format html", RUN, 200),
    reader("run compare", "run", "compare run", RUN, 500),
    reader("run pareto", "run", "pareto run --out out", RUN, 300),
    reader("run gate", "baseline", GATE, (*RUN, "baseline.json"), 500),
    reader("baseline", "baseline", GATE, "baseline.json", 800),
    reader("run verify", "run", "verify run", CELLS, 200),
    reader("bundle verify", "bundles", "verify renders.zip --data capture", "renders.zip", 300),
    reader("leaderboard", "bundles", "leaderboard build . --out out", "*.zip", 500),
    reader("run extremes", "run", "extremes run --views 1 --dimensions 1", CELLS, 30),
    reader("run sweep", "run", "sweep run --methods ga --variants half", CELLS, 20),
    reader("run reenact", "two_subjects", "reenact run --frames 1", share=30),
    reader("run continued", "run", "run --config config.json", CELLS, 150),
    reader("images", "images", "evaluate images --like run --out out --label theirs", "images/**/*", 200),
    *(reader(f"avatar {m}", "run", draw(m, AVATAR.format(m)), f"{AVATAR.format(m)}/*", 600) for m in METHODS),
    reader("avatar compact", "compact", draw("ours", "avatar"), "avatar/*", 1000),
    reader("avatar export", "run", f"export ply {OURS} --out out.ply --capture capture", f"{OURS}/*"),
    reader("avatar to compact", "run", f"compact {OURS} --out out", "run/901/ours/**/*"),
    reader("ply", "ply", "import ga point_cloud.ply --capture capture --out out", "point_cloud.ply", 500),
    reader("colmap bin", "colmap", colmap("bin"), "bin/sparse/**/*", 800),
    reader("colmap txt", "colmap", colmap("txt"), "txt/sparse/**/*", 800),
    reader("exclusions", "exclusions", lambda: read_exclusions(Path(EXCLUSIONS)), EXCLUSIONS, 700),
    reader("exclusions tongue", "exclusions", "tongue capture --out reviewed", EXCLUSIONS, 60),
    reader("settings", "settings", "run --config config.yaml", share=600),
    reader("settings yaml", "settings", lambda: read_yaml(Path("config.yaml")), share=500),
    reader("checkpoint", "checkpoint", lambda: load_checkpoint(Path(CHECKPOINT), "run", "cpu"), share=700),
    reader("weights", "weights", lambda: load_backbone(SQUEEZE, Path(BACKBONE)), share=200),
    reader("synthetic", "synthetic", f"synth {SYNTH} --out synthetic", share=6),
]

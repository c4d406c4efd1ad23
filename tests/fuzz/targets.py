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
from headbench.datasets.steps.exclusion_file import read_exclusions
from headbench.methods.shared.checkpoint import load_checkpoint
from headbench.metrics.weights import load_backbone, network_spec

from .cases import ExitCode
from .samples import METHODS, SETTINGS, SYNTH

AVATAR = "run/901/{}/seed-0/avatar"


@dataclass(frozen=True)
class Target:
    """A reader. ``share`` is how many of 20,000 cases it gets, ``files`` are patterns of what may be damaged."""

    name: str
    sample: str
    read: Callable[[], object]
    files: tuple[str, ...] = ("**/*",)
    share: int = 100


def command(*words: str) -> Callable[[], None]:
    """A call of the command line; a code that is not 0 is raised."""

    def call() -> None:
        try:
            code = cli.main(list(words))
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        if code:
            raise ExitCode(code)

    return call


def read_clip() -> None:
    """Open a capture and decode a frame of each split."""
    clip = read_capture("capture")
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


def heads(file: str) -> Callable[[], object]:
    """Load a head model."""
    return lambda: load_head(file)


def colmap(folder: str) -> Callable[[], object]:
    """Read a sparse model and its cameras."""
    return lambda: model_cameras(read_model(folder), distortion="left to the images")


RUN = ("run/run.json", "run/rows.parquet")
CELLS = ("run/run.json", "run/rows.parquet", "run/901/**/*")
PREPARE = ("prepare", "nersemble", "--root", "recording", "--tracking", "tracking", "--head", "head.npz")
PREPARE = (
    *PREPARE,
    "--subjects",
    "901",
    "--sequences",
    "EMO-1,FREE",
    "--downscale",
    "2",
    "--every",
    "1",
    "--out",
    "out",
)
MEAN = ("--methods", "mean-image", "--preset", "smoke", "--set", "metrics=psnr", "--set", "frames_per_task=1")

TARGETS = [
    Target("capture", "capture", read_clip, share=3000),
    Target("capture run", "capture", command("run", "--data", "capture", "--out", "out", *MEAN), share=100),
    Target("capture lint", "capture", command("lint", "capture"), share=200),
    Target("capture inspect", "capture", command("inspect", "capture", "--out", "out"), share=60),
    Target("capture tongue", "capture", command("tongue", "capture", "--out", "out"), share=60),
    Target("capture steps", "capture", command("steps", "capture", "--out", "out"), share=40),
    Target("capture colmap", "capture", command("export", "colmap", "capture", "--out", "out"), share=100),
    Target(
        "capture refit", "capture", command("refit", "capture", "--target", "2020", "--out", "out"), share=10
    ),
    Target("head npz", "heads", heads("head.npz"), ("head.npz",), 800),
    Target("head eyelids", "heads", heads("eyelids.npz"), ("eyelids.npz",), 200),
    Target("head flame2023", "heads", heads("flame2023.pkl"), ("flame2023.pkl",), 800),
    Target("head flame2020", "heads", heads("flame2020.pkl"), ("flame2020.pkl",), 400),
    Target(
        "head masks",
        "heads",
        lambda: load_head("head.npz", masks="FLAME_masks.pkl"),
        ("FLAME_masks.pkl",),
        600,
    ),
    Target(
        "head regions", "heads", lambda: load_head("head.npz", regions="regions.json"), ("regions.json",), 400
    ),
    Target("recording check", "recording", command(*PREPARE, "--check"), share=800),
    Target("recording", "recording", command(*PREPARE), share=300),
    Target("videos", "videos", command(*PREPARE), ("recording/**/*",), 200),
    Target("run table", "run", command("table", "run"), RUN, 1200),
    Target(
        "run table cost", "run", command("table", "run", "--layout", "cost", "--format", "html"), RUN, 200
    ),
    Target("run compare", "run", command("compare", "run"), RUN, 500),
    Target("run pareto", "run", command("pareto", "run", "--out", "out"), RUN, 300),
    Target(
        "run gate",
        "baseline",
        command("gate", "run", "--baseline", "baseline.json"),
        (*RUN, "baseline.json"),
        500,
    ),
    Target(
        "baseline", "baseline", command("gate", "run", "--baseline", "baseline.json"), ("baseline.json",), 800
    ),
    Target("run verify", "run", command("verify", "run"), CELLS, 200),
    Target("run extremes", "run", command("extremes", "run", "--views", "1", "--dimensions", "1"), CELLS, 30),
    Target("run sweep", "run", command("sweep", "run", "--methods", "ga", "--variants", "half"), CELLS, 20),
    Target("run reenact", "two_subjects", command("reenact", "run", "--frames", "1"), share=30),
    Target("run continued", "run", command("run", "--config", "config.json"), CELLS, 150),
    Target(
        "images",
        "images",
        command("evaluate", "images", "--like", "run", "--out", "out", "--label", "theirs"),
        ("images/**/*",),
        200,
    ),
    *(
        Target(f"avatar {name}", "run", draw(name, AVATAR.format(name)), (f"{AVATAR.format(name)}/*",), 600)
        for name in METHODS
    ),
    Target("avatar compact", "compact", draw("ours", "avatar"), ("avatar/*",), 1000),
    Target(
        "avatar export",
        "run",
        command("export", "ply", AVATAR.format("ours"), "--out", "out.ply", "--capture", "capture"),
        (f"{AVATAR.format('ours')}/*",),
        100,
    ),
    Target(
        "avatar to compact",
        "run",
        command("compact", AVATAR.format("ours"), "--out", "out"),
        ("run/901/ours/**/*",),
        100,
    ),
    Target(
        "ply",
        "ply",
        command("import", "ga", "point_cloud.ply", "--capture", "capture", "--out", "out"),
        ("point_cloud.ply",),
        500,
    ),
    Target("colmap bin", "colmap", colmap("bin"), ("bin/sparse/**/*",), 800),
    Target("colmap txt", "colmap", colmap("txt"), ("txt/sparse/**/*",), 800),
    Target(
        "exclusions",
        "exclusions",
        lambda: read_exclusions(Path("reviewed/tongue.yaml")),
        ("reviewed/tongue.yaml",),
        700,
    ),
    Target(
        "exclusions tongue",
        "exclusions",
        command("tongue", "capture", "--out", "reviewed"),
        ("reviewed/tongue.yaml",),
        60,
    ),
    Target("settings", "settings", command("run", "--config", "config.yaml"), share=600),
    Target("settings yaml", "settings", lambda: read_yaml(Path("config.yaml")), share=500),
    Target(
        "checkpoint",
        "checkpoint",
        lambda: load_checkpoint(Path("checkpoint.safetensors"), "run", "cpu"),
        share=700,
    ),
    Target(
        "weights",
        "weights",
        lambda: load_backbone(network_spec("squeeze"), Path("squeezenet1_1-b8a52dc0.pth")),
        share=200,
    ),
    Target("synthetic", "synthetic", command("synth", *SYNTH, "--out", "synthetic"), share=6),
]
BY_NAME = {target.name: target for target in TARGETS}

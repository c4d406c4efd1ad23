"""Everything that reads files from outside: the sample that it reads, what of it may be damaged, and how it is called.

A reader is called in a folder that holds a copy of the sample. It is a command line, or a function where the command
behind it would take too long for thousands of cases.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from headbench.bench import cli
from headbench.bench.engine.config import resolve_method
from headbench.bench.io.arrays import read_npy, read_npz
from headbench.bench.io.documents import read_json, read_yaml
from headbench.bench.io.images import read_pixels
from headbench.bench.io.saved import read_saved
from headbench.bench.io.unpickle import read_pickle
from headbench.bench.registry import get
from headbench.bench.rows import Rows
from headbench.datasets.colmap.model import read_model
from headbench.datasets.colmap.reader import model_cameras
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.loaders import load_head
from headbench.datasets.monocular.reader import read_video
from headbench.datasets.steps.exclude import read_exclusions
from headbench.methods.shared.checkpoint import load_checkpoint
from headbench.methods.shared.ply import read_ply
from headbench.methods.shared.tensor_files import read_safetensors
from headbench.metrics.lpips_network import SQUEEZE, load_backbone
from headbench.metrics.torch_file import read_weights

from .samples import AVATAR, BACKBONE, CHECKPOINT, GA, METHODS, NUMBERS, OURS, PREPARE, SETTINGS, SYNTH


class Exit(Exception):
    """A command ended with a code other than 0."""


@dataclass(frozen=True)
class Reader:
    """A reader of a sample; ``files`` are patterns of what may be damaged, ``cases`` how many it gets in a round."""

    name: str
    sample: str
    read: Callable[[], object]
    files: tuple[str, ...] = ("**/*",)
    cases: int = 15
    text: bool = False
    """Whether a part of the file may be a whole file."""

    @property
    def file(self) -> str:
        """The one file."""
        return self.files[0]


def command(line: str) -> Callable[[], None]:
    """A call of the command line; a code that is not 0 is raised."""

    def call() -> None:
        try:
            code: Any = cli.main(line.split())
        except SystemExit as end:
            code = end.code
        if code:
            raise Exit(code)

    return call


def look_at(read: Callable[[str], Any], path: str) -> Callable[[], None]:
    """Open a capture or a video and decode a frame of each split."""

    def call() -> None:
        clip = read(path)
        for keys in filter(None, clip.splits.values()):
            clip.image(keys[0])
            clip.mask(keys[0])

    return call


sound_clip = functools.cache(lambda: read_capture("capture"))


def draw(method: str, folder: str) -> Callable[[], None]:
    """Load an avatar and draw the first training frame of the capture, which is read once: it is not what is damaged."""

    def call() -> None:
        clip = sound_clip()
        avatar = resolve_method(get("methods", method), "smoke", SETTINGS.get(method, {})).create()
        key = clip.splits["train"][0]
        avatar.load(Path(folder), device="cpu").render(clip.cameras[key.camera], clip.poses[key.timestep])

    return call


def on(read: Callable[..., object], *arguments: Any, **options: Any) -> Callable[[], object]:
    """A call of a function."""
    return lambda: read(*arguments, **options)


def of_file(name: str, file: str, read: Callable[[Path], Any], text: bool = False) -> Reader:
    """A reader of one small file of the sample ``files``."""
    return Reader(name, "files", lambda: read(Path(file)), (file,), 10, text)


def read_colmap(path: Path) -> object:
    """The cameras of the model that has a file."""
    return model_cameras(read_model(path.parent), distortion="left to the images")


SMALL = (
    of_file("npz", "plain.npz", read_npz),
    of_file("npz, compressed", "compressed.npz", read_npz),
    of_file("npy", "a.npy", read_npy),
    of_file("rows", "rows.parquet", Rows.read),
    of_file("torch", "a.pth", lambda path: read_weights(path, {"x": NUMBERS.shape})),
    of_file("torch, old", "old.pth", lambda path: read_weights(path, {"x": NUMBERS.shape})),
    of_file("torch, arrays", "a.frame", read_saved),
    of_file("pickle", "a.pkl", read_pickle),
    of_file("pickle of Python 2", "python2.pkl", read_pickle),
    of_file("safetensors", "a.safetensors", read_safetensors),
    of_file("ply", "a.ply", lambda path: read_ply(path, ("x", "y", "z"))),
    of_file("png", "a.png", read_pixels),
    of_file("jpeg", "a.jpg", read_pixels),
    of_file("colmap", "bin/images.bin", read_colmap),
    of_file("colmap, cameras", "bin/cameras.bin", read_colmap),
    of_file("colmap, text", "txt/images.txt", read_colmap, text=True),
    of_file("colmap, text cameras", "txt/cameras.txt", read_colmap, text=True),
    of_file("json", "a.json", read_json),
    of_file("yaml", "a.yaml", read_yaml, text=True),
)
"""Readers of one small file each, which every test run damages."""

RUN = ("run/run.json", "run/protocols/*.json", "run/rows.parquet")
CELLS = (*RUN, "run/901/**/*")
MEAN = "--methods mean-image --preset smoke --set metrics=psnr --set frames_per_task=1"
GATE = "compare run --baseline baseline.json"
PLY = f"{GA}/point_cloud.ply"
EXCLUSIONS = "reviewed/tongue.yaml"
IMPORT = "import tracking tracker --head tracker/head.npz"
FUNCTIONS = (
    Reader("capture", "capture", look_at(read_capture, "capture"), cases=25),
    Reader("head npz", "heads", on(load_head, "head.npz"), ("head.npz",)),
    Reader("head eyelids", "heads", on(load_head, "eyelids.npz"), ("eyelids.npz",)),
    Reader("head flame2023", "heads", on(load_head, "flame2023.pkl"), ("flame2023.pkl",)),
    Reader("head flame2020", "heads", on(load_head, "flame2020.pkl"), ("flame2020.pkl",)),
    Reader("head masks", "heads", on(load_head, "head.npz", masks="FLAME_masks.pkl"), ("FLAME_masks.pkl",)),
    Reader("head regions", "heads", on(load_head, "head.npz", regions="regions.json"), ("regions.json",)),
    *(
        Reader(f"monocular {name}", "monocular", look_at(read_video, name), (f"{name}/**/*",))
        for name in ("insta", "imavatar")
    ),
    *(
        Reader(f"avatar {m}", "run", draw(m, AVATAR.format(m)), (f"{AVATAR.format(m)}/*",), 5)
        for m in METHODS
    ),
    Reader("avatar compact", "run", draw("ours", "compact"), ("compact/*",)),
    Reader("exclusions", "heads", on(read_exclusions, Path(EXCLUSIONS)), (EXCLUSIONS,)),
    Reader("checkpoint", "files", on(load_checkpoint, Path(CHECKPOINT), "run", "cpu"), (CHECKPOINT,)),
    Reader("weights", "files", on(load_backbone, SQUEEZE, Path(BACKBONE)), (BACKBONE,), 4),
)
COMMANDS = tuple(
    Reader(name, sample, command(line), files, cases)
    for name, sample, line, files, cases in (
        ("capture run", "capture", f"run --data capture --out out {MEAN}", ("**/*",), 3),
        ("capture lint", "capture", "lint capture", ("**/*",), 3),
        ("capture inspect", "capture", "inspect capture --out out", ("**/*",), 3),
        ("capture tongue", "capture", "prepare tongue capture --out out", ("**/*",), 3),
        ("capture steps", "capture", "inspect steps capture --out out", ("**/*",), 3),
        ("capture colmap", "capture", "export colmap capture --out out", ("**/*",), 3),
        ("capture refit", "capture", "prepare refit capture --target 2020 --out out", ("**/*",), 3),
        ("recording check", "recording", f"{PREPARE} --out out --check", ("**/*",), 3),
        ("recording", "recording", f"{PREPARE} --out out", ("**/*",), 3),
        ("videos", "videos", f"{PREPARE} --out out", ("recording/**/*",), 3),
        ("monocular run", "monocular", f"run --data imavatar --out out {MEAN}", ("imavatar/**/*",), 3),
        ("tracker", "monocular", f"{IMPORT} --out out", ("tracker/**/*",), 6),
        ("run table", "run", "table run", RUN, 6),
        ("run table cost", "run", "table run --layout cost --format html", RUN, 3),
        ("run compare", "run", "compare run", RUN, 4),
        ("run pareto", "run", "report pareto run --out out", RUN, 3),
        ("run gate", "run", GATE, (*RUN, "baseline.json"), 4),
        ("baseline", "run", GATE, ("baseline.json",), 6),
        ("run verify", "run", "verify run", CELLS, 3),
        ("bundle verify", "run", "verify bundles/renders.zip --data capture", ("bundles/renders.zip",), 4),
        ("leaderboard", "run", "report leaderboard bundles --out out", ("bundles/*.zip",), 4),
        ("run extremes", "run", "run extremes run --views 1 --samples 1 --path 0", CELLS, 3),
        ("run sweep", "run", "run sweep run --methods ga --variants half", CELLS, 3),
        ("run reenact", "two_subjects", "run reenact run --frames 1", ("**/*",), 3),
        ("run continued", "run", "run --config config.json", CELLS, 3),
        ("images", "run", "evaluate images --like run --out out --label theirs", ("images/**/*",), 3),
        ("avatar export", "run", f"export ply {OURS} --out out.ply --capture capture", (f"{OURS}/*",), 3),
        ("avatar to compact", "run", f"export compact {OURS} --out out", ("run/901/ours/**/*",), 3),
        ("ply import", "run", f"import ga {PLY} --capture capture --out out", (PLY,), 4),
        ("exclusions tongue", "heads", "prepare tongue capture --out reviewed", (EXCLUSIONS,), 3),
        ("settings", "files", "run --config config.yaml", ("config.yaml",), 6),
        ("synthetic", "synthetic", f"synth {SYNTH} --out synthetic", ("**/*",), 3),
    )
)
READERS = (*FUNCTIONS, *COMMANDS, *SMALL)

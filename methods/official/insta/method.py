"""INSTA by its authors' code.

Zielonka, Bolkart, Thies, "Instant Volumetric Head Avatars", CVPR 2023. Their program is C++ and CUDA, built on
instant-ngp. It takes a scene and a configuration, trains, records the frames of the scene's test split, and ends.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ....bench.contracts import Clip, Frame, FrameKey, Progress
from ....bench.errors import InputError
from ....bench.io.documents import read_json
from ....bench.io.files import read_bytes, write_bytes, write_json
from ....bench.io.images import read_pixels
from ...shared.avatar_files import (
    SUBJECT_FILE,
    Subject,
    read_shared_head,
    read_subject,
)
from ...shared.loop import Fit
from ..checkout import Checkout, Environment, Repository, inspect_program
from ..config import INSTAOfficialConfig
from ..ga.method import copy_file
from ..method import Listed, OfficialMethod, Workplace
from ..spec import INSTA_OFFICIAL
from ..video import check_masks
from .export import (
    CONDITIONS,
    MASK_FOLDER,
    MASKS,
    PART,
    TEST,
    VideoMesh,
    check_camera,
    write_list,
    write_training,
)

CONFIGS, MAIN, OURS = Path("configs/nerf"), "main.json", "headbench.json"
INPUT, EXPERIMENTS = "../input", "experiments"
"""Paths relative to the program's working directory. It finds files by parts of their paths ("train", "test") and
passes paths to a shell, so none may be absolute because a run folder can have any name."""
RECORDED = Path("headbench/debug")
"""Folder of its output, named after its configuration."""
SNAPSHOT, BACKGROUND_FILE, RENDERS = "snapshot.msgpack", "background.json", "renders"
PLAN, LAUNCHER = "parts.json", Path(__file__).with_name("parts.py")
LAST_SIZE = 16
"""Side of the unused final render of a training."""
MOST_CONFIG = 1 << 16
_ITERATION = re.compile(r"iteration=(\d+) loss=([-+.\de]+|-?nan|inf)")
_DRAWN = re.compile(r"^headbench: drawn (\d+)")

INSTA_REPOSITORY = Repository(
    "https://github.com/Zielon/INSTA",
    INSTAOfficialConfig().commit,
    (str(CONFIGS / MAIN), "src/recorder.cu", *(f"{MASK_FOLDER}/{name}.obj" for name in MASKS)),
    (),
)


class INSTAOfficial(OfficialMethod[INSTAOfficialConfig]):
    """The method: see the module."""

    name, version = INSTA_OFFICIAL.name, INSTA_OFFICIAL.version
    config_class, repository = INSTAOfficialConfig, INSTA_REPOSITORY

    def inspect_environment(self) -> Environment:
        """Check their program and the GPU."""
        return inspect_program(self.name, self.config, self.repository)

    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Refuse a clip without masks, a skewed camera, and a head outside their scene."""
        check_masks(clip)
        for name in sorted({key.camera for key in clip.splits["train"]}):
            check_camera(clip.cameras[name])
        VideoMesh.of(Subject.of(clip), clip.head, checkout)

    def export(
        self, clip: Clip, checkout: Checkout, work: Workplace, progress: Progress
    ) -> dict[str, FrameKey]:
        """Write the training frames as a tracked video, and the files that the program opens in its working directory."""
        head = VideoMesh.of(Subject.of(clip), clip.head, checkout)
        head.write_masks(work.program)
        _copy_main(checkout, work)
        return write_training(clip, head, work, progress)

    def train_command(self, fit: Fit, checkout: Checkout, work: Workplace) -> list[str]:
        """Their program without a window; its output folder ``input/experiments`` is a link to ``model``."""
        _write_config(work, max_steps=fit.budget.iterations, max_images_gpu=self.config.images_on_gpu)
        link = work.input / EXPERIMENTS
        link.unlink(missing_ok=True)
        link.symlink_to(Path("..") / work.model.name)
        return [*_program(checkout), "--scene", INPUT, *_size(LAST_SIZE, LAST_SIZE)]

    def done(self, line: str) -> tuple[int, str] | None:
        """Parse the line that it writes after each iteration."""
        match = _ITERATION.search(line)
        return None if match is None else (int(match[1]), f"loss {match[2]}")

    def keep(self, fit: Fit, work: Workplace) -> dict[str, Any]:
        """The snapshot."""
        copy_file(work.model / RECORDED / SNAPSHOT, fit.out / SNAPSHOT)
        return {}

    def files(self, folder: Path) -> list[Path]:
        """Field with its occupancy grid and settings, and the subject."""
        return [folder / name for name in (SNAPSHOT, SUBJECT_FILE)]

    def write_list(
        self,
        folder: Path,
        frames: Sequence[Listed],
        background: Sequence[float],
        checkout: Checkout,
        work: Workplace,
    ) -> None:
        """Write the frames as test splits, each rendered in a separate call by the launcher."""
        model = read_shared_head(folder)
        head = VideoMesh.of(read_subject(folder / SUBJECT_FILE, model), model, checkout)
        head.write_masks(work.program)
        _copy_main(checkout, work)
        _write_config(work, max_images_gpu=PART, max_cached_bvh=PART, render_from_snapshot=True)
        (work.program / SNAPSHOT).symlink_to((folder / SNAPSHOT).absolute())
        self.render_folder(folder, work).mkdir(parents=True)
        plan = {
            "program": [*_program(checkout), "--snapshot", SNAPSHOT],
            "input": INPUT,
            "list": TEST,
            "output": str(EXPERIMENTS / RECORDED),
            "renders": str(Path("..") / work.model.name / RENDERS),
            "parts": write_list(frames, head, work),
        }
        write_json(work.root / PLAN, plan)
        write_json(work.root / BACKGROUND_FILE, {"background": [float(level) for level in background]})
        write_bytes(work.root / LAUNCHER.name, read_bytes(LAUNCHER, "the launcher", MOST_CONFIG))

    def render_command(self, folder: Path, checkout: Checkout, work: Workplace) -> list[str]:
        """The launcher, with the plan that was written with the list, run by headbench's interpreter."""
        return [sys.executable, str(work.root / LAUNCHER.name), str(work.root / PLAN)]

    def drawn(self, line: str) -> int | None:
        """From the launcher."""
        match = _DRAWN.search(line)
        return None if match is None else int(match[1])

    def render_folder(self, folder: Path, work: Workplace) -> Path:
        """Output folder of the launcher."""
        return work.model / RENDERS

    def render_name(self, number: int) -> str:
        """Render by the number that the plan gives to each frame of a list."""
        return f"{number:06d}.png"

    def read_back(self, frame: Listed, path: Path, work: Workplace) -> Frame:
        """A render on black, composited on the background by its coverage."""
        pixels = read_pixels(path, size=(frame.camera.width, frame.camera.height))
        if pixels.ndim != 3 or pixels.shape[2] != 4:
            raise InputError(path, str(frame.key), "colours and coverage (RGBA)", f"shape {pixels.shape}")
        rgba = cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA).astype(np.float32) / 255
        rgb, alpha = rgba[..., :3], rgba[..., 3]
        ground = np.array(read_json(work.root / BACKGROUND_FILE)["background"], np.float32)
        return Frame(np.clip(rgb + (1 - alpha[..., None]) * ground, 0, 1), np.ascontiguousarray(alpha))

    def remarks(self, clip: Clip, seed: int) -> dict[str, list[str]]:
        """Leaks and differences, for readers of results."""
        differences = [
            "frames are renumbered; the test split that their program renders at the end is a placeholder of one pixel",
            "depths and classes of pixels (mouth, skin, hair) are those of the head model's mesh, not of a depth map of the "
            + "tracker and of a face parsing network",
            "meshes have no teeth; the static offset is part of them",
            "the background is removed from partly covered pixels",
            "images are read again for each part of the training instead of kept in memory",
            "renders are rounded down to 8 bits by their program",
        ]
        if clip.head.expression_basis.shape[2] < CONDITIONS:
            size = clip.head.expression_basis.shape[2]
            differences.append(f"{size} expression coefficients are padded with zeros to {CONDITIONS}")
        if len(clip.splits["train"]) > self.config.images_on_gpu:
            differences.append(
                f"{self.config.images_on_gpu} of {len(clip.splits['train'])} images are drawn anew after every 1,500 "
                + "iterations, as their code does it"
            )
        if seed:
            differences.append(f"their code fixes the seeds; seed {seed} is a repetition, not another start")
        return {"leaks": [], "differences": differences}


def _program(checkout: Checkout) -> list[str]:
    return [*checkout.python, "--no-gui", "--config", OURS]


def _size(width: int, height: int) -> list[str]:
    return ["--width", str(width), "--height", str(height)]


def _copy_main(checkout: Checkout, work: Workplace) -> None:
    content = read_bytes(checkout.folder / CONFIGS / MAIN, "a configuration", MOST_CONFIG)
    write_bytes(work.program / CONFIGS / MAIN, content)


def _write_config(work: Workplace, **changes: Any) -> None:
    """Their published settings with the given changes, without further videos."""
    fixed = {"parent": MAIN, "use_dataset_cache": False, "render_novel_trajectory": False}
    write_json(work.program / CONFIGS / OURS, {"render_from_snapshot": False, **fixed, **changes})

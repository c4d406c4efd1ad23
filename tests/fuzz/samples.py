"""Small valid inputs of every kind that headbench reads from outside, made once and kept in a folder.

Each builder writes one sample into the folder it is given, and may take files from samples named before it.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import safetensors.torch
import scipy.sparse
import torch
import yaml

from headbench.bench import cli
from headbench.bench.io.files import digest
from headbench.bench.rows import Row, Rows
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import save_head
from headbench.methods.shared.avatar_files import read_shared_head
from headbench.methods.shared.checkpoint import save_checkpoint
from headbench.methods.shared.ply import write_ply
from headbench.metrics.lpips_network import SQUEEZE

from ..datasets.head.flame_files import legacy_pickle, write_flame
from ..datasets.head.toy import toy_head
from ..datasets.monocular.videos import Recording, write_imavatar, write_insta
from ..datasets.nersemble.benchmark_folder import write_benchmark
from ..datasets.nersemble.recordings import write_recording
from ..datasets.tiny_capture import make_plan, rig, write_tiny_capture
from ..datasets.tracker_files.trackers import write_flashavatar
from ..methods.official.repository import lip_numbers, make_interpreter, make_repository
from ..world import SETTINGS

AVATAR = "run/901/{}/seed-0/avatar"
GA, OURS = AVATAR.format("ga"), AVATAR.format("ours")
CHECKPOINT, BACKBONE = "checkpoint.safetensors", "squeezenet1_1-b8a52dc0.pth"
SYNTH = "--cameras 2 --timesteps 7 --size 16x16"
PREPARE = (
    "prepare nersemble --root recording --tracking tracking --head head.npz --subjects 901 "
    "--sequences EMO-1,FREE --downscale 2 --every 1"
)
METHODS = ("mean-image", "nearest-camera", "flashavatar", "ga", "gbs", "gha", "insta", "rgbavatar", "ours")
NUMBERS = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)


def configuration(methods: tuple[str, ...], metrics: tuple[str, ...] = ("psnr", "storage")) -> dict:
    """Settings of a run in a folder that has the capture in ``capture``."""
    return {
        "data": "capture",
        "out": "run",
        "methods": list(methods),
        "preset": "smoke",
        "metrics": list(metrics),
        "frames_per_task": 1,
        "settings": {name: SETTINGS[name] for name in methods if name in SETTINGS},
    }


def with_capture(folder: Path, samples: Path) -> None:
    """Copy the capture into a sample."""
    shutil.copytree(samples / "capture" / "capture", folder / "capture")


def files(folder: Path, samples: Path) -> None:
    """A small file of every format, a checkpoint of a run called "run", weights of LPIPS at random, and settings."""
    import pycolmap

    np.savez(folder / "plain.npz", x=NUMBERS)
    np.savez_compressed(folder / "compressed.npz", x=NUMBERS)
    np.save(folder / "a.npy", NUMBERS)
    tensors = {"x": torch.from_numpy(NUMBERS)}
    torch.save(tensors, folder / "a.pth")
    torch.save(tensors, folder / "old.pth", _use_new_zipfile_serialization=False)
    (folder / "a.safetensors").write_bytes(safetensors.torch.save(tensors))
    (folder / "a.pkl").write_bytes(pickle.dumps({"x": NUMBERS}))
    objects = {"x": NUMBERS, "matrix": scipy.sparse.csc_matrix(np.eye(4)), "text": "lbs"}
    (folder / "python2.pkl").write_bytes(legacy_pickle(objects))
    write_ply(folder / "a.ply", ("x", "y", "z"), NUMBERS)
    rows = (Row("m", "1", 0, "t", "s", "q", i, "c", "full", "psnr", 1.0, "h") for i in range(30))
    Rows.of(rows).write(folder / "rows.parquet")
    picture = np.random.default_rng(0).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    for name in ("a.png", "a.jpg"):
        cv2.imwrite(str(folder / name), picture)
    (folder / "a.json").write_text('{"x": [1, 2.5, "text"]}')
    (folder / "a.yaml").write_text("x: [1, 2.5, text]\ny: {z: true}\n")
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=7, model="PINHOLE", width=40, height=30, params=[50.0, 51, 20, 15])
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image("a.png", np.zeros((2, 2)), 7, 3)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for kind, write in (("bin", model.write_binary), ("txt", model.write_text)):
        (folder / kind).mkdir()
        write(folder / kind)
    state = {"iteration": 3, "tensors": tensors, "moments": [torch.zeros(2), 0.5, "text"]}
    save_checkpoint(folder / CHECKPOINT, "run", state)
    torch.manual_seed(0)
    torch.save(SQUEEZE.build().state_dict(), folder / BACKBONE)
    torch.save({"flame": {"exp": NUMBERS, "jaw": NUMBERS[:1]}, "frame_id": "00001"}, folder / "a.frame")
    values = {**configuration(METHODS), "data": "nowhere", "seeds": [0, 1], "regions": ["face"]}
    values["reader_settings"] = {"background": [0, 0, 0]}
    (folder / "config.yaml").write_text(yaml.safe_dump(values))


def capture(folder: Path, samples: Path, subject: str = "901") -> None:
    """A capture with a head model beside it: five timesteps, two cameras."""
    lengths = {"FREE": 2, "EMO-1-shout+laugh": 2, "SEN-01-cramp_small_danger": 1}
    cameras = rig(24, 32, 12.3, 15.1)[:2]
    head = toy_head(16, version="procedural2020")  # the version that every method takes as it is
    offset = np.zeros_like(head.template)
    plan = make_plan(lengths=lengths, cameras=cameras, head=head, static_offset=offset, subject=subject)
    write_tiny_capture(folder / "capture", plan)


def heads(folder: Path, samples: Path) -> None:
    """Head models of every kind, files with their regions, a capture of another, and a file of frames to leave out."""
    with_capture(folder, samples)
    head = toy_head(16)
    save_head(folder / "head.npz", head)
    save_head(folder / "eyelids.npz", toy_head(16, eyelids=True))
    many = toy_head(16, shape_size=300, expression_size=10)
    write_flame(folder / "flame2023.pkl", many, legacy=False)
    write_flame(folder / "flame2020.pkl", many)
    masks = {name: np.asarray(region) for name, region in head.regions.items() if "ring" not in name}
    (folder / "FLAME_masks.pkl").write_bytes(pickle.dumps(masks, protocol=2))
    rings = {name: np.asarray(region).tolist() for name, region in head.regions.items() if "ring" in name}
    (folder / "regions.json").write_text(json.dumps(rings))
    _main("prepare", "tongue", str(folder / "capture"), "--out", str(folder / "reviewed"))


def recording(folder: Path, samples: Path) -> None:
    """A raw recording as images with foreground masks, its tracking and its head model."""
    write_recording(folder, sequences={"EMO-1-shout+laugh": 1, "FREE": 1})


def videos(folder: Path, samples: Path) -> None:
    """A raw recording as videos."""
    write_recording(folder, images=False, sequences={"EMO-1-shout+laugh": 2, "FREE": 2})


def monocular(folder: Path, samples: Path) -> None:
    """The capture's frontal camera as tracked videos, in both layouts and as a tracker's files."""
    clip = read_capture(samples / "capture" / "capture")
    clip = replace(clip, poses={t: replace(pose, neck=np.zeros(3)) for t, pose in clip.poses.items()})
    video = Recording(clip, next(iter(clip.cameras)))
    write_insta(video, folder / "insta", parameters=("exp",))
    write_imavatar(video, folder / "imavatar", ["a", "b"])
    write_flashavatar(video, folder / "tracker")


def run(folder: Path, samples: Path) -> None:
    """A finished run of all methods with its capture, and what is made of it.

    That is a baseline, a compact avatar, bundles with and without renders, a folder of images to evaluate, and a
    participant's folder of the NeRSemble benchmark.
    """
    _run(folder, samples, METHODS)
    with contextlib.chdir(folder):
        _main("compare", "run", "--baseline", "baseline.json", "--update")
        _main("export", "compact", OURS, "--out", "compact")
        Path("bundles").mkdir()
        for name, options in (("renders", ["--renders"]), ("values", ["--methods", "ours"])):
            _main("bundle", "run", "--out", f"bundles/{name}.zip", "--by", "Somebody", *options)
        shutil.copytree(Path(GA).parent / "renders", "images")
        write_benchmark(Path("benchmark"), read_shared_head(Path(GA)), frames=1)


def unfinished(folder: Path, samples: Path) -> None:
    """A run that has not begun, with a checkpoint after every iteration."""
    with_capture(folder, samples)
    values = configuration(METHODS)
    for name, settings in values["settings"].items():
        often = {"checkpoint_every_s": 0.0}
        bound = name in ("ga", "gbs", "ours")
        values["settings"][name] = {**settings, **({"splats": often} if bound else often)}
    (folder / "config.json").write_text(json.dumps(values))


def two_subjects(folder: Path, samples: Path) -> None:
    """A finished run of one method on two subjects."""
    capture(folder, samples)
    capture(folder, samples, subject="902")
    _run(folder, samples, ("mean-image", "ga"))


def timed(folder: Path, samples: Path) -> None:
    """A finished run with speeds."""
    _run(folder, samples, ("mean-image", "ga"), ("psnr", "fps"))


def official(folder: Path, samples: Path) -> None:
    """A stand-in for an official repository and its interpreter."""
    with_capture(folder, samples)
    make_repository(folder / "repository", *lip_numbers(toy_head(16)))
    make_interpreter(folder / "python")


def synthetic(folder: Path, samples: Path) -> None:
    """A synthetic capture as `synth` leaves it."""
    _main("synth", *SYNTH.split(), "--out", str(folder / "synthetic"))


SAMPLES = (
    files,
    capture,
    heads,
    recording,
    videos,
    monocular,
    run,
    unfinished,
    two_subjects,
    timed,
    official,
    synthetic,
)


def make(root: Path) -> None:
    """Make every sample."""
    for build in SAMPLES:
        folder = root / build.__name__
        folder.mkdir(parents=True)
        build(folder, root)


def prepare_samples(root: Path = Path("build/fuzz")) -> Path:
    """The folder with the samples of the code as it is.

    They are made in another process where they are missing, since that starts threads, which no fork survives.
    """
    os.environ.update(OMP_NUM_THREADS="1", OMP_WAIT_POLICY="PASSIVE")
    top = Path(__file__).parents[2]
    packages = ("bench", "datasets", "methods", "metrics", "reports")
    sources = [Path(__file__), *(path for name in packages for path in sorted((top / name).rglob("*.py")))]
    current = root / digest(*(path.read_text() for path in sources))[:12]
    if not current.exists():
        shutil.rmtree(root, ignore_errors=True)
        partial = root / "partial"
        made = subprocess.run(
            [sys.executable, "-m", "headbench.tests.fuzz.samples", str(partial)],
            check=False,
            capture_output=True,
            text=True,
        )
        if made.returncode:
            raise RuntimeError(f"samples: {made.stdout[-5000:]}{made.stderr[-5000:]}")
        partial.rename(current)
    return current.resolve()


def _run(
    folder: Path, samples: Path, methods: tuple[str, ...], metrics: tuple[str, ...] = ("psnr", "storage")
) -> None:
    if not (folder / "capture").exists():
        with_capture(folder, samples)
    (folder / "config.json").write_text(json.dumps(configuration(methods, metrics)))
    with contextlib.chdir(folder):
        _main("run", "--config", "config.json")


def _main(*words: str) -> None:
    code = cli.main(list(words))
    if code != 0:
        raise RuntimeError(f"headbench {' '.join(words)} ended with {code}")


if __name__ == "__main__":
    make(Path(sys.argv[1]))

"""Every reader of files from outside takes damaged bytes for what they are: it reads them or raises `InputError`.

``HEADBENCH_FUZZ_EXAMPLES`` is the number of examples of each reader; they are new in every run where it is set.
"""

import os
import pickle
import resource
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import safetensors.torch
import scipy.sparse
import torch
from hypothesis import given, note, settings
from hypothesis import strategies as st

from headbench.bench.configuration import build_file
from headbench.bench.engine.config import RunConfig
from headbench.bench.errors import InputError
from headbench.bench.io.arrays import read_npy, read_npz, read_pickle, read_saved
from headbench.bench.io.documents import read_json, read_yaml
from headbench.bench.io.images import read_pixels
from headbench.bench.rows import Row, Rows
from headbench.datasets.colmap.model import read_model
from headbench.datasets.colmap.reader import model_cameras
from headbench.datasets.drive.table import read_table
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.loaders import load_head, read_chart
from headbench.datasets.monocular.reader import read_video
from headbench.datasets.steps.exclude import read_exclusions
from headbench.methods.shared.tensor_files import (
    load_checkpoint,
    read_ply,
    read_safetensors,
    save_checkpoint,
    write_ply,
)
from headbench.metrics.lpips_network import read_weights

from .datasets.head.flame_files import legacy_pickle, write_flame
from .datasets.head.toy import toy_head
from .datasets.monocular.videos import Recording, write_imavatar, write_insta
from .datasets.tiny_capture import make_plan, write_tiny_capture

EXAMPLES = int(os.environ.get("HEADBENCH_FUZZ_EXAMPLES", "8"))
NUMBERS = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)


def clip_of(read):
    """Open a capture or a video and decode a frame of each split."""

    def call(path):
        clip = read(path)
        for keys in filter(None, clip.splits.values()):
            clip.image(keys[0])
            clip.mask(keys[0])

    return call


def colmap(path):
    return model_cameras(read_model(path))


READERS = {
    "plain.npz": read_npz,
    "compressed.npz": read_npz,
    "a.npy": read_npy,
    "rows.parquet": Rows.read,
    "new.pth": lambda path: read_weights(path, {"x": NUMBERS.shape}),
    "old.pth": lambda path: read_weights(path, {"x": NUMBERS.shape}),
    "a.frame": read_saved,
    "a.pkl": read_pickle,
    "python2.pkl": read_pickle,
    "a.safetensors": read_safetensors,
    "checkpoint.safetensors": lambda path: load_checkpoint(path, "run", "cpu"),
    "a.ply": lambda path: read_ply(path, ("x", "y", "z")),
    "a.png": read_pixels,
    "a.jpg": read_pixels,
    "a.json": read_json,
    "a.yaml": read_yaml,
    "config.yaml": lambda path: build_file(RunConfig, path),
    "excluded.yaml": read_exclusions,
    "chart.obj": lambda path: read_chart(path, np.array([[0, 1, 2]])),
    "signal.csv": read_table,
    "signal.jsonl": read_table,
    "bin": colmap,
    "txt": colmap,
    "head.npz": load_head,
    "flame2020.pkl": load_head,
    "capture": clip_of(read_capture),
    "insta": clip_of(read_video),
    "imavatar": clip_of(read_video),
}
"""Readers by the file or folder of the sample that they read."""


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """A small sound file of every format."""
    import pycolmap

    folder = tmp_path_factory.mktemp("samples")
    np.savez(folder / "plain.npz", x=NUMBERS)
    np.savez_compressed(folder / "compressed.npz", x=NUMBERS)
    np.save(folder / "a.npy", NUMBERS)
    tensors = {"x": torch.from_numpy(NUMBERS)}
    torch.save(tensors, folder / "new.pth")
    torch.save(tensors, folder / "old.pth", _use_new_zipfile_serialization=False)
    torch.save({"flame": {"exp": NUMBERS, "jaw": NUMBERS[:1]}, "frame_id": "00001"}, folder / "a.frame")
    (folder / "a.safetensors").write_bytes(safetensors.torch.save(tensors))
    state = {"iteration": 3, "tensors": tensors, "moments": [torch.zeros(2), 0.5, "text"]}
    save_checkpoint(folder / "checkpoint.safetensors", "run", state)
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
    (folder / "config.yaml").write_text(
        "data: nowhere\nout: run\nmethods: [ga]\nseeds: [0, 1]\nframes_per_task: 3\n"
    )
    (folder / "excluded.yaml").write_text(
        "format: headbench-exclusions-1\nsubjects:\n  '901': {threshold: 0.5, frames: {}, overrides: {1: keep}}\n"
    )
    (folder / "chart.obj").write_text("vt 0 0\nvt 0 1\nvt 1 1\nf 1/1 2/2 3/3\n")
    (folder / "signal.csv").write_text("frame,jawOpen\n0,0.5\n1,0.25\n")
    (folder / "signal.jsonl").write_text('{"jawOpen": 0.5}\n{"jawOpen": 0.25}\n')
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=7, model="PINHOLE", width=40, height=30, params=[50.0, 51, 20, 15])
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image("a.png", np.zeros((2, 2)), 7, 3)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for kind, write in (("bin", model.write_binary), ("txt", model.write_text)):
        (folder / kind).mkdir()
        write(folder / kind)
    save_head(folder / "head.npz", toy_head(16))
    write_flame(folder / "flame2020.pkl", toy_head(16, shape_size=300, expression_size=10))
    head = toy_head(16, version="procedural2020")
    write_tiny_capture(folder / "capture", make_plan(head=head, static_offset=np.zeros_like(head.template)))
    clip = read_capture(folder / "capture")
    clip = replace(clip, poses={t: replace(pose, neck=np.zeros(3)) for t, pose in clip.poses.items()})
    video = Recording(clip, next(iter(clip.cameras)))
    write_insta(video, folder / "insta", parameters=("exp",))
    write_imavatar(video, folder / "imavatar", ["a", "b"])
    return folder


@pytest.fixture(scope="module")
def less_memory():
    """A damaged length is an error of memory, not an end of the machine."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 8 * 2**30, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def damaged(draw, content):
    """Cut, repeat, remove or overwrite a part."""
    start = draw(st.integers(0, min(len(content), 512)) | st.integers(0, len(content)))
    end = draw(st.integers(start, len(content)))
    block = draw(
        st.binary(min_size=1, max_size=8) | st.sampled_from([bytes(200), b"\xff\xff\xff\x7f", b"-1"])
    )
    overwritten = content[:start] + block + content[start + len(block) :]
    cut, repeated, removed = content[:start], content[:end] + content[start:], content[:start] + content[end:]
    return draw(st.sampled_from([overwritten, overwritten, cut, repeated, removed, content + block, b""]))


@pytest.mark.usefixtures("less_memory")
@pytest.mark.filterwarnings("ignore")  # of the libraries, about what they refuse
@pytest.mark.parametrize("name", READERS)
def test_damaged_bytes_are_read_or_refused_by_name(samples, name):
    read, place = READERS[name], samples / name
    read(place)
    files = sorted(path for path in place.rglob("*") if path.is_file()) if place.is_dir() else [place]

    @settings(max_examples=EXAMPLES, derandomize="HEADBENCH_FUZZ_EXAMPLES" not in os.environ)
    @given(st.data())
    def case(data):
        path = data.draw(st.sampled_from(files))
        content = path.read_bytes()
        note(path.name)
        path.write_bytes(damaged(data.draw, content))
        named = place
        try:
            read(place)
        except InputError as error:
            named = Path(error.file)
        finally:
            path.write_bytes(content)
        assert named.is_relative_to(samples)

    case()

"""What every reader of a file promises, held by damaged files: one `InputError` that names the file, in bounded memory."""

from __future__ import annotations

import itertools
import os
import pickle
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import safetensors.torch
import scipy.sparse
import torch

from headbench.bench.errors import InputError
from headbench.bench.io.arrays import read_npy, read_npz
from headbench.bench.io.documents import read_json, read_yaml
from headbench.bench.io.images import read_pixels
from headbench.bench.io.unpickle import read_pickle
from headbench.bench.rows import Row, Rows
from headbench.datasets.colmap.model import read_model
from headbench.methods.shared.ply import read_ply, write_ply
from headbench.methods.shared.tensor_files import read_safetensors
from headbench.metrics.torch_file import read_weights

from .datasets.head.flame_files import legacy_pickle

NUMBERS = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
MAX_MEMORY = 20_000_000
"""Bytes that reading a damaged file of some kilobytes may take, Python's and numpy's."""


@dataclass(frozen=True)
class Reader:
    """A reader by the file that it reads, which ``write`` makes. ``text``: a part of it may be a whole file."""

    file: str
    write: Callable[[Path], Any]
    read: Callable[[Path], Any]
    text: bool = False


def write_rows(path: Path) -> None:
    Rows.of(Row("m", "1", 0, "t", "s", "q", i, "c", "full", "psnr", 1.0, "h") for i in range(30)).write(path)


def write_model(path: Path) -> None:
    """Cameras and images of a COLMAP model as text, or as what COLMAP's documentation says of binary ones."""
    import pycolmap

    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=7, model="PINHOLE", width=40, height=30, params=[50.0, 51, 20, 15])
    )
    image = pycolmap.Image("a.png", np.zeros((2, 2)), 7, 3)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    (model.write_binary if path.suffix == ".bin" else model.write_text)(path.parent)


def write_torch(**layout: bool) -> Callable[[Path], None]:
    return lambda path: torch.save({"x": torch.from_numpy(NUMBERS)}, path, **layout)


def read_torch(path: Path) -> Any:
    return read_weights(path, {"x": NUMBERS.shape})


def colmap(path: Path) -> Any:
    return read_model(path.parent)


OBJECTS = {"x": NUMBERS, "matrix": scipy.sparse.csc_matrix(np.eye(4)), "text": "lbs"}
PICTURE = np.random.default_rng(0).integers(0, 255, (20, 30, 3), dtype=np.uint8)
READERS = {
    "npz": Reader("a.npz", lambda p: np.savez(p, x=NUMBERS), read_npz),
    "npz, compressed": Reader("a.npz", lambda p: np.savez_compressed(p, x=NUMBERS), read_npz),
    "npy": Reader("a.npy", lambda p: np.save(p, NUMBERS), read_npy),
    "rows": Reader("rows.parquet", write_rows, Rows.read),
    "torch": Reader("a.pth", write_torch(), read_torch),
    "torch, old": Reader("a.pth", write_torch(_use_new_zipfile_serialization=False), read_torch),
    "pickle": Reader("a.pkl", lambda p: p.write_bytes(pickle.dumps({"x": NUMBERS})), read_pickle),
    "pickle of Python 2": Reader("a.pkl", lambda p: p.write_bytes(legacy_pickle(OBJECTS)), read_pickle),
    "safetensors": Reader(
        "a.safetensors",
        lambda p: p.write_bytes(safetensors.torch.save({"x": torch.from_numpy(NUMBERS)})),
        read_safetensors,
    ),
    "ply": Reader(
        "a.ply", lambda p: write_ply(p, ("x", "y", "z"), NUMBERS), lambda p: read_ply(p, ("x", "y", "z"))
    ),
    "png": Reader("a.png", lambda p: cv2.imwrite(str(p), PICTURE), read_pixels),
    "jpeg": Reader("a.jpg", lambda p: cv2.imwrite(str(p), PICTURE), read_pixels),
    "colmap": Reader("images.bin", write_model, colmap),
    "colmap, cameras": Reader("cameras.bin", write_model, colmap),
    "colmap, text": Reader("images.txt", write_model, colmap, text=True),
    "json": Reader("a.json", lambda p: p.write_text('{"x": [1, 2.5, "text"]}'), read_json),
    "yaml": Reader(
        "a.yaml", lambda p: p.write_text("x: [1, 2.5, text]\ny: {z: true}\n"), read_yaml, text=True
    ),
}


def replace_by(make: Callable[[Path], Any]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        path.unlink()
        make(path)

    return damage


def cut_to(part: float) -> Callable[[Path], None]:
    return lambda path: os.truncate(path, int(path.stat().st_size * part))


DAMAGE = {
    "missing": lambda path: path.unlink(),
    "a folder": replace_by(Path.mkdir),
    "a pipe": replace_by(os.mkfifo),
    "a link to itself": replace_by(lambda path: path.symlink_to(path)),
    "of another format": lambda path: path.write_bytes(b"solid \xff\xfe\x00 mesh\n" * 20),
    "empty": cut_to(0.0),
    "cut in its first tenth": cut_to(0.1),
    "cut in its middle": cut_to(0.5),
    "cut near its end": cut_to(0.95),
}


@pytest.fixture
def damaged(tmp_path, monkeypatch) -> Callable[[Reader], Path]:
    monkeypatch.chdir(tmp_path)

    def make(reader: Reader) -> Path:
        path = tmp_path / reader.file
        reader.write(path)
        reader.read(path)
        return path

    return make


def part_of_a_text(name: str, damage: str) -> bool:
    """Whether the damage leaves a text, which is shorter and sound."""
    return READERS[name].text and damage.startswith(("empty", "cut"))


@pytest.mark.parametrize(
    ("name", "damage"),
    [pair for pair in itertools.product(READERS, DAMAGE) if not part_of_a_text(*pair)],
)
def test_a_damaged_file_is_refused_by_its_name(damaged, name, damage):
    reader = READERS[name]
    path = damaged(reader)
    DAMAGE[damage](path)
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            reader.read(path)
        assert tracemalloc.get_traced_memory()[1] < MAX_MEMORY
    finally:
        tracemalloc.stop()
    # A model of COLMAP without one of its files is none: the folder is named.
    assert caught.value.file in (str(path), str(path.parent))
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 2000


@pytest.mark.filterwarnings("ignore")  # of the libraries, about what they refuse
@pytest.mark.parametrize("name", READERS)
def test_changed_bytes_are_refused_or_harmless(damaged, name):
    path, reader = damaged(READERS[name]), READERS[name]
    whole = path.read_bytes()
    for case in range(40):
        rng = np.random.default_rng(case)
        content = bytearray(whole)
        for place in rng.integers(0, len(whole), rng.integers(1, 4)):
            content[place] = rng.integers(256)
        path.write_bytes(content)
        tracemalloc.start()
        try:
            with suppress(InputError):
                reader.read(path)
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert peak < MAX_MEMORY

"""Damage to files as hypothesis draws it: bytes for all of them, structure for those whose format is known.

A file of a known format is decoded into dictionaries, lists, arrays and scalars, one of these is changed, and the result
is encoded again, so that the damage lies behind the parser. Texts, archives and images have changes of their own (`ODD`),
and something else may stand in place of the file (`replace`). What is crafted against one parser is in its own tests
(tests/bench/io, tests/methods/shared/test_tensor_files.py).
"""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
import yaml
from hypothesis import strategies as st
from hypothesis.errors import HypothesisException
from hypothesis.extra import numpy as stn
from safetensors.numpy import load, save

Draw = Callable[[st.SearchStrategy], Any]

NUMBERS = st.floats() | st.integers() | st.sampled_from([2**31, 2**63, -(2**63), 2**64, 10**30, 1e38, 1e300])
TEXTS = st.text(max_size=8) | st.sampled_from(
    ["../../outside", "/dev/zero", "x\n\x1b[31my", "a" * 100_000, "\ud800", "2026-01-01", "1e999", "CON"]
)
SCALARS = st.none() | st.booleans() | NUMBERS | TEXTS
TREES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=5,
)
DTYPES = st.sampled_from(["f2", "f4", "f8", "i1", "i8", "u1", "?", "c8", "U4", "S3", "M8[s]", ">f4"])
ARRAYS = DTYPES.flatmap(
    lambda dtype: stn.arrays(dtype, stn.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3))
)


def damage(path: Path, outside: Path, draw: Draw) -> str:
    """Damage a file in one of the ways that its suffix allows; return which.

    ``outside`` is a folder that no reader may write to; links lead there.
    """
    ways = ["bytes"] * 3 + ["odd"] * (path.suffix in ODD) * 2 + ["tree"] * (path.suffix in CODECS) * 5
    way = draw(st.sampled_from([*ways, "place"]))
    if way == "place":
        return replace(path, outside, draw)
    content = path.read_bytes()
    try:
        if way == "odd":
            changed = ODD[path.suffix](content, draw)
        else:
            changed = change_bytes(content, draw) if way == "bytes" else tree_of(path.suffix, content, draw)
    except HypothesisException:
        raise
    except Exception:  # noqa: BLE001 - what the format cannot hold, or what an earlier change has damaged
        changed = content[:-1]
    path.unlink()  # never through a link, and never into a file that is shared
    path.write_bytes(changed)
    return way


def change_bytes(content: bytes, draw: Draw) -> bytes:
    """Cut, repeat, or overwrite a part, with noise, with a number as a count may be, or with another format's start."""
    start = draw(st.integers(0, min(len(content), 512)) | st.integers(0, len(content)))
    end = draw(st.integers(start, len(content)))
    numbers = (
        struct.pack(code, 2**shift) for code, shift in (("<I", 30), ("<Q", 62), (">I", 30), ("<H", 15))
    )
    starts = (
        b"PK\x03\x04",
        b"\x80\x04",
        b"\x89PNG\r\n\x1a\n",
        b"PAR1",
        b"\xff\xd8\xff",
        b"\xef\xbb\xbf",
        b"{}",
    )
    block = draw(st.binary(min_size=1, max_size=20) | st.sampled_from([*numbers, *starts, bytes(200)]))
    cut, overwritten = content[:start], content[:start] + block + content[start + len(block) :]
    repeated, removed = content[:end] + content[start:], content[:start] + content[end:]
    return draw(st.sampled_from([overwritten, overwritten, cut, repeated, removed, content + block, b""]))


def replace(path: Path, outside: Path, draw: Draw) -> str:
    """Put something else where the file should be, or nothing."""
    links = {"a link outside": outside / f"target{path.suffix}", "a link to nothing": outside / "nothing"}
    links["a link to itself"] = Path(path.name)
    way = draw(st.sampled_from(["nothing", "a folder", *links]))
    if way == "a link outside":
        shutil.copyfile(path, links[way])
    path.unlink()
    if way == "a folder":
        path.mkdir()
    elif way in links:
        path.symlink_to(links[way])
    return way


# Trees of dictionaries, lists, arrays and scalars.


def tree_of(suffix: str, content: bytes, draw: Draw) -> bytes:
    """A file with one node of what it holds removed, renamed, repeated, replaced or moved."""
    decode, encode = CODECS[suffix]
    tree = {"top": decode(content)}
    places = _nodes(tree["top"]) or [(tree, "top")]
    container, key = draw(st.sampled_from(places))
    change = draw(st.sampled_from(["junk", "value", "remove", "other", "again"]))
    if change == "remove":
        del container[key]
    elif change == "other":
        other, name = draw(st.sampled_from(places))
        container[key] = other[name]
    elif change == "again" and isinstance(container, dict):
        container[draw(TEXTS)] = container[key]
    else:
        container[key] = draw(TREES if change == "junk" else _near(container[key]))
    return encode(tree["top"])


def _nodes(tree: Any, depth: int = 0) -> list[tuple[Any, Any]]:
    """Each (container, key) of a tree."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [pair for k, v in items for pair in [(tree, k), *(_nodes(v, depth + 1) if depth < 20 else ())]]


def _near(value: Any) -> st.SearchStrategy:
    """Values of the same kind, or nearly."""
    if isinstance(value, np.ndarray):
        return _near_array(value)
    if isinstance(value, str):
        return st.sampled_from([f"{value} ", f"../{value}", f"{value}\0", value[:-1], [value], value * 50])
    if isinstance(value, (int, float)):
        return NUMBERS | st.sampled_from([-value, value + 1, value * 1e9, str(value), [value]])
    return st.sampled_from([value[:-1], value * 2, [value]]) if isinstance(value, list) else SCALARS


def _near_array(array: np.ndarray) -> st.SearchStrategy:
    def spoilt(number: float) -> np.ndarray:
        with np.errstate(all="ignore"):
            filled = np.array(array)
            filled.reshape(-1)[: max(1, filled.size // 2)] = np.asarray(number).astype(array.dtype)
            return filled

    values = st.sampled_from([np.nan, np.inf, -1.0, 1e38, 2.0**31 - 1]).map(spoilt)
    shapes = [array[None], array.T, array.reshape(-1), np.zeros_like(array)]
    shapes += [array[:0], array[1:], np.concatenate([array, array])] if array.ndim else []
    return values | st.sampled_from(shapes) | DTYPES.map(lambda d: np.zeros(array.shape, d)) | ARRAYS


def _stream(write: Callable[[io.BytesIO], Any]) -> bytes:
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def _npz(content: bytes) -> dict[str, Any]:
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _safetensors(arrays: dict[str, Any]) -> bytes:
    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()}, arrays.pop("", None))


def _mapped(value: Any, kind: type, change: Callable[[Any], Any]) -> Any:
    if isinstance(value, dict):
        return {key: _mapped(item, kind, change) for key, item in value.items()}
    return change(value) if isinstance(value, kind) else value


def _torch_tree(content: bytes) -> Any:
    return _mapped(torch.load(io.BytesIO(content), weights_only=True), torch.Tensor, torch.Tensor.numpy)


def _torch_bytes(tree: Any) -> bytes:
    tensors = _mapped(tree, np.ndarray, lambda array: torch.from_numpy(np.ascontiguousarray(array)))
    return _stream(lambda stream: torch.save(tensors, stream))


def _json(tree: Any) -> bytes:
    return json.dumps(tree, default=repr).encode("utf-8", "surrogatepass")


CODECS: dict[str, tuple[Callable[[bytes], Any], Callable[[Any], bytes]]] = {
    ".json": (json.loads, _json),
    ".yaml": (
        yaml.safe_load,
        lambda t: yaml.safe_dump(t, allow_unicode=True).encode("utf-8", "surrogatepass"),
    ),
    ".npz": (_npz, lambda t: _stream(lambda stream: np.savez_compressed(stream, **t))),
    ".npy": (lambda c: np.load(io.BytesIO(c)), lambda t: _stream(lambda stream: np.save(stream, t))),
    ".parquet": (
        lambda c: pq.read_table(io.BytesIO(c), use_threads=False, pre_buffer=False).to_pydict(),
        lambda t: _stream(lambda stream: pq.write_table(pa.table(t), stream)),
    ),
    ".safetensors": (load, _safetensors),
    ".pkl": (lambda c: dict(pickle.loads(c)), pickle.dumps),
    **dict.fromkeys((".pt", ".pth"), (_torch_tree, _torch_bytes)),
}


def _line(content: bytes, draw: Draw) -> bytes:
    """A line removed or doubled, or a word of it replaced."""
    lines = content.split(b"\n")
    place = draw(st.integers(0, min(len(lines), 40) - 1))
    words = lines[place].split(b" ")
    other = [b"-1", b"nan", b"1e999", b"99999999999999999999", b"0", b"", b"../x", b"\xff", b"x" * 1000, b"#"]
    words[draw(st.integers(0, len(words) - 1))] = draw(st.sampled_from(other))
    lines[place : place + 1] = draw(st.sampled_from([[], [lines[place]] * 2, [b" ".join(words)]]))
    return b"\n".join(lines)


def _member(content: bytes, draw: Draw) -> bytes:
    """An archive with a member damaged, renamed or doubled; a bundle lists its digest, as one would who forges a result."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    place = draw(st.integers(0, len(members) - 1))
    name, data = members[place]
    suffix = Path(name).suffix
    changed = (
        tree_of(suffix, data, draw) if suffix in CODECS and draw(st.booleans()) else change_bytes(data, draw)
    )
    names = st.sampled_from([name, name, name, "../../outside/evil.npy", "/evil.npy", "x" * 300, ""])
    members[place : place + draw(st.integers(0, 1))] = [(draw(names), changed)]
    for index, (other, value) in enumerate(members):
        if other == "bundle.json":
            listed = json.loads(value)
            listed["files"][name] = hashlib.sha256(changed).hexdigest()
            members[index] = other, _json(listed)
    packing = draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA]))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", packing) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return stream.getvalue()


def _picture(content: bytes, draw: Draw) -> bytes:
    """Another size, number of channels, depth or format."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    colour = image if image.ndim == 3 else np.dstack([image] * 3)
    forms = [image[:-1], image[:1, :1], colour[..., 0], colour.astype(np.uint16) * 257, np.zeros_like(image)]
    form = draw(st.sampled_from([*forms, np.dstack([colour[..., :3], colour[..., :1]])]))
    return cv2.imencode(draw(st.sampled_from([".png", ".png", ".jpg", ".bmp", ".tiff"])), form)[1].tobytes()


ODD: dict[str, Callable[[bytes, Draw], bytes]] = {
    **dict.fromkeys((".yaml", ".json", ".ply", ".txt"), _line),
    **dict.fromkeys((".zip", ".npz", ".pt", ".pth"), _member),
    **dict.fromkeys((".png", ".jpg"), _picture),
}

"""Damage to files as hypothesis draws it: bytes for all of them, structure for those whose format is known.

A file of a known format is decoded into dictionaries, lists, arrays and scalars, one of these is changed, and the result
is encoded again, so that the damage lies behind the parser. A file may also be what no change of a sound one gives
(`ODD`), or something else may stand in its place (`PLACES`).
"""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import shutil
import struct
import zipfile
import zlib
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
        return draw(st.sampled_from(PLACES))(path, outside)
    content = path.read_bytes()
    try:
        if way == "odd":
            changed = draw(st.sampled_from(ODD[path.suffix]))
            changed = changed(content, draw) if callable(changed) else changed
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


# What stands where the file should be.


def removed(path: Path, outside: Path) -> str:
    path.unlink()
    return "removed"


def folder(path: Path, outside: Path) -> str:
    path.unlink()
    path.mkdir()
    return "a folder"


def link_outside(path: Path, outside: Path) -> str:
    target = shutil.copyfile(path, outside / f"target{path.suffix}")
    path.unlink()
    path.symlink_to(target)
    return "a link outside"


def link_nowhere(path: Path, outside: Path) -> str:
    path.unlink()
    path.symlink_to(outside / "nothing")
    return "a link to nothing outside"


def link_loop(path: Path, outside: Path) -> str:
    path.unlink()
    path.symlink_to(path.name)
    return "a link to itself"


PLACES = [removed, folder, link_outside, link_nowhere, link_loop]


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
    def spoilt(number: Any) -> np.ndarray:
        with np.errstate(all="ignore"):
            filled = np.array(array)
            filled.reshape(-1)[: max(1, filled.size // 2)] = np.asarray(number).astype(array.dtype)
            return filled

    shapes = [
        array[None],
        array.T,
        array.reshape(-1),
        array[:0] if array.ndim else array,
        np.zeros_like(array),
    ]
    twice = [np.concatenate([array, array]), array[1:]] if array.ndim else []
    values = st.sampled_from([np.nan, np.inf, -1.0, 1e38, 2.0**31 - 1]).map(spoilt)
    return (
        values | st.sampled_from([*shapes, *twice]) | DTYPES.map(lambda d: np.zeros(array.shape, d)) | ARRAYS
    )


def _stream(write: Callable[[io.BytesIO], Any]) -> bytes:
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def _npz(content: bytes) -> dict[str, Any]:
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _safetensors(arrays: dict[str, Any]) -> bytes:
    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()}, arrays.pop("", None))


def _arrays_of(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _arrays_of(item) for key, item in value.items()}
    return value.numpy() if isinstance(value, torch.Tensor) else value


def _tensors_of(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tensors_of(item) for key, item in value.items()}
    return torch.from_numpy(np.ascontiguousarray(value)) if isinstance(value, np.ndarray) else value


def _json(tree: Any) -> bytes:
    return json.dumps(tree, default=repr).encode("utf-8", "surrogatepass")


_TORCH = (
    lambda content: _arrays_of(torch.load(io.BytesIO(content), weights_only=True)),
    lambda tree: _stream(lambda stream: torch.save(_tensors_of(tree), stream)),
)
CODECS: dict[str, tuple[Callable[[bytes], Any], Callable[[Any], bytes]]] = {
    ".json": (json.loads, _json),
    ".yaml": (
        yaml.safe_load,
        lambda t: yaml.safe_dump(t, allow_unicode=True).encode("utf-8", "surrogatepass"),
    ),
    ".npz": (_npz, lambda t: _stream(lambda stream: np.savez_compressed(stream, **t))),
    ".npy": (lambda c: np.load(io.BytesIO(c)), lambda t: _stream(lambda stream: np.save(stream, t))),
    ".parquet": (
        lambda c: pq.read_table(io.BytesIO(c)).to_pydict(),
        lambda t: _stream(lambda stream: pq.write_table(pa.table(t), stream)),
    ),
    ".safetensors": (load, _safetensors),
    ".pkl": (lambda c: dict(pickle.loads(c)), pickle.dumps),
    ".pt": _TORCH,
    ".pth": _TORCH,
}


# What no change of one value gives: content, or a function of the content.


def _json_twice(content: bytes, draw: Draw) -> bytes:
    text, value = content.decode(), json.dumps(draw(TREES))
    start = text.index("{") + 1
    return f'{text[:start]}"{text[start:].split(chr(34))[1]}": {value}, {text[start:]}'.encode()


def _number(content: bytes, draw: Draw) -> bytes:
    """Another word in place of a digit."""
    places = [place for place, byte in enumerate(content) if chr(byte).isdigit()]
    place = draw(st.sampled_from(places))
    words = [
        b"9" * 5000,
        b"1e400",
        b"NaN",
        b"-Infinity",
        b"0x1",
        b"01",
        b"-",
        b"057",
        b"null",
        b'"1"',
        b"nan",
    ]
    return content[:place] + draw(st.sampled_from(words)) + content[place + 1 :]


YAML = (
    *("!!python/object/apply:os.system [ls]", "!unknown x", "!!bool x", "!!binary '='", "!!set {a, b}"),
    *("2026-01-01", "1:30:00", ".nan", "&a [*a]", "*nothing", "'\0'", "---\na: 1", "%YAML 9.9", '"\\ud800"'),
    *("&x {<<: *x}", "{[1]: 2}", "{? {a: 1} : 2}", "[" * 3000 + "]" * 3000, "{a: " * 1000 + "}" * 1000),
)
YAML_BOMB = "\n".join(
    ["a0: &a0 lol", *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 9))]
)


def _yaml_value(content: bytes, draw: Draw) -> bytes:
    text = content.decode()
    start = draw(st.sampled_from([place for place, letter in enumerate(text) if letter == ":"])) + 1
    return f"{text[:start]} {draw(st.sampled_from(YAML))}{text[text.find(chr(10), start) :]}".encode()


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
    return _zip(members, packing)


def _zip(members: list[tuple[str, bytes]], packing: int = zipfile.ZIP_DEFLATED) -> bytes:
    def write(stream: io.BytesIO) -> None:
        with zipfile.ZipFile(stream, "w", packing) as archive:
            for name, data in members:
                archive.writestr(name, data)

    return _stream(write)


def _npz_bomb(content: bytes, draw: Draw) -> bytes:
    """A member that claims more numbers than it has, or one of 3 10^8 zeros."""
    claimed, given = draw(st.sampled_from([(9_999_999_999, 0), (10**8, 0), (3 * 10**8, 3 * 10**8)]))
    text = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({claimed},), }}".encode().ljust(117)
    header = b"\x93NUMPY\x01\x00\x76\x00" + text + b"\n"
    first, *others = _npz(content).items()
    rest = [(f"{name}.npy", _stream(lambda s, a=array: np.save(s, a))) for name, array in others]
    return _zip([(f"{first[0]}.npy", header + bytes(given)), *rest])


def _png(content: bytes, draw: Draw) -> bytes:
    """Another size or kind in the header of a PNG, with a right checksum; of little data, the size makes it a bomb."""
    sizes = [(0, 0), (1, 1), (25, 33), (6_000, 6_000), (20_000, 20_000), (70_000, 70_000), (2**31 - 1, 1)]
    kind = bytearray(content[24:29])
    kind[draw(st.integers(0, 4))] = draw(st.sampled_from([2, 0, 1, 3, 4, 6, 8, 16, 255]))
    size = struct.pack(">II", *draw(st.sampled_from(sizes)))
    fields = draw(st.sampled_from([size + content[24:29], content[16:24] + bytes(kind)]))
    return content[:12] + b"IHDR" + fields + struct.pack(">I", zlib.crc32(b"IHDR" + fields)) + content[33:]


def _picture(content: bytes, draw: Draw) -> bytes:
    """Another size, number of channels, depth or format."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    colour = image if image.ndim == 3 else np.dstack([image] * 3)
    forms = [image[:-1], image[:1, :1], colour[..., 0], colour.astype(np.uint16) * 257, np.zeros_like(image)]
    form = draw(st.sampled_from([*forms, np.dstack([colour[..., :3], colour[..., :1]])]))
    return cv2.imencode(draw(st.sampled_from([".png", ".png", ".jpg", ".bmp", ".tiff"])), form)[1].tobytes()


def _header(content: bytes, draw: Draw) -> bytes:
    """Another header of a safetensors file over the same numbers."""
    end = 8 + struct.unpack("<Q", content[:8])[0]
    header = tree_of(".json", content[8:end], draw)
    claimed = draw(st.sampled_from([len(header), len(header), len(header), 1, 2**40, 2**63]))
    return struct.pack("<Q", claimed) + header + content[end:]


PICKLES = [
    b"\x80\x04(" + b"]" * 10**6 + b"t.",
    b"\x80\x04" + b"N0" * 10**6 + b"N.",
    b"\x80\x02]q\x00" + b"".join(b"(h%ch%ctq%c" % (n, n, n + 1) for n in range(40)) + b".",
    b"\x80\x04cos\nsystem\nU\x02lsq\x00\x85R.",
    b"\x80\x04cnumpy\nzeros\nJ\xff\xff\xff\x7f\x85R.",
    b"\x80\x04cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nJ\xff\xff\xff\x7f\x85U\x01b\x87R.",
    b"\x80\x04\x8e" + struct.pack("<Q", 2**40) + b"x.",
    b"\x80\x04I" + b"9" * 100_000 + b"\n.",
    b"c__builtin__\ngetattr\n.",
    b"\x80\x04\x95" + struct.pack("<Q", 2**60) + b".",
]
ODD: dict[str, list[Any]] = {
    ".json": [_json_twice, _number, b"[" * 100_000 + b"]" * 100_000, b'{"a":' * 10**5 + b"1" + b"}" * 10**5],
    ".yaml": [_yaml_value, _yaml_value, _number, _line, YAML_BOMB.encode()],
    ".npz": [_member, _npz_bomb],
    ".zip": [_member],
    ".pt": [_member],
    ".pth": [_member],
    ".png": [_png, _picture],
    ".jpg": [_picture],
    ".safetensors": [_header],
    ".pkl": PICKLES,
    ".ply": [_line],
    ".txt": [_line],
}

"""Damage to files, by what they hold: bytes for all of them, structure for those whose format is known.

A file of a known format is decoded into dictionaries, lists, arrays and scalars, one or more of these are changed,
and the result is encoded again, so that the damage lies behind the parser. Everything is drawn from one generator.
"""

from __future__ import annotations

import copy
import hashlib
import io
import json
import pickle
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from math import inf, nan
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
import yaml
from numpy.random import Generator
from safetensors.numpy import load, save

Change = Callable[[bytes, Generator], bytes]


def pick(rng: Generator, *choices: Any) -> Any:
    return choices[rng.integers(len(choices))]


WHOLE = (0, 1, -1, 2**31, 2**63, -(2**63), 2**64, 10**30)
REAL = (nan, inf, -inf, 0.5, -0.0, 1e38, 1e300, -1e300, 5e-324)
TEXTS = (
    "",
    " ",
    "0",
    "nan",
    "1e999",
    "a" * 100_000,
    "é\u0301\U0001f600",
    "\x00",
    "\ud800",
    ".",
    "a/b",
    "CON",
)
ODD_TEXTS = ("../../outside", "/dev/zero", "x\n\x1b[31my", "=1+1", "2026-01-01", "os:system")
TREES = ([], {}, [[]], [None], {"": None}, [0] * 1000, {"a": {"b": {"c": 1}}}, [[1, 2], [3]])
SCALARS: list[Any] = [None, True, False, *WHOLE, *REAL, *TEXTS, *ODD_TEXTS, *TREES]
NUMBERS = (nan, inf, -inf, 0, 1, -1, 255, 2**31 - 1, -(2**31), 2**40, 1e38, -1e38, 1e300, 1e-320)
DTYPES = ("f2", "f4", "f8", "i1", "i8", "u1", "?", "c8", "U4", "S3", "M8[s]", ">f4")


def mutate(path: Path, outside: Path, rng: Generator) -> str:
    """Damage a file in one of the ways that its suffix allows; return the way's name.

    ``outside`` is a folder that no reader may write to, links lead there.
    """
    changes: list[tuple[str, Any]] = [*BYTES, *(BY_SUFFIX.get(path.suffix, []) * 3)]
    names = [*changes, *([] if rng.random() < 0.8 else PLACES)]
    name, change = pick(rng, *names)
    if (name, change) in PLACES:
        change(path, outside, rng)
        return name
    content = path.read_bytes()
    try:
        with np.errstate(all="ignore"):
            changed = change(content, rng)
    except Exception:  # noqa: BLE001 - what a second change finds damaged, or what the format cannot hold
        name, changed = "flip", flip(content, rng)
    path.unlink()  # never through a link, and never into a file that is shared
    path.write_bytes(changed)
    return name


# Bytes.


def flip(content: bytes, rng: Generator) -> bytes:
    """Other bits in up to eight places, most of them near the start."""
    data = bytearray(content or b"\0")
    for _ in range(rng.integers(1, 9)):
        end = min(len(data), 512) if rng.random() < 0.5 else len(data)
        data[rng.integers(end)] ^= 1 << rng.integers(8)
    return bytes(data)


def truncate(content: bytes, rng: Generator) -> bytes:
    return content[: rng.integers(len(content) + 1)]


def empty(content: bytes, rng: Generator) -> bytes:
    return b""


def append(content: bytes, rng: Generator) -> bytes:
    return content + rng.bytes(rng.integers(1, 2000))


def overwrite(content: bytes, rng: Generator) -> bytes:
    """A block of zeros, of ones, or of noise."""
    start, length = rng.integers(len(content) + 1), int(rng.integers(1, 200))
    block = (b"\0" * length, b"\xff" * length, rng.bytes(length))[rng.integers(3)]
    return content[:start] + block + content[start + length :]


def repeat(content: bytes, rng: Generator) -> bytes:
    """A part of the file twice."""
    start, end = sorted(rng.integers(len(content) + 1, size=2))
    return content[:end] + content[start:]


def foreign(content: bytes, rng: Generator) -> bytes:
    """The start of a file of another kind."""
    starts = (b"PK\x03\x04", b"\x80\x04", b"\x89PNG\r\n\x1a\n", b"PAR1", b"\xff\xd8\xff", b"\xef\xbb\xbf")
    return pick(rng, *starts, b"{}", b"[]", b"null") + (content if rng.random() < 0.5 else b"")


def number(content: bytes, rng: Generator) -> bytes:
    """A number of 2, 4 or 8 bytes that is out of all bounds, as a count or a length may be."""
    code = ["<H", "<I", "<Q", ">H", ">I", ">Q", "<i", "<f", "<d"][rng.integers(9)]
    size = struct.calcsize(code)
    if code[1] in "fd":
        value: Any = (nan, inf, 1e38, -1.0)[rng.integers(4)]
    else:
        value = (2 ** (8 * size - 1) - 1, 2 ** (8 * size - 2), 1, 0)[rng.integers(4)]
    end = min(len(content), 256) if rng.random() < 0.5 else len(content)
    start = rng.integers(end) if end else 0
    return content[:start] + struct.pack(code, value) + content[start + size :]


BYTES = [(f.__name__, f) for f in (flip, truncate, empty, append, overwrite, repeat, foreign, number)]


# What stands where the file should be.


def removed(path: Path, outside: Path, rng: Generator) -> None:
    path.unlink()


def folder(path: Path, outside: Path, rng: Generator) -> None:
    path.unlink()
    path.mkdir()


def link_outside(path: Path, outside: Path, rng: Generator) -> None:
    """A link to a file outside that has the same content."""
    target = outside / f"target{path.suffix}"
    shutil.copyfile(path, target)
    path.unlink()
    path.symlink_to(target)


def link_nowhere(path: Path, outside: Path, rng: Generator) -> None:
    """A link to a file outside that is not there."""
    path.unlink()
    path.symlink_to(outside / "nothing")


def link_loop(path: Path, outside: Path, rng: Generator) -> None:
    path.unlink()
    path.symlink_to(path.name)


def folder_outside(path: Path, outside: Path, rng: Generator) -> None:
    """A link to a folder outside in place of the folder that holds the file; not of those that a command line names."""
    if outside.parent in (path.parents[1], path.parents[2]):
        return link_outside(path, outside, rng)
    target = outside / "folder"
    shutil.copytree(path.parent, target, symlinks=True)
    shutil.rmtree(path.parent)
    path.parent.symlink_to(target)


PLACES = [(f.__name__, f) for f in (removed, folder, link_outside, link_nowhere, link_loop, folder_outside)]


# Trees of dictionaries, lists, arrays and scalars.


def nodes(tree: Any, depth: int = 0) -> list[tuple[Any, Any]]:
    """Each (container, key) of a tree."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    found = []
    for key, value in items:
        found.append((tree, key))
        if depth < 20:
            found += nodes(value, depth + 1)
    return found


def scalar(rng: Generator) -> Any:
    """A value that does not belong where it is put."""
    return copy.deepcopy(pick(rng, *SCALARS))


def change_tree(tree: Any, rng: Generator) -> Any:
    """Change one node: remove, rename, repeat, replace it, or change its value."""
    places = nodes(tree)
    if not places or rng.random() < 0.03:
        return scalar(rng)
    container, key = pick(rng, *places)
    kind = rng.integers(10)
    if kind == 0:
        del container[key]
    elif kind == 1 and isinstance(container, dict):
        container[(f"{key}x", "", "__class__", "é", str(key).upper())[rng.integers(5)]] = container.pop(key)
    elif kind == 1:
        container.insert(key, container[key])
    elif kind == 2:
        other, name = pick(rng, *places)
        container[key] = copy.deepcopy(other[name])
    elif kind <= 4:
        container[key] = scalar(rng)
    else:
        container[key] = change_value(container[key], rng)
    return tree


def change_value(value: Any, rng: Generator) -> Any:
    """Another value of the same kind, or nearly."""
    if isinstance(value, np.ndarray):
        return change_array(value, rng)
    if isinstance(value, bool) or value is None:
        return (0, 1, "true", "null")[rng.integers(4)]
    if isinstance(value, (int, float)):
        near = (-value, value * 1e9, value + 1, value - 1, float(value), str(value), [value])
        return pick(rng, *near, *NUMBERS, 2**70)
    if isinstance(value, str):
        longer = (f"{value} ", value * 50, f"../{value}", f"/{value}", f"{value}\0")
        return pick(rng, *longer, value[: len(value) // 2], 7, [value])
    if isinstance(value, list):
        table = dict(enumerate(map(str, value)))
        return pick(rng, value[:-1], value * 2, [value], value[::-1], table, value[:1] * 5)
    return scalar(rng)


def change_array(array: np.ndarray, rng: Generator) -> np.ndarray:
    """Other numbers, another type, or another shape."""
    array = np.array(array)
    kind = rng.integers(8)
    if kind <= 2 and array.size:
        flat = array.reshape(-1)
        count = 1 if rng.random() < 0.6 else flat.size
        flat[rng.integers(flat.size, size=count)] = np.asarray(pick(rng, *NUMBERS)).astype(array.dtype)
        return array
    if kind == 3:
        return array.astype(pick(rng, *DTYPES))
    if kind == 4:
        flat = array.reshape(-1)
        return pick(rng, flat, array[None], array[..., None], array.T, flat[:1].reshape(()))
    if kind == 5 and array.ndim:
        axis = rng.integers(array.ndim)
        return np.concatenate([array, array], axis) if rng.random() < 0.5 else np.delete(array, 0, axis)
    if kind == 6:
        return np.empty((0, *array.shape[1:]), array.dtype)
    if kind == 7:
        return np.zeros(array.shape, array.dtype)
    return array.astype(object)


def tree_change(decode: Callable[[bytes], Any], encode: Callable[[Any], bytes]) -> Change:
    """A change of what a file holds."""

    def change(content: bytes, rng: Generator) -> bytes:
        return encode(change_tree(decode(content), rng))

    return change


# Formats: how they become trees and files again, and damage that only they can have.


def json_twice(content: bytes, rng: Generator) -> bytes:
    """A key twice in one object."""
    text = content.decode()
    colons = [i for i, c in enumerate(text) if c == "{"]
    start = pick(rng, *colons) + 1
    key = text[start:].split('"')[1]
    value = json.dumps(pick(rng, *SCALARS))
    return f'{text[:start]}"{key}": {value}, {text[start:]}'.encode("utf-8", "surrogatepass")


def json_deep(content: bytes, rng: Generator) -> bytes:
    count = int(rng.integers(10, 200_000))
    return (b"[" * count + b"]" * count, b'{"a":' * count + b"1" + b"}" * count)[rng.integers(2)]


def json_number(content: bytes, rng: Generator) -> bytes:
    """A number that is long, or none, in place of one."""
    text = content.decode()
    digits = [i for i, c in enumerate(text) if c.isdigit()]
    start = pick(rng, *digits)
    words = ("9" * 5000, "1e400", "NaN", "-Infinity", "0x1", "01", "-", "1" + "0" * 100_000, "null", '"1"')
    return (text[:start] + pick(rng, *words) + text[start + 1 :]).encode()


def dump_json(tree: Any) -> bytes:
    return json.dumps(tree, default=repr).encode("utf-8", "surrogatepass")


YAML_TAGS = ("bool x", "timestamp x", "int x", "float x", "binary '='", "set {a, b}", "omap [a: 1]")
YAML_CALLS = ("!!python/object/apply:os.system [ls]", "!!python/name:os.system", "!unknown x")
YAML_PLAIN = ("2026-01-01", "1:30:00", "0o7", "~", "yes", ".nan", "-.inf", "|\n  block", "@", "\t", "'", '"')
YAML_ODD = ("&a [*a]", "*nothing", "'\0'", "---\na: 1", "%YAML 9.9", '"\\ud800"')
YAML_MAPS = ("&x {<<: *x}", "{<<: 1}", "{[1]: 2}", "{? {a: 1} : 2}", *YAML_ODD)
YAML_LONG = ("[" * 3000 + "]" * 3000, "{a: " * 1000 + "1" + "}" * 1000, "1" * 5000, "'" + "é" * 50_000 + "'")
YAML_VALUES = (*(f"!!{tag}" for tag in YAML_TAGS), *YAML_CALLS, *YAML_PLAIN, *YAML_MAPS, *YAML_LONG)


def yaml_odd(content: bytes, rng: Generator) -> bytes:
    """What YAML knows beside plain values."""
    text = content.decode()
    value = pick(rng, *YAML_VALUES)
    colons = [i for i, c in enumerate(text) if c == ":"]
    if not colons or rng.random() < 0.2:
        return value.encode("utf-8", "surrogatepass")
    start = pick(rng, *colons) + 1
    end = text.find("\n", start)
    return f"{text[:start]} {value}{text[end:]}".encode("utf-8", "surrogatepass")


def yaml_bomb(content: bytes, rng: Generator) -> bytes:
    """Aliases of aliases: 10 to the power of the levels."""
    levels = range(1, int(rng.integers(3, 9)))
    lines = [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in levels]
    key = ("data", "methods", "settings", "901")[rng.integers(4)]
    return "\n".join(["a0: &a0 lol", *lines, f"{key}: *a{levels[-1]}"]).encode()


def read_npz(content: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def write_npz(arrays: dict[str, Any]) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def write_npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npy_header(dtype: str, count: int) -> bytes:
    """The first 128 bytes of an npy of so many numbers."""
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({count},), }}"
    return b"\x93NUMPY\x01\x00\x76\x00" + text.encode().ljust(117) + b"\n"


def npy(content: bytes, rng: Generator) -> bytes:
    return write_npy(change_array(np.load(io.BytesIO(content)), rng))


def zip_members(content: bytes, rng: Generator) -> bytes:
    """An archive with a member damaged, replaced, doubled, or one more."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    index = rng.integers(len(members))
    name, data = members[index]
    names = ("../../outside/evil.npy", "/evil.npy", "a/b.npy", "file.npy", f"{name}.txt", "x" * 300, "")
    damaged = (flip(data, rng), truncate(data, rng), number(data, rng))
    other = pick(rng, *damaged, b"", b"text", pickle.dumps([1]), npy_header("<f8", 9_999_999_999))
    changed = (pick(rng, *names) if rng.random() < 0.4 else name, other)
    members[index : index + int(rng.random() < 0.7)] = [changed]
    stream = io.BytesIO()
    packing = pick(rng, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA)
    with zipfile.ZipFile(stream, "w", packing) as archive:
        for member in members:
            archive.writestr(*member)
    return stream.getvalue()


def bundle_member(content: bytes, rng: Generator) -> bytes:
    """A bundle with a damaged member whose digest is listed as it is now, as somebody would who forges a result."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    name = pick(rng, "run.json", "rows.parquet", *members)
    changes = [*BYTES, *(BY_SUFFIX.get(Path(name).suffix, []) * 3)]
    members[name] = changes[rng.integers(len(changes))][1](members[name], rng)
    if name != "bundle.json":
        index = json.loads(members["bundle.json"])
        index["files"][name] = hashlib.sha256(members[name]).hexdigest()
        members["bundle.json"] = json.dumps(index).encode()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for member in members.items():
            archive.writestr(*member)
    return stream.getvalue()


def npz_bomb(content: bytes, rng: Generator) -> bytes:
    """A member of 10^8 to 4 * 10^9 zeros."""
    arrays = read_npz(content)
    name = sorted(arrays)[rng.integers(len(arrays))]
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for other, array in arrays.items():
            if other != name:
                archive.writestr(f"{other}.npy", write_npy(array))
        count = int(10 ** rng.uniform(7, 8.5))
        with archive.open(f"{name}.npy", "w") as member:
            member.write(npy_header("|u1", count))
            for _ in range(count // 10**6):
                member.write(bytes(10**6))
    return stream.getvalue()


def png_header(content: bytes, fields: bytes) -> bytes:
    """A PNG with other fields in its header, with a right checksum."""
    header = b"IHDR" + fields
    return content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:]


def png_size(content: bytes, rng: Generator) -> bytes:
    """Another width and height."""
    large = ((20_000, 20_000), (70_000, 70_000), (2**31 - 1, 1), (2**31, 2**31))
    size = pick(rng, (0, 0), (1, 1), (25, 33), (32, 24), *large)
    return png_header(content, struct.pack(">II", *size) + content[24:29])


def png_kind(content: bytes, rng: Generator) -> bytes:
    """Another depth, colour type, compression or interlacing."""
    fields = bytearray(content[24:29])
    fields[rng.integers(5)] = pick(rng, 0, 1, 2, 3, 4, 6, 8, 16, 255)
    return png_header(content, content[16:24] + bytes(fields))


def png_bomb(content: bytes, rng: Generator) -> bytes:
    """A large black image in a megabyte."""
    side = (6_000, 20_000)[rng.integers(2)]
    rows = side // 100
    squeeze = zlib.compressobj(9, wbits=-15)
    # Blocks of equal zeros are equal, so that one is squeezed and repeated.
    block = squeeze.compress(bytes(100 * (1 + 3 * side))) + squeeze.flush(zlib.Z_FULL_FLUSH)
    checksum = (rows * 100 * (1 + 3 * side)) % 65521 << 16 | 1
    data = b"\x78\x9c" + block * rows + b"\x03\x00" + struct.pack(">I", checksum)
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)), (b"IDAT", data), (b"IEND", b""))
    body = b"".join(
        struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body


def image_other(content: bytes, rng: Generator) -> bytes:
    """Another size, number of channels, depth or format."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    colour = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    form = pick(
        rng,
        *(image[:-1], image[:, :-1], np.concatenate([image, image]), image[:1, :1], np.zeros_like(image)),
        *(colour[..., 0], colour[..., :3], colour.astype(np.uint16) * 257),
        cv2.resize(image, None, fx=2, fy=2),
        np.dstack([colour[..., :3], np.zeros(image.shape[:2], np.uint8)]),
    )
    suffix = pick(rng, ".png", ".png", ".png", ".jpg", ".bmp", ".tiff", ".webp")
    return cv2.imencode(suffix, form)[1].tobytes()


def read_parquet(content: bytes) -> dict[str, list]:
    return pq.read_table(io.BytesIO(content)).to_pydict()


def write_parquet(tree: dict[str, list]) -> bytes:
    stream = io.BytesIO()
    pq.write_table(pa.table(tree), stream)
    return stream.getvalue()


def parquet_column(content: bytes, rng: Generator) -> bytes:
    """A column of another type, with nothing in it, twice, or none."""
    table = pq.read_table(io.BytesIO(content))
    index = int(rng.integers(table.num_columns))
    name, rows = table.column_names[index], table.num_rows
    values = (None, [1.0], "x", b"\xff", {"a": 1}, nan, inf, True, 2**62, -1, "", "a" * 10_000, "../x")
    types = (pa.float16(), pa.int8(), pa.timestamp("s"), pa.decimal128(10, 2), pa.string(), pa.binary())
    kind = rng.integers(6)
    if kind == 0:
        table = table.remove_column(index)
    elif kind == 1:
        table = table.append_column(name, table.column(index))
    elif kind == 2:
        other = pick(rng, *types, pa.dictionary(pa.int32(), pa.string()))
        table = table.set_column(index, name, table.column(index).cast(other, safe=False))
    elif kind == 3:
        table = table.slice(0, int(rng.integers(0, 2)))
    else:
        table = table.set_column(index, name, pa.array([pick(rng, *values)] * rows))
    stream = io.BytesIO()
    pq.write_table(table, stream)
    return stream.getvalue()


def safetensors_header(content: bytes, rng: Generator) -> bytes:
    """Another header over the same numbers."""
    length = struct.unpack("<Q", content[:8])[0]
    tree = change_tree(json.loads(content[8 : 8 + length]), rng)
    if isinstance(tree, dict) and rng.random() < 0.3:
        tree[f"t{rng.integers(9)}"] = {"dtype": "F32", "shape": [2**40, 2**20], "data_offsets": [0, 4]}
    header = dump_json(tree)
    claimed = len(header) if rng.random() < 0.9 else int(2 ** rng.integers(1, 63))
    return struct.pack("<Q", claimed) + header + content[8 + length :]


def safetensors_values(content: bytes, rng: Generator) -> bytes:
    """Other tensors under the same metadata."""
    arrays: Any = change_tree(load(content), rng)
    length = struct.unpack("<Q", content[:8])[0]
    metadata = json.loads(content[8 : 8 + length]).get("__metadata__")
    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()}, metadata)


def torch_tree(content: bytes, rng: Generator) -> bytes:
    """Other tensors and values in a file of torch."""

    def converted(value: Any, kind: type, convert: Callable) -> Any:
        if isinstance(value, kind):
            return convert(value)
        if isinstance(value, dict):
            return {key: converted(item, kind, convert) for key, item in value.items()}
        return [converted(item, kind, convert) for item in value] if isinstance(value, list) else value

    tree = {"top": torch.load(io.BytesIO(content), weights_only=True)}
    changed = change_tree(converted(tree, torch.Tensor, torch.Tensor.numpy), rng)
    stream = io.BytesIO()
    top = changed.get("top") if isinstance(changed, dict) else changed
    torch.save(converted(top, np.ndarray, lambda a: torch.from_numpy(np.ascontiguousarray(a))), stream)
    return stream.getvalue()


def pickle_tree(content: bytes, rng: Generator) -> bytes:
    """Other arrays and values in a pickle that the samples hold; legacy ones end as damage to bytes."""
    return pickle.dumps(change_tree(dict(pickle.loads(content)), rng), protocol=int(rng.integers(0, 6)))


def pickle_bomb(content: bytes, rng: Generator) -> bytes:
    """Few bytes that become many objects, or that call something."""
    count = int(10 ** rng.uniform(2, 6.5))
    doubled = b"\x80\x02]q\x00" + b"".join(b"(h%ch%ctq%c" % (n, n, n + 1) for n in range(40)) + b"."
    streams = (
        b"\x80\x04(" + b"]" * count + b"t.",
        b"\x80\x04" + b"]" * count + b"a" * (count - 1) + b".",
        b"\x80\x04" + b"N0" * count + b"N.",
        b"\x80\x04}" + b"".join(b"J%sN" % struct.pack("<i", n) for n in range(count // 10)) + b".",
        doubled,
        b"\x80\x04cos\nsystem\nU\x02lsq\x00\x85R.",
        b"\x80\x04cnumpy\nzeros\nJ\xff\xff\xff\x7f\x85R.",
        b"\x80\x04cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nJ\xff\xff\xff\x7f\x85U\x01b\x87R.",
        b"\x80\x04\x8e" + struct.pack("<Q", 2**40) + b"x.",
        b"\x80\x04I" + b"9" * min(count, 100_000) + b"\n.",
        b"c__builtin__\ngetattr\n.",
        b"\x80\x04" + b"(" * count + b".",
        b"\x80\x04\x95" + struct.pack("<Q", 2**60) + b".",
    )
    return pick(rng, *streams)


def text_line(content: bytes, rng: Generator) -> bytes:
    """A line removed, doubled or moved, or a word of it replaced."""
    lines = content.split(b"\n")
    index = int(rng.integers(min(len(lines), 40)))
    words = lines[index].split(b" ")
    numbers = (b"-1", b"nan", b"1e999", b"99999999999999999999", b"0", b"1 1")
    kind = rng.integers(5)
    if kind == 0:
        del lines[index]
    elif kind == 1:
        lines.insert(index, lines[index])
    else:
        words[rng.integers(len(words))] = pick(rng, *numbers, b"", b"../x", b"\xff", b"x" * 1000, b"#")
        lines[index] = b" ".join(words)
    return b"\n".join(lines)


def ply_values(content: bytes, rng: Generator) -> bytes:
    """Other numbers behind the header."""
    start = content.index(b"end_header\n") + 11
    values = np.frombuffer(content[start : start + (len(content) - start) // 4 * 4], "<f4").copy()
    values[rng.integers(values.size, size=int(rng.integers(1, 50)))] = pick(rng, *NUMBERS)
    return content[:start] + values.tobytes()


def boxes(content: bytes, rng: Generator) -> bytes:
    """A length in the structure of an MP4 that is not right."""
    kinds = (b"moov", b"trak", b"mdia", b"stbl", b"stsz", b"stco", b"stsc", b"mdat", b"stts")
    found = [place for kind in kinds if (place := content.find(kind)) > 0]
    start = pick(rng, *found) + pick(rng, -4, 4, 8, 12)
    length = struct.pack(">I", pick(rng, 0, 1, 2**31, 2**32 - 1, 7))
    return content[:start] + length + content[start + 4 :]


def dump_yaml(tree: Any) -> bytes:
    return yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "surrogatepass")


JSON, NPZ = tree_change(json.loads, dump_json), tree_change(read_npz, write_npz)
YAML, ROWS = tree_change(yaml.safe_load, dump_yaml), tree_change(read_parquet, write_parquet)
BY_SUFFIX: dict[str, list[tuple[str, Change]]] = {
    ".json": [*[("tree", JSON)] * 7, ("twice", json_twice), ("deep", json_deep), ("number", json_number)],
    ".yaml": [*[("tree", YAML)] * 4, *[("odd", yaml_odd)] * 2, ("bomb", yaml_bomb), ("line", text_line)],
    ".npz": [*[("tree", NPZ)] * 7, *[("member", zip_members)] * 2, ("bomb", npz_bomb)],
    ".npy": [("array", npy)],
    ".zip": [*[("member", bundle_member)] * 4, ("archive", zip_members)],
    ".png": [("size", png_size), ("kind", png_kind), ("bomb", png_bomb), *[("other", image_other)] * 2],
    ".jpg": [("other", image_other)],
    ".parquet": [("tree", ROWS), ("column", parquet_column)],
    ".safetensors": [("header", safetensors_header), ("values", safetensors_values)],
    ".pkl": [("tree", pickle_tree), ("bomb", pickle_bomb)],
    ".pt": [("tree", torch_tree), ("member", zip_members)],
    ".pth": [("tree", torch_tree), ("member", zip_members)],
    ".ply": [("line", text_line), ("values", ply_values)],
    ".txt": [("line", text_line)],
    ".mp4": [("boxes", boxes)],
}

"""A compact avatar: subject and field in one small file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from ....bench.contracts import FloatArray, HeadAsset
from ....bench.errors import InputError
from ...ours.field import PLANES, CanonicalFrames
from ...ours.storage import PER_SPLAT, RESIDUAL, SPLAT_WIDTHS, StoredField, checked_field
from ...shared.avatar_files import Subject
from ...shared.subject_mesh import SubjectMesh
from .container import Arrays, Content, coded, packed_sizes, read_content
from .encoding import (
    HARMONICS,
    MATRICES,
    decode_field,
    decode_splats,
    encode_field,
    encode_splats,
)
from .precision import Precision

PARTS: Mapping[str, tuple[str, ...]] = {
    "positions": ("positions",),
    "scales": ("log_scales",),
    "rotations": ("rotations",),
    "opacities": ("logits",),
    "triangles": ("triangles",),
    "classes": ("classes",),
    "harmonics": (*HARMONICS, "colours"),
    "colors": (RESIDUAL,),
    "planes": PLANES,
    "lines": ("lines",),
    "differences": ("difference", "moved_by", "shapes", "exact_shapes"),
    "tables": ("features", "grid/"),
    "networks": (*MATRICES, "network_", "line_gain", "line_bias", "matrix/"),
    "subject": ("shape", "static_offset"),
}
"""Parts of an avatar by the prefixes of their array names; all other arrays are "other"."""


def encode(
    field: StoredField,
    subject: Subject,
    head: HeadAsset,
    precision: Precision,
    weights: FloatArray | None = None,
) -> Content:
    """Content of the coded file of an avatar whose splats are sorted by triangle (`simplify`).

    ``weights`` is the (N,) `importance` of the splats; None: all are equally visible.
    """
    precision = precision.scaled
    tensors = {name: value.cpu() for name, value in field.tensors.items()}
    splats, steps = encode_splats(tensors, precision, "rotation" in field.dynamic, weights)
    person = encode_subject(subject, precision)
    steps |= person.steps
    text = {**person.text, "dynamic": ",".join(field.dynamic)}
    # Decoded positions decide which samples of the planes are needed.
    read = Arrays(Path(), Content({**splats, **person.arrays}, text, steps))
    table = decode_splats(read)["splats"]
    stored = decode_subject(read, head)
    mesh = SubjectMesh(head, stored.shape, stored.static_offset, "cpu")
    frames = CanonicalFrames.of(mesh.frames(mesh.canonical))
    positions = frames.positions(table[:, -1].to(torch.int64), table[:, : SPLAT_WIDTHS["means"]])
    shared = encode_field(tensors, positions, precision, weights)
    steps |= {"planes": precision.planes, "lines": precision.lines}
    coded_names = {*PER_SPLAT, *PLANES, "lines", *MATRICES}
    other = {name: value.numpy() for name, value in tensors.items() if name not in coded_names}
    return Content({**splats, **shared, **person.arrays, **other}, text, steps)


def decode(path: Path, content: Content, head: HeadAsset, device: str) -> tuple[Subject, StoredField]:
    """Subject and field of the content of a compact file. Raises `InputError`, naming ``path``, for invalid content."""
    arrays = Arrays(path, content)
    subject = decode_subject(arrays, head)
    tensors = {**decode_splats(arrays), **decode_field(arrays)}
    for name, values in arrays.rest().items():
        tensors[name] = torch.from_numpy(np.array(values))
    names = content.text.get("dynamic", "")
    field = checked_field(path, tensors, names, head)
    return subject, field._replace(tensors={name: value.to(device) for name, value in tensors.items()})


def read_compact(path: Path, head: HeadAsset, device: str) -> tuple[Subject, StoredField]:
    """Read what `write_compact` wrote. Raises `InputError` for anything else, before it takes more memory."""
    return decode(path, read_content(path), head, device)


def part_sizes(content: Content) -> dict[str, int]:
    """Packed bytes by part, without the header of a few kB."""
    return _by_part(packed_sizes(content.arrays))


def _by_part(sizes: Mapping[str, int]) -> dict[str, int]:
    result = dict.fromkeys([*PARTS, "other"], 0)
    for name, size in sizes.items():
        part = next((part for part, starts in PARTS.items() if name.startswith(starts)), "other")
        result[part] += size
    return {part: size for part, size in result.items() if size}


def encode_subject(subject: Subject, precision: Precision) -> Content:
    """Arrays of the subject in a compact file."""
    arrays = {
        "shape": subject.shape.astype(np.float32),
        "static_offset": coded(subject.static_offset.T, precision.subject),
    }
    text = {"name": subject.name, "head_model": subject.head_model}
    return Content(arrays, text, {"subject": precision.subject})


def decode_subject(arrays: Arrays, head: HeadAsset) -> Subject:
    """Subject of a compact file. Raises `InputError` if it does not fit the head model."""
    for key in ("name", "head_model"):
        if key not in arrays.text:
            raise InputError(arrays.path, f"text, {key}", "a string", "none")
    name, version = arrays.text["name"], arrays.text["head_model"]
    if version != head.version:
        raise InputError(arrays.path, "head_model", repr(head.version), repr(version)[:80])
    shape = arrays.floats("shape", head.shape_basis.shape[2])
    offset = arrays.decoded("static_offset", arrays.step("subject"), 3, len(head.template))
    return Subject(name, version, shape, np.ascontiguousarray(offset.T))

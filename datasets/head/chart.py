"""Texture coordinates of a head model's triangles, from an OBJ file of its mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...bench.contracts import FloatArray, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, check_numbers
from ...bench.io.documents import read_text
from ...bench.io.files import reading

CHART_FILES = ("head_template_mesh.obj", "head_template.obj")
"""FLAME's mesh with texture coordinates, as VHAP and GaussianAvatars, and DECA, name it."""


def read_chart(path: Path, faces: IntArray) -> FloatArray:
    """Texture coordinates of the corners of triangles, (F, 3, 2) float32.

    The OBJ file may order the triangles differently, begin each at another corner, and contain additional ones.

    Parameters
    ----------
    faces : IntArray
        (F, 3) triangles of the head model.

    Raises
    ------
    InputError
        The file is missing or damaged, lacks texture coordinates or a triangle of the head model, or has non-finite
        coordinates or faces other than triangles.
    """
    text = read_text(path, "mesh")
    with reading(path, "an OBJ mesh of triangles with texture coordinates"):
        rows = [row for row in map(str.split, text.splitlines()) if row[:1] in (["vt"], ["f"])]
        coordinates = np.array([row[1:3] for row in rows if row[0] == "vt"], np.float64)
        corners = [[corner.split("/")[:2] for corner in row[1:]] for row in rows if row[0] == "f"]
        indices = np.array(corners, np.int64) - 1
        if indices.shape[1:] != (3, 2) or indices.min() < 0:
            raise ValueError("no triangles, or indices below 1")
        check_numbers(path, "vt", coordinates, MAX_MAGNITUDE)
        given, uv = indices[:, :, 0], coordinates[indices[:, :, 1]]
    order, wanted = np.argsort(given, axis=1), np.argsort(faces, axis=1)
    known, known_order = np.unique(np.take_along_axis(given, order, 1), axis=0, return_index=True)
    places = {tuple(corners): row for corners, row in zip(known.tolist(), known_order.tolist())}
    found = [places.get(tuple(corners), -1) for corners in np.take_along_axis(faces, wanted, 1).tolist()]
    if -1 in found:
        expected = "the triangles of the head model"
        raise InputError(path, "f", expected, f"{found.count(-1)} of {len(faces)} that are not there")
    result = np.empty((len(faces), 3, 2), np.float32)
    by_vertex = np.take_along_axis(uv[found], order[found][:, :, None], 1)
    np.put_along_axis(result, wanted[:, :, None], by_vertex, 1)
    return result

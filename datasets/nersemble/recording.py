"""Find participants, sequences, calibrations and stills in any of NeRSemble's raw layouts.

=============================  =================================  ======================================
second release                 first release, parts merged        the ten sequences of the 2023 paper
=============================  =================================  ======================================
``ID/calibration/camera_...``  ``camera_params/ID/camera_...``    ``ID/camera_params.json``
``ID/calibration/color_...``   ``color_correction/ID/SER.npy``    ``ID/annotations/SEQ/color_correction``
``ID/sequences/SEQ/images/``   ``ID/SEQ/``                        ``ID/sequences/SEQ/frame_%05d/``
=============================  =================================  ======================================

The benchmark toolkit's folders read as the second release. Parts of the first release that were not merged
(``sequence_SEQ_part-N/ID/SEQ``) are found too. Nothing is decoded here; `sequence` inspects the videos.

``camera_params.json`` holds world-to-camera matrices with OpenCV axes in metres, and one intrinsic matrix for all
cameras (raw recordings) or one per camera (the benchmark's cropped videos); no lens distortion.

Convert a raw frame to the image of a capture: smaller, colour-calibrated, on white if there is a mask. Two forms of
colour calibration exist. Version 1 is an affine map on the stored values, ``SER.npy``. Version 2 is a polynomial on
linear values, ``color_calibration.json``. Images are 8-bit sRGB before and after. VHAP's reader computes the version 2
correction and then returns the uncorrected image, so exports made with it carry raw colours.

Formats read:

- NeRSemble's `camera_params.json`. Written by the authors of tobias-kirschstein/nersemble-data@14e967e3 and
  tobias-kirschstein/nersemble-benchmark@e15f204d, whose readers it follows. Not checked on a file of the program.
- NeRSemble's `metadata_sequences.csv`. Written by the authors of tobias-kirschstein/nersemble-data@14e967e3. Not checked on a file of the program.
- NeRSemble's colour calibration, version 1 and 2. Written by the authors of tobias-kirschstein/nersemble-data@14e967e3,
  whose `src/nersemble_data/util/color_correction.py` it follows. Not checked on a file of the program.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...bench.contracts import ByteArray, Camera, FloatArray
from ...bench.errors import InputError
from ...bench.io.arrays import check_numbers, read_npy
from ...bench.io.documents import read_json, read_text
from ...bench.io.files import check_name, entries, reading
from ...bench.io.images import read_bgr
from ..ga.transforms import MAX_INTEGER, found_entry, read_matrix, read_rigid
from ..images import srgb_to_linear
from .names import BACKGROUND, FULL_SIZE, is_subject, match_sequence, serial_of

Correction = Callable[[ByteArray], ByteArray]
"""From (H, W, 3) 8-bit RGB to the same."""

_LARGEST = 1e6  # of a coefficient; genuine ones are below 100
_CHANNELS = "rgb"
_PAIRS, _SQUARES, _CUBES = ("rg", "rb", "gb"), ("rr", "gg", "bb"), ("rrr", "ggg", "bbb")
_CYCLE, _COUNTERCYCLE = ("rrg", "ggb", "bbr"), ("rrb", "ggr", "bbg")
_QUARTIC_MIXED = ("rrgb", "rggb", "rgbb")
_SECOND = (*_PAIRS, *_SQUARES, "rgb")
_THIRD = (*_SECOND, *_CYCLE, *_COUNTERCYCLE, *_CUBES)
_FOURTH = (
    *("rrrg", "rrrb", "gggr", "gggb", "bbbr", "bbbg"),
    *_QUARTIC_MIXED,
    *("rrgg", "rrbb", "ggbb"),
    *("rrrr", "gggg", "bbbb"),
)
_BEYOND_LINEAR: dict[int, tuple[str, ...]] = {
    3: (),
    4: ("",),
    5: ("rgb", ""),
    7: (*_PAIRS, ""),
    8: (*_PAIRS, "rgb", ""),
    10: (*_PAIRS, *_SQUARES, ""),
    11: (*_SECOND, ""),
    14: (*_SECOND, *_CUBES, ""),
    16: (*_SECOND, *_CYCLE, *_CUBES),
    17: (*_SECOND, *_CYCLE, *_CUBES, ""),
    19: _THIRD,
    20: (*_THIRD, ""),
    22: (*_THIRD, *_QUARTIC_MIXED),
    35: (*_THIRD, *_FOURTH, ""),
}

POLYNOMIALS = {count: (*_CHANNELS, *beyond) for count, beyond in _BEYOND_LINEAR.items()}
"""Terms by their count, each a product of channels ("rrg" is R R G, "" the constant 1): the augmented
matrices of Cheung, Westland, Connah, Ripamonti (2004), in colour-science's order."""


def linear_to_srgb(values: FloatArray) -> FloatArray:
    """Encode linear values to sRGB, clipped to [0, 1]; float32, (H, W, C)."""
    clipped = np.clip(values, 0, 1).astype(np.float32)
    curved = 1.055 * cv2.pow(clipped, 1 / 2.4).reshape(clipped.shape) - 0.055
    return np.where(clipped <= 0.0031308, 12.92 * clipped, curved)


_LINEAR = srgb_to_linear(np.arange(256) / 255).astype(np.float32)
_LINEAR.flags.writeable = False

_STEPS = 2**16 - 1
"""Steps of linear values in `_ENCODED`. A level spans at least 20 steps, so results are within 0.53 levels of the
exact ones instead of 0.5."""

_ENCODED = (
    np.rint(255 * linear_to_srgb((np.arange(_STEPS + 1) / _STEPS).reshape(1, -1, 1))).astype(np.uint8).ravel()
)
_ENCODED.flags.writeable = False


@dataclass(frozen=True, eq=False)
class AffineCorrection:
    """Version 1: ``out = rgb @ matrix[:, :3] + matrix[:, 3]`` on stored values in [0, 1], clipped. ``rgb`` is a row on
    the left, so the linear part is the transpose of the usual form."""

    matrix: FloatArray  # (3, 4)

    def __call__(self, image: ByteArray) -> ByteArray:
        if self.is_identity:
            return image
        usual = np.hstack([self.matrix[:, :3].T, 255 * self.matrix[:, 3:]])
        return _to_bytes(cv2.transform(image.astype(np.float32), usual))

    @property
    def is_identity(self) -> bool:
        """Whether images come back as they are."""
        return np.array_equal(self.matrix, np.eye(3, 4))


@dataclass(frozen=True, eq=False)
class PolynomialCorrection:
    """Version 2: decode sRGB, ``matrix @ terms``, encode sRGB, clip; terms as in `POLYNOMIALS`."""

    matrix: FloatArray  # (3, N)

    def __call__(self, image: ByteArray) -> ByteArray:
        if self.is_identity:
            return image
        linear = _LINEAR[image]
        height, width, _ = image.shape
        terms = self._expand(linear).reshape(-1, height * width)
        planes = self.matrix.astype(np.float32) @ terms
        steps = np.clip(planes * _STEPS + 0.5, 0, _STEPS).astype(np.uint16)
        return cv2.merge([*_ENCODED[steps].reshape(3, height, width)]).astype(np.uint8, copy=False)

    @property
    def is_identity(self) -> bool:
        """Whether images come back as they are."""
        return np.array_equal(self.matrix, np.eye(*self.matrix.shape))

    @cached_property
    def _terms(self) -> tuple[str, ...]:
        return POLYNOMIALS[self.matrix.shape[1]]

    def _expand(self, linear: FloatArray) -> FloatArray:
        """(N, H, W) terms of an (H, W, 3) image."""
        planes = dict(zip(_CHANNELS, np.moveaxis(linear, 2, 0)))
        terms = np.empty((len(self._terms), *linear.shape[:2]), dtype=np.float32)
        for target, term in zip(terms, self._terms):
            target[...] = reduce(np.multiply, (planes[c] for c in term), np.float32(1))
        return terms


def _to_bytes(levels: NDArray[Any]) -> ByteArray:
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def affine_correction(path: Path) -> AffineCorrection:
    """Read version 1, ``SER.npy``."""
    matrix = read_npy(path)
    if matrix.dtype.kind not in "fiu" or matrix.shape not in ((3, 4), (4, 4)):
        found = f"{matrix.dtype} {matrix.shape}"
        raise InputError(path, "", "an affine matrix of numbers, (4, 4) or (3, 4)", found)
    check_numbers(path, "", matrix, _LARGEST)
    return AffineCorrection(matrix[:3].astype(np.float64))


def polynomial_correction(path: Path, serial: str, value: Any) -> PolynomialCorrection:
    """Check one entry of version 2's JSON: a 3 x N matrix with N out of `POLYNOMIALS`."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.ndim != 2 or matrix.shape[0] != 3 or matrix.shape[1] not in POLYNOMIALS:
        counts = ", ".join(map(str, POLYNOMIALS))
        found = f"shape {matrix.shape}" if matrix.size else repr(value)[:60]
        raise InputError(path, serial, f"a 3 x N matrix of numbers, N out of {counts}", found)
    check_numbers(path, serial, matrix, _LARGEST)
    return PolynomialCorrection(matrix)


def prepare_pixels(
    bgr: ByteArray,
    mask: ByteArray | None,
    size: tuple[int, int],
    correct: Correction | None = None,
    still: ByteArray | None = None,
) -> tuple[ByteArray, ByteArray | None]:
    """Shrink a frame by averaging areas, correct its colours, put it on white.

    With a mask a, only the contribution of the foreground is averaged and corrected. With the still B of the empty
    set, it is I - (1 - a) B, within [0, a], which removes the background from soft edges. Without it, it is a I, as in
    VHAP, and edges keep a fraction a (1 - a) of the background. Colours are corrected at the small size, as VHAP does.

    ``bgr``: (H, W, 3) in OpenCV's channel order. ``mask``: (H, W) foreground coverage; with None the image keeps its
    background. ``size``: (width, height) of the result, at most the frame's. ``still``: (H, W, 3) image of the empty set
    from the same camera, in OpenCV's channel order.

    Returns
    -------
    tuple[ByteArray, ByteArray | None]
        (h, w, 3) RGB and the (h, w) mask, or None without a mask.
    """
    if mask is None:
        rgb = cv2.cvtColor(_shrink(bgr, size), cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
        return (correct(rgb) if correct else rgb), None
    weighted = cv2.cvtColor(_shrink(_foreground_share(bgr, mask, still), size), cv2.COLOR_BGR2RGB)
    mask = _shrink(mask, size)
    coverage = cv2.merge([mask] * 3)
    if correct:
        straight = cv2.divide(weighted, coverage, scale=255).astype(np.uint8, copy=False)
        weighted = cv2.multiply(correct(straight), coverage, scale=1 / 255)
    white_share = cv2.bitwise_not(coverage)
    return cv2.add(weighted, white_share).astype(np.uint8, copy=False), mask


def _foreground_share(bgr: ByteArray, mask: ByteArray, still: ByteArray | None) -> ByteArray:
    coverage = cv2.merge([mask] * 3)
    if still is None:
        return cv2.multiply(bgr, coverage, scale=1 / 255).astype(np.uint8, copy=False)
    behind = cv2.multiply(still, cv2.bitwise_not(coverage), scale=1 / 255)
    return cv2.min(cv2.subtract(bgr, behind), coverage).astype(np.uint8, copy=False)


def read_still(path: Path, size: tuple[int, int]) -> ByteArray:
    """Still of the empty set as OpenCV decodes it, resized to the frames' (width, height)."""
    still = read_bgr(path)
    return cv2.resize(still, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def _shrink(image: ByteArray, size: tuple[int, int]) -> ByteArray:
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


CAMERA_FILE = "camera_params.json"
COLOUR_FILE = "color_calibration.json"
SEQUENCES_FILE = "metadata_sequences.csv"
_AVAILABLE = ("x", "m")


@dataclass(frozen=True, eq=False)
class Participant:
    """One participant's folder in a recording."""

    subject: str
    """Three-digit id."""
    calibration_file: Path
    """``camera_params.json``."""
    sequences: Mapping[str, Path]
    """Folder by full sequence name, without ``BACKGROUND``."""
    backgrounds: Mapping[str, Path] = field(default_factory=dict)
    """Still of the empty set by serial."""
    listed: tuple[str, ...] = ()
    """Sequences that the release's metadata lists; empty without metadata."""
    colour_file: Path | None = None
    colour_folder: Path | None = None

    def match(self, wanted: str) -> str:
        """Full name of a sequence given by name or unique prefix."""
        try:
            return match_sequence(self.calibration_file, wanted, self.sequences)
        except InputError as error:
            remedy = "Fetch it, or name the sequences to use with --sequences."
            recorded = [name for name in self.listed if name == wanted or name.startswith(wanted)]
            if recorded and not any(name in self.sequences for name in recorded):
                remedy = f"{SEQUENCES_FILE} lists {', '.join(recorded)}. {remedy}"
            raise InputError(error.file, error.key, error.expected, error.found, remedy) from None

    def corrections(self, sequence: str, serials: Iterable[str]) -> dict[str, Correction]:
        """Colour correction by serial; empty if the recording has no colour calibration."""
        if self.colour_file is not None:
            entries = read_json(self.colour_file)
            return {s: polynomial_correction(self.colour_file, s, entries.get(s)) for s in serials}
        folders = (
            self.colour_folder,
            self.calibration_file.parent / "annotations" / sequence / "color_correction",
        )
        for folder in folders:
            if folder is not None and folder.is_dir():
                return {serial: affine_correction(folder / f"{serial}.npy") for serial in serials}
        return {}


def participants(root: Path) -> dict[str, Participant]:
    """Participants under ``root`` by id."""
    if not root.is_dir():
        raise InputError(root, "", "a folder with recordings", "a file" if root.exists() else "nothing")
    listed = _listed_sequences(root)
    ids = {path.name for path in root.iterdir() if path.is_dir() and is_subject(path.name)}
    parts = [part for part in sorted(root.glob("sequence_*_part-*")) if part.is_dir()]
    ids |= {path.name for part in parts for path in part.iterdir() if path.is_dir() and is_subject(path.name)}
    by_id = {name: _participant(root, parts, name, listed.get(name, ())) for name in sorted(ids)}
    if not by_id:
        expected = "folders named after participants (three digits), such as 074"
        names = ", ".join([path.name for path in entries(root)][:5]) or "an empty folder"
        raise InputError(root, "", expected, names, "Give the folder that holds the participants' folders.")
    return by_id


def participant(root: Path, subject: str) -> Participant:
    """One participant, with calibration."""
    by_id = participants(root)
    if subject not in by_id:
        raise InputError(root, "subject", f"one out of {', '.join(by_id)}", subject)
    one = by_id[subject]
    if not one.calibration_file.exists():
        expected = "the calibration of the cameras"
        raise InputError(one.calibration_file, "", expected, "no such file", "Download calibrations.")
    return one


def _participant(root: Path, parts: Iterable[Path], subject: str, listed: tuple[str, ...]) -> Participant:
    folder = root / subject
    sequences: dict[str, Path] = {}
    for parent in (folder / "sequences", folder, *(part / subject for part in parts)):
        if parent == folder and (folder / "sequences").is_dir():
            continue
        for path in entries(parent):
            if path.is_dir() and path.name not in ("calibration", "annotations"):
                sequences.setdefault(check_name(path.name, parent, "sequence"), path)
    stills = sequences.pop(BACKGROUND, None)
    named = {serial_of(path.stem, "image"): path for path in entries(stills, "image_*.*")} if stills else {}
    colour_file = folder / "calibration" / COLOUR_FILE
    places = (folder / "calibration", root / "camera_params" / subject, folder)
    calibrations = [place / CAMERA_FILE for place in places]
    return Participant(
        subject=subject,
        calibration_file=next((path for path in calibrations if path.exists()), calibrations[0]),
        sequences=sequences,
        backgrounds={serial: path for serial, path in sorted(named.items(), key=str) if serial},
        listed=listed,
        colour_file=colour_file if colour_file.exists() else None,
        colour_folder=root / "color_correction" / subject,
    )


def _listed_sequences(root: Path) -> dict[str, tuple[str, ...]]:
    """Sequences that ``metadata_sequences.csv`` marks as available (``x`` or ``m``), by participant."""
    path = root / SEQUENCES_FILE
    if not path.exists():
        return {}
    with reading(path, "a CSV file"):
        rows = [*csv.DictReader(io.StringIO(read_text(path, "CSV"), newline=""))]
    if rows and "ID" not in rows[0]:
        expected = "a column of participants"
        raise InputError(path, "ID", expected, f"columns {', '.join(map(str, rows[0]))[:80]}")
    return {
        str(row["ID"]).strip().zfill(3): tuple(
            name
            for name, cell in row.items()
            if name not in ("ID", "wears_glasses", None)
            and isinstance(cell, str)
            and cell.strip() in _AVAILABLE
        )
        for row in rows
    }


@dataclass(frozen=True, eq=False)
class Calibration:
    """Cameras by serial, in the file's order, which is the order of camera indices."""

    file: Path
    """Source of the values, for error messages."""
    world_to_camera: Mapping[str, FloatArray]
    """(4, 4) by serial."""
    intrinsics: Mapping[str, FloatArray]
    """(3, 3) by serial, pixels of an image of ``size``; of cameras that are not used there may be none."""
    size: tuple[int, int] | None
    """(width, height) that the intrinsics refer to; None if they refer to the images as they are."""

    @property
    def serials(self) -> list[str]:
        """Serials of all cameras."""
        return [*self.world_to_camera]

    def camera(self, serial: str, size: tuple[int, int], output: tuple[int, int]) -> Camera:
        """Camera for images of ``output`` size made of images of ``size``, both (width, height). Pixels scale with the
        edges of the image: no half-pixel term."""
        width, height = self.size or size
        if abs(size[0] * height - size[1] * width) > max(width, height):
            expected = f"images of the shape of {width}x{height}, which the intrinsics refer to"
            found = f"images of {size[0]}x{size[1]} from camera {serial}"
            remedy = "Give height and width in camera_params.json where the recording has another size."
            raise InputError(self.file, "width, height", expected, found, remedy)
        if serial not in self.intrinsics:
            raise InputError(self.file, "intrinsics", f"a matrix for camera {serial}", "none")
        K = np.diag([output[0] / width, output[1] / height, 1.0]) @ self.intrinsics[serial]
        return Camera(serial, *output, K, self.world_to_camera[serial])

    def aligned(self) -> Calibration:
        """The same cameras in a world with the mean camera looking along -z and +y up, as in VHAP.

        The mean of all camera-to-world rotations is orthonormalised column by column (x, y, z); with its
        second and third columns negated it is the new basis. No translation, no scale. All cameras of the
        file count, also those that are not used.
        """
        to_world = {serial: np.linalg.inv(matrix) for serial, matrix in self.world_to_camera.items()}
        basis = _gram_schmidt(np.mean([matrix[:3, :3] for matrix in to_world.values()], axis=0))
        if basis is None:
            found = "rotations whose mean has no direction"
            raise InputError(self.file, "world_2_cam", "cameras that look about one way", found)
        turn = np.eye(4)
        turn[:3, :3] = basis * [1.0, -1.0, -1.0]
        turned = {serial: np.linalg.inv(turn.T @ matrix) for serial, matrix in to_world.items()}
        return replace(self, world_to_camera=turned)


def _gram_schmidt(matrix: FloatArray) -> FloatArray | None:
    """Orthonormal columns by Gram-Schmidt; None if they are linearly dependent."""
    columns: list[FloatArray] = []
    for column in matrix.T:
        rest = column - sum((np.dot(column, known) * known for known in columns), np.zeros(3))
        length = np.linalg.norm(rest)
        if length < 1e-6:
            return None
        columns.append(rest / length)
    return np.stack(columns, axis=1)


def read_calibration(path: Path) -> Calibration:
    """Read and check ``camera_params.json``."""
    value = read_json(path)
    matrices = value.get("world_2_cam")
    if not isinstance(matrices, dict) or not matrices:
        raise InputError(path, "world_2_cam", "an object from serial to 4x4 matrix", found_entry(matrices))
    world_to_camera = {}
    for serial, entry in matrices.items():
        check_name(serial, path, "world_2_cam")
        world_to_camera[serial] = read_rigid(path, f"world_2_cam.{serial}", entry)
    shared = value.get("intrinsics")
    if isinstance(shared, dict):
        intrinsics = {
            s: _intrinsics(path, f"intrinsics.{s}", shared[s]) for s in world_to_camera if s in shared
        }
    else:
        intrinsics = dict.fromkeys(world_to_camera, _intrinsics(path, "intrinsics", shared))
    return Calibration(path, world_to_camera, intrinsics, _size(path, value, isinstance(shared, dict)))


def _size(path: Path, value: Mapping[str, Any], per_camera: bool) -> tuple[int, int] | None:
    if "width" not in value and "height" not in value:
        return None if per_camera else FULL_SIZE
    sizes = []
    for key in ("width", "height"):
        number = value.get(key)
        plain = isinstance(number, (int, float)) and not isinstance(number, bool)
        if number is None or not plain or not 1 <= number < MAX_INTEGER or number % 1:
            raise InputError(path, key, "a number of pixels from 1", found_entry(number))
        sizes.append(int(number))
    return sizes[0], sizes[1]


def _intrinsics(path: Path, key: str, value: Any) -> FloatArray:
    K = read_matrix(path, key, value, 3)
    zeros = [K[0, 1], K[1, 0], K[2, 0], K[2, 1]]
    if K[0, 0] <= 0 or K[1, 1] <= 0 or K[2, 2] != 1 or np.any(zeros):
        expected = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths"
        raise InputError(path, key, expected, found_entry(value))
    return K

"""A fault of one camera is found by its code and named by camera, with sensor noise too; healthy captures are quiet."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from headbench.bench.contracts import Camera
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.ga.writer import SequencePlan
from headbench.datasets.images import read_image
from headbench.datasets.lint.catalogue import RULES, errors
from headbench.datasets.lint.command import lint_capture
from headbench.datasets.lint.settings import LintSettings

from ..head.toy import toy_head
from ..tiny_capture import look_at
from .good_capture import (
    HEIGHT,
    LENGTHS,
    WIDTH,
    GoodCapture,
    good_plan,
    smooth_poses,
    write_good_capture,
    write_pixels,
)

RIG_CODES = {"HB308", "HB513", "HB514", "HB515", "HB516", "HB517"}
pytestmark = pytest.mark.usefixtures("one_torch_thread")

CAMERA, OTHER = "222200001", "222200004"
"""The camera that faults are planted at, and the one that it is exchanged with."""
Plant = Callable[[GoodCapture], None]


def images(capture: GoodCapture, camera: str = "") -> list[Path]:
    """Images in the order of timesteps; of one camera where one is given."""
    frames: list[dict] = []
    capture.each_frame(frames.append)
    frames = [frame for frame in frames if not camera or frame["camera_id"] == camera]
    return [capture.union / f["file_path"] for f in sorted(frames, key=lambda f: f["timestep_index"])]


def change_images(capture: GoodCapture, change: Callable[[np.ndarray], np.ndarray], camera: str = "") -> None:
    for path in images(capture, camera):
        write_pixels(path, change(read_image(path, (1, 1, 1))))


def add_noise(capture: GoodCapture) -> None:
    """Sensor noise of 3 levels in every image."""
    rng = np.random.default_rng(0)
    change_images(
        capture,
        lambda image: np.clip(image + rng.normal(0, 3.0, image.shape), 0, 255).round().astype(np.uint8),
    )


def exchange(capture: GoodCapture) -> None:
    """Two cameras have each other's calibration."""
    keys = ("transform_matrix", "fl_x", "fl_y", "cx", "cy")
    known: dict[str, dict] = {}
    capture.each_frame(lambda f: known.update({f["camera_id"]: {k: f[k] for k in keys}}))
    turn = {CAMERA: OTHER, OTHER: CAMERA}
    capture.each_frame(lambda f: f.update(known[turn.get(f["camera_id"], f["camera_id"])]))


def _move(change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    def edit(frame):
        if frame["camera_id"] == CAMERA:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    return lambda capture: capture.each_frame(edit)


def _aside(metres: float, axis: int) -> Plant:
    def shift(matrix):
        matrix[:3, 3] += metres * matrix[:3, axis]
        return matrix

    return _move(shift)


def _late(frames: int) -> Plant:
    """Images (and masks) of so many frames before, within each sequence."""

    def plant(capture):
        content = {p: (p.read_bytes(), _mask(p).read_bytes()) for p in images(capture, CAMERA)}
        for path in content:
            sequence = [other for other in content if other.parent == path.parent]
            source = sequence[min(max(sequence.index(path) - frames, 0), len(sequence) - 1)]
            path.write_bytes(content[source][0])
            _mask(path).write_bytes(content[source][1])

    return plant


def _mask(image: Path) -> Path:
    return image.parent.parent / "fg_masks" / image.name


def _each(change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    return lambda capture: change_images(capture, change, CAMERA)


def _freeze(capture: GoodCapture) -> None:
    first = read_image(images(capture, CAMERA)[0], (1, 1, 1))
    change_images(capture, lambda image: first, CAMERA)


class CameraFault(NamedTuple):
    """``code`` must be found, and name `CAMERA`."""

    name: str
    code: str
    plant: Plant


CAMERA_FAULTS = (
    CameraFault("exchanged", "HB513", exchange),
    CameraFault("3 cm aside", "HB514", _aside(0.03, 0)),
    CameraFault("2 frames late", "HB515", _late(2)),
    CameraFault("blurred by 4 px", "HB517", _each(lambda image: cv2.GaussianBlur(image, (0, 0), 4.0))),
    CameraFault("black", "HB308", _each(np.zeros_like)),
    CameraFault("frozen", "HB516", _freeze),
)


def arc(count: int) -> list[Camera]:
    """Cameras on an arc of 100 degrees at two heights."""
    angles = np.radians(np.linspace(-50, 50, count))
    places = [np.array([np.sin(a), 0.08 + 0.15 * (i % 2), np.cos(a)]) for i, a in enumerate(angles)]
    return [
        look_at(f"2222000{i:02d}", at, WIDTH, HEIGHT, WIDTH / 2 + 0.4, HEIGHT / 2 - 0.6)
        for i, at in enumerate(places)
    ]


@pytest.fixture(scope="module")
def painted(tmp_path_factory) -> Callable[[int, int], GoodCapture]:
    """A capture of so many cameras and this seed, written once."""

    @cache
    def write(cameras: int, seed: int) -> GoodCapture:
        head = toy_head(32, seed=seed, version="toy2023")
        poses = [
            (name, smooth_poses(head, count, i + seed)) for i, (name, count) in enumerate(LENGTHS.items())
        ]
        sequences = [SequencePlan(name, of_sequence) for name, of_sequence in poses]
        rig = arc(cameras)
        held_out = (rig[cameras // 2].id,)
        plan = good_plan(head=head, cameras=rig, sequences=sequences, novel_view_cameras=held_out)
        return write_good_capture(tmp_path_factory.mktemp("rig"), plan)

    return write


def findings(union: Path):
    _, found = lint_capture(LintSettings(str(union), views=12, duplicates=60, ignore=("HB616",)))
    return {finding.code: finding.message for finding in found}


@pytest.mark.parametrize("fault", CAMERA_FAULTS, ids=lambda fault: fault.name)
def test_a_fault_of_one_camera_is_found_and_named(fault: CameraFault, painted, tmp_path):
    capture = painted(6, 0).copied(tmp_path / "rig")
    fault.plant(capture)
    add_noise(capture)
    found = findings(capture.union)
    assert set(found) == {fault.code}, "the fault, and nothing that follows from it"
    named = {camera.id for camera in arc(6) if camera.id in found[fault.code]}
    assert named == ({CAMERA, OTHER} if fault.code == "HB513" else {CAMERA})
    before_run = [error[:5] for error in errors(read_capture(capture.union))]
    assert before_run == [rule.code for rule in RULES if rule.code == fault.code and rule.severity == "error"]


@pytest.mark.parametrize("noise", [True, False])
def test_no_camera_of_a_healthy_capture_is_blamed(noise, painted, tmp_path):
    if not noise:
        assert not RIG_CODES & findings(painted(2, 4).union).keys()
        return
    capture = painted(6, 0).copied(tmp_path / "rig")
    rng = np.random.default_rng(0)

    def err(arrays, index):
        arrays["translation"] += rng.normal(0, 1e-3, arrays["translation"].shape)
        arrays["expr"] *= 0.9

    capture.each_parameters(err)
    add_noise(capture)
    assert not RIG_CODES & findings(capture.union).keys()

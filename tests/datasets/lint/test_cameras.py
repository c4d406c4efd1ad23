"""A fault of one camera is found by its code and named by camera, with sensor noise too; healthy captures are quiet."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.contracts import Camera
from headbench.datasets.ga.writer import SequencePlan
from headbench.datasets.lint.command import lint_capture
from headbench.datasets.lint.settings import LintSettings
from headbench.datasets.synthetic.capture import synthesize

from ..head.toy import toy_head
from ..tiny_capture import look_at
from .camera_faults import CAMERA, CAMERA_FAULTS, OTHER, CameraFault, add_noise, change_images
from .good_capture import HEIGHT, LENGTHS, WIDTH, GoodCapture, good_plan, smooth_poses, write_good_capture

RIG_CODES = {"HB308", "HB513", "HB514", "HB515", "HB516", "HB517"}
NOISE = 3.0


pytestmark = pytest.mark.usefixtures("one_torch_thread")


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


HIDDEN_BY_NOISE = ("HB308", "HB516", "HB517")
"""Codes whose faults are told by what noise changes; for the others noise is only harder."""


@pytest.mark.parametrize(
    ("fault", "noise"),
    [
        pytest.param(fault, noise, id=f"{fault.name}, noise {noise}")
        for fault in CAMERA_FAULTS
        for noise in (0.0, NOISE)
        if noise or fault.code in HIDDEN_BY_NOISE
    ],
)
def test_a_fault_of_one_camera_is_found_and_named(fault: CameraFault, noise, painted, tmp_path):
    capture = painted(6, 0).copied(tmp_path / "rig")
    fault.plant(capture)
    if noise:
        add_noise(capture, noise)
    found = findings(capture.union)
    assert set(found) == {fault.code}, "the fault, and nothing that follows from it"
    named = {camera.id for camera in arc(6) if camera.id in found[fault.code]}
    assert named == ({CAMERA, OTHER} if fault.code == "HB513" else {CAMERA})


@pytest.mark.parametrize(
    ("cameras", "seed", "noise", "tracking_mm"),
    [(6, 0, NOISE, 1.0), (3, 2, NOISE, 0.0), (2, 4, 0.0, 0.0)],
)
def test_no_camera_of_a_healthy_capture_is_blamed(cameras, seed, noise, tracking_mm, painted, tmp_path):
    capture = painted(cameras, seed).copied(tmp_path / "rig")
    rng = np.random.default_rng(seed)

    def err(arrays, index):
        arrays["translation"] += rng.normal(0, 1e-3 * tracking_mm, arrays["translation"].shape)
        arrays["expr"] *= 1 - 0.1 * tracking_mm

    capture.each_parameters(err)
    if noise:
        add_noise(capture, noise)
    assert not RIG_CODES & findings(capture.union).keys()


@pytest.mark.slow
def test_no_camera_of_a_synthetic_capture_is_blamed(tmp_path):
    synthesize(
        tmp_path,
        cameras=4,
        timesteps=8,
        size=(36, 52),
        seed=6,
        tracking_error=1.0,
        samples_per_pixel=4,
        workers=1,
    )
    (union,) = tmp_path.glob("UNION*")
    assert not RIG_CODES & findings(union).keys()


def test_a_single_camera_is_compared_with_no_other(painted, tmp_path):
    """A black one is still told, by its own images."""
    capture = painted(2, 4).copied(tmp_path / "rig")
    for part in ("train", "val", "test"):
        capture.edit(
            f"transforms_{part}.json",
            lambda v: v.update(frames=[f for f in v["frames"] if f["camera_id"] == "222200000"]),
        )
    assert not RIG_CODES & findings(capture.union).keys()
    change_images(capture, np.zeros_like)
    assert RIG_CODES & findings(capture.union).keys() == {"HB308"}

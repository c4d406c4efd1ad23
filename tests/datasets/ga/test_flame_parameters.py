"""Parameter files as trackers leave them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.ga.tracking import read_tracking, resolve_teeth
from headbench.datasets.head.teeth import with_teeth

from ..head.toy import toy_head

HEAD = toy_head(16)
VERTICES = len(HEAD.template)


def write_files(folder: Path, count: int = 2, **changes) -> dict[int, Path]:
    """Parameter files; a change is a function of the timestep that gives an array, or None to leave it out."""
    files = {}
    for t in range(count):
        rng = np.random.default_rng(t)
        arrays = {
            "translation": rng.normal(size=(1, 3)),
            "rotation": rng.normal(size=(1, 3)),
            "neck_pose": rng.normal(size=(1, 3)),
            "jaw_pose": rng.normal(size=(1, 3)),
            "eyes_pose": rng.normal(size=(1, 6)),
            "shape": np.arange(6.0),
            "expr": rng.normal(size=(1, 8)),
            "static_offset": np.full((1, VERTICES, 3), 0.001),
        }
        for key, function in changes.items():
            value = function(t)
            arrays.pop(key, None)
            if value is not None:
                arrays[key] = value
        files[t] = folder / f"{t:05d}.npz"
        np.savez(files[t], **{key: value.astype(np.float32) for key, value in arrays.items()})
    return files


def test_shorter_coefficients_are_padded_with_zeros(tmp_path):
    files = write_files(tmp_path, shape=lambda t: np.ones((1, 4)), expr=lambda t: np.full((1, 5), t + 1.0))
    tracking = read_tracking(files, HEAD, "s")
    assert tracking.shape.tolist() == [1, 1, 1, 1, 0, 0]
    assert tracking.poses[1].expression.tolist() == [2, 2, 2, 2, 2, 0, 0, 0]


def test_missing_static_offset_is_zero_and_noted(tmp_path):
    tracking = read_tracking(write_files(tmp_path, static_offset=lambda t: None), HEAD, "s")
    assert tracking.static_offset.shape == tracking.head.template.shape
    assert not tracking.static_offset.any()
    assert tracking.notes["static_offset"] == "zeros, as the files have none"


def test_first_timestep_rules_and_what_is_ignored_is_measured(tmp_path):
    files = write_files(
        tmp_path,
        3,
        shape=lambda t: np.full(6, 0.5 * t),
        static_offset=lambda t: np.full((1, VERTICES, 3), 0.25 * t),
        dynamic_offset=lambda t: np.full((1, VERTICES, 3), -0.125 * t),
    )
    tracking = read_tracking(files, HEAD, "s")
    assert not tracking.shape.any()
    assert not tracking.static_offset.any()
    assert tracking.notes["change_of_shape_ignored"] == 1.0
    assert tracking.notes["change_of_static_offset_ignored_m"] == 0.5
    assert tracking.notes["dynamic_offset_ignored_m"] == 0.25


REFUSED = {
    "00001.npz, static_offset": {"static_offset": lambda t: np.zeros((1, VERTICES + t, 3))},
    "00001.npz, static_offset:": {"static_offset": lambda t: np.zeros((1, VERTICES, 3)) if t else None},
    "jaw_pose": {"jaw_pose": lambda t: np.ones((2, 3))},
    "jaw_pose:": {"jaw_pose": lambda t: np.ones((1, 3, 1))},
    "shape, static_offset": {"shape": lambda t: np.full((1, 6), 5000.0)},
    "shape, static_offset:": {"static_offset": lambda t: np.full((1, VERTICES, 3), 20.0)},
}


@pytest.mark.parametrize("name", REFUSED)
def test_faulty_parameters_are_refused(tmp_path, name):
    with pytest.raises(InputError, match=name):
        read_tracking(write_files(tmp_path, **REFUSED[name]), HEAD, "s")


def test_teeth_policies():
    file, toothed = Path("x"), with_teeth(HEAD)
    more = len(toothed.template)
    flame = toy_head(16, version="flame2020")
    lipless = replace(HEAD, regions={})
    cases = [
        (HEAD, VERTICES, "auto", (more, VERTICES)),
        (HEAD, None, "auto", (more, more)),
        (lipless, VERTICES, "auto", (VERTICES, VERTICES)),
        (lipless, None, "auto", (VERTICES, VERTICES)),
        (HEAD, more, "auto", (more, more)),
        (HEAD, more, "keep", (VERTICES, VERTICES)),  # the teeth's rows are dropped
        (HEAD, VERTICES, "add", (more, VERTICES)),  # the teeth's rows are zero
        (toothed, VERTICES, "auto", (more, VERTICES)),
        (toothed, more, "add", (more, more)),
        (flame, VERTICES, "auto", (more, VERTICES)),
        (flame, VERTICES, "keep", (VERTICES, VERTICES)),
    ]
    for head, rows, policy, expected in cases:
        found, used = resolve_teeth(head, rows, policy, file)
        assert (len(found.template), used) == expected, (rows, policy)
    for head, rows, policy in [(HEAD, VERTICES - 1, "auto"), (HEAD, more + 1, "auto"), (toothed, 5, "keep")]:
        with pytest.raises(InputError, match="static_offset"):
            resolve_teeth(head, rows, policy, file)
    # Where teeth are needed they are not left out: of FLAME, by rows of the offset, on demand.
    for head, rows, policy in [
        (replace(flame, regions={}), VERTICES, "auto"),
        (lipless, more, "auto"),
        (lipless, None, "add"),
    ]:
        with pytest.raises(InputError, match="regions"):
            resolve_teeth(head, rows, policy, file)

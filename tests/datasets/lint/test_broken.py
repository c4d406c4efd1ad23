"""Whatever is in the files, the linter ends with findings, never with an exception."""

from __future__ import annotations

import json
from itertools import count

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from headbench.bench.errors import InputError
from headbench.datasets.lint.command import lint
from headbench.datasets.lint.settings import LintSettings

from ..tiny_capture import edit_npz
from .good_capture import GoodCapture

PLACED = ([], {}, "../../../../etc/passwd", [[1.0] * 4] * 4, 1e-300)
JUNK = st.one_of(
    *(st.none(), st.booleans(), st.integers(-(10**30), 10**30), st.floats(), st.text(max_size=8)),
    *map(st.just, PLACED),
)
KEYS = [
    *("timestep_index", "camera_index", "camera_id", "cx", "cy", "fl_x", "fl_y", "h", "w", "camera_angle_x"),
    *("transform_matrix", "file_path", "fg_mask_path", "flame_param_path"),
]
ARRAYS = ["translation", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "shape", "expr", "static_offset"]
_numbers = count()

fuzz = settings(
    max_examples=8,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    derandomize=True,
)


def outcome(capture: GoodCapture) -> list[str]:
    findings = lint(LintSettings(str(capture.union), views=3, duplicates=6))
    json.dumps(findings.data)
    return [finding["code"] for finding in findings.data["findings"]]


@fuzz
@given(key=st.sampled_from(KEYS), junk=JUNK, everywhere=st.booleans())
def test_junk_in_a_frame(pristine, tmp_path, key, junk, everywhere):
    capture = pristine.copied(tmp_path / f"{next(_numbers)}")

    def spoil(value):
        for frame in value["frames"][:: 1 if everywhere else len(value["frames"])]:
            frame[key] = junk

    capture.edit("transforms_train.json", spoil)
    outcome(capture)


@fuzz
@given(
    key=st.sampled_from(["subject", "head_model", "head_file", "background", "cy", "sequences", "excluded"]),
    junk=JUNK,
)
def test_junk_in_the_declaration(pristine, tmp_path, key, junk):
    capture = pristine.copied(tmp_path / f"{next(_numbers)}")
    capture.edit("headbench.json", lambda value: value.update({key: junk}))
    outcome(capture)


@fuzz
@given(
    key=st.sampled_from(ARRAYS),
    shape=st.sampled_from([(), (0,), (1, 3), (3,), (2, 2, 2), (1, 500)]),
    value=st.sampled_from([0.0, 1e30, -1e38, np.nan, np.inf]),
    kind=st.sampled_from(["f4", "f8", "i8", "U3", "c8"]),
)
def test_junk_in_parameters(pristine, tmp_path, key, shape, value, kind):
    capture = pristine.copied(tmp_path / f"{next(_numbers)}")
    finite = value if np.isfinite(value) or kind in ("f4", "f8") else 7
    array = np.full(shape, finite if kind != "i8" else int(min(max(finite, -(2**62)), 2**62))).astype(kind)
    edit_npz(capture.files("flame_param")[3], lambda arrays: arrays.update({key: array}))
    outcome(capture)


@fuzz
@given(data=st.data())
def test_files_cut_off_or_overwritten(pristine, tmp_path, data):
    capture = pristine.copied(tmp_path / f"{next(_numbers)}")
    files = [p for p in capture.writer.root.rglob("*") if p.is_file() and "transforms.json" not in p.name]
    path = data.draw(st.sampled_from(sorted(files)))
    content = path.read_bytes()
    end = data.draw(st.integers(0, max(0, len(content) - 1)))
    path.write_bytes(content[:end] + data.draw(st.binary(max_size=20)))
    try:
        outcome(capture)
    except InputError:
        raise AssertionError(f"{path.name} cut off at {end} stops the linter") from None


def test_only_one_json_left(good):
    """No train JSON, no parameters, no head: the images of the rest are still looked at."""
    (good.union / "transforms_train.json").unlink()
    (good.union / "head_model.npz").unlink()
    for path in good.files("flame_param"):
        path.unlink()
    found = outcome(good)
    assert {"HB101", "HB103", "HB602"} <= set(found)

"""Whatever is in the files, the linter ends with findings, never with an exception."""

from __future__ import annotations

import json
from itertools import count

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

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
VALUES = [
    np.array(np.nan),
    np.zeros((0,)),
    np.full((1, 3), 1e30),
    np.zeros((2, 2, 2), int),
    np.array(["x"] * 3),
]
_numbers = count()


def outcome(capture: GoodCapture) -> list[str]:
    findings = lint(LintSettings(str(capture.union), views=3, duplicates=6))
    json.dumps(findings.data)
    return [finding["code"] for finding in findings.data["findings"]]


def _junk_in_frames(capture, data):
    key, junk = data.draw(st.sampled_from(KEYS)), data.draw(JUNK)
    capture.edit(
        "transforms_train.json", lambda value: [f.update({key: junk}) for f in value["frames"]] and None
    )


def _junk_in_the_declaration(capture, data):
    keys = ["subject", "head_model", "head_file", "background", "cy", "sequences", "excluded"]
    capture.edit(
        "headbench.json", lambda value: value.update({data.draw(st.sampled_from(keys)): data.draw(JUNK)})
    )


def _junk_in_parameters(capture, data):
    key, array = data.draw(st.sampled_from(ARRAYS)), data.draw(st.sampled_from(VALUES))
    edit_npz(capture.files("flame_param")[3], lambda arrays: arrays.update({key: array}))


def _file_cut_off_or_overwritten(capture, data):
    files = [p for p in capture.writer.root.rglob("*") if p.is_file() and "transforms.json" not in p.name]
    path = data.draw(st.sampled_from(sorted(files)))
    content = path.read_bytes()
    end = data.draw(st.integers(0, max(0, len(content) - 1)))
    path.write_bytes(content[:end] + data.draw(st.binary(max_size=20)))


@pytest.mark.parametrize(
    "damage", [_junk_in_frames, _junk_in_the_declaration, _junk_in_parameters, _file_cut_off_or_overwritten]
)
@settings(max_examples=2, deadline=None, suppress_health_check=[*HealthCheck], derandomize=True)
@given(data=st.data())
def test_damage_ends_with_findings(pristine, tmp_path, damage, data):
    capture = pristine.copied(tmp_path / f"{next(_numbers)}")
    damage(capture, data)
    outcome(capture)


def test_a_path_that_no_file_can_have(good):
    good.edit("transforms_train.json", lambda value: value["frames"][0].update(file_path="a\0b.png"))
    assert "HB103" in outcome(good)


def test_only_one_json_left(good):
    """No train JSON, no parameters, no head: the images of the rest are still looked at."""
    (good.union / "transforms_train.json").unlink()
    (good.union / "head_model.npz").unlink()
    for path in good.files("flame_param"):
        path.unlink()
    found = outcome(good)
    assert {"HB101", "HB103", "HB602"} <= set(found)

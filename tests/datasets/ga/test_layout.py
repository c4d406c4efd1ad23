"""Names and conventions of the layout, against closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import Camera
from headbench.datasets.ga import layout

finite = st.floats(-3, 3)


@settings(deadline=None)
@given(
    axis=st.tuples(finite, finite, finite),
    place=st.tuples(finite, finite, finite),
    focal=st.tuples(st.floats(10, 9000), st.floats(10, 9000)),
    center=st.tuples(st.floats(0, 550), st.floats(0, 802)),
    cy=st.sampled_from(["top", "bottom"]),
)
def test_cameras_survive_the_json(axis, place, focal, center, cy):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(axis).as_matrix(), place
    K = np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])
    camera = Camera("c", 550, 802, K, matrix)
    entries = layout.intrinsics_to_json(camera, cy)
    np.testing.assert_allclose(layout.intrinsics_from_json(entries, 550, 802, cy), K, rtol=0, atol=1e-12)
    stored = np.array(layout.extrinsics_to_json(matrix))
    np.testing.assert_allclose(layout.extrinsics_from_json(stored), matrix, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("folder", "subject", "sequence"),
    [
        ("074_EMO-1_v16_DS4_whiteBg_staticOffset_maskBelowLine", "074", "EMO-1"),
        ("074_EMO-1-shout+laugh_v16_DS4_whiteBg", "074", "EMO-1-shout+laugh"),
        ("306_SEN-01-cramp_small_danger_v16_DS2-0.5x_lmkSTAR", "306", "SEN-01-cramp_small_danger"),
        ("306_FREE", "306", "FREE"),
        ("901_FREE_v3_whiteBg_staticOffset", "901", "FREE"),
        ("306_EXP-3-cheeks+nose_v8", "306", "EXP-3-cheeks+nose"),
        ("obama", "", "obama"),
    ],
)
def test_sequence_folder_names(folder, subject, sequence):
    assert layout.parse_sequence_folder(folder) == (subject, sequence)


@pytest.mark.parametrize(
    ("folder", "subject"),
    [
        *(("UNION10_306_EMO1234EXP234589_v16_DS2-0.5x_lmkSTAR_teethV3_SMOOTH", "306"), ("UNION_074", "074")),
        *(("UNION20_a1", "a1"), ("074_EMO-1_v16", "")),
    ],
)
def test_union_folder_names(folder, subject):
    assert layout.parse_union_folder(folder) == subject


def test_declaration_survives(tmp_path):
    declaration = layout.Declaration(
        subject="s",
        head_model="procedural2023",
        background=(0.25, 0.5, 1.0),
        cy="top",
        sequences={"s_FREE_v16": "FREE"},
        excluded={12: "tongue out", 3: "blur"},
        synthetic={"seed": 7},
    )
    declaration.write(tmp_path)
    assert layout.Declaration.read(tmp_path) == declaration
    assert layout.Declaration.read(tmp_path / "elsewhere") is None

"""Colour calibration against numbers of the colour-science package, and against float64 formulas."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from headbench.bench.errors import InputError
from headbench.datasets.images import srgb_to_linear
from headbench.datasets.nersemble.pixels import (
    POLYNOMIALS,
    AffineCorrection,
    PolynomialCorrection,
    affine_correction,
    linear_to_srgb,
    polynomial_correction,
)

# sum over i of (i + 1) * term i of colour-science 0.4.7's matrix_augmented_Cheung2004 at RGB (0.7, 0.3, 0.11).
WEIGHTED_SUMS = {
    3: 1.63,
    4: 5.63,
    5: 6.7224,
    7: 10.053,
    8: 11.2147,
    10: 17.3119,
    11: 18.5429,
    14: 25.657203,
    16: 14.617106,
    17: 31.617106,
    19: 17.488779,
    20: 37.488779,
    22: 18.013611,
    35: 65.98024724,
}

IMAGES = arrays(np.uint8, (3, 5, 3))
ALL_LEVELS = np.stack([np.arange(256)] * 3, axis=-1).astype(np.uint8)[None]


@pytest.mark.parametrize("count", WEIGHTED_SUMS)
def test_terms_are_those_of_colour_science(count):
    channels = dict(zip("rgb", (0.7, 0.3, 0.11)))
    terms = [np.prod([channels[c] for c in term]) for term in POLYNOMIALS[count]]
    assert len(terms) == count
    assert POLYNOMIALS.keys() == WEIGHTED_SUMS.keys()
    assert np.dot(terms, np.arange(1, count + 1)) == pytest.approx(WEIGHTED_SUMS[count], abs=1e-9)


def test_the_curve_is_that_of_srgb():
    # colour-science 0.4.7: cctf_decoding and cctf_encoding.
    np.testing.assert_allclose(
        srgb_to_linear(np.array([0.5, 0.03])), [0.214041140482, 0.00232198142415], rtol=1e-10
    )
    encoded = linear_to_srgb(np.full((1, 1, 3), 0.2))
    np.testing.assert_allclose(encoded, 0.484529204482, rtol=1e-6)


def reference(matrix: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Version 2 in float64, pixel by pixel."""
    terms = POLYNOMIALS[matrix.shape[1]]
    out = np.empty(image.shape)
    for where in np.ndindex(image.shape[:2]):
        value = image[where] / 255
        linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
        expanded = [np.prod([dict(zip("rgb", linear))[c] for c in term]) for term in terms]
        mapped = np.clip(matrix @ np.array(expanded), 0, 1)
        out[where] = np.where(mapped <= 0.0031308, 12.92 * mapped, 1.055 * mapped ** (1 / 2.4) - 0.055)
    return 255 * out


@pytest.mark.parametrize("count", POLYNOMIALS)
@settings(max_examples=5)
@given(image=IMAGES, seed=st.integers(0, 100))
def test_polynomials_agree_with_float64(count, image, seed):
    rng = np.random.default_rng(seed)
    matrix = np.eye(3, count) + 0.15 * rng.normal(size=(3, count))
    result = PolynomialCorrection(matrix)(image)
    assert result.dtype == np.uint8
    assert np.abs(result - reference(matrix, image)).max() <= 0.53


@settings(max_examples=20)
@given(image=IMAGES, values=arrays(np.float64, (4, 4), elements=st.floats(-2, 2)))
def test_affine_maps_multiply_rows_from_the_left(image, values):
    expected = 255 * np.clip(image / 255 @ values[:3, :3] + values[:3, 3], 0, 1)
    result = AffineCorrection(values[:3])(image)
    assert np.abs(result - expected).max() <= 0.501


@pytest.mark.parametrize("count", POLYNOMIALS)
def test_the_identity_changes_no_level(count):
    kinds = [(PolynomialCorrection, np.eye(3, count)), (AffineCorrection, np.eye(3, 4))]
    for kind, identity in kinds:
        for nearly in (identity, identity + 1e-9):  # of the second the whole computation runs
            np.testing.assert_array_equal(kind(nearly)(ALL_LEVELS), ALL_LEVELS)


@pytest.mark.parametrize(
    "content",
    [
        *(np.eye(2), np.zeros((3, 3)), np.full((4, 4), np.nan), np.full((4, 4), "a")),
        *(np.array([{"a": 1}], dtype=object), np.zeros((4, 4), complex)),
        *(b"", b"\x93NUMPY\x01\x00", b"PK\x03\x04", None),
    ],
)
def test_faulty_affine_files_are_refused(content, tmp_path):
    path = tmp_path / "1.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        np.save(path, content, allow_pickle=True)
    with pytest.raises(InputError) as error:
        affine_correction(path)
    assert error.value.file == str(path)


@pytest.mark.parametrize(
    "value",
    [
        *(None, 1, "M", [[1, 2, 3]], [[1, 2], [3]], [[[1]]]),
        *(np.eye(3, 6).tolist(), np.full((3, 3), np.inf).tolist()),
    ],
)
def test_faulty_polynomials_are_refused(value, tmp_path):
    with pytest.raises(InputError) as error:
        polynomial_correction(tmp_path / "color_calibration.json", "222200037", value)
    assert error.value.key == "222200037"

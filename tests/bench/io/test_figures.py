"""Figures with names that the font lacks."""

import warnings

import numpy as np
import pytest
from matplotlib.figure import Figure

from headbench.bench.io.figures import drawable, pixels


@pytest.mark.parametrize(
    ("text", "drawn"),
    [
        ("naïve Ωλ → – ±", "naïve Ωλ → – ±"),
        ("张三 a", "U+5F20 U+4E09 a"),
        (
            "\N{GRINNING FACE WITH SMILING EYES}\nb",
            "\N{GRINNING FACE WITH SMILING EYES}\nb",
        ),  # DejaVu Sans has some
        ("\N{PARROT}\nb", "U+1F99C\nb"),
    ],
)
def test_characters_that_the_font_lacks_are_code_points(text, drawn):
    assert drawable(text) == drawn

    def picture(name):
        figure = Figure(figsize=(3, 2), layout="constrained")
        axes = figure.subplots()
        axes.set_title(name, fontweight="bold")
        axes.set_yticks([0], [name])
        axes.plot([0], [0], label=name)
        axes.legend()
        return pixels(figure)

    with warnings.catch_warnings(action="error"):
        np.testing.assert_array_equal(picture(text), picture(drawn))

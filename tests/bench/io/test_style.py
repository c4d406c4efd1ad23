"""The shared style: contrast of its colours in both schemes, and marks that differ in shape."""

import re

import pytest

from headbench.bench.io.style import policy_hash, stylesheet


def luminance(colour):
    """Relative luminance of "#rrggbb", WCAG 2."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear))


def contrast(a, b):
    high, low = sorted((luminance(a), luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


COLOURS = dict(re.findall(r"--([a-z0-9-]+): light-dark\((#[0-9a-f]{6}, #[0-9a-f]{6})\)", stylesheet()))
METHODS = [name for name in COLOURS if re.fullmatch("m[0-9]", name)]


@pytest.mark.parametrize("scheme", [0, 1])
@pytest.mark.parametrize("name", ["ink", "muted", "accent", "warn", "rule", *METHODS])
def test_colours_of_text_marks_and_borders_stand_out(scheme, name):
    paper, colour = (COLOURS[key].split(", ")[scheme] for key in ("paper", name))
    assert contrast(paper, colour) >= (3 if name == "rule" else 4.5)


def test_the_hash_is_that_of_the_standard():
    # The example of the CSP specification, "Hash usage for script elements".
    assert policy_hash("alert('Hello, world.');") == "sha256-qznLcsROx4GACP2dm0UCKCzCG+HiZ1guq6ZZDob/Tng="

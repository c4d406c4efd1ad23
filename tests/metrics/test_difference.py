import numpy as np
import pytest
from skimage.metrics import mean_squared_error

from headbench.bench.errors import InputError
from headbench.bench.registry import get, resolve
from headbench.metrics.difference import l1, l2

RNG = np.random.default_rng(0)
IMAGE, TRUTH = RNG.integers(0, 256, (2, 7, 9, 3), dtype=np.uint8)


def test_values_are_those_of_float_images_and_scikit_image():
    floats = IMAGE / 255, TRUTH / 255
    assert l1(IMAGE, TRUTH) == pytest.approx(np.linalg.norm(np.subtract(*floats).ravel(), 1) / 189)
    assert l2(IMAGE, TRUTH) == pytest.approx(mean_squared_error(*floats))
    black = np.zeros_like(TRUTH)
    assert (l1(black, black + np.uint8(51)), l2(black, black + np.uint8(51))) == pytest.approx((0.2, 0.04))


@pytest.mark.parametrize("name", ["l1", "l2"])
def test_a_region_is_scored_by_its_pixels(name):
    spec = get("metrics", name)
    metric = resolve(spec.implementation)
    inside = RNG.random((7, 9)) < 0.5
    values = metric.in_regions(IMAGE, TRUTH, {"part": inside, "none": inside & ~inside})
    assert values == pytest.approx({"part": metric(IMAGE[inside][None], TRUTH[inside][None])})
    assert (spec.kind, spec.higher_is_better) == ("regional", False)
    with pytest.raises(InputError, match="quantise"):
        metric(IMAGE / 255, TRUTH)

import pytest
import torch

from headbench.metrics.lpips_network import NETWORKS

SPECS = pytest.mark.parametrize("spec", NETWORKS.values(), ids=NETWORKS)


@SPECS
def test_taps_have_the_channels_that_the_linear_layers_expect(spec):
    with torch.no_grad():
        outputs = spec.build()(torch.rand(2, 3, spec.smallest, spec.smallest + 5))
    assert tuple(out.shape[1] for out in outputs) == spec.channels
    assert all(min(out.shape[2:]) >= 1 and (out >= 0).all() for out in outputs)


@SPECS
def test_one_pixel_below_the_smallest_image_is_refused(spec):
    with torch.no_grad(), pytest.raises(RuntimeError):
        spec.build()(torch.rand(1, 3, spec.smallest - 1, 64))


def test_parameter_counts_are_those_published():
    counts = {name: sum(p.numel() for p in spec.build().parameters()) for name, spec in NETWORKS.items()}
    assert counts == {"alex": 2_469_696, "squeeze": 722_496, "vgg": 14_714_688}

"""FID: the distance by other formulas, the network in functional calls, and the images that it is given."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from headbench.bench.conformance.methods import picture
from headbench.bench.errors import InputError, UnavailableError
from headbench.metrics import fid
from headbench.metrics.fid import VARIABLE, Fid, frechet_distance
from headbench.metrics.inception import Inception, InceptionNetwork, resized

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("count", [12, 60], ids=["fewer", "more"])
def test_the_distance_is_that_of_the_eigenvalues(count):
    """With fewer samples than dimensions, and with more."""
    first = RNG.normal(size=(count, 20)) @ RNG.normal(size=(20, 20))
    second = RNG.normal(1, 2, size=(count + 3, 20))
    covariances = [np.cov(sample, rowvar=False) for sample in (first, second)]
    roots = np.sqrt(np.maximum(np.linalg.eigvals(covariances[0] @ covariances[1]).real, 0))
    means = np.square(first.mean(axis=0) - second.mean(axis=0)).sum()
    expected = means + sum(map(np.trace, covariances)) - 2 * roots.sum()
    assert frechet_distance(first, second) == pytest.approx(expected, rel=1e-5)
    assert frechet_distance(second, first) == pytest.approx(expected, rel=1e-5)


def test_shifted_and_scaled_features_have_a_closed_form():
    sample = RNG.normal(size=(40, 5))
    spread = np.cov(sample, rowvar=False).trace()
    assert frechet_distance(sample, sample) == pytest.approx(0, abs=1e-12)
    assert frechet_distance(sample, sample + 3) == pytest.approx(5 * 9)
    about = sample.mean(axis=0)
    assert frechet_distance(sample, about + 4 * (sample - about)) == pytest.approx(9 * spread)


@pytest.fixture(scope="module")
def state():
    """Random parameters, whose features neither vanish nor grow."""
    torch.manual_seed(0)
    state = InceptionNetwork().state_dict()
    for name, value in state.items():
        if name.endswith("conv.weight"):
            value.normal_(0, (2 / value[0].numel()) ** 0.5)
        elif name.endswith(("bn.weight", "running_var")):
            value.uniform_(0.5, 1.5)
        elif value.is_floating_point():
            value.normal_(0, 0.1)
    return state


def features(state, x):
    """The network of the project pytorch-fid, written out."""

    def conv(x, name, stride=1, padding=0):
        x = functional.conv2d(x, state[f"{name}.conv.weight"], None, stride, padding)
        normal = (state[f"{name}.bn.{part}"] for part in ("running_mean", "running_var", "weight", "bias"))
        return functional.relu(functional.batch_norm(x, *normal, eps=0.001))

    def chain(x, name, *paddings, last=1):
        for number, padding in enumerate(paddings, 1):
            place = name if len(paddings) == 1 else f"{name}_{number}"
            x = conv(x, place, last if number == len(paddings) else 1, padding)
        return x

    def halves(x, name):
        return [conv(x, f"{name}a", 1, (0, 1)), conv(x, f"{name}b", 1, (1, 0))]

    def mean(x):
        return functional.avg_pool2d(x, 3, 1, 1, count_include_pad=False)

    def pool(x):
        return functional.max_pool2d(x, 3, 2)

    x = conv(conv(conv(x, "Conv2d_1a_3x3", 2), "Conv2d_2a_3x3"), "Conv2d_2b_3x3", 1, 1)
    x = pool(conv(conv(pool(x), "Conv2d_3b_1x1"), "Conv2d_4a_3x3"))
    for m in ("Mixed_5b", "Mixed_5c", "Mixed_5d"):
        five, three = chain(x, f"{m}.branch5x5", 0, 2), chain(x, f"{m}.branch3x3dbl", 0, 1, 1)
        x = torch.cat([conv(x, f"{m}.branch1x1"), five, three, conv(mean(x), f"{m}.branch_pool")], 1)
    double = chain(x, "Mixed_6a.branch3x3dbl", 0, 1, 0, last=2)
    x = torch.cat([conv(x, "Mixed_6a.branch3x3", 2), double, pool(x)], 1)
    row, column = (0, 3), (3, 0)
    for m in ("Mixed_6b", "Mixed_6c", "Mixed_6d", "Mixed_6e"):
        seven = chain(x, f"{m}.branch7x7", 0, row, column)
        double = chain(x, f"{m}.branch7x7dbl", 0, column, row, column, row)
        x = torch.cat([conv(x, f"{m}.branch1x1"), seven, double, conv(mean(x), f"{m}.branch_pool")], 1)
    three = chain(x, "Mixed_7a.branch3x3", 0, 0, last=2)
    x = torch.cat([three, chain(x, "Mixed_7a.branch7x7x3", 0, row, column, 0, last=2), pool(x)], 1)
    for m in ("Mixed_7b", "Mixed_7c"):
        pooled = mean(x) if m == "Mixed_7b" else functional.max_pool2d(x, 3, 1, 1)
        three = halves(conv(x, f"{m}.branch3x3_1"), f"{m}.branch3x3_2")
        double = halves(
            conv(conv(x, f"{m}.branch3x3dbl_1"), f"{m}.branch3x3dbl_2", 1, 1), f"{m}.branch3x3dbl_3"
        )
        x = torch.cat([conv(x, f"{m}.branch1x1"), *three, *double, conv(pooled, f"{m}.branch_pool")], 1)
    return x.mean(dim=(2, 3))


def test_the_network_is_that_of_pytorch_fid(state):
    network = InceptionNetwork().eval()
    torchvision, auxiliary, classifier = 27_161_264, 3_326_696, (2048 + 1) * 1000  # published
    assert sum(value.numel() for value in network.parameters()) == torchvision - auxiliary - classifier
    network.load_state_dict(state)
    images = torch.rand(2, 3, 107, 139) * 2 - 1
    with torch.no_grad():
        found, expected = network(images), features(state, images)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))
    assert expected.std() > 0.01


@pytest.mark.parametrize("size", [(401, 512), (120, 96)], ids=["reduced", "enlarged"])
def test_images_are_resized_as_by_clean_fid(size):
    """Bicubic with antialiasing, without rounding, within 8 bits beside a sharp edge; torch's has the same kernel."""
    image = picture(0, size).copy()
    image[:, : size[1] // 2] = 255
    image[: size[0] // 2] = 0
    x = torch.tensor(image).permute(2, 0, 1)[None].float()
    expected = functional.interpolate(x, (299, 299), mode="bicubic", antialias=True, align_corners=False)
    assert expected.min() < -1
    assert expected.max() > 256
    np.testing.assert_allclose(resized(image), expected[0].permute(1, 2, 0).clip(0, 255), atol=0.01)


def test_fid_is_the_distance_of_the_features_of_all_pairs(state, tmp_path, monkeypatch):
    torch.save({**state, "fc.weight": torch.zeros(1008, 2048)}, tmp_path / "weights.pth")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "weights.pth"))
    monkeypatch.setattr(fid, "BATCH", 2)
    pairs = [(picture(seed, (64, 80)), picture(seed + 20, (64, 80))) for seed in range(3)]
    with torch.no_grad():
        images, truth = (
            features(
                state,
                torch.tensor(np.stack([resized(pair[i]) for pair in pairs])).permute(0, 3, 1, 2) / 128 - 1,
            )
            for i in (0, 1)
        )
    value = Fid()(iter(pairs))
    assert value == pytest.approx(frechet_distance(images.double().numpy(), truth.double().numpy()), rel=1e-3)
    assert Fid()((truth, truth) for _, truth in pairs) == pytest.approx(0, abs=1e-6 * value)
    with pytest.raises(UnavailableError, match="two frames"):
        Fid()(pairs[:1])
    with pytest.raises(InputError, match="shape of the ground truth"):
        Fid()([(pairs[0][0], pairs[0][1][:-1])])
    torch.save({**state, "Conv2d_1a_3x3.bn.bias": torch.zeros(3)}, tmp_path / "other.pth")
    with pytest.raises(InputError, match=r"Conv2d_1a_3x3\.bn\.bias.*shape \(3,\)"):
        Inception(tmp_path / "other.pth")


def test_without_a_file_the_variable_is_named(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(UnavailableError, match=f"FID needs a network.*Set {VARIABLE}.*pytorch-fid"):
        Fid()([])

import operator

import cv2
import numpy as np
import pytest
import torch
from torch.nn import functional

from headbench.bench.errors import InputError, UnavailableError
from headbench.metrics.lpips import lpips
from headbench.metrics.lpips_network import NETWORKS, NO_WEIGHTS, VARIABLE, Lpips


@pytest.fixture
def random_weights(tmp_path):
    """A folder with random weights for every network: enough for whatever does not depend on their values."""
    torch.manual_seed(3)
    for spec in NETWORKS.values():
        torch.save(spec.build().state_dict(), tmp_path / spec.features_file)
    return tmp_path


def frames(count, size=(40, 48), seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, *size, 3), dtype=np.uint8)


@pytest.mark.parametrize(("net", "first", "second"), [("alex", 0.7219, 0.1376), ("squeeze", 0.7110, 0.1479)])
def test_published_check_images_have_their_reference_scores(reference_folder, net, first, second):
    reference, p0, p1 = (
        cv2.cvtColor(cv2.imread(str(reference_folder / "check_images" / f"ex_{n}.png")), cv2.COLOR_BGR2RGB)
        for n in ("ref", "p0", "p1")
    )
    metric = Lpips(net, weights=reference_folder)
    assert round(metric(p0, reference), 4) == first
    assert round(metric(p1, reference), 4) == second
    assert metric(reference, reference) == 0.0


def test_an_odd_size_has_the_score_that_torchmetrics_documents(reference_folder):
    """Its documentation's pair, here rounded to 8 bits; 100 pixels do not divide evenly in the pooling."""
    torch.manual_seed(42)
    images, truths = (torch.rand(2, 3, 100, 100).permute(0, 2, 3, 1) for _ in range(2))
    stacks = ((x * 255).round().to(torch.uint8).numpy() for x in (images, truths))
    scores = Lpips("squeeze", weights=reference_folder).distances(*stacks)
    np.testing.assert_allclose(scores, [0.1024, 0.0938], atol=1.5e-4)


def test_the_metric_of_the_registry_is_alexnet(reference_folder, bare_machine, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(reference_folder))
    a, b = frames(2)
    assert lpips(a, b) == Lpips("alex", weights=reference_folder)(a, b)
    assert lpips(a, b) != Lpips("squeeze", weights=reference_folder)(a, b)


@pytest.mark.parametrize("net", NETWORKS)
def test_equals_the_definition_in_float64(random_weights, net):
    """Equation 1 written out with plain functional calls for the layers' outputs."""
    metric = Lpips(net, weights=random_weights)
    a, b = frames(2)
    network = NETWORKS[net].build().double()
    network.load_state_dict(torch.load(random_weights / NETWORKS[net].features_file, weights_only=True))

    def features(image):
        x = torch.tensor(image, dtype=torch.float64).permute(2, 0, 1)[None] / 255 * 2 - 1
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x = (x - shift[:, None, None]) / scale[:, None, None]
        with torch.no_grad():
            return [functional.normalize(f, dim=1)[0].numpy() for f in network(x)]

    expected = 0.0
    for fa, fb, weight in zip(features(a), features(b), metric._linear, strict=True):
        expected += np.einsum("chw,c->hw", (fa - fb) ** 2, weight.double().numpy().ravel()).mean()
    assert metric(a, b) == pytest.approx(expected, rel=1e-4)


def test_symmetry_identity_and_batches(random_weights):
    metric = Lpips("squeeze", weights=random_weights)
    images, truths = frames(5), frames(5, seed=1)
    one_by_one = [metric(a, b) for a, b in zip(images, truths)]
    assert metric(truths[0], images[0]) == pytest.approx(one_by_one[0], rel=1e-6)
    assert metric(images[0], images[0]) == 0.0
    np.testing.assert_allclose(metric.distances(images, truths), one_by_one, rtol=1e-5)
    pairs = iter(list(zip(images, truths)))
    batches = metric.batched(pairs, size=2)
    assert next(batches) == pytest.approx(one_by_one[0], rel=1e-5)
    assert operator.length_hint(pairs) == 3  # read lazily
    np.testing.assert_allclose(list(batches), one_by_one[1:], rtol=1e-5)
    assert metric.distances(images[:0], truths[:0]).shape == (0,)
    # Cameras of one capture may have images of different sizes.
    mixed = [(a[:40], b[:40]) if i % 3 else (a, b) for i, (a, b) in enumerate(zip(images, truths))]
    np.testing.assert_allclose(list(metric.batched(mixed)), [metric(a, b) for a, b in mixed], rtol=1e-5)


def test_frames_a_network_cannot_see_have_no_value(random_weights):
    metric = Lpips("alex", weights=random_weights)
    small = frames(1, (30, 64))[0]
    with pytest.raises(UnavailableError, match="at least 31 x 31 pixels; these have 64 x 30"):
        metric(small, small)
    with pytest.raises(InputError, match="two stacks"):
        metric.distances(frames(2), frames(3))


def test_the_fingerprint_tells_weights_apart_and_not_files(random_weights, tmp_path):
    state = torch.load(random_weights / "alexnet_features.pth", weights_only=True)
    full = {**state, "classifier.1.bias": torch.zeros(3)}
    torch.save(full, tmp_path / "full.pth")
    other = {**state, "features.0.bias": state["features.0.bias"] + 1e-3}
    torch.save(other, tmp_path / "other.pth")
    first, second, third = (
        Lpips(weights=path).fingerprint
        for path in (random_weights / "alexnet_features.pth", tmp_path / "full.pth", tmp_path / "other.pth")
    )
    assert first == second != third


def test_without_weights_every_call_is_unavailable_asking_once(bare_machine):
    a, b = frames(2)
    for _ in range(3):
        with pytest.raises(UnavailableError, match=VARIABLE) as caught:
            lpips(a, b)
        assert caught.value.note == NO_WEIGHTS
    assert len(bare_machine) == 1


@pytest.mark.filterwarnings("error")
def test_read_only_and_mirrored_frames_are_fine(random_weights):
    metric = Lpips("squeeze", weights=random_weights)
    a, b = frames(2)
    expected = metric(a[:, ::-1].copy(), b)
    a.flags.writeable = b.flags.writeable = False
    assert metric(a[:, ::-1], b) == expected


def test_ground_truth_seen_before_is_not_read_again(random_weights):
    truths = frames(4, seed=1)
    fresh, cached = (Lpips("alex", weights=random_weights, cache_mb=mb) for mb in (0, 100))
    looked_at = []
    network = cached._network
    cached._network = lambda x: looked_at.append(len(x)) or network(x)
    for method in range(3):
        images = frames(4, seed=10 + method)
        np.testing.assert_array_equal(cached.distances(images, truths), fresh.distances(images, truths))
    assert looked_at == [4, 4, 4, 4]  # images, truths; then images alone


def test_the_cache_stays_within_its_bound_and_tells_sizes_apart(random_weights):
    metric = Lpips("squeeze", weights=random_weights, cache_mb=0.5)
    for seed in range(30):
        metric(*frames(2, seed=seed))
        assert metric._held <= 0.5e6
    assert metric._cache
    one = np.full((32, 64, 3), 90, np.uint8)
    other = one.reshape(64, 32, 3)  # the same bytes
    expected = Lpips("squeeze", weights=random_weights, cache_mb=0)(other // 2, other)
    metric(one // 2, one)
    assert metric(other // 2, other) == pytest.approx(expected, rel=1e-6)

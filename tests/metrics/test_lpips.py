import hashlib
import io
import operator
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from torch.nn import functional

from headbench.bench.conformance.methods import picture
from headbench.bench.errors import InputError, LeftOutError, UnavailableError
from headbench.metrics import lpips_network as weights
from headbench.metrics.lpips import lpips, lpips_face, lpips_squeeze
from headbench.metrics.lpips_network import ALEX, NETWORKS, NO_WEIGHTS, SQUEEZE, VARIABLE, Lpips, read_weights


@pytest.fixture
def state():
    torch.manual_seed(0)
    return SQUEEZE.build().state_dict()


def test_places_are_searched_in_order(bare_machine, tmp_path, monkeypatch):
    hub = tmp_path / "hub" / "checkpoints" / SQUEEZE.file
    own = weights.cache_folder() / SQUEEZE.features_file
    variable = tmp_path / "variable.pth"
    explicit = tmp_path / "folder" / SQUEEZE.features_file
    for path in (hub, own, variable, explicit):
        path.parent.mkdir(parents=True, exist_ok=True)
    hub.touch()
    assert weights.find_backbone(SQUEEZE) == hub
    own.touch()
    assert weights.find_backbone(SQUEEZE) == own
    variable.touch()
    monkeypatch.setenv(weights.VARIABLE, str(variable))
    assert weights.find_backbone(SQUEEZE) == variable
    explicit.touch()
    assert weights.find_backbone(SQUEEZE, explicit.parent) == explicit
    assert bare_machine == []


def test_a_variable_with_another_network_s_file_is_passed_over(bare_machine, tmp_path, monkeypatch):
    alex = tmp_path / ALEX.features_file
    own = weights.cache_folder() / SQUEEZE.file
    own.parent.mkdir(parents=True, exist_ok=True)
    for path in (alex, own):
        path.touch()
    monkeypatch.setenv(weights.VARIABLE, str(alex))
    assert (weights.find_backbone(ALEX), weights.find_backbone(SQUEEZE)) == (alex, own)
    assert bare_machine == []


def test_a_named_place_without_weights_is_no_reason_to_look_on(bare_machine, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="not there"):
        weights.find_backbone(SQUEEZE, tmp_path / "nowhere")
    monkeypatch.setenv(weights.VARIABLE, str(tmp_path))
    with pytest.raises(
        UnavailableError, match=f"squeeze.*{weights.VARIABLE}.*Download {SQUEEZE.url}"
    ) as caught:
        weights.find_backbone(SQUEEZE)  # a folder may well hold those of another network
    assert caught.value.note == weights.NO_WEIGHTS
    assert bare_machine == []


def test_without_weights_or_network_the_remedy_is_named_once(bare_machine):
    for _ in range(2):
        with pytest.raises(UnavailableError) as caught:
            weights.find_backbone(SQUEEZE)
        for part in ("the network is down", SQUEEZE.url, str(weights.cache_folder()), weights.VARIABLE):
            assert part in str(caught.value)
        assert caught.value.note == weights.NO_WEIGHTS
    assert bare_machine == [(SQUEEZE.url, weights.TIMEOUT_S)]


def test_what_is_fetched_is_kept_only_with_the_right_hash(bare_machine, monkeypatch, state):
    buffer = io.BytesIO()
    torch.save(state, buffer)
    prefix = hashlib.sha256(buffer.getvalue()).hexdigest()[:8]
    monkeypatch.setattr("urllib.request.urlopen", lambda url, timeout: io.BytesIO(buffer.getvalue()))
    good, bad = (replace(SQUEEZE, file=f"net-{p}.pth", features_file="none") for p in (prefix, "00000000"))
    path = weights.find_backbone(good)
    assert path == weights.cache_folder() / good.file
    assert weights.load_backbone(SQUEEZE, path).keys() == state.keys()
    with pytest.raises(UnavailableError, match=f"SHA-256 is {prefix}"):
        weights.find_backbone(bad)
    assert [p.name for p in weights.cache_folder().iterdir()] == [good.file]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda s: s.pop("features.3.squeeze.bias"), r"features\.3\.squeeze\.bias.*no such entry"),
        (lambda s: s.update({"features.0.bias": torch.zeros(63)}), r"features\.0\.bias.*shape \(63,\)"),
        (lambda s: s.update({"features.0.bias": torch.full((64,), torch.nan)}), "finite"),
        (lambda s: s.update({"features.0.bias": torch.zeros(64, dtype=torch.int32)}), "int32"),
        (lambda s: s.update({"features.0.bias": "text"}), "found str"),
    ],
)
def test_a_faulty_entry_is_named(tmp_path, state, spoil, message):
    spoil(state)
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(InputError, match=message):
        weights.load_backbone(SQUEEZE, tmp_path / "w.pth")


def test_linear_layers_of_torchmetrics_equal_the_reference(reference_folder):
    for net, spec in weights.NETWORKS.items():
        ours = weights.load_linear(spec)
        theirs = weights.load_linear(spec, reference_folder / "lin_v0.1" / f"{net}.pth")
        assert [w.shape[1] for w in ours] == list(spec.channels)
        for a, b in zip(ours, theirs, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)
            assert (a >= 0).all()


BASE = torch.arange(24.0).reshape(2, 3, 4)
STATE = {
    "plain": BASE,
    "half": BASE[0].half(),
    "double": BASE[1].double(),
    "turned": BASE.permute(2, 0, 1),
    "expanded": torch.ones(1, 3).expand(1, 3),
    "scalar": torch.tensor(3.0),
    "empty": torch.zeros(0, 2),
    "parameter": torch.nn.Parameter(torch.ones(2)),
    "other": torch.arange(3, dtype=torch.int32),
}
WANTED = {name: tuple(value.shape) for name, value in STATE.items() if name != "other"}


def saved(state, new=True) -> bytes:
    stream = io.BytesIO()
    torch.save(state, stream, _use_new_zipfile_serialization=new)
    return stream.getvalue()


@pytest.mark.parametrize("new", [False, True])
def test_tensors_are_those_that_torch_reads(tmp_path, new):
    (tmp_path / "w.pth").write_bytes(saved(STATE, new))
    found = read_weights(tmp_path / "w.pth", WANTED)
    assert [*found] == [*WANTED]
    for name, values in found.items():
        assert torch.equal(values, STATE[name].detach().float())
        assert values.dtype == torch.float32


class Call:
    """Pickles as a call."""

    def __reduce__(self):
        return os.mkdir, ("made-by-a-pickle",)


DAMAGED = {
    "a sparse tensor": saved({"plain": torch.zeros(200).to_sparse()}),
    "another shape": saved({"plain": torch.zeros(201)}),
    "integers": saved({"plain": torch.zeros(200, dtype=torch.int32)}),
    "infinite numbers": saved({"plain": torch.full((200,), torch.inf)}),
    "no tensor": saved({"plain": 1}),
    "another name": saved({"other": torch.zeros(200)}),
    "a call": saved({"plain": Call()}),
    "a call in the old layout": saved({"plain": Call()}, new=False),
    "a truncated file": saved({"plain": torch.zeros(200)})[:-100],
    "an archive without a pickle": b"PK\x05\x06" + bytes(18),
    "a list": saved([1, 2]),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_other_files_are_refused_and_nothing_is_run(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "w.pth"
    path.write_bytes(DAMAGED[name])
    with pytest.raises(InputError) as caught:
        read_weights(path, {"plain": (200,)})
    assert caught.value.file == str(path)
    assert "weights_only" not in str(caught.value)
    assert [*tmp_path.iterdir()] == [path]


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


def test_metrics_of_the_registry_name_their_networks(random_weights, bare_machine, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(random_weights))
    a, b = frames(2)
    values = lpips(a, b), lpips_squeeze(a, b)
    assert values == tuple(Lpips(net, weights=random_weights)(a, b) for net in ("alex", "squeeze"))
    assert values[0] != values[1]


def test_squeezenet_is_that_of_the_publication(random_weights):
    """SqueezeNet 1.1 in functional calls, by the names of torchvision's parameters."""
    state = torch.load(random_weights / SQUEEZE.features_file, weights_only=True)
    image = torch.rand(1, 3, 47, 64)

    def layer(x, name, **options):
        weight, bias = state[f"features.{name}.weight"], state[f"features.{name}.bias"]
        return functional.conv2d(x, weight, bias, **options).relu()

    x = layer(image, "0", stride=2)
    expected = [x]
    for number in range(2, 13):
        if number in (2, 5, 8):
            x = functional.max_pool2d(x, 3, 2, ceil_mode=True)
            continue
        x = layer(x, f"{number}.squeeze")
        x = torch.cat([layer(x, f"{number}.expand1x1"), layer(x, f"{number}.expand3x3", padding=1)], 1)
        if number in (4, 7, 9, 10, 11, 12):
            expected.append(x)
    network = SQUEEZE.build()
    network.load_state_dict(state)
    for ours, theirs in zip(network(image), expected, strict=True):
        torch.testing.assert_close(ours, theirs)


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


@pytest.fixture
def alex(random_weights, monkeypatch, bare_machine):
    """The network of the metric of the face."""
    monkeypatch.setenv(VARIABLE, str(random_weights))
    return Lpips("alex", weights=random_weights)


def mask(size, rows, columns):
    inside = np.zeros(size, np.bool_)
    inside[slice(*rows), slice(*columns)] = True
    return inside


def enlarged(image):
    return cv2.resize(image, (256, 256), interpolation=cv2.INTER_LINEAR)


def test_lpips_of_the_face_is_that_of_the_cut_images(alex):
    a, b = frames(2, (80, 60))
    high = mask((80, 60), (10, 42), (20, 40))  # 32 rows, centre at column 30
    assert lpips_face(a, b, high) == alex(enlarged(a[10:42, 14:46]), enlarged(b[10:42, 14:46]))
    beside = mask((80, 60), (10, 50), (0, 12))  # columns -14 to 26
    wide = (np.pad(image, ((0, 0), (14, 0), (0, 0)), "edge") for image in (a, b))
    assert lpips_face(a, b, beside) == alex(*(enlarged(image[10:50, :40]) for image in wide))
    whole = frames(2, (512, 512))
    means = (image.reshape(256, 2, 256, 2, 3).mean(axis=(1, 3)) for image in whole)
    halved = [np.floor(each + 0.5).astype(np.uint8) for each in means]
    assert lpips_face(*whole, np.ones((512, 512), np.bool_)) == pytest.approx(alex(*halved), rel=1e-3)


def test_what_is_beside_the_crop_of_the_face_does_not_matter(alex):
    a, b = frames(2, (80, 60))
    face = mask((80, 60), (10, 42), (20, 40))
    crop = mask((80, 60), (10, 42), (14, 46))[..., None]
    value = lpips_face(a, b, face)
    for level in (0, 255):
        assert lpips_face(np.where(crop, a, level).astype(np.uint8), b, face) == value
    assert lpips_face(np.where(crop, 128, a).astype(np.uint8), b, face) != value


def test_the_size_of_the_frame_hardly_changes_the_face(alex):
    large = [cv2.GaussianBlur(picture(seed, (384, 384)), (0, 0), 8) for seed in (1, 2)]
    small = [cv2.resize(image, (128, 128), interpolation=cv2.INTER_AREA) for image in large]
    face = mask((384, 384), (60, 330), (60, 330))
    expected = lpips_face(*large, face)
    assert lpips_face(*small, face[1::3, 1::3]) == pytest.approx(expected, rel=0.03)
    assert alex(*small) != pytest.approx(alex(*large), rel=0.1)


@pytest.mark.parametrize(
    ("rows", "columns"),
    [((0, 0), (0, 0)), ((5, 20), (5, 20)), ((10, 50), (30, 39))],
    ids=["none", "15", "9/40"],
)
def test_a_face_that_is_hardly_seen_is_left_out(alex, rows, columns):
    a, b = frames(2, (80, 60))
    with pytest.raises(LeftOutError, match="off screen or turned away"):
        lpips_face(a, b, mask((80, 60), rows, columns))

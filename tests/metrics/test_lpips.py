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

from headbench.bench.errors import InputError, UnavailableError
from headbench.metrics import lpips_network as weights
from headbench.metrics.lpips import lpips
from headbench.metrics.lpips_network import ALEX, NETWORKS, NO_WEIGHTS, VARIABLE, VGG, Lpips, read_weights


@pytest.fixture
def state():
    torch.manual_seed(0)
    return ALEX.build().state_dict()


def test_places_are_searched_in_order(bare_machine, tmp_path, monkeypatch):
    hub = tmp_path / "hub" / "checkpoints" / ALEX.file
    own = weights.cache_folder() / ALEX.features_file
    variable = tmp_path / "variable.pth"
    explicit = tmp_path / "folder" / ALEX.features_file
    for path in (hub, own, variable, explicit):
        path.parent.mkdir(parents=True, exist_ok=True)
    hub.touch()
    assert weights.find_backbone(ALEX) == hub
    own.touch()
    assert weights.find_backbone(ALEX) == own
    variable.touch()
    monkeypatch.setenv(weights.VARIABLE, str(variable))
    assert weights.find_backbone(ALEX) == variable
    explicit.touch()
    assert weights.find_backbone(ALEX, explicit.parent) == explicit
    assert bare_machine == []


def test_a_variable_with_another_network_s_file_is_passed_over(bare_machine, tmp_path, monkeypatch):
    alex = tmp_path / ALEX.features_file
    own = weights.cache_folder() / VGG.file
    own.parent.mkdir(parents=True, exist_ok=True)
    for path in (alex, own):
        path.touch()
    monkeypatch.setenv(weights.VARIABLE, str(alex))
    assert (weights.find_backbone(ALEX), weights.find_backbone(VGG)) == (alex, own)
    assert bare_machine == []


def test_a_named_place_without_weights_is_no_reason_to_look_on(bare_machine, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="not there"):
        weights.find_backbone(ALEX, tmp_path / "nowhere")
    monkeypatch.setenv(weights.VARIABLE, str(tmp_path))
    with pytest.raises(UnavailableError, match=f"alex.*{weights.VARIABLE}.*Download {ALEX.url}") as caught:
        weights.find_backbone(ALEX)  # a folder may well hold those of another network
    assert caught.value.note == weights.NO_WEIGHTS
    assert bare_machine == []


def test_without_weights_or_network_the_remedy_is_named_once(bare_machine):
    for _ in range(2):
        with pytest.raises(UnavailableError) as caught:
            weights.find_backbone(ALEX)
        for part in ("the network is down", ALEX.url, str(weights.cache_folder()), weights.VARIABLE):
            assert part in str(caught.value)
        assert caught.value.note == weights.NO_WEIGHTS
    assert bare_machine == [(ALEX.url, weights.TIMEOUT_S)]


def test_what_is_fetched_is_kept_only_with_the_right_hash(bare_machine, monkeypatch, state):
    buffer = io.BytesIO()
    torch.save(state, buffer)
    prefix = hashlib.sha256(buffer.getvalue()).hexdigest()[:8]
    monkeypatch.setattr("urllib.request.urlopen", lambda url, timeout: io.BytesIO(buffer.getvalue()))
    good, bad = (replace(ALEX, file=f"net-{p}.pth", features_file="none") for p in (prefix, "00000000"))
    path = weights.find_backbone(good)
    assert path == weights.cache_folder() / good.file
    assert weights.load_backbone(ALEX, path).keys() == state.keys()
    with pytest.raises(UnavailableError, match=f"SHA-256 is {prefix}"):
        weights.find_backbone(bad)
    assert [p.name for p in weights.cache_folder().iterdir()] == [good.file]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda s: s.pop("features.3.bias"), r"features\.3\.bias.*no such entry"),
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
        weights.load_backbone(ALEX, tmp_path / "w.pth")


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


def test_published_check_images_have_their_reference_scores(reference_folder):
    reference, p0, p1 = (
        cv2.cvtColor(cv2.imread(str(reference_folder / "check_images" / f"ex_{n}.png")), cv2.COLOR_BGR2RGB)
        for n in ("ref", "p0", "p1")
    )
    metric = Lpips(weights=reference_folder)
    assert round(metric(p0, reference), 4) == 0.7219
    assert round(metric(p1, reference), 4) == 0.1376
    assert metric(reference, reference) == 0.0


def test_the_metric_of_the_registry_is_alexnet(reference_folder, bare_machine, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(reference_folder))
    a, b = frames(2)
    assert lpips(a, b) == Lpips("alex", weights=reference_folder)(a, b)


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
    metric = Lpips("alex", weights=random_weights)
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


def test_without_weights_every_call_is_unavailable_asking_once(bare_machine):
    a, b = frames(2)
    for _ in range(3):
        with pytest.raises(UnavailableError, match=VARIABLE) as caught:
            lpips(a, b)
        assert caught.value.note == NO_WEIGHTS
    assert len(bare_machine) == 1


@pytest.mark.filterwarnings("error")
def test_read_only_and_mirrored_frames_are_fine(random_weights):
    metric = Lpips("alex", weights=random_weights)
    a, b = frames(2)
    expected = metric(a[:, ::-1].copy(), b)
    a.flags.writeable = b.flags.writeable = False
    assert metric(a[:, ::-1], b) == expected

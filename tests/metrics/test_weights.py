import hashlib
import io
from dataclasses import replace

import pytest
import torch

from headbench.bench.errors import InputError, UnavailableError
from headbench.metrics import lpips_network as weights
from headbench.metrics.lpips_network import ALEX, SQUEEZE


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

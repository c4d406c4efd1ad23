from importlib.metadata import EntryPoint

import pytest

from headbench.bench import registry
from headbench.bench.errors import HeadbenchError, InputError
from headbench.bench.specs import MetricSpec, ProfileSpec


def with_entries(monkeypatch, *entries):
    monkeypatch.setattr(registry, "entry_points", lambda group: list(entries))


def entry(name, value):
    return EntryPoint(name, value, "headbench.metrics")


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(InputError, match="Did you mean 'psnr'.*installed here"):
        registry.get("metrics", "pnsr")


def test_a_broken_plugin_is_listed_and_raises_when_asked_for(monkeypatch, toy):
    with_entries(monkeypatch, entry("gone", "no_such_module:SPEC"), entry("good", "toy_plugin:ERROR"))
    plugins = registry.discover("metrics")
    assert plugins["good"].spec is toy.ERROR
    assert "no_such_module" in plugins["gone"].error
    with pytest.raises(HeadbenchError, match="broken"):
        registry.get("metrics", "gone")


def test_an_entry_of_the_wrong_kind_is_broken(monkeypatch, toy):
    with_entries(monkeypatch, entry("method", "toy_plugin:METHOD"))
    assert "MetricSpec" in registry.discover("metrics")["method"].error


def test_a_plugin_that_raises_on_import_leaves_others_usable(monkeypatch, toy, tmp_path):
    (tmp_path / "explodes.py").write_text("raise SystemError('boom')")
    monkeypatch.syspath_prepend(tmp_path)
    with_entries(monkeypatch, entry("explodes", "explodes:SPEC"), entry("good", "toy_plugin:ERROR"))
    plugins = registry.discover("metrics")
    assert plugins["explodes"].spec is None
    assert isinstance(plugins["good"].spec, MetricSpec)


def test_the_first_party_wins_a_clash_of_names(monkeypatch, toy, caplog):
    other, own = entry("psnr", "toy_plugin:NOT_HERE"), entry("psnr", "toy_plugin:ERROR")
    monkeypatch.setattr(registry, "_origin", lambda e: "headbench" if e is own else "other")
    with_entries(monkeypatch, other, own)
    assert registry.discover("metrics")["psnr"].spec is toy.ERROR
    assert "hidden" in caplog.text


def test_a_spec_not_yet_packaged_is_reached_by_module(toy):
    assert registry.get("methods", "toy_plugin:METHOD") is toy.METHOD
    with pytest.raises(HeadbenchError, match="cannot be imported"):
        registry.get("methods", "toy_plugin:NOTHING")


@pytest.mark.parametrize(
    "name", [":", "toy_plugin:", "toy_plugin:NOTHING", ".toy_plugin:METHOD", "no.such:METHOD"]
)
def test_a_reference_that_leads_nowhere_is_refused(toy, name):
    with pytest.raises(HeadbenchError, match="cannot be imported"):
        registry.get("methods", name)


@pytest.mark.parametrize(
    "changes", [{"profile": "canonical"}, {"name": "psnr"}, {"tables": ("comparison",)}], ids=str
)
def test_a_profile_with_the_label_of_another_metric_is_refused(changes):
    own = {"name": "psnr@lab", "profile": "lab", "tables": ("lab",)}
    metric = MetricSpec(
        **(own | changes), label="P", unit="", higher_is_better=True, digits=2, implementation="a:b"
    )
    with pytest.raises(ValueError, match="psnr"):
        ProfileSpec("lab", "in Lab", "", (metric,))


def test_a_plugin_installed_meanwhile_is_found(toy, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    assert "late" not in registry.discover("metrics")
    installed = tmp_path / "late-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: late\nVersion: 1.0\n")
    (installed / "entry_points.txt").write_text("[headbench.metrics]\nlate = toy_plugin:ERROR\n")
    assert registry.discover("metrics")["late"].origin == "late 1.0"
    assert registry.get("metrics", "late") is toy.ERROR

import importlib
import sys
from importlib.metadata import EntryPoint

import pytest

from headbench.bench import registry
from headbench.bench.errors import HeadbenchError, InputError
from headbench.bench.registry import code_digest, forget_code, is_outside
from headbench.bench.specs import MetricSpec, ProfileSpec

FILE = {"plug.py": "class M: pass", "beside.py": "", "further/near.py": "", "notes.txt": ""}
PACKAGE = {"plug/__init__.py": "", "plug/deep/__init__.py": "", "plug/deep/impl.py": "class M: pass"}
PACKAGE |= {"plug/net/layers.py": "", "plug/data/table.csv": "", "plug_tests/test.py": ""}
FOLDER = {"plug/impl.py": "class M: pass", "plug/net.py": "", "other/__init__.py": ""}


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Write files into a folder on the module path; return the digest of an object as a new process would find it."""
    monkeypatch.syspath_prepend(tmp_path)

    def drop():
        for name in [name for name in sys.modules if name.partition(".")[0] == "plug"]:
            del sys.modules[name]
        importlib.invalidate_caches()
        forget_code()

    def write(files, reference):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        drop()
        return code_digest(reference)

    yield write
    drop()


@pytest.mark.parametrize(
    ("files", "reference", "counted"),
    [
        (FILE, "plug:M", {"plug.py", "beside.py"}),
        (PACKAGE, "plug.deep.impl:M", {name for name in PACKAGE if name.startswith("plug/")} - {"plug/data/table.csv"}),
        (FOLDER, "plug.impl:M", {"plug/impl.py", "plug/net.py"}),
    ],
    ids=["file", "package", "folder"],
)  # fmt: skip
def test_an_edit_counts_in_each_file_of_the_code(write, files, reference, counted):
    known = write(files, reference)
    assert len(known) == 12
    changed = {
        name for name, text in files.items() if write({**files, name: f"{text}\n#"}, reference) != known
    }
    assert changed == counted
    assert write(files, reference) == known


def test_code_of_this_package_is_the_folder_of_the_module():
    ga, config = (code_digest(f"headbench.methods.ga.{name}") for name in ("spec:GA", "method:GAAppearance"))
    assert ga == config != code_digest("headbench.methods.gbs.spec:GBS")
    assert [is_outside(f"{name}:X") for name in ("headbench.methods.ga.spec", "toy")] == [False, True]


def with_entries(monkeypatch, *entries):
    monkeypatch.setattr(registry, "entry_points", lambda group: list(entries))


def entry(name, value):
    return EntryPoint(name, value, "headbench.metrics")


def test_a_broken_plugin_is_listed_and_raises_when_asked_for(monkeypatch, toy, tmp_path):
    (tmp_path / "explodes.py").write_text("raise SystemError('boom')")
    monkeypatch.syspath_prepend(tmp_path)
    broken = {"gone": "no_such_module:SPEC", "method": "toy_plugin:METHOD", "explodes": "explodes:SPEC"}
    entries = [entry(*each) for each in broken.items()]
    with_entries(monkeypatch, *entries, entry("good", "toy_plugin:ERROR"))
    plugins = registry.discover("metrics")
    assert plugins["good"].spec is toy.ERROR
    for name, why in {"gone": "no_such_module", "method": "MetricSpec", "explodes": "boom"}.items():
        assert why in plugins[name].error
        with pytest.raises(HeadbenchError, match="broken"):
            registry.get("metrics", name)
    with pytest.raises(InputError, match="Did you mean 'good'"):
        registry.get("metrics", "goood")


def test_of_many_names_the_nearest_are_shown():
    known = [f"metric-{number}" for number in range(40)]
    error = str(registry.unknown("file", "name", "metric-399", known))
    assert "expected one of metric-39, " in error
    assert "or 35 others, found 'metric-399'" in error
    assert "one of metric-0, metric-1, found" in str(registry.unknown("file", "name", "x", known[:2]))


def test_the_first_party_wins_a_clash_of_names(monkeypatch, toy, caplog):
    other, own = entry("psnr", "toy_plugin:NOT_HERE"), entry("psnr", "toy_plugin:ERROR")
    monkeypatch.setattr(registry, "_origin", lambda e: "headbench" if e is own else "other")
    with_entries(monkeypatch, other, own)
    assert registry.discover("metrics")["psnr"].spec is toy.ERROR
    assert "hidden" in caplog.text


def test_a_spec_not_yet_packaged_is_reached_by_module(toy):
    assert registry.get("methods", "toy_plugin:METHOD") is toy.METHOD
    for name in (":", "toy_plugin:", "toy_plugin:NOTHING", ".toy_plugin:METHOD", "no.such:METHOD"):
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

"""The reference has an entry for everything that is registered, and pages call commands and options that exist."""

import re
from collections import defaultdict
from importlib.metadata import entry_points
from pathlib import Path

import pytest

import headbench
from headbench.bench import cli
from headbench.bench.configuration import setting_paths
from headbench.bench.engine.config import RunConfig
from headbench.bench.errors import ExitCode
from headbench.bench.executors.settings import Execution
from headbench.bench.registry import discover, resolve
from headbench.bench.rows import COLUMNS
from headbench.datasets.lint.catalogue import RULES

ROOT = Path(__file__).parents[2]
PAGES = [
    path
    for path in [ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("**/README.md")]
    if not {".venv", "build", "generated"} & set(path.relative_to(ROOT).parts)
    and not any(part.startswith((".", "work-")) for part in path.relative_to(ROOT).parts)
]
ENTRY = re.compile(r"^:::\{(\w+)\} (\S+)", re.MULTILINE)
EMPTY = re.compile(r":::\{(?:option|confval)\} (.+)\n(?::[\w-]+:.*\n)*\n*:::")


def installed(group):
    """Names of the entry points of headbench's own distribution."""
    return {
        entry.name for entry in entry_points(group=f"headbench.{group}") if entry.dist.name == "headbench"
    }


@pytest.fixture(scope="module")
def entries(reference):
    """Names of the entries of the reference by their kind; options by command."""
    found = defaultdict(set)
    for page, text in reference.items():
        for kind, name in ENTRY.findall(text):
            found[kind].add((page, name) if kind == "option" else name)
    return found


def test_every_command_has_a_page(reference):
    listed = {name.partition("/")[2] for name in reference if name.startswith("commands/")} - {"index"}
    assert listed == {name.replace(" ", "-") for name in installed("commands")}


@pytest.mark.commands
def test_every_option_of_the_help_has_an_entry(entries, capsys):
    assert installed("commands")
    for command in sorted(installed("commands")):
        assert cli.main([*command.split(), "--help"]) == 0
        shown = re.findall(r"^[│|]? {1,2}(--[a-z][a-z0-9-]*)(?=\s|│)", capsys.readouterr().out, re.MULTILINE)
        page = f"commands/{command.replace(' ', '-')}"
        listed = {name for of, name in entries["option"] if of == page and name.startswith("--")}
        assert set(shown) - {"--help"} == listed, command


def command_lines(text):
    """Command lines of headbench in blocks of code and in inline code, without comments."""
    fenced = re.findall(r"^```(?:bash|yaml)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line for block in fenced for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"`(headbench [^`]+)`", text.replace("\n", " "))
    return [found[1] for line in lines if (found := re.search(r"\b(headbench [a-z][^#|;]*)", line))]


def test_commands_on_pages_exist_with_their_options(entries):
    known, wrong, lines = installed("commands"), [], 0
    for page in PAGES:
        for line in command_lines(page.read_text(encoding="utf-8")):
            lines += 1
            words = line.split()[1:]
            name = next((name for name in (" ".join(words[:2]), words[0]) if name in known), None)
            group = any(other.startswith(f"{words[0]} ") for other in known)
            options = {word.partition("=")[0] for word in words if re.match(r"--[a-z]", word)}
            listed = {
                (f"commands/{(name or '').replace(' ', '-')}", option) for option in options - {"--help"}
            }
            if (name is None and not group) or not listed <= entries["option"]:
                wrong.append((page.name, line))
    assert wrong == []
    assert lines > 100


def test_command_lines_are_found_on_pages():
    text = (
        "```bash\nPYTHONPATH=. headbench run --data a \\\n  --out b  # why\n```\nor `headbench\nlist methods`"
    )
    assert command_lines(text) == ["headbench run --data a    --out b  ", "headbench list methods"]


def test_every_setting_has_an_entry(entries):
    names = set()
    for cls, prefix in [(RunConfig, ""), (Execution, "execution.")]:
        names |= {f"{prefix}{path}" for path in leaves(cls)}
    for method, plugin in discover("methods").items():
        if plugin.spec.config and plugin.origin.startswith("headbench "):
            cls = resolve(plugin.spec.config)
            names |= {f"settings.{method}.{path}" for path in leaves(cls)}
            for values in plugin.spec.presets.values():
                names |= {f"settings.{method}.{path}" for path in flattened(values)}
    assert len(names) > 300
    assert sorted(names - entries["confval"]) == []


def leaves(cls):
    """Settings that hold a value, not a group of settings."""
    paths = setting_paths(cls)
    return [path for path in paths if not any(other.startswith(f"{path}.") for other in paths)]


def flattened(values, prefix=""):
    for key, value in values.items():
        yield from flattened(value, f"{prefix}{key}.") if isinstance(value, dict) else [f"{prefix}{key}"]


def test_every_option_and_setting_is_explained(reference):
    assert [name for text in reference.values() for name in EMPTY.findall(text)] == []


def test_every_registered_name_has_an_entry(entries):
    metrics = [metric.name for plugin in discover("profiles").values() for metric in plugin.spec.metrics]
    expected = {
        "lint": {rule.code for rule in RULES},
        "metric": installed("metrics") | set(metrics),
        "profile": installed("profiles"),
        "condition": installed("conditions"),
        "exitcode": {str(code.value) for code in ExitCode},
    }
    assert all(expected.values())
    missing = {kind: sorted(names - entries[kind]) for kind, names in expected.items()}
    assert not any(missing.values()), missing


def test_every_public_name_has_an_entry(reference):
    api = "\n".join(text for page, text in reference.items() if page.startswith("api/"))
    documented = set(re.findall(r"headbench\.(\w+)", api))
    assert set(headbench.__all__) <= documented


def test_formats_state_writer_and_check(reference):
    rows = re.findall(r"^\| (.+) \| (.+) \| (.+) \| `(.+)` \|$", reference["formats"], re.MULTILINE)
    checked = [row for row in rows if row[2] != "**not checked**"]
    assert f"{len(checked)} of {len(rows)} formats were checked" in reference["formats"]
    for name in ("loaders", "drive/formats", "drive/signal", "import_ga", *READ_PACKAGES):
        assert any(name in row[3] for row in rows), name
    for _, _, check, _ in checked:
        assert re.search(r"\w+/[\w.-]+@[0-9a-f]{8}\b|(wheel|package).*`?[\w./]+", check), check


READ_PACKAGES = (
    "datasets/ga",
    "datasets/colmap",
    "datasets/monocular",
    "datasets/nersemble",
    "datasets/tracker_files",
)
"""Packages of readers of other programs' captures."""


def test_every_environment_variable_is_listed():
    page = (ROOT / "docs" / "reference" / "environment.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^\| `(\w+)`", page, re.MULTILINE))
    sources = [
        path.read_text(encoding="utf-8")
        for package in ("bench", "datasets", "methods", "metrics", "reports")
        for path in (ROOT / package).rglob("*.py")
    ]
    own = {name for text in sources for name in re.findall(r"""["'](HEADBENCH_[A-Z_]+[A-Z])["']""", text)}
    assert own
    assert own <= listed


def test_every_column_of_rows_is_explained():
    page = (ROOT / "docs" / "reference" / "run-folder.md").read_text(encoding="utf-8")
    table = page.split("## Columns of rows.parquet")[1].split("##")[0]
    assert set(COLUMNS) <= set(re.findall(r"`(\w+)`", table))

"""The built site: the reference has an entry for everything that is registered, links lead somewhere, no request leaves it."""

import re
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
EMPTY = re.compile(r":::\{(?:option|confval)\} (.+)\n(?::[\w-]+:.*\n)*\n*:::")


def installed(group):
    """Names of the entry points of headbench's own distribution."""
    return {
        entry.name for entry in entry_points(group=f"headbench.{group}") if entry.dist.name == "headbench"
    }


def command_lines(text):
    """Command lines of headbench in blocks of code and in inline code, without comments."""
    fenced = re.findall(r"^```(?:bash|yaml)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line for block in fenced for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"`(headbench [^`]+)`", text.replace("\n", " "))
    return [found[1] for line in lines if (found := re.search(r"\b(headbench [a-z][^#|;]*)", line))]


@pytest.fixture(scope="module")
def entries(site):
    """Names of the objects of the reference by their type."""
    found = {}
    for domain in ("std", "py"):
        for name, _, kind, *_ in site[0].env.domains[domain].get_objects():
            found.setdefault(kind, set()).add(name)
    return found


def test_pages_have_no_broken_link_and_no_warning(site):
    assert site[1] == ""


def test_every_command_has_a_page(site):
    pages = {
        page.rpartition("/")[2]
        for page in site[0].env.found_docs
        if page.startswith("reference/generated/commands/")
    }
    assert pages - {"index"} == {name.replace(" ", "-") for name in installed("commands")}


def test_every_option_of_the_help_has_an_entry(entries, capsys):
    assert installed("commands")
    for command in sorted(installed("commands")):
        with pytest.raises(SystemExit):
            cli.main([*command.split(), "--help"])
        shown = re.findall(r"^[│|]? {1,2}(--[a-z][a-z-]*)(?=\s|│)", capsys.readouterr().out, re.MULTILINE)
        program = command.replace(" ", "-")
        listed = {
            name.partition(".")[2]
            for name in entries["cmdoption"]
            if name.startswith(f"headbench-{program}.")
        }
        assert set(shown) - {"--help"} == {name for name in listed if name.startswith("--")}, command


PAGES = [
    path
    for path in [*ROOT.glob("docs/**/*.md"), *ROOT.glob("**/README.md")]
    if not {".venv", "build", "generated"} & set(path.relative_to(ROOT).parts)
    and not any(part.startswith((".", "work-")) for part in path.relative_to(ROOT).parts)
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_on_pages_exist_with_their_options(page, entries):
    wrong = []
    for line in command_lines(page.read_text(encoding="utf-8")):
        words = line.split()[1:]
        known = installed("commands")
        name = next((name for name in (" ".join(words[:2]), words[0]) if name in known), None)
        group = any(other.startswith(f"{words[0]} ") for other in known)
        options = {word.partition("=")[0] for word in words if re.match(r"--[a-z]", word)}
        listed = {f"headbench-{(name or '').replace(' ', '-')}.{option}" for option in options - {"--help"}}
        if (name is None and not group) or not listed <= entries["cmdoption"]:
            wrong.append(line)
    assert wrong == []


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


def test_every_option_and_setting_is_explained(site):
    folder = ROOT / "docs" / "reference" / "generated"
    assert [
        name for path in sorted(folder.rglob("*.md")) for name in EMPTY.findall(path.read_text("utf-8"))
    ] == []


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("lint", {rule.code for rule in RULES}),
        ("metric", installed("metrics")),
        ("profile", installed("profiles")),
        ("condition", installed("conditions")),
        ("exitcode", {str(code.value) for code in ExitCode}),
    ],
)
def test_every_registered_name_has_an_entry(entries, kind, names):
    assert names
    assert names <= entries[kind]


def test_every_metric_of_a_profile_has_an_entry(entries):
    metrics = [metric.name for plugin in discover("profiles").values() for metric in plugin.spec.metrics]
    assert set(metrics) <= entries["metric"]


def test_every_public_name_has_an_entry(entries):
    documented = set().union(
        *(entries.get(kind, set()) for kind in ("class", "function", "exception", "data"))
    )
    assert {f"headbench.{name}" for name in headbench.__all__} <= documented


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


def test_command_lines_are_found_on_pages():
    text = (
        "```bash\nPYTHONPATH=. headbench run --data a \\\n  --out b  # why\n```\nor `headbench\nlist methods`"
    )
    assert command_lines(text) == ["headbench run --data a    --out b  ", "headbench list methods"]
    assert sum(len(command_lines(page.read_text(encoding="utf-8"))) for page in PAGES) > 100


SEEN = ("index", "howto/own-data", "reference/generated/methods/ours", "search")


def test_pages_name_no_file_elsewhere(site):
    loaded = re.compile(r"""<(?:script|link|img|iframe|source)[^>]+(?:src|href)=["'](?:https?:)?//""")
    pages = list(Path(site[0].outdir).rglob("*.html"))
    assert len(pages) > 100
    assert [page.name for page in pages if loaded.search(page.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1440, 390])
def test_pages_fit_and_are_silent(site, browser, scheme, width):
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page, heard = context.new_page(), []
    page.on("request", lambda request: heard.append(request.url) if "//" in request.url[:8] else None)
    page.on("console", lambda message: heard.append(message.text))
    page.on("pageerror", lambda error: heard.append(str(error)))
    for name in SEEN:
        address = (Path(site[0].outdir) / f"{name}.html").as_uri()
        page.goto(f"{address}?q=max_splats" if name == "search" else address)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), name
    page.wait_for_selector("#search-results li a")
    assert [text for text in heard if not text.startswith("file:")] == []
    context.close()


READ = (*SEEN, "explanation/results", "reference/generated/api/contracts", "tutorials/paper-table")


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.slow)])
def test_axe_finds_nothing_serious_in_pages(site, new_tab, serious, scheme):
    tab = new_tab(1440, 900, color_scheme=scheme)
    found = {}
    for name in READ:
        tab.goto((Path(site[0].outdir) / f"{name}.html").as_uri())
        found[name] = serious(tab)
    assert found == {name: [] for name in READ}


def test_every_column_of_rows_is_explained():
    page = (ROOT / "docs" / "reference" / "run-folder.md").read_text(encoding="utf-8")
    table = page.split("## Columns of rows.parquet")[1].split("##")[0]
    assert set(COLUMNS) <= set(re.findall(r"`(\w+)`", table))

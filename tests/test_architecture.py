"""Which package may import which, and what no code may contain."""

import ast
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("bench", "datasets", "methods", "metrics", "reports")
MAY_IMPORT = {
    "bench": set(),
    "datasets": {"bench"},
    "methods": {"bench", "datasets"},
    "metrics": {"bench"},
    "reports": {"bench"},
}
MAY_IMPORT_ALL = ("bench/cli.py", "bench/experiments/")
"""What composes the packages."""
FORBIDDEN_PACKAGES = {"reports": {"torch"}, "bench": {"torch"}}
NOWHERE = {"torchvision", "pickle5", "chumpy"}
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


@cache
def import_nodes(source: str) -> list[ast.Import | ast.ImportFrom]:
    """Every import of a source, also those in functions."""
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import | ast.ImportFrom)]


def imports(path: Path, source: str, *, members: bool = False) -> list[str]:
    """Absolute dotted names of everything a source imports, ``headbench.`` in front for our own.

    With ``members`` also the names after ``from ... import``, which may be modules.
    """
    package = ["headbench", *path.relative_to(ROOT).parent.parts]
    names: list[str] = []
    for node in import_nodes(source):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
            continue
        base = package[: len(package) - node.level + 1] if node.level else []
        stem = ".".join([*base, *([node.module] if node.module else [])])
        names += [stem] if node.module else []
        names += [f"{stem}.{alias.name}" for alias in node.names] if members or not node.module else []
    return names


@cache
def texts() -> dict[str, str]:
    """The text of every source, by its path in the repository."""
    return {path.relative_to(ROOT).as_posix(): path.read_text() for path in SOURCES}


def violations(path: Path, source: str) -> list[str]:
    """What a source of a package imports against the rules."""
    package = path.relative_to(ROOT).parts[0]
    composes = path.relative_to(ROOT).as_posix().startswith(MAY_IMPORT_ALL)
    allowed = set(PACKAGES) if composes else {package, *MAY_IMPORT[package]}
    found = []
    for name in imports(path, source):
        parts = name.split(".")
        if parts[0] == "headbench":
            other = parts[1] if len(parts) > 1 else ""
            if other not in allowed:
                found.append(f"{package} imports {name}")
        elif parts[0] in FORBIDDEN_PACKAGES.get(package, set()) | NOWHERE | set(PACKAGES):
            found.append(f"{package} imports {name}")
    return found


def circle(sources: dict[str, str]) -> set[str]:
    """Modules that import each other, directly or through others; imports in functions and for types count."""
    edges = {}
    for name, source in sources.items():
        path = ROOT / (name.removeprefix("headbench.").replace(".", "/") + ".py")
        edges[name] = {one for one in imports(path, source, members=True) if one in sources and one != name}
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        return set(error.args[1])
    return set()


def test_modules_do_not_import_each_other_in_circles():
    dotted = {f"headbench.{name[:-3].replace('/', '.')}": text for name, text in texts().items()}
    assert circle(dotted) == set()


@pytest.mark.parametrize(
    "back",
    [
        "from .command import Settings",
        "def f():\n    from . import command",
        "if TYPE_CHECKING:\n    from ..x.command import Settings",
        "from .between import g",
    ],
)
def test_a_circle_is_found(back):
    sources = {
        "headbench.bench.x.command": "from .work import f",
        "headbench.bench.x.work": back,
        "headbench.bench.x.between": "from .command import Settings",
        "headbench.bench.y": "from .x import work",
    }
    assert circle(sources) == set(sources) - {"headbench.bench.y"} - (
        set() if "between" in back else {"headbench.bench.x.between"}
    )


def test_packages_import_only_what_stands_below_them():
    assert [(name, found) for name, text in texts().items() for found in violations(ROOT / name, text)] == []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("bench/x.py", "from ..methods import ga"),
        ("bench/x.py", "def f():\n    import torch"),
        ("bench/engine/run.py", "from ...reports import table_report"),
        ("bench/experiments/suite.py", "import torch"),
        ("metrics/x.py", "from ..datasets.clip import CaptureClip"),
        ("datasets/head/x.py", "from ...methods.ga import GA"),
        ("datasets/head/x.py", "from headbench.metrics import psnr"),
        ("reports/x.py", "import torch.nn"),
        ("methods/x.py", "import torchvision"),
        ("methods/x.py", "from datasets import clip"),
    ],
)
def test_a_forbidden_import_is_found(path, source):
    assert violations(ROOT / path, source)


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("methods/splats/x.py", "from ...datasets.head.model import HeadModel\nfrom .. import configs"),
        ("datasets/head/x.py", "from ...bench.contracts import Clip\nfrom . import arrays"),
        ("bench/x.py", "from .contracts import Clip"),
        ("bench/experiments/x.py", "from ...reports.suite.suite import suite_report"),
    ],
)
def test_a_lawful_import_passes(path, source):
    assert violations(ROOT / path, source) == []


@pytest.mark.parametrize("name", ["contracts.py", "specs.py"])
def test_contracts_need_numpy_and_the_standard_library_only(name):
    import sys

    path = ROOT / "bench" / name
    roots = {name.split(".")[0] for name in imports(path, path.read_text())}
    assert roots <= {"numpy"} | set(sys.stdlib_module_names)


def test_packages_are_namespace_packages():
    # A top-level datasets/__init__.py would shadow the well-known package of that name.
    assert [package for package in (*PACKAGES, "tests") if (ROOT / package / "__init__.py").exists()] == []


BANNED = {
    "a vertex or triangle count of FLAME": r"\b(5023|5143|9976|10144)\b",
    "a welded device": r"\.cuda\(\)",
    "eval or exec": r"(?<![\w.])(eval|exec)\(",
    "bare pickle": r"\bpickle\.loads?\(|allow_pickle\s*=\s*True|weights_only\s*=\s*False",
    "unsafe YAML": r"yaml\.(load\((?!text, _Loader\))|unsafe_load|full_load)",
    "a debugger": r"\bbreakpoint\(\)|set_trace\(",
    "a machine's path": r"[\"'](/home|/root|/data|/tmp|/mnt)/",
}


def test_rows_are_read_through_their_query_alone():
    pattern = re.compile(r"\._table\b|\bread_parquet\(")
    users = {name for name, text in texts().items() if pattern.search(text)}
    assert {name for name in users if name.startswith(("bench", "reports"))} == {"bench/rows.py"}


@pytest.mark.parametrize("what", BANNED)
def test_no_code_contains(what):
    found = [(name, hit) for name, text in texts().items() for hit in re.finditer(BANNED[what], text)]
    assert [f"{name}:{hit.string.count(chr(10), 0, hit.start()) + 1}: {hit[0]}" for name, hit in found] == []


READ_IN_ONE_PLACE = {
    r"\bnp\.load\(|\bzipfile\.ZipFile\(": {
        "bench/io/arrays.py",
        "datasets/nersemble/benchmark/submission.py",
        "methods/avatars/export.py",  # an archive just made in memory
    },
    r"\bcv2\.im(read|readmulti|decode|decodemulti|write|writemulti|encode)\b": {
        "bench/io/images.py",
        "methods/official/flashavatar/method.py",  # a text for the authors' program
        "methods/official/gha/stages.py",  # a program for the authors' interpreter, run there
    },
    r"\bImage\.open\(|\bimageio\b|\bimread\(|\bimsave\(|skimage\.io\b|mimread|\.fromarray\(.*\.save\(": {
        "bench/io/images.py",  # the words, in the names of OpenCV's functions; the package that brings ffmpeg
        "methods/official/gha/method.py",  # names of packages that the authors' code needs
        "methods/official/shim/blendshapes.py",
    },
    r"\bcv2\.VideoCapture\(": {
        "bench/io/images.py",
        "datasets/nersemble/sequence.py",
    },
    r"\bsafe_open\(|\bload_file\(": {"methods/shared/tensor_files.py"},
    r"\btorch\.load\(": {
        "methods/official/flashavatar/method.py",  # programs for the authors' interpreters, run there
        "methods/official/gbs/method.py",
        "metrics/lpips_network.py",
    },
}


@pytest.mark.parametrize("pattern", READ_IN_ONE_PLACE)
def test_binary_files_are_read_in_one_place(pattern):
    users = {name for name, text in texts().items() if re.search(pattern, text)}
    assert users <= READ_IN_ONE_PLACE[pattern]


def test_packages_of_few_uses_are_imported_in_functions():
    """Each is slow to import and used by few commands."""
    slow = re.compile(r"^(?:import|from) (?:nlopt|pycolmap|pymeshlab)\b", re.MULTILINE)
    assert [name for name, text in texts().items() if slow.search(text)] == []


ENTRIES = re.compile(r"^( *)(?:Parameters|Attributes)\n\1-+\n((?:\1 *(?!\"\"\")\S.*\n)+)", re.MULTILINE)


def malformed_entries(source: str) -> list[str]:
    """Entries of Parameters and Attributes other than ``name : type``, then an indented description."""
    found = []
    for indent, section in ENTRIES.findall(source):
        entry = re.compile(rf"{indent}\*{{0,2}}[\w.]+(, \*{{0,2}}[\w.]+)* : .*[^.,;:\n]\n{indent}    \S")
        starts = re.finditer(rf"^{indent}\S.*$", section, re.MULTILINE)
        found += [start[0].strip() for start in starts if not entry.match(section, start.start())]
    return found


def test_entries_of_docstrings_name_types():
    assert [(name, line) for name, text in texts().items() for line in malformed_entries(text)] == []


@pytest.mark.parametrize(
    ("entry", "malformed"),
    [
        ("width, height : int\n        Size, pixels.", False),
        ("width : size in pixels.", True),
        ("width : size in pixels,\n        and more.", True),
        ("width\n        Size in pixels.", True),
    ],
)
def test_malformed_entries_are_found(entry, malformed):
    source = f'    """Draw.\n\n    Parameters\n    ----------\n    {entry}\n    """\n'
    assert bool(malformed_entries(source)) is malformed


def test_names_of_tests_have_at_most_60_characters():
    tests = {path: path.read_text() for path in (ROOT / "tests").rglob("*.py")}
    names = {path: re.findall(r"^def (test_\w+)", text, re.MULTILINE) for path, text in tests.items()}
    assert sum(map(len, names.values())) > 1_000
    assert [(path, name) for path, found in names.items() for name in found if len(name) > 60] == []
    assert [path for path, found in names.items() if len(set(found)) < len(found)] == []


def test_public_classes_have_names_of_their_own():
    homes: dict[str, list[str]] = {}
    for path, text in texts().items():
        for name in re.findall(r"^class ([A-Z]\w*)", text, re.MULTILINE):
            homes.setdefault(name, []).append(path)
    assert len(homes) > 500
    assert {name: paths for name, paths in homes.items() if len(paths) > 1} == {}

"""README and pages: links lead somewhere, commands exist, the CI example fits, the table is generated."""

import json
import re
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

from headbench.bench.cli import main
from headbench.bench.registry import discover

from .docs_ext import stored_results

ROOT = Path(__file__).parents[1]
PACKAGES = ("bench", "datasets", "methods", "metrics", "reports")
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *(path for name in PACKAGES for path in sorted((ROOT / name).rglob("README.md"))),
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8"))
    # Sphinx writes the generated pages, and checks the links to them (`make docs`).
    places = [link for link in links if "://" not in link and "generated/" not in link]
    assert [link for link in places if not (page.parent / link).exists()] == []


def test_every_command_is_listed(capsys):
    offered = {p.spec.name for p in discover("commands").values() if p.origin.split()[0] == "headbench"}
    assert main(["list", "commands", "--json"]) == 0
    listed = json.dumps(json.loads(capsys.readouterr().out))
    assert {name for name in offered if f'"{name}"' not in listed} == set()


def test_the_readme_counts_what_is_stored():
    from headbench.bench.protocol import named_protocols
    from headbench.reports.papers import papers

    said = f"Tables of {len(papers())} papers and {len(named_protocols())} evaluation protocols"
    assert said in README


def test_the_readme_is_short():
    assert README.count("\n") <= 120
    assert len(README.split()) <= 1000
    pictures = re.findall(r"!\[.+?\]\((.+?)\)", README)
    assert len(pictures) == 2
    assert sum((ROOT / picture).stat().st_size for picture in pictures) < 400_000


def test_a_release_names_its_address_and_has_absolute_links(tmp_path):
    subprocess.run(
        ["make", "-s", "release-source", f"RELEASE={tmp_path}/r", "URL=https://example.org/me/headbench"],
        cwd=ROOT,
        check=True,
    )
    readme, project = ((tmp_path / "r" / name).read_text("utf-8") for name in ("README.md", "pyproject.toml"))
    links = re.findall(r"\]\(([^)#]+)\)", readme)
    assert links
    assert [link for link in links if "://" not in link] == []
    assert "/raw/HEAD/reports/gallery/subjects.jpg" in readme
    assert tomllib.loads(project)["project"]["urls"]["Repository"] == "https://example.org/me/headbench"


def test_the_citation_has_the_version_of_the_package():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])


WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_call_what_exists_and_hold_no_rights(path):
    workflow = yaml.load(path.read_text(encoding="utf-8"), yaml.BaseLoader)
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert workflow["permissions"] == {"contents": "read"}
    assert "pull_request_target" not in workflow["on"]
    assert "secrets." not in path.read_text(encoding="utf-8")
    for job in workflow["jobs"].values():
        assert int(job["timeout-minutes"]) > 0
        for step in job["steps"]:
            assert re.fullmatch(r"[\w-]+/[\w-]+@v\d+", step.get("uses", "a/b@v1"))
            script = step.get("run", "")
            assert {*re.findall(r"\bmake ([\w-]+)", script)} <= targets
            named = re.findall(r"bin/headbench ([a-z]+(?: [a-z]+)?)", script)
            assert all({name, name.split()[0]} & set(discover("commands")) for name in named)
            assert (
                "${{" not in script or "github.repository" in script
            )  # what others write is no part of a script


def test_the_hook_checks_what_make_check_does():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"]
    (mypy,) = (hook for repo in hooks for hook in repo["hooks"] if hook["id"] == "mypy")
    assert mypy["entry"].removeprefix(".venv/bin/") in (ROOT / "Makefile").read_text(encoding="utf-8")
    locked = re.search(
        r"^ruff==([\d.]+)", (ROOT / "requirements-dev.txt").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert {repo.get("rev") for repo in hooks} == {f"v{locked[1]}", None}


def test_the_container_copies_every_package_and_no_more():
    lines = (ROOT / "Containerfile").read_text(encoding="utf-8").splitlines()
    copied = {word for line in lines if line.startswith("COPY") for word in line.split()[1:-1]}
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["scikit-build"]["wheel"][
        "packages"
    ]
    files = {"CMakeLists.txt", "LICENSE", "README.md", "__init__.py", "py.typed", "pyproject.toml"}
    files |= {f"requirements{kind}.txt" for kind in ("", "-dev", "-torch-cpu", "-torch-cuda")}
    assert copied == set(packages.values()) | files
    assert all((ROOT / name).exists() for name in copied)


@pytest.fixture(scope="module")
def stored():
    return stored_results.StoredResults(ROOT)


@pytest.mark.commands
def test_blocks_of_pages_are_those_of_the_stored_rows(stored):
    marks = {page: re.findall(r"<!-- (\S+):begin -->", page.read_text(encoding="utf-8")) for page in PAGES}
    found = {
        (str(page.relative_to(ROOT)), name): stored_results.block_of(page, name)
        for page, names in marks.items()
        for name in names
    }
    assert found == stored.blocks()


@pytest.mark.commands
def test_measured_figures_are_those_of_the_stored_rows(stored):
    written = json.loads((ROOT / "reports" / "measured.json").read_text("utf-8"))
    assert written == stored.measured()
    assert {"ours", "ga"} <= written["methods"].keys()


def test_nothing_installs_headbench_by_its_name():
    # It is on no package index, where anybody could register that name. Extras are installed from a checkout.
    by_name = re.compile(r"(?<![\w./-])headbench\[\w|pip install(?: -\S+)* ['\"]?headbench(?![\w./-])")
    extra = re.compile(r"(?:install_extra\([\"']|-e '\.\[)([\w,]+)")
    known = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    listed = subprocess.run(
        ["git", "grep", "-lIE", "install|headbench"], cwd=ROOT, check=True, capture_output=True
    )
    named, extras = [], set()
    for name in listed.stdout.decode().splitlines():
        text = (ROOT / name).read_text("utf-8")
        named += [f"{name}: {found[0]}" for found in by_name.finditer(text)]
        extras |= {word for found in extra.findall(text) for word in found.split(",")}
    assert named == []
    assert {"cuda", "slurm"} <= extras <= set(known)

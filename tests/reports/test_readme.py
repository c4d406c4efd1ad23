"""What is published of a suite: its run without this machine's folders."""

import pytest

from headbench.bench.engine.store import RunFolder
from headbench.bench.manifest import PROTOCOLS
from headbench.reports import readme
from headbench.reports.runs import RunSet
from headbench.reports.statistics.comparisons import PairedComparison


def test_the_run_of_a_suite_is_published_without_folders(write_run, tmp_path, monkeypatch):
    page = tmp_path / "public" / "README.md"
    for name in (readme.SUITE, readme.PROTOCOLS):
        written = page.parent / readme.PAGES[name]
        written.parent.mkdir(parents=True, exist_ok=True)
        written.write_text("\n".join(readme.marks(name)))
    write_run("run", {"ga": 30.0, "ours": 31.0})
    monkeypatch.setattr(readme, "suite_results", lambda folder: "tables")
    monkeypatch.setattr(readme, "suite_block", lambda root, name: "block")
    readme.publish_suite(tmp_path, page.parent)
    target = page.parent / readme.GALLERY / readme.SUITE
    found = {path.relative_to(target).as_posix() for path in target.rglob("*.json")}
    protocols = {f"run/{PROTOCOLS}/hash-{task}.json" for task in ("novel_view", "self_reenactment")}
    assert found == {"run/run.json", *protocols}
    published = RunFolder(target / "run").read_manifest()
    assert published.protocols == RunFolder(tmp_path / "run").read_manifest().protocols
    assert published.configuration.out == ""


@pytest.mark.parametrize(
    ("difference", "p", "said"),
    [
        (1.0, 0.01, "`ours` is better than `ga`"),
        (-1.0, 0.01, "`ga` is better than `ours`"),
        (1.0, 0.2, "`ours` and `ga`: cannot be told apart"),
    ],
)
def test_conclusions_name_the_better_method(difference, p, said):
    values = tuple((f"s{n}", difference) for n in range(10))
    pair = PairedComparison(
        "novel_view",
        "psnr",
        True,
        "ours",
        "ga",
        differences=values,
        difference=difference,
        p_holm=p,
        family=1,
    )
    assert readme._conclusion(pair, "dB") == said


def test_a_conclusion_states_equivalence():
    pair = PairedComparison(
        *("novel_view", "psnr", True, "ours", "ga"),
        differences=tuple((f"s{n}", 0.1) for n in range(10)),
        difference=0.1,
        p_holm=0.2,
        family=1,
        margin=0.3,
        p_equivalence_holm=0.01,
    )
    assert readme._conclusion(pair, "dB") == (
        "`ours` and `ga`: cannot be told apart (equivalent within 0.3 dB)"
    )


def test_too_few_subjects_allow_no_conclusion(write_run):
    text = readme.conclusions(RunSet.read([write_run("run", {"ga": 30.0, "ours": 31.0})]))
    assert "- Novel view: `ours` and `ga`: not testable with 4 subjects" in text
    assert "is better" not in text

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
    monkeypatch.setattr(readme, "suite_block", lambda root: "block")
    readme.publish_suite(tmp_path, page.parent)
    target = page.parent / readme.GALLERY / readme.SUITE
    found = {path.relative_to(target).as_posix() for path in target.rglob("*.json")}
    protocols = {f"run/{PROTOCOLS}/hash-{task}.json" for task in ("novel_view", "self_reenactment")}
    assert found == {"run/run.json", *protocols}
    published = RunFolder(target / "run").read_manifest()
    assert published.protocols == RunFolder(tmp_path / "run").read_manifest().protocols
    assert published.configuration.out == ""


def pair(second="ga", metric="psnr", difference=1.0, p=0.01, **given):
    """A comparison of `ours` with another method over ten subjects."""
    values = tuple((f"s{n}", difference) for n in range(10))
    settings = {"differences": values, "difference": difference, "p_holm": p, "family": 1, **given}
    return PairedComparison("novel_view", metric, metric == "psnr", "ours", second, **settings)


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        ([pair()], "`ours` is better than `ga` by PSNR"),
        ([pair(difference=-1.0)], "`ga` is better than `ours` by PSNR"),
        ([pair(p=0.2)], "`ours` against `ga`, by PSNR: cannot be told apart"),
        (
            [pair(difference=0.1, p=0.2, margin=0.3, p_equivalence_holm=0.01)],
            "`ours` against `ga`, by PSNR: cannot be told apart (equivalent within 0.3)",
        ),
        (
            [pair(), pair("gha"), pair(metric="lpips", difference=-1.0), pair("gha", "lpips", -1.0)],
            "`ours` is better than `ga` and `gha` by PSNR and LPIPS",
        ),
        (
            [pair(difference=-1.0), pair("gbs", difference=-1.0), pair("gha"), pair("gbs", "lpips", p=0.2)],
            (
                "`ga` and `gbs` are better than `ours` by PSNR; `ours` is better than `gha` by PSNR; "
                "`ours` against `gbs`, by LPIPS: cannot be told apart"
            ),
        ),
    ],
)
def test_conclusions_name_the_better_methods(pairs, said, write_run):
    runs = RunSet.read([write_run("run", {"ga": 30.0, "ours": 31.0})])
    assert readme._conclusions(runs, pairs) == f"- Novel view: {said}."


def test_too_few_subjects_allow_no_conclusion(write_run):
    text = readme.conclusions(RunSet.read([write_run("run", {"ga": 30.0, "ours": 31.0})]))
    assert "not testable with 4 subjects" in text
    assert "is better" not in text

"""Claims of a paper against runs: tolerances, signs, and what was not run."""

from dataclasses import replace

import pandas as pd
import pytest

from headbench.bench.configuration import build
from headbench.reports.claims import ClaimValue, JudgedClaim, claims_text, judge, values_text
from headbench.reports.papers import Claim, Paper, paper_named
from headbench.reports.runs import RunSet

from .test_table_report import GEOMETRY, OPACITY

PAPER = "tensorial-2025"


def judged(*folders):
    """Status of every claim of the paper by its id, from runs of all its tables."""
    paper, runs = paper_named(PAPER), RunSet.read(folders)
    verdicts = judge(paper, {table.table: runs for table in paper.tables})
    return {verdict.claim.id: verdict for verdict in verdicts}


def test_claims_are_met_missed_or_not_run(write_run):
    found = judged(write_run("a", {"ours": 33.0, "insta": 28.0}, {"ours": OPACITY}))
    statuses = {name: verdict.status for name, verdict in found.items()}
    assert {name: statuses[name] for name in ("ours-storage", "better-than-insta", "faster-than-insta")} == (
        dict.fromkeys(("ours-storage", "better-than-insta", "faster-than-insta"), "met")
    )
    assert statuses["ours-speed"] == statuses["smaller-than-insta"] == "missed"  # 133 FPS; 8.3 MB against 7.8
    assert statuses["ga-novel-view"] == statuses["freedom-wins-novel-view"] == "not run"
    psnr, ssim, lpips = found["ours-novel-view"].findings
    assert (psnr.holds, ssim.holds, lpips.holds) == (True, False, True)
    assert psnr.measured == pytest.approx(33.0)
    assert psnr.source.endswith("a: ours, 4 rows")
    (speed,) = found["faster-than-insta"].findings
    assert (speed.printed, speed.measured) == (275, pytest.approx(5))
    assert found["ga-novel-view"].findings[0].source == "GA was not run"


@pytest.mark.parametrize("recorded", [True, False], ids=["rows", "manifests"])
def test_speeds_of_different_devices_are_not_compared(write_run, change_manifest, recorded):
    on_gpu, on_cpu = write_run("gpu", {"ours": 33.0}, {"ours": OPACITY}), write_run("cpu", {"insta": 28.0})
    for folder, device in ((on_gpu, "cuda"), (on_cpu, "cpu")):
        if recorded:
            table = pd.read_parquet(folder / "rows.parquet")
            table.loc[table["metric"] == "fps", ["machine", "threads"]] = device, 2
            table.to_parquet(folder / "rows.parquet", index=False)
        else:
            change_manifest(folder, lambda m, device=device: m["configuration"].update(device=device))
    found = judged(on_gpu, on_cpu)
    assert found["faster-than-insta"].status == "not run"
    places = (
        "ours: cuda with 2 threads; insta: cpu with 2 threads"
        if recorded
        else "ours: cuda, abacus; insta: abacus"
    )
    (speed,) = found["faster-than-insta"].findings
    assert speed.source == f"fps was measured on different machines: {places}"
    assert found["better-than-insta"].status == "met"


def test_the_ablation_is_found_by_its_settings(write_run):
    opacity = write_run("opacity", {"ours": 35.0}, {"ours": OPACITY})
    free = write_run("free", {"ours": 36.0}, {"ours": GEOMETRY})
    found = judged(opacity, free)
    assert found["freedom-wins-novel-view"].status == "met"
    assert found["freedom-loses-self-reenactment"].status == "missed"
    psnr, _ = found["freedom-wins-novel-view"].findings
    assert psnr.printed == pytest.approx(1.23)
    assert psnr.measured == pytest.approx(1.0)
    assert "free: ours" in psnr.source
    assert "opacity: ours" in psnr.source


def test_tables_without_a_run_are_not_run():
    paper = paper_named(PAPER)
    verdicts = judge(paper, {})
    assert {verdict.status for verdict in verdicts} == {"not run"}
    count = len(paper.claims)
    assert f"{count} claims: 0 met, 0 missed, {count} not run." in claims_text(verdicts)
    assert "| – | – | no run of Table 4 |" in values_text(verdicts)


def paper_of(comparison, than="", **values):
    """A paper with one claim about one value, printed as 10 for "a" and 12 for "b"."""
    rows = [
        {"name": n, "method": n, "values": dict.fromkeys(values, p)} for n, p in (("a", "10"), ("b", "12"))
    ]
    table = {"table": "1", "data": "d", "conditions": "c", "grade": "A", "read": "r", "rows": rows}
    claim = {"id": "x", "text": "", "table": "1", "row": "a", "than": than, "comparison": comparison}
    content = {"title": "t", "venue": "v", "arxiv": None, "tables": [table]}
    return build(Paper, {**content, "claims": [{**claim, "values": values}]}, "paper")


@pytest.mark.parametrize(
    ("comparison", "key", "tolerance", "measured", "status"),
    [
        ("near", "fps", 1, 11, "met"),
        ("near", "fps", 1, 12, "missed"),
        ("near", "fps", 1, 8.5, "missed"),
        ("reaches", "fps", 1, 9, "met"),
        ("reaches", "fps", 1, 30, "met"),
        ("reaches", "fps", 1, 8.5, "missed"),
        ("reaches", "storage", 1, 11, "met"),
        ("reaches", "storage", 1, 0, "met"),
        ("reaches", "storage", 1, 11.5, "missed"),
        ("sign", "fps", 0, 19, "met"),
        ("sign", "fps", 0, 20, "missed"),
        ("sign", "fps", 2, 19, "missed"),
    ],
)
def test_tolerances(write_run, comparison, key, tolerance, measured, status):
    """Row b, if it is compared with, measures 20."""
    levels = {"fps": lambda value: value - 100, "storage": lambda value: 10 * (value - 5)}
    folder = write_run("run", {"a": levels[key](measured), "b": levels[key](20)})
    paper = paper_of(comparison, "b" if comparison == "sign" else "", **{key: tolerance})
    (verdict,) = judge(paper, {"1": RunSet.read([folder])})
    assert verdict.status == status


def test_one_missed_value_decides_before_those_not_run():
    claim = Claim("x", "", "1", "a", "near", {"fps": 1.0, "storage": 1.0})
    lacking = ClaimValue("fps", 1, None, False, "")
    for holds, status in ((True, "not run"), (False, "missed")):
        assert JudgedClaim(claim, "A", (lacking, ClaimValue("storage", 1, 1, holds, ""))).status == status


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"row": "c"}, "x: printed values; found 1, c, fps"),
        ({"than": "b"}, "for no other; found 'b'"),
        ({"than": "a", "comparison": "sign"}, "x: a printed difference; found equal values of fps"),
        ({"values": {}}, "at least one; found none"),
    ],
)
def test_claims_about_what_is_not_printed_are_refused(changes, said):
    paper = paper_of("near", fps=1)
    with pytest.raises(ValueError, match=said):
        replace(paper, claims=(replace(paper.claims[0], **changes),))

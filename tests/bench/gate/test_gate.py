"""The gate from its command line: a run made worse on purpose, a noise-level change, holes, usage."""

import dataclasses
import json
import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench import cli
from headbench.bench.engine import run as runner
from headbench.bench.engine.store import RunFolder
from headbench.bench.gate.baseline import Baseline, ResultKey, Results, Tolerance
from headbench.bench.gate.command import (
    Verdict,
    environment_changes,
    exit_code,
    judge,
    to_junit,
    to_markdown,
)
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import write_json
from headbench.bench.rows import Rows
from headbench.bench.specs import MetricSpec

SPEC = MetricSpec("m", "M", "dB", True, 2, "a:b")
numbers = st.floats(-1e6, 1e6)
sizes = st.floats(0, 1e3)


PLACE = ResultKey("t", "a", "s", "full", "m")


def verdict_of(found, expected, tolerance, place=PLACE):
    results = Results(Path("r"), {place: found}, {}, {"m": SPEC}, {}, {place: 1})
    return judge(results, Baseline("same", {}, {}, {"m": tolerance}, {place: expected}, {place: 1}))[0]


@given(numbers, numbers, sizes, st.floats(0, 1), st.booleans())
def test_a_number_fails_beyond_the_larger_tolerance_when_worse(found, expected, absolute, relative, higher):
    outcome = verdict_of(found, expected, Tolerance(higher, absolute, relative)).outcome
    allowed = max(absolute, relative * abs(expected))
    slack = 1e-6 * (1 + abs(expected) + allowed)
    better = (found - expected) * (1 if higher else -1)
    if better < -allowed - slack:
        assert outcome == "regressed"
    elif better > allowed + slack:
        assert outcome == "improved"
    elif abs(better) < allowed - slack:
        assert outcome == "pass"


@given(numbers, numbers, sizes)
def test_direction_swaps_improved_and_regressed(found, expected, absolute):
    swap = {"regressed": "improved", "improved": "regressed", "pass": "pass"}
    up = verdict_of(found, expected, Tolerance(True, absolute)).outcome
    assert verdict_of(found, expected, Tolerance(False, absolute)).outcome == swap[up]


@given(st.integers(-10_000, 10_000), st.integers(0, 500))
def test_a_move_by_exactly_the_tolerance_passes(hundredths, tolerance):
    expected, absolute = hundredths / 100, tolerance / 100
    assert verdict_of(expected - absolute, expected, Tolerance(True, absolute)).outcome == "pass"


@pytest.mark.parametrize(
    ("outcomes", "code"), [([], 3), (["unjudged"], 3), (["pass"], 0), (["improved", "new", "unjudged"], 0)]
)
def test_exit_codes(outcomes, code):
    assert exit_code([Verdict(PLACE, outcome) for outcome in outcomes]) == code


def test_default_tolerances_are_ten_digits_or_a_share_of_speed():
    assert Tolerance.default(SPEC).allowed(1000.0) == 0.1
    fast = MetricSpec("f", "F", "FPS", True, 1, "a:b", machine_bound=True)
    assert Tolerance.default(fast).allowed(100.0) == pytest.approx(30.0)


def test_a_number_without_rows_is_missing_with_the_reason():
    baseline = Baseline("same", {}, {}, {"m": Tolerance(True, 0.1)}, {PLACE: 1.0}, {PLACE: 1})
    nothing = Results(Path("r"), {}, {}, {"m": SPEC}, {}, {})
    failed = Results(Path("r"), {}, {PLACE: "failed: why"}, {"m": SPEC}, {}, {})
    assert judge(nothing, baseline)[0].outcome == "missing"
    assert judge(failed, baseline)[0].reason == "failed: why"


@given(st.text(), st.text(min_size=1))
def test_any_name_gives_valid_xml_and_stays_in_its_cell(subject, note):
    verdict = verdict_of(0.0, 1.0, Tolerance(True, 0.1), ResultKey("t", "a", subject, "full", "m"))
    root = ElementTree.fromstring(to_junit([verdict], [note]).split("\n", 1)[1])
    assert root.find("testsuite/testcase/failure") is not None
    assert all(element.get("time") for element in (*root.iter("testcase"), *root.iter("testsuite")))
    table = [line for line in to_markdown([verdict], 1, []).splitlines() if line.startswith("| regressed")]
    assert len(table) == 1
    assert table[0].replace("\\\\", "").replace("\\|", "").count("|") == 10


def test_the_environment_is_compared_entry_by_entry():
    before = {"cores": 2, "packages": {"torch": "2.4", "numpy": "2"}}
    now = {"cores": 2, "packages": {"torch": "2.5", "numpy": "2"}, "device": "cpu"}
    assert environment_changes(before, now) == ["device: None to cpu", "packages.torch: 2.4 to 2.5"]
    assert environment_changes(before, before) == []
    assert len(environment_changes({"torch": "9" * 10**6}, {})[0]) < 1000


@pytest.fixture
def baseline(run, tmp_path, capsys):
    path = tmp_path / "baseline.json"
    assert cli.main(["compare", str(run), "--baseline", str(path), "--update"]) == 0
    capsys.readouterr()
    return path


def gate(run, baseline, *options):
    return cli.main(["compare", str(run), "--baseline", str(baseline), *options])


def worse_by(decibels):
    """Brighten just so many pixels of a frame that its PSNR drops by so much."""

    def change(image):
        # Brighter than the truth already: a pixel 40 levels brighter adds ((d + 40)^2 - d^2) / n to the mean squared
        # error, d its error before, n the number of pixels. A drop by x dB is a growth by the factor 10^(x / 10).
        flat = image.reshape(-1, 3).astype(int).copy()
        errors = flat - TRUTH_LEVEL
        mse = float(np.mean(errors**2))
        target = mse * 10 ** (decibels / 10)
        gain = np.sort(((errors + 40) ** 2 - errors**2).mean(axis=1) / len(flat))[::-1]
        count = int(np.searchsorted(np.cumsum(gain), target - mse)) + 1
        flat[:count] += 40
        return flat.reshape(image.shape).astype(np.uint8)

    return change


TRUTH_LEVEL = 40 + 30  # of the toy's self-reenactment frames, camera a


def psnr_of(rows):
    """Mean of what `worse_by` is applied to."""
    own = rows.query("subject == 'subject2' and task == 'self_reenactment' and metric == 'psnr'")
    return own.groupby("sequence")["value"].mean().mean()


@pytest.fixture
def stored(run):
    """Rows of the run, and what writes others in their place."""
    path = RunFolder(run).rows
    return pd.read_parquet(path), lambda rows: Rows(rows).write(path)


@pytest.fixture
def judged(run, baseline, capsys):
    """The gate's exit code and what it prints."""

    def judged(*options, run=run, baseline=baseline):
        code = gate(run, baseline, *options)
        return code, capsys.readouterr().out

    return judged


def test_a_run_worse_by_0_3_db_fails_with_metric_subject_size(stored, remeasured, judged, tmp_path):
    code, out = judged()
    assert (code, "nothing got worse (6 pass)" in out) == (0, True)
    loss = psnr_of(stored[0]) - psnr_of(remeasured("subject2", "self_reenactment", worse_by(0.3)))
    assert 0.3 <= loss < 0.5  # by whole pixels of a tiny image
    junit, markdown = tmp_path / "gate.xml", tmp_path / "gate.md"
    code, out = judged("--junit", str(junit), "--markdown", str(markdown))
    assert code == 1
    assert "1 regressed, 5 pass" in out
    assert "psnr of toy, subject subject2, self_reenactment: regressed" in out
    assert f"{-loss:.3f} dB" in out
    suites = {suite.get("name"): suite for suite in ElementTree.parse(junit).getroot()}
    assert {name: (s.get("tests"), s.get("failures")) for name, s in suites.items()} == {
        "self_reenactment": ("2", "1"),
        "novel_view": ("2", "0"),
        "avatar": ("2", "0"),
    }
    failed = suites["self_reenactment"].find("testcase/failure/..")
    assert failed.get("name") == "psnr full subject subject2"
    assert failed.get("classname") == "self_reenactment.toy"
    text = markdown.read_text()
    assert text.startswith("### Gate: regressed (1 regressed, 5 pass)")
    assert "| regressed | self_reenactment | toy | subject2 | psnr (dB) |" in text


def test_improvements_and_new_numbers_pass_and_can_be_kept(baseline, remeasured, judged):
    record = read_json(baseline)
    for group in ("values", "frames"):
        record[group] = {k: v for k, v in record[group].items() if k != "avatar/toy/subject2/full/files"}
    record["count"] = len(record["values"])
    write_json(baseline, record)
    remeasured("subject1", "novel_view", lambda image: np.full_like(image, 50))
    code, out = judged()
    assert code == 0
    assert "1 improved, 1 new, 4 pass" in out
    assert "--update" in out
    assert judged("--update")[0] == 0
    assert "6 pass" in judged()[1]


def test_a_missing_subject_is_code_3_also_beside_a_regression(stored, remeasured, judged):
    _, write = stored
    rows = remeasured("subject1", "novel_view", lambda image: image + 20)
    write(rows[rows["subject"] != "subject2"])
    code, out = judged()
    assert code == 3
    assert "3 missing, 1 regressed" in out
    assert "subject subject2" in out


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda rows: rows.iloc[1:], "values, 3 expected"),
        (
            lambda rows: rows.assign(status=["failed", *rows["status"][1:]], reason="no gold"),
            "failed: no gold",
        ),
        (lambda rows: rows.assign(value=[math.inf, *rows["value"][1:]]), "a value that is not finite"),
        (lambda rows: pd.concat([rows, rows.iloc[:1]]), "measured twice"),
    ],
)
def test_rows_with_holes_give_no_number(stored, judged, spoil, why):
    rows, write = stored
    write(spoil(rows))
    code, out = judged()
    assert code == 3
    assert why in out
    assert judged("--update")[0] == 3  # a baseline with holes would hide them


def test_a_region_of_fewer_frames_is_code_3(stored, judged, baseline):
    """Which frames a region is seen in is not in the protocol: only the baseline has how many there were."""
    rows, write = stored
    rows = pd.concat([rows, rows[rows["task"] != ""].assign(region="face")])
    write(rows)
    assert judged("--update")[0] == 0
    place = "novel_view/toy/subject2/face/psnr"
    frames = read_json(baseline)["frames"]
    assert (frames[place], frames["avatar/toy/subject2/full/files"]) == (3, 1)
    assert judged()[0] == 0
    write(rows.query("not (region == 'face' and subject == 'subject2' and timestep == 1)"))
    code, out = judged()
    assert code == 3
    assert "psnr (face) of toy, subject subject2, novel_view: missing: 2 frames, 3 in the baseline" in out
    assert "1 missing, 9 pass" in out
    code, out = judged("--update")
    assert code == 0
    assert f"frames: {place}: 3 to 2" in out
    write(rows)
    assert judged()[0] == 0


def test_another_protocol_is_code_3_not_a_comparison(config, judged):
    other = dataclasses.replace(config, frames_per_task=1, out=config.out + "-other")
    runner.run(other)
    code, out = judged(run=other.out)
    assert code == 3
    assert "other frames or settings" in out


def test_remade_captures_compare_where_the_baseline_says_so(config, toy, monkeypatch, judged):
    remade = toy.ToyClip

    def read(path):
        clip = remade(path)
        clip.fingerprint = f"remade-{clip.subject}"
        return clip

    monkeypatch.setattr(toy, "read", read)
    other = dataclasses.replace(config, out=config.out + "-other")
    runner.run(other)
    code, out = judged(run=other.out)
    assert code == 3
    assert "other captures" in out
    assert judged("--update", "--captures", "remade")[0] == 0
    code, out = judged(run=other.out)
    assert code == 0
    assert "made again" in out


@pytest.fixture
def slower(baseline):
    """The baseline with a machine-bound metric that is worse now; a function that makes it one of another machine."""
    record = read_json(baseline)
    record["tolerances"]["files"]["machine_bound"] = True
    record["values"] = {k: v - 100 if k.endswith("files") else v for k, v in record["values"].items()}
    write_json(baseline, record)

    def of_another_machine():
        record["environment"]["processor"] = "abacus"
        write_json(baseline, record)

    return of_another_machine


def test_speed_is_judged_on_request_and_on_its_own_machine_alone(slower, judged, tmp_path):
    junit, markdown = tmp_path / "gate.xml", tmp_path / "gate.md"
    code, out = judged("--junit", str(junit), "--markdown", str(markdown))
    assert code == 0
    assert "2 unjudged, 4 pass" in out
    for text in (out, markdown.read_text(), junit.read_text()):
        assert "--judge-speed" in text
    avatar = ElementTree.parse(junit).find("testsuite[@name='avatar']")
    assert (avatar.get("failures"), avatar.get("skipped")) == ("0", "2")
    code, out = judged("--judge-speed")
    assert code == 1
    assert "2 regressed, 4 pass" in out
    slower()
    code, out = judged("--judge-speed")
    assert code == 0
    assert "2 unjudged, 4 pass" in out
    assert "measured on another machine" in out
    assert "Environment changed: processor: abacus to" in out


def test_missing_speed_is_code_3_on_request_alone(slower, stored, judged):
    rows, write = stored
    failed = rows.assign(status=["failed" if m == "files" else "ok" for m in rows["metric"]])
    for changed, counted in ((rows[rows["metric"] != "files"], "2 unjudged, 4 pass"), (failed, "4 pass")):
        write(changed)
        code, out = judged()
        assert (code, counted in out) == (0, True)
        code, out = judged("--judge-speed")
        assert (code, "2 missing, 4 pass" in out) == (3, True)


def test_a_number_unavailable_in_the_baseline_too_is_no_loss(stored, judged, tmp_path):
    whole, write = stored
    path = tmp_path / "new.json"
    lacking = (whole["subject"] == "subject2") & (whole["metric"] == "psnr")
    without = whole.assign(
        value=whole["value"].mask(lacking),
        status=whole["status"].mask(lacking, "missing"),
        reason=whole["reason"].mask(lacking, "no gold"),
    )
    for rows, options, expected, words in (
        (without, ["--update"], 0, "no gold"),
        (without, [], 0, "Unavailable here as in the baseline"),
        (whole, [], 0, "new"),
        (whole, ["--update"], 0, ""),
        (without, [], 3, "missing: no gold"),  # it was there before
        (without, ["--update"], 3, "no gold"),
    ):
        write(rows)
        code, out = judged(*options, baseline=path)
        assert code == expected
        assert words in out


def test_invalid_results_are_code_3_and_the_reports_say_so(run, baseline, tmp_path, capsys):
    junit, markdown = tmp_path / "gate.xml", tmp_path / "gate.md"
    reports = "--junit", str(junit), "--markdown", str(markdown)
    damaged = tmp_path / "damaged.json"
    damaged.write_text(baseline.read_text()[:100])
    for folder, file in (
        (tmp_path / "nowhere", baseline),
        (run, tmp_path / "no-baseline.json"),
        (run, damaged),
    ):
        assert gate(run, baseline, *reports) == 0
        assert gate(folder, file, *reports) == 3
        (suite,) = ElementTree.parse(junit).getroot()
        assert [suite.get(name) for name in ("tests", "errors", "time")] == ["1", "1", "0"]
        assert suite.find("testcase").get("time") == "0"
        wrong = str(folder if file == baseline else file)
        assert wrong in suite.find("testcase/error").get("message")
        assert "missing or invalid" in markdown.read_text()
        assert wrong in markdown.read_text().replace("\\", "")
    started = dataclasses.replace(RunFolder(run).read_manifest(), status="started")
    started.write(RunFolder(run).manifest)
    assert gate(run, baseline) == 3
    assert "Start the run again" in capsys.readouterr().out


def more(record, key, value=1.0):
    """Add a number to a baseline."""
    record["values"][key] = value
    record["frames"][key] = 1
    record["count"] += 1


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda r: r.pop("values"), "values"),
        (lambda r: r.update(values={}, count=0), "at least one number"),
        (lambda r: r["values"].popitem(), "as many as count says, 6"),
        (lambda r: r["frames"].popitem(), "a number from 1 for each of values"),
        (lambda r: r["frames"].update({"novel_view/toy/subject1/full/psnr": 0}), "a number from 1"),
        (lambda r: r.update(protocols={}), "protocols: expected an entry 'novel_view'"),
        (lambda r: r["tolerances"]["psnr"].update(digits=10**9), "from 0 to"),
        (lambda r: more(r, "a/b"), "task/method/subject/region/metric"),
        (lambda r: more(r, f"novel_view/a/{'x' * 1000}/full/psnr"), "1 to 120 bytes"),
        (lambda r: more(r, "a/b/c/d/psnr", math.nan), "a finite number"),
        (lambda r: r["tolerances"]["psnr"].update(absolute=-1.0), "a finite number from 0"),
    ],
)
def test_a_baseline_that_makes_no_sense_is_code_3_naming_what(run, baseline, change, match, capsys):
    record = read_json(baseline)
    change(record)
    baseline.write_text(json.dumps(record))
    assert gate(run, baseline) == 3
    assert match in capsys.readouterr().out


def test_update_keeps_tolerances_that_were_set_by_hand(run, baseline):
    record = read_json(baseline)
    assert record["tolerances"]["psnr"]["absolute"] == 0.1
    record["tolerances"]["psnr"]["absolute"] = 0.02
    write_json(baseline, record)
    assert gate(run, baseline, "--update") == 0
    assert read_json(baseline)["tolerances"]["psnr"]["absolute"] == 0.02

import csv
import io
import itertools
import json
from dataclasses import replace

import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.rows import Rows
from headbench.bench.specs import MetricSpec
from headbench.reports.statistics.command import CompareSettings, compare_runs

from ..made_rows import TASKS, avatar_row, row

SUBJECTS = 7
ERRORS = {"good": 1.0, "bad": 3.0, "floor": 9.0}


@pytest.fixture
def folder(tmp_path, write_manifest):
    """A finished run of seven subjects: error good < bad < floor on every subject, by other amounts."""
    folder = RunFolder(tmp_path / "run")
    error = MetricSpec("error", "Error", "levels", False, 2, "m:e")
    metrics = [error, replace(error, name="size", kind="avatar")]
    protocols = {task: f"hash-{task}" for task in TASKS}
    write_manifest(folder, metrics, dict.fromkeys(ERRORS), protocols, (0, 1), trivial=("floor",))
    rows = []
    for (name, level), s, seed in itertools.product(ERRORS.items(), range(SUBJECTS), (0, 1)):
        rows.append(avatar_row(name, "size", 2.0, f"s{s}", seed=seed))
        for task, protocol in protocols.items():
            place = {"seed": seed, "task": task, "protocol": protocol}
            rows.append(row(name, "error", level * (1 + s / 10) + seed, f"s{s}", **place))
    Rows.of(rows).write(folder.rows)
    return folder.root


def test_text_tells_size_interval_test_and_verdict(folder):
    text = compare_runs(CompareSettings((str(folder),))).text
    novel, reenacted, size, how = text.split("\n\n")
    head, names, _, metric, line = novel.splitlines()
    assert (head, metric) == ("Novel view", "Error (levels, lower is better)")
    assert "95 % interval" in names
    assert how.startswith("p: exact sign-flip test over 7 subjects, with Holm's correction for ")
    # Mean of 2 (1 + s/10) over seven subjects: 2.6, good below bad; all of one sign: p = 2/2^7.
    for part in ("good - bad", "-2.600", "0.0156", "good is better"):
        assert part in line
    assert reenacted.startswith("Self-reenactment")
    assert "+0.000" in size
    assert "no significant difference" in size


HERE = {"machine": "A (2 cores)", "threads": 2, "other_cores": 0.0}
ELSEWHERE = "Measured on {}; not comparable with other machines or thread counts."


@pytest.mark.parametrize(
    ("bad", "floor", "note"),
    [
        (HERE, {**HERE, "threads": 1}, ""),  # the floor is not compared
        (
            {**HERE, "other_cores": 0.5},
            HERE,
            "bad: Measured under load: other processes used up to 0.50 cores.",
        ),
        (
            {**HERE, "threads": 1},
            HERE,
            f"good: {ELSEWHERE.format('A (2 cores) with 2 threads')} bad: {ELSEWHERE.format('A (2 cores) with 1 thread')}",
        ),
    ],
)
def test_speeds_that_do_not_compare_have_a_note(folder, change_manifest, bad, floor, note):
    change_manifest(folder, lambda m: m["metrics"][1].update(machine_bound=True))
    rows = pd.read_parquet(RunFolder(folder).rows)
    for method, given in (("good", HERE), ("bad", bad), ("floor", floor)):
        own = (rows["metric"] == "size") & (rows["method"] == method)
        rows.loc[own, list(given)] = list(given.values())
    Rows(rows).write(RunFolder(folder).rows)
    found = compare_runs(CompareSettings((str(folder),)))
    assert found.text.splitlines()[-1:] == ([f"Error: {note}"] if note else found.text.splitlines()[-1:])
    assert found.text.count("Measured") == note.count("Measured")
    assert [c["note"] for c in found.data["comparisons"]] == ["", "", note]
    text = compare_runs(CompareSettings((str(folder),), format="csv")).text
    assert [line["note"] for line in csv.DictReader(io.StringIO(text))] == ["", "", note]


def test_json_has_every_subject(folder):
    (first, *_) = compare_runs(CompareSettings((str(folder),), metrics=("error",))).data["comparisons"]
    assert first["differences"] == pytest.approx({f"s{s}": -2 * (1 + s / 10) for s in range(SUBJECTS)})
    assert first["low"] < first["difference"] < first["high"]
    assert first["seeds"] == (2, 2)
    assert json.dumps(first)


def test_csv_reads_back(folder):
    text = compare_runs(CompareSettings((str(folder),), trivial=True, format="csv")).text
    table = pd.read_csv(io.StringIO(text), keep_default_na=False)
    assert len(table) == 3 * 3
    assert set(table["family"]) == {3}
    row = next(csv.DictReader(io.StringIO(text)))
    assert (row["first"], row["second"], row["verdict"]) == ("good", "bad", "good is better")
    assert float(row["difference"]) == pytest.approx(-2.6)


def test_one_reference_makes_fewer_comparisons(folder):
    found = compare_runs(CompareSettings((str(folder),), against="floor")).data["comparisons"]
    assert {(c["first"], c["second"]) for c in found} == {("good", "floor"), ("bad", "floor")}
    assert {c["family"] for c in found} == {2}


def test_other_levels_are_kept(folder):
    strict = compare_runs(CompareSettings((str(folder),), level=0.001, metrics=("error",)))
    assert "99.9 % interval" in strict.text
    assert "not testable with 7 subjects (it takes 11)" in strict.text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"against": "nobody"}, "nobody"),
        ({"metrics": ("error", "jod")}, "metrics of the runs: error, size, found jod"),
    ],
)
def test_what_is_not_there_is_refused(folder, changes, message):
    with pytest.raises(InputError, match=message):
        compare_runs(CompareSettings((str(folder),), **changes))


def test_settings_are_checked():
    with pytest.raises(ValueError, match="between 0 and 1"):
        CompareSettings(("run",), level=5)
    with pytest.raises(ValueError, match="at least one"):
        CompareSettings(())


def test_a_failed_method_has_a_reason(make_run, capsys):
    folder = make_run("a", methods=("toy_plugin:METHOD", "toy_plugin:FAILING"))
    assert cli.main(["compare", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "no comparison: failing: RuntimeError: the training diverged" in out


def test_one_method_alone_has_nothing_to_be_compared_with(make_run, capsys):
    assert cli.main(["compare", str(make_run("a"))]) == 2
    assert "two methods" in capsys.readouterr().err


def test_equivalence_is_tested_where_a_margin_is_given(folder):
    # Differences of 2 to 3.2 levels in seven subjects: all within 4, no more than half of them within 2.5.
    wide, narrow = (
        compare_runs(CompareSettings((str(folder),), equivalence=(f"error={margin}",)))
        for margin in ("4", "2.5")
    )
    novel, reenacted, size, _ = wide.text.split("\n\n")
    for text in (novel, reenacted):
        assert "good is better; equivalent within 4 levels (Holm 0.0078)" in text
    assert "equivalen" not in size
    assert narrow.text.count("good is better; equivalence within 2.5 levels not shown") == 2
    text = compare_runs(CompareSettings((str(folder),), equivalence=("error=4",), format="csv")).text
    first, *_, last = csv.DictReader(io.StringIO(text))
    assert (first["margin"], first["equivalent"], last["equivalent"]) == ("4.0", "True", "")


@pytest.mark.parametrize("word", ["0.3", "error=", "error=0", "error=-1", "error=nan", "=0.3"])
def test_a_margin_is_a_metric_and_a_positive_number(word):
    with pytest.raises(ValueError, match="METRIC=MARGIN"):
        CompareSettings(("run",), equivalence=(word,))


def test_margins_of_other_metrics_are_refused(folder):
    settings = CompareSettings((str(folder),), metrics=("size",), equivalence=("error=4",))
    with pytest.raises(InputError, match="--equivalence: expected compared metrics: size, found error"):
        compare_runs(settings)

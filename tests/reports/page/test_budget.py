"""The part "Which method for a budget" of a page: its answers are those of ``headbench recommend``."""

import json

import pytest

from headbench.bench.engine.store import RunFolder
from headbench.bench.rows import Rows
from headbench.bench.specs import MetricSpec
from headbench.reports.page import budget
from headbench.reports.page.report import write_report
from headbench.reports.page.settings import PageSettings
from headbench.reports.recommend import COSTS, RecommendSettings, recommend
from headbench.reports.runs import RunData, RunSet

from ..made_rows import avatar_row, row

METRICS = [
    MetricSpec("psnr", "PSNR", "dB", True, 2, "m:psnr"),
    MetricSpec("training_time", "Training", "min", False, 1, "m:time", kind="avatar", machine_bound=True),
    MetricSpec("storage", "Storage", "MB", False, 2, "m:storage", kind="avatar"),
    MetricSpec("latency_p50", "p50", "ms", False, 2, "m:p50", kind="avatar", machine_bound=True),
]
COST_METRICS = [name for name, _ in COSTS.values()]
METHODS = {
    # PSNR, its change from subject to subject, minutes, MB, ms
    "large": (31.0, 0.0, 4.0, 8.0, 20.0),
    "near": (30.9, 0.5, 3.0, 4.0, 30.0),
    "equal": (29.0, 0.0, 2.0, 2.0, 10.0),
    "small": (29.0, 0.0, 1.0, 1.0, None),
    "floor": (50.0, 0.0, 0.1, 0.1, 0.1),
}
LIMITS = [
    {},
    {"megabytes": 8.0},
    {"megabytes": 7.5},
    {"seconds": 120.0},
    {"milliseconds": 25.0},
    {"seconds": 200.0, "megabytes": 3.0},
    {"seconds": 240.0, "megabytes": 8.0, "milliseconds": 30.0},
    {"megabytes": 1.0},
]


@pytest.fixture
def made(tmp_path, write_manifest):
    """Write a run of some subjects with costs that were measured."""

    def made(subjects=8, costs=COST_METRICS):
        folder, rows = RunFolder(tmp_path / "run"), []
        for method, (psnr, wobble, *values) in METHODS.items():
            for n in range(subjects):
                rows.append(row(method, "psnr", psnr + n + wobble * (-1) ** n, f"s{n}", protocol="p"))
                rows += [
                    avatar_row(method, name, value, f"s{n}")
                    for name, value in zip(COST_METRICS, values, strict=True)
                    if name in costs and value is not None
                ]
        Rows.of(rows).write(folder.rows)
        known = [spec for spec in METRICS if spec.name in ("psnr", *costs)]
        write_manifest(folder, known, dict.fromkeys(METHODS), {"novel_view": "p"}, trivial=("floor",))
        return folder.root

    return made


def content(run):
    return budget.budget_of(RunSet.read([run]), (RunData.read(run),), {"large": 3})


def command(run, limits):
    return recommend(RecommendSettings((str(run),), task="novel_view", **limits))


def test_answers_are_those_of_the_command(made):
    run = made()
    answers = json.loads(json.dumps(content(run)["answers"]))
    verdicts = set()
    for limits in LIMITS:
        fitting = [
            all(
                answers["costs"][cost][i] is not None and answers["costs"][cost][i] <= limits[cost]
                for cost in limits
            )
            for i in range(len(answers["names"]))
        ]
        names = [name for name, fits in zip(answers["names"], fitting) if fits]
        bits = sum(1 << i for i, fits in enumerate(fitting) if fits)
        expected = command(run, limits)
        assert names[0] == expected.data["recommended"]
        assert set(names) == set(expected.data["fitting"])
        sentence = answers["sentences"][answers["sets"][f"{bits:x}"]]
        assert sentence in expected.text
        verdicts.add(sentence.partition(" (")[0])
    assert verdicts == {
        "Not significantly worse",
        "All other choices within the limits are significantly worse",
        "It is the only choice within the limits.",
    }


def test_the_script_gives_the_answers_of_the_command(made, new_tab, tmp_path):
    run, out = made(), tmp_path / "page.html"
    write_report(PageSettings((str(run),), str(out), trust=True))
    tab = new_tab(1200, 800)
    tab.goto(out.as_uri())
    for limits in LIMITS:
        for cost in COSTS:
            tab.fill(f"#limit-{cost}", str(limits.get(cost, "")))
        expected, said = command(run, limits), tab.locator("#answer").text_content()
        first, sentence = (
            expected.text.partition(" Mean over")[0],
            said.partition(". ")[2].partition(" Left out")[0],
        )
        assert said.startswith(first)
        assert sentence in expected.text
        shown = tab.locator("#budget tbody tr:visible th").all_text_contents()
        assert set(shown) == set(expected.data["fitting"])
        assert ("Left out: small: no measured milliseconds." in said) == ("milliseconds" in limits)
    tab.fill("#limit-megabytes", "0.5")
    assert tab.locator("#answer").text_content() == "No choice is within 0.5 MB."


def test_the_table_has_costs_marks_and_tests(made):
    found = content(made())
    rows = {each["label"]: each for each in found["rows"]}
    assert [*rows] == ["large", "near", "equal", "small"]
    assert [each["mark"] for each in rows.values()] == [3, None, None, None]
    assert [text for _, text in rows["large"]["costs"]] == ["◆ 240", "◆ 8", "◆ 20"]
    assert [text for _, text in rows["equal"]["costs"]] == ["120", "2", "◆ 10"]
    assert rows["small"]["costs"][2] == (None, "–")
    assert "the same recommendation for 8 of 8" in found["left_out"][0]
    assert found["left_out"][1].startswith("Over the budgets of the 3 choices")


def test_one_subject_leaves_open_what_cannot_be_known(made):
    found = content(made(1))
    assert found["left_out"][0].startswith("The runs have one subject, so it is not known")
    assert "A test of these methods needs 7 subjects; there is 1." in found["answers"]["sentences"]


def test_without_costs_there_is_nothing_to_limit(made, tmp_path):
    run, out = made(costs=()), tmp_path / "page.html"
    assert content(run)["answers"]["costs"] == {}
    write_report(PageSettings((str(run),), str(out), trust=True))
    text = out.read_text()
    assert "Not measured: training time, size, frame time." in text
    assert 'id="limits"' not in text


def test_without_a_complete_choice_the_reason_is_given(made):
    run = made()
    rows = Rows.read(run / "rows.parquet").of_subjects({"s0", "s1"})
    kept = rows.select(method="floor", metric="psnr", task="novel_view", region="full", seeds=(0,))
    Rows(kept).write(run / "rows.parquet")
    assert "a method with values of every subject" in content(run)["reason"]


def test_limits_leave_the_sets_that_single_limits_make(monkeypatch, made):
    costs = ([1, 2, None], [3, 1, 1])
    # All; {0} or {0, 1} by the first cost; {1, 2} by the second; {1} by both.
    assert budget.sets_within(3, costs) == {0b111, 0b001, 0b011, 0b110, 0b010}
    monkeypatch.setattr(budget, "MOST_SETS", 1)
    assert list(content(made())["answers"]["sets"]) == ["f"]

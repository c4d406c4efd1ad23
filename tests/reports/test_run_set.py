import pytest

from headbench.bench.errors import InputError
from headbench.bench.rows import ALL
from headbench.reports.runs import RunSet


def test_other_seeds_of_the_same_settings_join(make_run):
    both = ("toy_plugin:METHOD", "toy_plugin:MIRROR")
    runs = RunSet.read([make_run("a", methods=both, seeds=(0,)), make_run("b", seeds=(1, 2))])
    assert runs.methods == ("toy", "mirror")
    assert runs.tasks == ("novel_view", "self_reenactment")
    assert [spec.name for spec in runs.metrics] == ["error", "files"]
    assert runs.rows.seeds("toy") == {0, 1, 2}


def test_other_settings_are_told_apart_by_what_differs(make_run):
    first = make_run("a", settings={"toy": {"level": 0.25}})
    second = make_run("b", settings={"toy": {"level": 0.5}})
    runs = RunSet.read([first, second])
    assert runs.methods == ("toy (level=0.25)", "toy (level=0.5)")
    what = {"metric": "error", "task": ALL, "region": "full", "seeds": ALL}
    labelled = runs.rows.select(method="toy (level=0.5)", **what)
    alone = RunSet.read([second]).rows.select(method="toy", **what)
    assert labelled["value"].tolist() == alone["value"].tolist() != []


def test_settings_too_long_for_a_label_give_way_to_the_folder(make_run, change_manifest):
    first, second = make_run("a"), make_run("b")
    change_manifest(first, lambda m: m["methods"][0].update(config={"level": "x" * 60}))
    assert RunSet.read([first, second]).methods == ("toy (a)", "toy (b)")


def test_the_same_training_twice_is_refused(make_run):
    first, second = make_run("a"), make_run("b")
    assert RunSet.read([first, second]).methods == ("toy (a)", "toy (b)")
    with pytest.raises(InputError, match="each training once"):
        RunSet.read([first, first])


def test_runs_of_other_frames_are_refused(make_run):
    with pytest.raises(InputError, match="protocol of novel_view"):
        RunSet.read([make_run("a"), make_run("b", frames_per_task=1)])


def test_a_metric_of_another_definition_is_refused(make_run, change_manifest):
    first, second = make_run("a"), make_run("b", seeds=(1,))
    change_manifest(second, lambda m: m["metrics"][0].update(digits=5, summary="in other words"))
    assert RunSet.read([first, second]).metrics[0].digits == 2
    change_manifest(second, lambda m: m["metrics"][0].update(implementation="other:error"))
    with pytest.raises(InputError, match="error as in"):
        RunSet.read([first, second])


def test_no_run_is_refused():
    with pytest.raises(InputError, match="at least one folder"):
        RunSet.read([])

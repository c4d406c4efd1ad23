from dataclasses import replace

import pytest

from headbench.bench.errors import InputError
from headbench.bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS
from headbench.bench.rows import ALL
from headbench.reports.runs import FrameSelection, RunData, RunSet, check_same_protocol
from headbench.reports.table_report import table_of, table_text
from headbench.reports.writers import to_markdown


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


@pytest.mark.parametrize(
    ("implementation", "version", "methods"),
    [
        ("headbench.methods.toy.method:Toy", "1", ("toy",)),
        ("headbench.methods.toy.method:Toy", "2", ("toy (version=1, code=0)", "toy (version=2, code=1)")),
        ("toy_plugin:Method", "1", ("toy (code=0)", "toy (code=1)")),
    ],
)
def test_versions_tell_the_code_of_this_package_apart(
    make_run, change_manifest, implementation, version, methods
):
    """A plug-in's version says nothing of its code."""
    folders = [make_run("a", seeds=(0,)), make_run("b", seeds=(1,))]
    for code, (folder, own) in enumerate(zip(folders, ("1", version))):
        change_manifest(
            folder,
            lambda m, code=code, own=own: m["methods"][0].update(
                implementation=implementation, version=own, code=str(code)
            ),
        )
    runs = RunSet.read(folders)
    assert runs.methods == methods
    said = "Files of these methods changed between the runs, although their version did not: toy (version 1)."
    assert (said in table_of(runs).facts) == (len(methods) == 1)


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


@pytest.fixture
def faces(make_run):
    """A run with a region: rows of the face are 10 lower, of which the frame at timestep 0 is 5 lower still."""
    import pandas as pd

    run = make_run("a")
    rows = pd.read_parquet(run / "rows.parquet")
    frames = rows[rows["task"] != ""]
    face = frames.assign(region="face", value=frames["value"] - 10 - 5 * (frames["timestep"] == 0))
    pd.concat([rows, face]).to_parquet(run / "rows.parquet", index=False)
    return run


def cell(table, task, metric):
    (index,) = [i for i, column in enumerate(table.columns) if (column.task, column.metric) == (task, metric)]
    return table.rows[0].cells[index].value


def test_a_region_stands_for_the_whole_frame(faces):
    whole, face = (
        table_of(RunSet.read([faces], part)) for part in (FrameSelection(), FrameSelection("face"))
    )
    frames = RunSet.read([faces]).rows.frames("novel_view", "full")
    early = len({frame for frame in frames if frame[2] == 0}) / len(frames)
    expected = cell(whole, "novel_view", "error") - 10 - 5 * early
    assert cell(face, "novel_view", "error") == pytest.approx(expected)
    assert cell(face, "", "files") == cell(whole, "", "files")
    assert "Region: face." in face.caption
    assert "Region" not in whole.caption


def test_sequences_leave_tasks_without_them_out(faces):
    runs = RunSet.read([faces])
    free = {frame[1] for frame in runs.rows.frames("self_reenactment", "full")}
    assert not free & {frame[1] for frame in runs.rows.frames("novel_view", "full")}
    part = RunSet.read([faces], FrameSelection(sequences=tuple(free)))
    assert part.tasks == ("self_reenactment",)
    for task in (SEEN_CAMERAS, UNSEEN_CAMERAS):
        assert cell(table_of(part), task, "error") == cell(table_of(runs), task, "error")
    assert f"Sequences: {', '.join(free)}." in table_text([faces], sequences=tuple(free))


@pytest.mark.parametrize(
    ("part", "words"),
    [
        (FrameSelection("nose"), "region: expected one of face, full, found nose"),
        (FrameSelection(sequences=("X",)), "sequences: .* X"),
    ],
)
def test_a_part_that_runs_do_not_have_is_refused(faces, part, words):
    with pytest.raises(InputError, match=words):
        RunSet.read([faces], part)


def test_no_run_is_refused():
    with pytest.raises(InputError, match="at least one folder"):
        RunSet.read([])


@pytest.fixture
def half_failed(faces):
    """The run with a region, with one subject failed: a row for each metric and task, of no frame."""
    import pandas as pd

    rows = pd.read_parquet(faces / "rows.parquet")
    lost = rows["subject"] == "subject2"
    failed = rows[lost & (rows["region"] == "full")].drop_duplicates(["task", "metric"])
    failed = failed.assign(
        sequence="", timestep=-1, camera="", value=float("nan"), status="failed", reason="E"
    )
    pd.concat([rows[~lost], failed]).to_parquet(faces / "rows.parquet", index=False)
    return faces


@pytest.mark.parametrize(
    "part",
    [
        FrameSelection(),
        FrameSelection("face"),
        FrameSelection(sequences=("FREE",)),
        FrameSelection("face", ("FREE",)),
    ],
)
def test_a_failed_subject_leaves_no_mean_of_the_others(half_failed, part):
    table = table_of(RunSet.read([half_failed], part))
    assert {cell.status for row in table.rows for cell in row.cells} == {"failed"}
    assert all(task.subjects == 2 for task in table.tasks)
    views = [] if part.sequences else ["novel_view"]
    assert [task.task for task in table.tasks] == [*views, SEEN_CAMERAS, UNSEEN_CAMERAS]


def self_reenactment(run):
    """Value of each task of self-reenactment in the comparison, with the table."""
    table = table_of(RunSet.read([run]))
    return {task.task: cell(table, task.task, "error") for task in table.tasks[1:]}, table


def test_seen_and_unseen_cameras_are_two_tasks(make_run):
    run = make_run("a")
    rows = RunSet.read([run]).rows.select(
        method="toy", metric="error", task="self_reenactment", region="full", seeds=ALL
    )
    by_camera = rows.groupby("camera")["value"].mean()  # the toy trains on camera a of each subject
    found, table = self_reenactment(run)
    assert found == pytest.approx({SEEN_CAMERAS: by_camera["a"], UNSEEN_CAMERAS: by_camera["b"]})
    assert by_camera["a"] != by_camera["b"]
    assert [task.frames for task in table.tasks[1:]] == [2, 2]
    assert {task.protocol_hash for task in table.tasks[1:]} == {*rows["protocol"]}
    for caption in (table.caption, table.short_caption):
        assert "Seen cameras (1 scored) have" in caption
        assert "unseen cameras (1 scored) have none" in caption


def train_on_both(manifest):
    for clip in manifest["clips"]:
        clip["training_cameras"] = ["a", "b"]


def train_on_none(manifest):
    for clip in manifest["clips"]:
        clip["training_cameras"] = []


@pytest.mark.parametrize(
    ("change", "why"), [(train_on_both, "on all of its"), (train_on_none, "on none of its")]
)
def test_one_column_states_why(make_run, change_manifest, change, why):
    run = make_run("a")
    expected = self_reenactment(run)[0]
    change_manifest(run, change)
    found, table = self_reenactment(run)
    assert found == pytest.approx({"self_reenactment": sum(expected.values()) / 2})
    assert why in table.caption


def test_runs_that_disagree_on_cameras_share_one_column(make_run, change_manifest):
    runs = [make_run("a"), make_run("b", seeds=(1,))]
    change_manifest(runs[1], train_on_both)
    assert "differ in which cameras" in table_of(RunSet.read(runs)).caption


def test_methods_under_a_condition_are_listed_apart(write_run):
    levels = {"ga": 30.0, "ga+few": 31.0, "mean-image": 15.0, "mean-image+few": 14.0}
    runs = RunSet.read([write_run("run", levels)])
    assert (runs.ranked, runs.changed) == (("ga",), ("ga+few", "mean-image+few"))
    groups = {title: [row.method for row in rows] for title, rows in table_of(runs).groups}
    assert [*groups.values()] == [["ga"], ["ga+few", "mean-image+few"], ["mean-image"]]
    curve = RunSet.read([write_run("curve", {"ga+few": 31.0, "ga+more": 32.0})])
    assert curve.ranked == ("ga+few", "ga+more")


def test_runs_of_other_subjects_are_read_as_one_run(make_run):
    both = make_run("both")
    apart = [make_run(name, subjects=(name,)) for name in ("subject1", "subject2")]
    one, joined = RunSet.read([both]), RunSet.read(apart)
    assert {task: joined.rows.protocols(task) for task in joined.tasks} == {
        task: one.rows.protocols(task) for task in one.tasks
    }
    assert joined.keys == one.keys
    assert joined.methods == one.methods
    assert to_markdown(table_of(joined)) == to_markdown(table_of(one))
    with pytest.raises(InputError, match="Score the same frames"):
        RunSet.read([both, apart[0]])


def test_captures_whose_files_differ_are_named_as_the_reason(make_run):
    run = RunData.read(make_run("both"))
    task = run.tasks[0]
    record = replace(run.manifest.protocols[task], hash="0" * 12, clips=(("subject1", "another"),))
    other = replace(run, manifest=replace(run.manifest, protocols={task: record}))
    with pytest.raises(InputError, match="files of the captures differ in content"):
        check_same_protocol(run, other, task)


def test_the_shared_subjects_are_those_of_every_method(make_run):
    both = ("toy_plugin:MIRROR", "toy_plugin:METHOD")
    runs = RunSet.read([make_run("a", both, ("subject1",)), make_run("b", subjects=("subject2",))])
    assert runs.shared.rows.subjects == {"subject1"}
    assert {key.subject for keys in runs.shared.keys.values() for key in keys} == {"subject1"}
    assert runs.only(["toy"]).shared.rows.subjects == {"subject1", "subject2"}
    alone = runs.only(["mirror"]).shared
    assert {key.subject for keys in alone.keys.values() for key in keys} == {"subject1"}

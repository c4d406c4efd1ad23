"""The harness on toy plug-ins: what a run leaves, resumes, refuses and records."""

import errno
import importlib
import os
import shutil
import sys
import time
import types
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.condition import PLAIN, Condition
from headbench.bench.contracts import Budget
from headbench.bench.engine import cell as cells
from headbench.bench.engine import config as runner_config
from headbench.bench.engine import run as runner
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import HeadbenchError, InputError, reason_of
from headbench.bench.executors.settings import Execution
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import write_json
from headbench.bench.io.lock import locked
from headbench.bench.manifest import Manifest
from headbench.bench.registry import Plugin
from headbench.bench.rows import Rows
from headbench.bench.specs import ReportSpec
from headbench.reports.runs import RunSet
from headbench.reports.tables import METHODS_TITLE, SUSPECT_TITLE, build_table


def killed_before(number, work):
    """Work in a process that ends at once before it gives its ``number``-th file its name; how it ended."""
    process = os.fork()
    if process == 0:
        rename, writes = os.replace, []

        def counted(*paths):
            writes.append(paths)
            if len(writes) == number:
                os._exit(9)
            rename(*paths)

        os.replace = counted
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def content(out):
    return sorted(str(path.relative_to(out)) for path in Path(out).rglob("*"))


@pytest.mark.commands
def test_a_run_killed_before_any_write_continues(config):
    whole = runner.run(config).rows
    for number in range(1, 100):
        again = replace(config, out=f"{config.out}-{number}")
        ended = killed_before(number, lambda run=again: runner.run(run))
        if ended == 0:
            break
        assert ended == 9
        assert runner.run(again).rows._table.equals(whole._table)
        assert content(again.out) == content(config.out)
    assert 5 < number < 99


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory")]
)
def test_out_of_memory_is_an_outcome_of_that_name(error):
    assert reason_of(error).startswith("out of memory: ")
    assert reason_of(ValueError("5")) == "ValueError: 5"


def test_losses_are_written_as_csv_and_for_tensorboard(config, toy, monkeypatch):
    original, written = toy.ToyMethod.fit, []

    def fit(self, clip, out, *arguments, **options):
        original(self, clip, out, *arguments, **options)
        write_json(out / "training.json", {"losses": [[1, 0.5], [2, 0.25]]})

    class Writer(nullcontext):
        def __enter__(self):
            return self

        def add_scalar(self, name, value, step):
            written.append((name, value, step))

    monkeypatch.setattr(toy.ToyMethod, "fit", fit)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", SimpleNamespace(SummaryWriter=Writer))
    runner.run(config)
    losses = [path.read_text() for path in Path(config.out).glob("*/toy/seed-0/losses.csv")]
    assert losses == 2 * ["iteration,loss\n1,0.5\n2,0.25\n"]
    assert written == 2 * [("loss", 0.5, 1), ("loss", 0.25, 2)]


@pytest.fixture
def subjects():
    return ("subject1", "subject2")


@pytest.fixture
def config(config):
    return replace(config, metrics=("toy_plugin:ERROR", "toy_plugin:FILES"))


@pytest.fixture
def refuses(toy):
    """Run with some changes, which are refused before any training."""

    def refuses(config, match, error=InputError, **changes):
        toy.FITS.clear()
        with pytest.raises(error, match=match):
            runner.run(replace(config, **changes))
        assert toy.FITS == []

    return refuses


def rows_of(config, **changes):
    """Table of the rows of a run."""
    config = replace(config, **changes)
    runner.run(config)
    return pd.read_parquet(RunFolder(Path(config.out)).rows)


@pytest.fixture
def kept(finished):
    """Table of the rows of a finished run, see `finished`."""

    def kept(config, **changes):
        finished(replace(config, **changes))
        return pd.read_parquet(RunFolder(Path(changes.get("out", config.out))).rows)

    return kept


def manifest_of(config):
    return read_json(Path(config.out) / "run.json")


def killed(self, *args, **kwargs):
    raise KeyboardInterrupt


def test_rows_hold_every_frame_of_every_task_keyed(config, kept):
    rows = kept(config)
    errors = rows[rows["metric"] == "error"]
    assert len(errors) == 2 * (3 + 2)  # subjects x (novel-view + self-reenactment frames)
    row = errors.query("subject == 'subject2' and task == 'novel_view' and timestep == 2")
    # rendered level round(0.5 * 255) = 128 against 40 + 20 + 1
    assert row["value"].tolist() == [128 - 61]
    assert row["protocol"].nunique() == 1
    per_avatar = rows[rows["metric"] == "files"]
    assert per_avatar["value"].tolist() == [1.0, 1.0]
    assert (per_avatar["timestep"] == -1).all()


def test_the_manifest_names_everything_that_made_the_numbers(config, kept):
    kept(config)
    record = manifest_of(config)
    assert record["status"] == "done"
    assert record["methods"][0]["config"] == {"level": 0.5, "fail": False}
    assert record["methods"][0]["budget"] == {"iterations": 2, "seconds": None}
    assert [clip["fingerprint"] for clip in record["clips"]] == ["toy-subject1", "toy-subject2"]
    assert record["clips"][0]["excluded"] == {"subject1/FREE/00004/a": "tongue out"}
    assert set(record["protocols"]) == {"novel_view", "self_reenactment"}
    assert record["machine"]["packages"]["numpy"]


def test_a_run_killed_in_training_continues(config, kept, toy, monkeypatch):
    whole = kept(config, out=config.out + "-whole")
    with monkeypatch.context() as patch:
        patch.setattr(toy.ToyAvatar, "render", killed)
        with pytest.raises(KeyboardInterrupt):
            runner.run(config)
    toy.FITS.clear()
    assert rows_of(config).equals(whole)
    assert toy.FITS == ["subject2"]  # the first had been trained


def test_the_record_of_training_counts_interruptions(config, toy, monkeypatch, cell):
    with monkeypatch.context() as patch:
        patch.setattr(toy.ToyMethod, "fit", killed)
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                runner.run(config)
    runner.run(config)
    assert cell.record["training"]["interruptions"] == 2
    assert RunFolder(Path(config.out)).cell("subject2", "toy", 0).record["training"]["interruptions"] == 0


def test_what_a_method_prepares_is_not_timed_as_training(config, toy, monkeypatch, cell):
    now, order = [0.0], []

    def prepare(self, device):
        order.append(device)
        now[0] += 1000.0

    fit = toy.ToyMethod.fit

    def timed_fit(self, *arguments, **options):
        order.append("fit")
        now[0] += 1.0
        return fit(self, *arguments, **options)

    monkeypatch.setattr(toy.ToyMethod, "prepare", prepare, raising=False)
    monkeypatch.setattr(toy.ToyMethod, "fit", timed_fit)
    monkeypatch.setattr(
        cells, "time", types.SimpleNamespace(perf_counter=lambda: now[0], monotonic=time.monotonic)
    )
    runner.run(config)
    assert order[:2] == ["cpu", "fit"]
    assert cell.record["training"]["seconds"] == 1.0
    assert "peak_device_memory_bytes" not in cell.record["training"]


@pytest.mark.parametrize("native", [True, False])
def test_a_method_that_looks_at_held_out_frames_fails(config, toy, monkeypatch, native):
    """Of this package or an adapter to a program of others."""
    monkeypatch.setattr(toy, "PEEKING", replace(toy.PEEKING, native=native))
    rows = rows_of(config, methods=("toy_plugin:PEEKING",))
    assert set(rows["status"]) == {"failed"}
    assert rows["reason"].str.contains("not a training frame").all()


def test_an_avatar_that_renders_lists_is_asked_for_lists(config, toy):
    metrics = ("psnr", "storage", "fps")
    rows = rows_of(config, methods=("toy_plugin:LISTING",), metrics=metrics)
    by_metric = dict(iter(rows.groupby("metric")))
    assert set(by_metric["psnr"]["status"]) == {"ok"} == set(by_metric["storage"]["status"])
    assert set(by_metric["fps"]["status"]) == {"missing"}
    assert by_metric["fps"]["reason"].str.contains("lists alone").all()
    one_by_one = rows_of(config, methods=("toy_plugin:MIRROR",), metrics=metrics, out=f"{config.out}-one")
    expected = one_by_one[one_by_one["metric"] == "psnr"]["value"]
    assert by_metric["psnr"]["value"].tolist() == expected.tolist()
    assert [len(keys) for keys in toy.LISTS] == [3, 2] * 2  # a list for each task


def test_a_list_that_comes_back_short_fails_the_cell(config, toy, monkeypatch):
    monkeypatch.setattr(toy.ListingAvatar, "short", True)
    rows = rows_of(config, methods=("toy_plugin:LISTING", "toy_plugin:METHOD"))
    assert set(rows[rows["method"] == "listing"]["status"]) == {"failed"}
    assert set(rows[rows["method"] == "toy"]["status"]) == {"ok"}


NEEDS = [
    ({"head_models": ("flame2020", "flame2023")}, "a head model in FLAME's layout"),
    ({"head_models": ("toy",)}, None),
    ({"monocular": True}, "a head model in FLAME's layout"),  # whose motion could go into the cameras
    ({"implementation": "toy_plugin:NoSuchClass"}, "no attribute 'NoSuchClass'"),
]


@pytest.mark.parametrize(("needs", "found"), NEEDS)
def test_needs_are_checked_before_training(config, toy, monkeypatch, refuses, needs, found):
    monkeypatch.setattr(toy.ToyClip, "head", types.SimpleNamespace(version="toy"))
    monkeypatch.setattr(toy, "SAME_NAME", replace(toy.METHOD, name="needy", **needs))
    both = ("toy_plugin:METHOD", "toy_plugin:SAME_NAME")
    if found is None:
        assert set(rows_of(config, methods=both)["status"]) == {"ok"}
    else:
        refuses(config, found, HeadbenchError, methods=both)


def test_a_capture_without_a_head_is_refused(config, refuses):
    """By what its reader names as `errors`; the option of the command goes on."""
    (Path(config.data) / "subject-wall").mkdir()
    refuses(config, "capture of subject-wall: expected a capture without .* found HB701: no head is seen.")
    assert "--unchecked" in str(pytest.raises(InputError, runner.run, config).value)
    runner.run(config, unchecked=True)
    runner.run(config)
    assert RunFolder(Path(config.out)).read_manifest().unchecked


BOTH = {"methods": ("toy_plugin:METHOD", "toy_plugin:MIRROR")}
OTHER = {
    "methods": (
        BOTH,
        "configuration.methods: expected toy_plugin:METHOD, as in this run, found toy_plugin:METHOD, toy_p",
    ),
    "seeds": ({"seeds": (1,)}, "configuration.seeds: expected 0, as in this run, found 1"),
    "preset": ({"preset": "fast"}, "configuration.preset: expected smoke, as in this run, found fast"),
    "metrics": (
        {"metrics": ("toy_plugin:ERROR",)},
        "metrics: expected toy_plugin:ERROR, toy_plugin:FILES, as",
    ),
    "tasks": ({"tasks": ("novel_view",)}, "configuration.tasks: "),
    "frames": (
        {"frames_per_task": 1},
        "configuration.frames_per_task: expected none, as in this run, found 1",
    ),
    "regions": ({"regions": ()}, "configuration.regions: "),
    "a method's setting": (
        {"settings": {"toy": {"level": 0.75}}},
        "methods.toy.config.level: expected 0.5, .* found 0.75",
    ),
    "a condition": (
        {"conditions": (PLAIN, Condition("half", ("toy",), {"level": 0.75}))},
        "configuration.conditions.half: expected none, as in this run, found name half, methods toy, settings level 0.75",
    ),
    "two": (
        {"seeds": (1,), "preset": "fast"},
        "preset, configuration.seeds: expected smoke; 0, .*, found fast; 1",
    ),
}


@pytest.mark.parametrize("case", OTHER)
def test_another_configuration_is_refused_and_named(config, kept, refuses, case):
    changes, match = OTHER[case]
    kept(config)
    folder = RunFolder(Path(config.out))
    before = folder.rows.read_bytes(), folder.manifest.read_bytes()
    refuses(config, f"{match}.*A run does not change: choose another --out", **changes)
    assert (folder.rows.read_bytes(), folder.manifest.read_bytes()) == before


def test_other_captures_are_refused_the_same_elsewhere_continue(config, kept, refuses, tmp_path, toy):
    rows = kept(config)
    shutil.copytree(config.data, tmp_path / "more")
    assert rows_of(config, data=str(tmp_path / "more")).equals(rows)
    assert toy.FITS == []
    (tmp_path / "more" / "subject3").mkdir()
    refuses(
        config, "captures.subject3, protocols.novel_view, .*: expected none; ", data=str(tmp_path / "more")
    )


def test_a_finished_run_is_read_back(config, kept, toy, monkeypatch, cell):
    """Also without the avatars, which may be deleted; nothing is trained, rendered or measured."""
    rows = kept(config)
    for name in ("avatar", "renders"):
        shutil.rmtree(cell.folder / name)
    monkeypatch.setattr(toy.ToyMethod, "load", lambda *arguments, **options: 1 / 0)
    RunFolder(Path(config.out)).rows.unlink()
    assert rows_of(config).equals(rows)


def test_a_failed_cell_is_repeated(config, toy, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(toy.ToyAvatar, "render", lambda *arguments: 1 / 0)
        assert set(rows_of(config)["status"]) == {"failed"}
    toy.FITS.clear()
    assert set(rows_of(config)["status"]) == {"ok"}
    assert toy.FITS == []


def test_a_full_disk_ends_the_run_and_loses_no_cell(config, toy, monkeypatch, cell):
    original = toy.ToyMethod.fit

    def full(self, clip, *arguments, **options):
        if clip.subject == "subject2":
            raise OSError(errno.ENOSPC, "No space left on device")
        return original(self, clip, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(toy.ToyMethod, "fit", full)
        with pytest.raises(OSError, match="No space left"):
            runner.run(config)
    assert len(cell.record["measured"]) == 2
    toy.FITS.clear()
    assert set(rows_of(config)["status"]) == {"ok"}
    assert toy.FITS == ["subject2"]


def test_more_is_measured_of_the_avatars_of_a_run(config, kept, toy):
    """Rendered and measured as by a run of its own, also under conditions; trained never."""
    config = replace(config, conditions=(PLAIN, Condition("half", ("toy",), {"level": 0.75})))
    kept(config)
    more = replace(config, metrics=("toy_plugin:ERROR", "psnr", "toy_plugin:STEPS"))
    found = rows_of(more, source=config.out, out=f"{config.out}-more")
    assert toy.FITS == []
    assert found.equals(rows_of(more, out=f"{config.out}-whole"))


def test_the_command_measures_more_of_the_avatars_of_a_run(config, kept, toy, capsys):
    kept(config, methods=BOTH["methods"], conditions=(PLAIN, Condition("half", ("toy",), {"level": 0.75})))
    words = ["run", "--from", config.out, "--out", f"{config.out}-more", "--metrics", "psnr"]
    assert cli.main(words) == 2
    assert "configuration.reader: expected names that run no code of others" in capsys.readouterr().err
    named = ["--methods", ",".join(BOTH["methods"]), "--set", "reader=toy_plugin:READER"]
    assert cli.main([*words[:3], *words[5:], *named]) == 2  # the source is no folder to write
    assert "out: expected --out" in capsys.readouterr().err
    assert cli.main([*words, *named]) == 0
    rows = pd.read_parquet(RunFolder(Path(f"{config.out}-more")).rows)
    assert {*zip(rows["method"], rows["condition"])} == {("toy", ""), ("toy", "half"), ("mirror", "")}
    assert set(rows["metric"]) == {"psnr"}
    assert toy.FITS == []


DAMAGE = {
    "cell.json": (
        "subject1/toy/seed-0/cell.json",
        "Delete .*subject1/toy/seed-0; the same command makes it again",
    ),
    "run.json": ("run.json", "run.json"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_record_is_refused_and_named(config, kept, refuses, name):
    kept(config)
    path, match = DAMAGE[name]
    (Path(config.out) / path).write_text("noise")
    refuses(config, match)


@pytest.mark.parametrize("measured", [None, 1])
def test_rows_that_cannot_be_read_are_measured_again(config, kept, toy, cell, measured):
    """Of a measured cell, and of one whose last metrics are still to be measured."""
    rows = kept(config)
    cell.update(measured=cell.record["measured"][:measured])
    cell.rows.write_bytes(cell.rows.read_bytes()[:100])
    assert rows_of(config).equals(rows)
    assert toy.FITS == []


def test_a_method_of_another_name_is_refused(config, kept, refuses, toy, monkeypatch):
    kept(config)
    monkeypatch.setattr(toy, "METHOD", replace(toy.METHOD, name="toy2"))
    refuses(config, "methods: expected toy, as in this run, found toy2")


def test_a_cell_of_other_inputs_or_none_is_not_overwritten(config, kept, cell, refuses):
    kept(config)
    cell.update(fingerprint="other")
    refuses(config, "cell.json, fingerprint: expected the data.* Choose another --out, or delete ")
    cell.file.unlink()
    reasons = rows_of(config).query("status == 'failed'")["reason"]
    assert reasons.str.contains("the record of the avatar in it, found none. Delete ").all()
    assert len(reasons)


def test_a_run_of_an_earlier_version_is_refused(config, kept, refuses):
    kept(config)
    folder = RunFolder(Path(config.out))
    write_json(folder.manifest, {**read_json(folder.manifest), "format": 2})
    refuses(config, "format: expected 3, found 2 .int.. The folder is of an earlier version of headbench")


@pytest.fixture
def edit(toy, tmp_path, monkeypatch):
    """Write a method of two files, with parts of their text replaced, to be imported anew."""
    texts = {
        "edited_plugin": "import edited_level, toy_plugin as toy\n"
        "class Method(toy.ToyMethod):\n    pass\n"
        "METHOD = toy.replace(toy.METHOD, implementation='edited_plugin:Method')\n",
        "edited_level": "LEVEL = 1",
    }
    folders = {name: tmp_path / name.partition("_")[2].replace("level", "plugin") for name in texts}
    for folder in {*folders.values()}:
        folder.mkdir()
        monkeypatch.syspath_prepend(folder)

    def edit(**changes):
        for name, text in texts.items():
            (folders[name] / f"{name}.py").write_text(text.replace(*changes.get(name, ("", ""))))
            sys.modules.pop(name, None)
        importlib.invalidate_caches()

    edit()
    yield edit
    for name in texts:
        sys.modules.pop(name, None)


EDITED = {"methods": ("edited_plugin:METHOD",)}


@pytest.mark.parametrize("kill", [False, True])
def test_changed_code_of_a_plug_in_is_refused(config, edit, toy, refuses, monkeypatch, kill):
    """Also between the parts of a training that was interrupted."""
    config = replace(config, **EDITED)
    with monkeypatch.context() as patch:
        if kill:
            patch.setattr(toy.ToyMethod, "fit", killed)
        with pytest.raises(KeyboardInterrupt) if kill else nullcontext():
            runner.run(config)
    for file, change in (("edited_level", ("1", "2")), ("edited_plugin", ("pass", "..."))):
        edit(**{file: change})
        refuses(config, "methods.toy.code: expected .*, as in this run")
    edit()
    runner.run(config)
    assert len(toy.FITS) == 2 * kill


def test_changed_code_of_a_native_method_is_warned_of(config, monkeypatch, caplog):
    """Its version says whether the results are other ones, and whoever edits it may forget that."""
    monkeypatch.setattr(runner_config, "is_outside", lambda reference: False)
    codes = ["first"]
    monkeypatch.setattr(runner_config, "code_digest", lambda reference: codes[-1])
    rows = rows_of(config)
    assert rows_of(config).equals(rows)
    assert "has changed" not in caplog.text
    codes.append("second")
    assert rows_of(config).equals(rows)
    assert "The code of toy has changed since this run was begun" in caplog.text
    assert manifest_of(config)["methods"][0]["code"] == "second"


def test_a_failing_method_is_recorded_and_the_others_go_on(config):
    rows = rows_of(config, methods=("toy_plugin:FAILING", "toy_plugin:METHOD"))
    failed = rows[rows["method"] == "failing"]
    assert set(failed["status"]) == {"failed"}
    assert failed["reason"].str.contains("the training diverged").all()
    assert failed["value"].isna().all()
    assert (rows[rows["method"] == "toy"]["status"] == "ok").all()


def test_frames_as_good_as_the_truth_are_suspect_and_not_ranked(config, toy, monkeypatch):
    original = toy.MirrorAvatar.render

    def truth(self, camera, pose, *others):
        frame = original(self, camera, pose, *others)
        return frame._replace(
            rgb=np.full_like(frame.rgb, (40 + 10 * pose.timestep + (camera.id == "b")) / 255)
        )

    monkeypatch.setattr(toy.MirrorAvatar, "render", truth)
    rows = rows_of(config, methods=("toy_plugin:METHOD", "toy_plugin:MIRROR"), metrics=("psnr",))
    assert set(rows["reason"][rows["method"] == "mirror"]) == {"suspect: above 50 dB"}
    assert set(rows["reason"][rows["method"] == "toy"]) == {""}
    runs = RunSet.read([Path(config.out)])
    table = build_table(runs, runs.metrics, ("novel_view",))
    groups = {title: [line.method for line in lines] for title, lines in table.groups}
    assert groups == {METHODS_TITLE: ["toy"], SUSPECT_TITLE: ["mirror"]}


def test_a_missing_metric_has_its_reason(config, caplog):
    both = replace(config, metrics=("toy_plugin:NOT_HERE", "toy_plugin:ERROR"))
    rows = rows_of(both)
    missing = rows[rows["metric"] == "not_here"]
    assert set(missing["status"]) == {"missing"}
    assert missing["reason"].str.contains("Put them there").all()
    assert missing["value"].isna().all()
    assert "Absent will be missing" in caplog.records[0].getMessage()


def test_metrics_of_one_measurement_are_taken_together_and_once(config, toy, monkeypatch):
    counted = []
    original = toy.files_in_avatar
    monkeypatch.setattr(toy, "files_in_avatar", lambda *arguments: counted.append(1) or original(*arguments))
    group = ("toy_plugin:FILES_NONE", "toy_plugin:FILES", "toy_plugin:FILES_LOAD")
    rows = rows_of(config, metrics=group).set_index(["subject", "metric"])
    assert len(counted) == 2  # subjects
    assert rows.loc[("subject1", "files"), "value"] == 1.0
    assert rows.loc[("subject1", "files_load"), "value"] == 4.0  # frames of the workload
    assert rows.loc[("subject1", "files_none"), "status"] == "missing"
    assert rows_of(config, metrics=group).set_index(["subject", "metric"]).equals(rows)
    assert len(counted) == 2


def test_a_capture_that_holds_out_nothing_is_trained_on(config, toy, monkeypatch, caplog):
    """Its avatars are measured with the poses of training frames."""
    opened = toy.ToyClip.__init__

    def without_tests(clip, path):
        opened(clip, path)
        clip.splits = {name: keys if name == "train" else () for name, keys in clip.splits.items()}

    monkeypatch.setattr(toy.ToyClip, "__init__", without_tests)
    rows = rows_of(config, metrics=("psnr", "toy_plugin:FILES_LOAD")).set_index(["subject", "metric"])
    assert dict(rows["value"]) == {("subject1", "files_load"): 3.0, ("subject2", "files_load"): 3.0}
    assert "Self-reenactment is missing: the captures hold out no frames" in caplog.text
    assert cli.main(["verify", config.out, "--trust"]) == 0


def test_a_metric_of_training_sees_the_record_of_the_fit(config, cell):
    assert rows_of(config, metrics=("toy_plugin:STEPS",))["value"].tolist() == [2.0, 2.0]
    measured = cell.record["details"]["steps"]
    assert measured["peak"] >= cell.record["training"]["memory_before_bytes"] > 0


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"settings": {"toy": {"levl": 1}}}, "Did you mean 'level'"),
        ({"settings": {"toy": {"budget": {"iterations": 0}}}}, "positive"),
        ({"methods": ("toy_plugin:METHOD", "toy_plugin:SAME_NAME")}, "each method once"),
        ({"methods": ("toy_plugin:METHOD", "toy_plugin:CHECKING")}, "no checkout"),
        ({"data": "nowhere"}, "no such folder"),
        ({"reader_settings": {"shfit": 1}}, "shfit"),
        ({"out": f"{__file__}/out"}, "can be written"),
        ({"device": "cuda:0"}, "cuda"),
    ],
)
def test_bad_settings_are_refused_before_training(config, refuses, monkeypatch, changes, match):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    refuses(config, match, **changes)


UNFIT = [({"fingerprint": "x" * 121}, "fingerprint"), ({"region_names": ("a/b",)}, "region: expected a name")]


@pytest.mark.parametrize(("part", "match"), UNFIT)
def test_what_no_results_can_be_read_with_is_refused(config, toy, monkeypatch, refuses, part, match):
    def read(path):
        clip = toy.ToyClip(path)
        clip.region_masks = dict
        vars(clip).update(part)
        return clip

    monkeypatch.setattr(toy, "read", read)
    refuses(config, match, regions=part.get("region_names"))
    monkeypatch.setattr(toy, "ERROR", replace(toy.ERROR, tables=("../up",)))
    refuses(config, "name and tables")


def test_two_runs_in_one_folder_are_refused_before_training(config, refuses):
    with locked(Path(config.out)):
        refuses(config, "no other process works in")
    runner.run(config)
    assert not (Path(config.out) / "run.lock").exists()


WRITE_REPORTS = runner.write_reports


def test_reports_open_neither_run_nor_captures_again(config, toy, monkeypatch):
    opened = []
    monkeypatch.setattr(runner, "write_reports", WRITE_REPORTS)
    monkeypatch.setattr(toy, "read", lambda path: opened.append(path) or toy.ToyClip(path))
    for kind in (Manifest, Rows):
        monkeypatch.setattr(kind, "read", lambda path: pytest.fail("read again"))
    folder = runner.run(replace(config, metrics=("psnr",))).folder
    assert folder.page.is_file()
    assert folder.contact_sheet.is_file()
    assert len(opened) == 2  # subjects


def test_a_report_that_fails_stops_no_other(monkeypatch, toy, tmp_path, caplog):
    caplog.set_level("WARNING", logger="headbench")
    plugins = [
        Plugin("broken", "other 1", None, "ImportError: no"),
        Plugin("failing", "other 1", ReportSpec("failing", "", "toy_plugin:failing_report")),
        Plugin("text", "other 1", ReportSpec("text", "", "toy_plugin:failing_report", writes=False)),
        Plugin("mine", "other 1", ReportSpec("mine", "", "toy_plugin:report")),
    ]
    monkeypatch.setattr(runner, "discover", lambda group: {plugin.name: plugin for plugin in plugins})
    assert runner.write_reports(types.SimpleNamespace(folder=RunFolder(tmp_path))) == [tmp_path / "mine.txt"]
    assert (tmp_path / "mine.txt").read_text() == "mine"
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 2
    assert "'broken' of other 1 is broken: ImportError: no" in messages[0]
    assert "'failing' of other 1 failed" in messages[1]


def test_a_full_disk_is_no_failure_of_one_report(monkeypatch, toy):
    def full(run):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(toy, "failing_report", full)
    failing = Plugin("failing", "other 1", ReportSpec("failing", "", "toy_plugin:failing_report"))
    monkeypatch.setattr(runner, "discover", lambda group: {"failing": failing})
    with pytest.raises(OSError, match="No space left"):
        runner.write_reports(SimpleNamespace())


def test_planned_cells_have_their_state_and_nothing_is_trained(config, toy, finished):
    finished(config)
    changes = {"preset": "fast", "settings": {"toy": {"budget": {"iterations": 3}}}}
    longer = replace(config, out=f"{config.out}-long", **changes)
    for settings, state in ((config, "done"), (longer, "to train")):
        names = [f"toy, subject {subject}, seed 0" for subject in ("subject1", "subject2")]
        assert runner.planned_cells(settings) == dict.fromkeys(names, state)
    assert toy.FITS == []
    assert not Path(longer.out).exists()
    runner.run(longer)
    (method,) = manifest_of(longer)["methods"]
    assert (method["config"]["level"], method["budget"]["iterations"]) == (0.25, 3)


@pytest.mark.parametrize(
    ("trainings", "cores", "gigabytes", "device", "seconds", "workers"),
    [
        *((3, 2, 23, "cpu", None, 2), (2, 16, 23, "cpu", None, 2), (9, 16, 7, "cpu", None, 3)),
        *((3, 1, 23, "cpu", None, None), (1, 2, 23, "cpu", None, None), (3, 2, 3, "cpu", None, None)),
        *((3, 2, 23, "cuda", None, None), (3, 2, 23, "cpu", 30.0, None)),
    ],
)
def test_trainings_on_cores_with_memory_run_at_once(
    monkeypatch, trainings, cores, gigabytes, device, seconds, workers
):
    def job(trivial=False, is_trained=False):
        method = SimpleNamespace(spec=SimpleNamespace(trivial=trivial), budget=Budget(None, seconds))
        return SimpleNamespace(source=None, method=method, cell=SimpleNamespace(is_trained=is_trained))

    monkeypatch.setattr(runner, "processor_count", lambda: cores)
    monkeypatch.setattr(runner, "memory", lambda: (10**12, gigabytes * 10**9))
    jobs = [*(job() for _ in range(trainings)), job(trivial=True), job(is_trained=True)]
    found = runner.chosen(
        Execution("auto"), SimpleNamespace(jobs=jobs, config=SimpleNamespace(device=device))
    )
    assert (found.executor, found.workers) == ("processes" if workers else "inline", workers)

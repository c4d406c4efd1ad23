"""The speed of a finished run measured again: other rows stay, nothing is trained, nothing is lost."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from headbench.bench import cli, machine
from headbench.bench.contracts import no_progress
from headbench.bench.engine import run as runner
from headbench.bench.engine import speed
from headbench.bench.engine.config import RunOptions
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.executors.settings import Execution
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import write_json
from headbench.bench.io.lock import locked
from headbench.bench.rows import ALL, Rows

CLOCKS = ("clock", "clock_half")


@pytest.fixture
def subjects():
    return ("subject1", "subject2")


@pytest.fixture
def config(config, monkeypatch):
    """A method that fails beside one that does not; no waiting for the load."""
    monkeypatch.setattr(machine, "SHORTEST_LOAD_S", 0.0)
    monkeypatch.setattr(speed, "write_reports", lambda folder: (folder / "reports").touch())
    return replace(
        config,
        methods=("toy_plugin:METHOD", "toy_plugin:FAILING"),
        metrics=("psnr", "toy_plugin:CLOCK", "toy_plugin:FILES", "toy_plugin:CLOCK_HALF"),
    )


def table(rows):
    return rows.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL).reset_index(drop=True)


def read(config):
    return table(Rows.read(RunFolder(Path(config.out)).rows))


def again(config, methods=()):
    return speed.measure_speed_again(Path(config.out), RunOptions(trust=True), methods, no_progress)


@pytest.mark.parametrize("execution", [None, Execution("processes", workers=2)], ids=["inline", "processes"])
def test_only_rows_of_speed_are_replaced(config, toy, cell, execution):
    runner.run(config, execution)
    toy.FITS.clear()
    before = read(config)
    findings = again(config, ("toy",))
    after = read(config)
    is_speed = before["metric"].isin(CLOCKS) & (before["method"] == "toy")
    assert after[~is_speed].equals(before[~is_speed])
    assert (after["value"][is_speed] > before["value"][is_speed]).all()
    assert (after["threads"][is_speed] >= 1).all()
    assert after["other_cores"][is_speed].notna().all()
    assert after["machine"][is_speed].str.contains("core").all()
    assert set(after["machine"][~is_speed]) == {""}
    (first,) = cell.step("measure")["earlier"]
    old = before[is_speed & (before["subject"] == "subject1")].set_index("metric")
    assert first["values"] == {name: old.loc[name, "value"] for name in CLOCKS}
    assert first["threads"] == old.loc["clock", "threads"]
    (change, _) = findings.data["changes"]
    assert change["value"] == (old.loc["clock", "value"], cell_value(after, "subject1"))
    assert (
        f"{change['value'][0]:.1f} -> {change['value'][1]:.1f}" in (Path(config.out) / "run.log").read_text()
    )
    assert (Path(config.out) / "reports").exists()
    table_again = table(runner.run(config, execution))  # keeps what was measured last
    assert table_again[is_speed].equals(after[is_speed])
    assert len(toy.FITS) <= 2  # cells that failed are tried again, no others


def cell_value(rows, subject):
    own = rows[(rows["method"] == "toy") & (rows["subject"] == subject) & (rows["metric"] == "clock")]
    return own["value"].item()


def test_earlier_values_add_up_and_failed_cells_are_left_out(config, cell):
    runner.run(config)
    again(config)
    findings = again(config)
    assert len(cell.step("measure")["earlier"]) == 2
    assert findings.data["left_out"] == ["subject1 failing seed 0", "subject2 failing seed 0"]
    assert findings.passed


@pytest.mark.parametrize(
    "error", [UnavailableError("gone", "find it"), RuntimeError("no ink"), None], ids=repr
)
def test_an_avatar_that_cannot_be_measured_keeps_its_speed(config, toy, cell, monkeypatch, error):
    runner.run(config)
    before, files = read(config), [cell.rows.read_bytes(), cell.step("measure")]
    counted = []

    def once(avatar, workload):
        counted.append(1)
        if len(counted) == 1 and error is not None:
            raise error
        return toy.Measurement(
            7.0, {"half": 3.5} if len(counted) > 1 else {}
        )  # a metric of the run lacks its detail

    monkeypatch.setattr(toy, "clock_time", once)
    findings = again(config)
    after = read(config)
    assert not findings.passed
    assert list(findings.data["failures"]) == ["subject1 toy seed 0"]
    assert after[after["subject"] == "subject1"].equals(before[before["subject"] == "subject1"])
    assert [cell.rows.read_bytes(), cell.step("measure")] == files
    assert cell_value(after, "subject2") == 7.0


@pytest.mark.parametrize("killed", ["begin", "finish"])
def test_a_kill_between_rows_and_record_loses_nothing(config, cell, monkeypatch, killed):
    runner.run(config)
    before = read(config)

    def kill(*arguments, **record):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(type(cell), killed, kill)
        with pytest.raises(KeyboardInterrupt):
            again(config)
    assert read(config).equals(before)
    again(config)
    assert cell_value(read(config), "subject1") > cell_value(before, "subject1")
    frames = before["metric"] == "psnr"
    assert read(config)[frames].equals(before[frames])
    assert cell.step("measure")["earlier"]


def test_a_restart_with_other_methods_takes_speeds_from_cells(config, toy, cell, monkeypatch):
    runner.run(config)
    before, write = read(config), Rows.write
    target = RunFolder(Path(config.out)).rows

    def killed_before_the_runs_file(rows, path):
        if path == target and cell.step("measure").get("earlier"):
            raise KeyboardInterrupt
        write(rows, path)

    with monkeypatch.context() as patch:
        patch.setattr(Rows, "write", killed_before_the_runs_file)
        with pytest.raises(KeyboardInterrupt):
            again(config)
    assert read(config).equals(before)
    again(config, ("failing",))  # whose cells are left out
    after = read(config)
    own = (after["method"] == "toy") & (after["subject"] == "subject1")
    assert after[own].reset_index(drop=True).equals(table(Rows.read(cell.rows)))
    assert cell_value(after, "subject1") > cell_value(before, "subject1")
    assert after[~own].equals(before[~own])


def avatar_altered(out):
    (out / "subject2/toy/seed-0/avatar/level.txt").write_text("0.75")


def avatar_gone(out):
    (out / "subject2/toy/seed-0/avatar/level.txt").unlink()


def training_not_recorded(out):
    (out / "subject2/toy/seed-0/fit.json").unlink()


def run_not_ended(out):
    write_json(out / "run.json", {**read_json(out / "run.json"), "status": "started"})


def other_settings(out):
    record = read_json(out / "run.json")
    record["configuration"]["settings"] = {"toy": {"level": 0.25}}
    write_json(out / "run.json", record)


REFUSED = {
    "avatar altered": (avatar_altered, (), "level.txt.*the file that was written"),
    "avatar gone": (avatar_gone, (), "level.txt.*is missing"),
    "no record": (training_not_recorded, (), "fit.json: expected the avatar of this run, found none"),
    "not ended": (run_not_ended, (), "'done'"),
    "other settings": (other_settings, (), "fit.json.*other settings"),
    "method": (None, ("other",), "toy, failing, found other"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_there_is_refused_before_any_measurement(config, toy, monkeypatch, name):
    harm, methods, expected = REFUSED[name]
    runner.run(config)
    if harm is not None:
        harm(Path(config.out))
    before = read(config)
    with pytest.raises(InputError, match=expected):
        again(config, methods)
    assert read(config).equals(before)


def test_a_folder_in_use_and_a_run_without_speed_are_refused(config):
    runner.run(replace(config, metrics=("psnr",)))
    with pytest.raises(InputError, match="a metric of speed"):
        again(config)
    with locked(Path(config.out)), pytest.raises(InputError, match="no other process"):
        again(config)


def test_the_command_prints_what_changed(config, capsys):
    runner.run(config)
    assert cli.main(["run", "speed", config.out, "--trust", "--methods", "toy", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [change["subject"] for change in found["changes"]] == ["subject1", "subject2"]
    assert (
        cli.main(["run", "speed", config.out]) == 2
    )  # plug-ins that a run folder names are imported with --trust alone

"""What ``headbench run extremes`` and ``headbench run reenact`` have in common: resumed, in worker processes, with failures."""

import json

import pandas as pd
import pytest

from headbench.bench.experiments.extremes import (
    ExtremesSettings,
    ReenactSettings,
    extremes_run,
    reenact_run,
)
from headbench.bench.registry import get

pytestmark = pytest.mark.usefixtures("no_sheets")
CELLS = {
    f"{subject}/{method}/seed-0" for subject in ("ball-a", "ball-bee") for method in ("bursting", "listed")
}


def driven(command, folder, **changes):
    if command == "extremes":
        how = {"views": 2, "samples": 3, "path": 2}
        return extremes_run(ExtremesSettings(str(folder), trust=True, **how, **changes))
    return reenact_run(ReenactSettings(str(folder), trust=True, **changes))


@pytest.fixture(params=["extremes", "reenact"])
def command(request):
    return request.param


@pytest.fixture
def renders(balls, monkeypatch):
    """Counts the frames that are rendered."""
    done = []
    original = balls.Ball.render
    monkeypatch.setattr(balls.Ball, "render", lambda *given: done.append(1) or original(*given))
    return done


@pytest.mark.commands
def test_worker_processes_leave_the_same(ball_run):
    folder = ball_run("BURSTING", "LISTED")
    outs = [folder.parent / name for name in ("inline", "tasks")]
    for out, how in zip(outs, ({}, {"executor": "processes", "workers": 1})):
        driven("extremes", folder, out=str(out), **how)
    left = [{p.relative_to(out).as_posix(): p for p in out.rglob("*") if p.is_file()} for out in outs]
    assert left[1].keys() - left[0].keys() == {f"{c}/job.log" for c in CELLS}
    for name, path in left[0].items():
        if not name.endswith(("run.json", "cell.json")):  # times
            assert path.read_bytes().replace(b"inline", b"tasks") == left[1][name].read_bytes(), name


def test_what_is_done_is_kept(ball_run, command, renders):
    folder = ball_run("BALL")
    out = folder / "out"
    assert driven(command, folder, out=str(out)).passed
    before, whole = (out / "rows.parquet").read_bytes(), len(renders)
    assert driven(command, folder, out=str(out)).passed
    assert len(renders) == whole
    assert (out / "rows.parquet").read_bytes() == before


def test_an_avatar_that_fails_is_recorded_and_the_others_go_on(ball_run, command, balls, monkeypatch):
    folder = ball_run("BALL", "SPLATTY")

    def burst(*given):
        raise RuntimeError("no splats today")

    monkeypatch.setattr(balls.Splatty, "splats", burst)
    found = driven(command, folder, out=str(folder / "out"))
    assert not found.passed
    assert "ball-a splatty seed 0 failed: RuntimeError: no splats today" in found.text
    rows = pd.read_parquet(folder / "out" / "rows.parquet")
    failed = rows[rows["method"] == "splatty"]
    assert set(failed["status"]) == {"failed"}
    assert set(failed["metric"]) == {metric.name for metric in get("conditions", command).metrics}
    record = json.loads((folder / "out" / "record.json").read_text())
    assert {avatar["method"] for avatar in record["avatars"]} == {"ball"}
    assert [each["subject"] for each in record["failed"]] == ["ball-a", "ball-bee"]

"""The reproduction of a paper: its runs, its plan, and a rehearsal on invented recordings that is killed once."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from headbench.bench import cli
from headbench.bench.contracts import no_progress
from headbench.bench.engine.config import resolve_cells
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.experiments import reproduce
from headbench.bench.experiments.forecast import Amounts, MethodRates, Rates, bytes_left, forecast
from headbench.bench.experiments.reproduce import ReproduceSettings, planned_runs
from headbench.bench.experiments.specs import MOVED_LINES
from headbench.datasets.head.loaders import load_head
from headbench.datasets.head.teeth import with_teeth
from headbench.datasets.nersemble.plan import plan_subject, shortened
from headbench.reports.papers import paper_named

from ...datasets.head.flame_files import write_flame
from ...datasets.head.flame_stand_in import stand_in, write_stand_in
from ...datasets.nersemble.recordings import SEQUENCES, write_painted, write_recording

SETTINGS = ReproduceSettings("tensorial-2025", "data", "tracking", "flame2023.pkl", "out")


def test_methods_without_the_device_run_on_their_own():
    runs = planned_runs(replace(SETTINGS, flame2020="2020.pkl"))
    assert {name: (run.methods, run.device) for name, run in runs.items()} == {
        "table-3-cpu": (("insta",), "cpu"),
        "table-3": (("ga", "gbs", "gha", "ours"), "cuda"),
        "table-4": (("ours",), "cuda"),
    }
    assert {run.heads["flame2020"] for run in runs.values()} == {"2020.pkl"}
    printed = ("psnr", "ssim", "lpips", "storage", "fps")
    assert {run.metrics for run in runs.values()} == {(*printed, "training_time")}
    assert {run.preset for run in runs.values()} == {"paper"}
    excluded = {name: run.reader_settings["exclude"] for name, run in runs.items()}
    assert excluded["table-3-cpu"] == excluded["table-3"] != excluded["table-4"]


def test_every_row_of_the_ablation_is_a_condition():
    (table,) = (t for t in paper_named("tensorial-2025").tables if t.table == "Table 4")
    cells = resolve_cells(planned_runs(SETTINGS)["table-4"])
    assert [condition.name for _, condition in cells] == ["", MOVED_LINES]
    dynamic = [list(method.config.lines.dynamic) for method, _ in cells]
    assert dynamic == [row.settings["lines.dynamic"] for row in table.rows]


def test_a_plan_multiplies_rates_by_amounts():
    settings = replace(SETTINGS, methods=("ga",), ablation="", iterations=("ga=3600",))
    rates = Rates(0.5, 1e6, {"ga": MethodRates(2.0, 0.1, 2e6)})
    found = forecast(rates, planned_runs(settings), {"table-3": Amounts(3, 7200, 36_000)})
    assert found["hours"] == pytest.approx(1 + 3 * 2 + 1)
    assert found["bytes"] == pytest.approx(7200 * 1e6 + 36_000 * 2e6)
    assert found["failed"] == []
    failed = {"ga": MethodRates(None, 0.0, 0.0)}
    again = forecast(replace(rates, methods=failed), planned_runs(settings), {"table-3": Amounts(3, 1, 1)})
    assert again["failed"] == ["ga: iterations"]


def test_amounts_are_those_of_the_recordings(tmp_path):
    recording = write_recording(tmp_path)
    plan = plan_subject(recording.settings(tmp_path / "out"), "901")
    trained, free = SEQUENCES.values()
    assert Amounts.of([plan, plan]) == Amounts(2, 2 * 3 * (trained + free), 2 * (trained + 3 * free))
    sample = shortened(plan, 2, tmp_path / "sample")
    assert [(job.count, job.tracked.count, job.folder.parent.name) for job in sample.jobs] == (
        [(2, 2, "sample")] * 2
    )


def test_room_is_needed_for_what_is_not_there(tmp_path, monkeypatch):
    """An earlier call has left captures; one more subject is refused, and nothing once all is written."""
    recording = write_recording(tmp_path)
    settings = replace(
        SETTINGS,
        data=str(recording.root),
        tracking=str(recording.tracking),
        head=str(recording.head),
        out=str(tmp_path / "out"),
        methods=("ga",),
        subjects="901",
        ablation="",
        sequences="EMO-1,FREE",
        downscale=2,
        device="cpu",
    )
    runs, plans = planned_runs(settings), [plan_subject(settings.preparation("table-3"), "901")]
    rates = Rates(0.5, 1e18, {"ga": MethodRates(2.0, 0.1, 1.0)})
    monkeypatch.setattr(reproduce, "measure", lambda *_: rates)
    (tmp_path / "out" / "captures").mkdir(parents=True)
    amounts = Amounts.of(plans)
    assert bytes_left(rates, runs, {"table-3": plans}) == amounts.images * 1e18 + amounts.frames
    with pytest.raises(InputError, match="GB of free space"):
        reproduce._plan(settings, runs, {"table-3": plans}, no_progress)
    for job in plans[0].jobs:
        for path in (job.image_path(t, i) for t in range(job.count) for i in range(len(job.cameras))):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    assert bytes_left(rates, runs, {"table-3": plans}) == amounts.frames
    reproduce._plan(settings, runs, {"table-3": plans}, no_progress)
    cell = RunFolder(Path(runs["table-3"].out)).cell("901", "ga", 0)
    cell.folder.mkdir(parents=True)
    cell.rows.touch()
    assert bytes_left(rates, runs, {"table-3": plans}) == 0


def test_a_sequence_without_tracking_is_named_first(tmp_path, capsys):
    recording = write_recording(tmp_path)
    shutil.rmtree(recording.tracking / "901_FREE_v3_DS2_wBg")
    words = [
        "run",
        "reproduce",
        "tensorial-2025",
        "--data",
        str(recording.root),
        "--out",
        str(tmp_path / "o"),
    ]
    words += ["--tracking", str(recording.tracking), "--head", str(recording.head), "--methods", "ga"]
    words += ["--subjects", "901", "--ablation", "", "--sequences", "EMO-1,FREE", "--device", "cpu"]
    assert cli.main(words) == 2
    assert "901 FREE: expected VHAP's tracked_flame_params_*.npz, found none" in capsys.readouterr().err
    assert not (tmp_path / "o" / "plan").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--device cude", "device is 'cude'"),
        ("--methods ga ga", "methods names something twice: ga, ga"),
        ("--downscale 0", "--downscale: expected at least 1, found 0"),
        ("--timed 1", "--timed: expected at least 2, found 1"),
        ("--methods ga --iterations gbs=3", "--iterations: expected one of ga, ours, found 'gbs'"),
    ],
)
def test_what_no_run_can_have_is_refused(words, message, capsys):
    required = ["--data", "d", "--tracking", "t", "--head", "h", "--out", "o"]
    assert cli.main(["run", "reproduce", "tensorial-2025", *required, *words.split()]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def rehearsal(folder: Path) -> list[str]:
    """Recordings of two subjects with a stand-in for FLAME of both years, and the command that reproduces the paper on them."""
    flame = folder / "flame"
    write_stand_in(flame)
    head = stand_in("flame2023")
    write_flame(flame / "flame2023.pkl", replace(head, expression_basis=head.expression_basis[:, :, ::-1]))
    head = replace(with_teeth(load_head(flame / "flame2023.pkl")), eyelid_basis=None)
    for seed, subject in enumerate(("901", "902")):
        recording = write_painted(folder, subject, head, size=(48, 64), seed=100 * seed)
    words = ["run", "reproduce", "tensorial-2025", "--data", str(recording.root)]
    words += ["--tracking", str(recording.tracking), "--head", str(flame / "flame2023.pkl")]
    words += ["--flame2020", str(flame / "generic_model.pkl"), "--out", str(folder / "out")]
    words += ["--subjects", "901,902", "--ablation", "901", "--sequences", "EMO-1,FREE", "--downscale", "2"]
    words += ["--device", "cpu", "--executor", "inline", "--preset", "smoke", "--timed", "2"]
    return [*words, "--methods", "gbs", "ours", "--iterations", "gbs=2", "ours=3"]


@pytest.mark.slow
def test_a_killed_rehearsal_continues_to_the_claims(tmp_path):
    words, out = rehearsal(tmp_path), tmp_path / "out"
    command = [sys.executable, "-m", "headbench.bench.start", *words]
    first = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
    trained = out / "runs" / "table-3" / "901" / "gbs" / "seed-0" / "rows.parquet"
    while not trained.exists() and first.poll() is None:
        time.sleep(0.2)
    os.killpg(first.pid, signal.SIGKILL)
    assert first.wait() == -signal.SIGKILL
    kept = [trained, out / "plan.json", *out.glob("captures/*/*/images/*.png")]
    before = {path: path.stat().st_mtime_ns for path in kept}
    assert cli.main(words) == 0
    assert {path: path.stat().st_mtime_ns for path in kept} == before
    assert (out / "plan.md").read_text().count("iterations |") == 4
    for name in ("jaw_bases.png", "expression_clusters.png"):
        assert (out / "figures" / name).exists()
    verdicts = json.loads((out / "claims.json").read_text())
    assert len(verdicts) == len(paper_named("tensorial-2025").claims)
    statuses = {verdict["claim"]["id"]: verdict["status"] for verdict in verdicts}
    assert statuses["ours-storage"] == "met"
    assert statuses["gbs-novel-view"] == statuses["opacity-novel-view"] == "missed"
    assert statuses["insta-novel-view"] == statuses["faster-than-gha"] == "not run"

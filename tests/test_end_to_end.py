"""The main job on real input, small: a path-traced capture, all methods, every metric, tables and pictures."""

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import pytest

from headbench.bench import cli
from headbench.bench.run_config import RunConfig, resolve_metrics
from headbench.bench.store import RunFolder, read_rows

TINY = ("--preset", "smoke", "--set", "frames_per_task=3")
METHODS = {"mean-image", "nearest-camera", "ga", "gbs", "gha", "insta", "ours"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of one small comparison from nothing."""
    out = tmp_path_factory.mktemp("demo")
    assert cli.main(["demo", "--out", str(out), *TINY]) == 0
    return RunFolder(out)


def quality(folder: RunFolder):
    """Rows that must not depend on the machine's load, in one order."""
    rows = read_rows(folder.rows)
    columns = ["method", "task", "subject", "sequence", "timestep", "camera", "metric"]
    machine_bound = {s.name for s in resolve_metrics(RunConfig("", "")) if "speed" in s.tables or s.training}
    return rows[~rows["metric"].isin(machine_bound)].sort_values(columns).reset_index(drop=True)


def test_every_cell_of_the_comparison_is_there(run):
    rows = read_rows(run.rows)
    assert set(rows["method"]) == METHODS
    assert set(rows["metric"]) == {s.name for s in resolve_metrics(RunConfig("", ""))}
    measured = rows[rows["metric"] != "lpips"]  # whose weights may not be at hand
    # Stages, primitives and shared files are offers that a method may leave out; the splat methods on a mesh make them.
    offers = measured["metric"].str.startswith(("stage_", "primitive")) | (
        measured["metric"] == "storage_shared"
    )
    measured = measured[~offers | measured["method"].isin({"ga", "gbs", "ours"})]
    assert (measured["status"] == "ok").all()
    assert measured["value"].notna().all()
    psnr = rows[rows["metric"] == "psnr"]
    frames = psnr[psnr["region"] == "full"].groupby(["method", "task"])["camera"].count()
    assert (frames == 3).all()


def test_trained_methods_beat_the_mean_image_even_after_seconds(run):
    rows = read_rows(run.rows)
    psnr = rows[(rows["metric"] == "psnr") & (rows["task"] == "novel_view") & (rows["region"] == "full")]
    means = psnr.groupby("method")["value"].mean()
    assert means["ga"] > means["mean-image"] + 1
    assert means["ours"] > means["mean-image"] + 1


def test_tables_and_pictures_are_left_to_look_at(run, capsys):
    assert {path.suffix for path in run.tables.iterdir()} == {".md", ".csv", ".tex", ".html", ".json"}
    sheet = cv2.imread(str(run.contact_sheet))
    assert sheet.shape[0] > 300
    assert sheet.std() > 10
    capsys.readouterr()
    assert {path.stem for path in run.tables.iterdir()} == {"comparison", "speed", "cost"}
    for layout, mark in (("speed", "Raster"), ("cost", "Per primitive")):
        assert cli.main(["table", str(run.root), "--layout", layout]) == 0
        assert mark in capsys.readouterr().out
    for form, mark in (("md", "| ours"), ("csv", "ours,"), ("latex", r"\toprule")):
        assert cli.main(["table", str(run.root), "--format", form]) == 0
        assert mark in capsys.readouterr().out


def test_the_manifest_lets_one_repeat_it(run):
    record = run.read_manifest()
    assert record["status"] == "done"
    assert record["peak_memory_bytes"] > 0
    for protocol in record["protocols"].values():
        assert protocol["hash"]
        assert not {tuple(k) for k in protocol["keys"]} & {tuple(k) for k, _ in protocol["excluded"]}


def test_the_result_is_there_for_machines(run, capsys):
    assert cli.main(["demo", "--out", str(run.root), *TINY, "--json"]) == 0
    means = json.loads(capsys.readouterr().out)["means"]
    assert {entry["method"] for entry in means} == METHODS


@pytest.mark.slow
def test_killed_at_random_moments_it_ends_with_the_same_numbers(run, tmp_path):
    command = [sys.executable, "-m", "headbench.bench.cli", "demo", "--out", str(tmp_path / "demo"), *TINY]
    draw = random.Random(time.time_ns())  # the moment must not matter
    for _ in range(4):
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=tmp_path
        )
        try:
            process.wait(draw.uniform(3, 25))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
    subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
    resumed, whole = quality(RunFolder(tmp_path / "demo")), quality(run)
    assert resumed.equals(whole)
    assert Path(tmp_path / "demo" / "contact_sheet.png").read_bytes() == run.contact_sheet.read_bytes()

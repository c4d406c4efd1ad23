"""What a run takes on disk, what can be deleted, and what its cells will probably take."""

import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.engine import run as runner
from headbench.bench.engine.disk import clean, usage
from headbench.bench.engine.forecast import forecast
from headbench.bench.engine.run import planned_jobs
from headbench.bench.errors import InputError, reason_of
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import write_json
from headbench.bench.io.lock import locked


def total(run):
    return sum(path.stat().st_size for path in run.rglob("*") if path.is_file())


def test_renders_are_deleted_and_rendered_again(config, toy):
    run = Path(config.out)
    runner.run(config)
    rows = (run / "rows.parquet").read_bytes()
    before = usage(run)
    assert sum(before.values()) == total(run)
    assert clean(run, ("renders",)) == before["renders"] > 0
    assert usage(run) == {**before, "renders": 0}
    assert not [*run.rglob("renders")]
    toy.FITS.clear()
    runner.run(config)
    assert toy.FITS == []
    assert usage(run)["renders"] == before["renders"]
    assert (run / "rows.parquet").read_bytes() == rows


def test_avatars_set_aside_and_checkpoints_are_deleted(config):
    run = Path(config.out)
    runner.run(config)
    (cell,) = run.glob("*/toy/seed-0")
    (cell / "avatar-damaged-1").mkdir()
    (cell / "avatar-damaged-1" / "level.txt").write_text("0.5")
    (cell / "avatar" / "checkpoint.safetensors").write_bytes(b"12345")
    assert clean(run, ("damaged", "checkpoints")) == 3  # a finished avatar keeps what its method wrote
    assert not (cell / "avatar-damaged-1").exists()
    assert (cell / "avatar" / "level.txt").exists()
    write_json(cell / "fit.json", {**read_json(cell / "fit.json"), "status": "started"})
    assert clean(run, ("checkpoints",)) == 5


def test_a_subject_called_jobs_and_runs_inside_are_no_logs(config, tmp_path):
    run = Path(config.out)
    runner.run(config)
    (subject,) = {path.parents[2].name for path in run.glob("*/toy/seed-0/fit.json")}
    (run / subject).rename(run / "jobs")
    inner = run / "sweep" / "subject1" / "toy" / "seed-0"
    inner.mkdir(parents=True)
    (run / "sweep" / "run.json").write_text("{}")
    (inner / "job.log").write_text("log")
    assert clean(run, ("logs",)) == 0
    assert (run / "jobs" / "toy" / "seed-0" / "fit.json").exists()
    with locked(run / "sweep"), pytest.raises(InputError, match="no other process works in"):
        clean(run, ("logs",))


def test_status_shows_the_disk_and_cleans(config, capsys):
    runner.run(config)
    assert cli.main(["status", config.out, "--clean", "renders"]) == 0
    assert "deleted: 0.0 MB of renders" in capsys.readouterr().out
    assert usage(Path(config.out))["renders"] == 0


def test_a_dry_run_estimates_by_cells_that_were_trained(config, toy):
    runner.run(config)
    longer = {"toy": {"budget": {"iterations": 200}}}
    other = replace(config, out=f"{config.out}-long", settings=longer)
    record = next(Path(config.out).glob("*/toy/seed-0/fit.json"))
    pd.Series({**pd.read_json(record, typ="series"), "seconds": 4.0}).to_json(record)
    before = toy.FITS.copy()
    (cell,) = forecast(planned_jobs(other), [Path(config.out)]).data["cells"]
    assert (cell["state"], cell["seconds"]) == ("to train", 4.0 * 200 / 2)
    assert cell["disk"] > 0
    (unknown,) = forecast(planned_jobs(other), []).data["cells"]
    assert unknown["seconds"] is None
    (done,) = forecast(planned_jobs(config), []).data["cells"]
    assert done["state"] == "done"
    assert toy.FITS == before
    assert not Path(other.out).exists()


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
    (losses,) = Path(config.out).glob("*/toy/seed-0/losses.csv")
    assert losses.read_text() == "iteration,loss\n1,0.5\n2,0.25\n"
    assert written == [("loss", 0.5, 1), ("loss", 0.25, 2)]

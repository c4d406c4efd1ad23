"""The suite on two small subjects: its tables, and what is refused before any work."""

import re

import pytest

from headbench.bench import cli
from headbench.bench.engine.config import resolve_method
from headbench.bench.experiments import suite as module
from headbench.bench.experiments.suite_settings import ABLATIONS
from headbench.bench.registry import get

SMALL = ("--subjects", "2", "--cameras", "2", "--timesteps", "60", "--size", "16x16")


@pytest.mark.slow
def test_the_suite_makes_subjects_and_tables_by_region_and_part(tmp_path, capsys):
    words = ["run", "suite", "--out", str(tmp_path / "s"), "--methods", "mean-image", "ga", "ours"]
    assert cli.main([*words, "--preset", "smoke", *SMALL]) == 0
    text = (tmp_path / "s" / "results.md").read_text()
    titles = re.findall("^## (.*)", text, re.MULTILINE)
    parts = [f"Sequence FREE-{part}" for part in ("1-seen", "2-recombined", "3-beyond")]
    assert titles == ["All frames", *(f"Region {name}" for name in sorted(module.REGIONS)), *parts]
    assert text.count("2 subjects") >= len(titles)
    assert text.count("first - second") >= len(titles)
    assert text in capsys.readouterr().out
    made = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.png")}
    assert cli.main([*words, "--preset", "smoke", *SMALL]) == 0
    assert all(path.stat().st_mtime_ns == time for path, time in made.items() if "renders" in path.parts)


@pytest.mark.parametrize("name", ABLATIONS)
def test_every_ablation_is_a_setting_of_ours_that_changes_it(name):
    plain = resolve_method(get("methods", "ours"), "fast", {})
    changed = resolve_method(get("methods", "ours"), "fast", ABLATIONS[name])
    assert changed.record() != plain.record()


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["--methods", "nothing"], "nothing"),
        (["--preset", "huge"], "huge"),
        (["--size", "big"], "WIDTHxHEIGHT"),
        (["--ablations", "all", "--methods", "ga"], "ours among them"),
        (["--ablations", "no-head"], "no-lines, lines-move-splats"),
        (
            ["--ablations", "no-lines", "fixed-sizes", "--preset", "paper"],
            "ablations that change ours of preset paper",
        ),
        (["--methods", "ours", "ga-official"], "checkout"),
        (["--executor", "processes", "--workers", "0"], "at least 1"),
        (["--set", "preset=smoke"], "expected one of execution"),
        (["--executor", "slurm", "--set", "execution.slurm.gpus=-1"], "at least 0"),
    ],
)
def test_what_cannot_be_run_is_refused_before_a_capture_is_made(tmp_path, capsys, words, match):
    assert cli.main(["run", "suite", "--out", str(tmp_path / "s"), *words]) == 2
    assert match in capsys.readouterr().err
    assert not (tmp_path / "s" / "capture").exists()

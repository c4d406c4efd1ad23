"""The suite on two small subjects: its tables and plan, and what is refused before any work."""

import re
from functools import reduce
from pathlib import Path
from types import SimpleNamespace

import pytest

from headbench.bench import cli
from headbench.bench.configuration import merge
from headbench.bench.engine.config import resolve_cells, resolve_method
from headbench.bench.engine.store import RunFolder
from headbench.bench.experiments import suite as module
from headbench.bench.experiments.specs import MOVED_LINES
from headbench.datasets.open import open_clip
from headbench.datasets.synthetic.plan import FRONTAL, serials
from headbench.methods.ours.spec import ADDITIONS, OURS, OURS_PLUS

SMALL = ("--subjects", "2", "--cameras", "2", "--timesteps", "60", "--size", "16x16")


@pytest.mark.slow
def test_the_suite_makes_subjects_and_tables_by_region_and_part(tmp_path, capsys):
    """With the other camera held out than in the captures' own splits."""
    (other,) = {*serials(2)} - {FRONTAL}
    words = ["run", "suite", "--out", str(tmp_path / "s"), "--methods", "mean-image", "ga", "ours"]
    words += ["--preset", "smoke", *SMALL, "--extremes", "1", "--repeated", "1", "--held-out-cameras", other]
    assert cli.main(words) == 0
    text = (tmp_path / "s" / "results.md").read_text()
    endpoints, recorded, exact = (re.findall("^## (.*)", part, re.MULTILINE) for part in text.split("\n# "))
    parts = [f"Sequence FREE-{part}" for part in ("1-seen", "2-recombined", "3-beyond", "4-speech")]
    tables = ["All frames", *(f"Region {name}" for name in sorted(module.REGIONS)), *parts]
    tables += ["Cost", "Speed", "Mechanism", "Conditions of ours"]
    assert (endpoints, recorded) == (["Primary endpoints"], tables)
    assert exact == [*tables, "New poses and views", "Variance between and within subjects"]
    assert text.count("not testable with 2 subjects") == 3
    assert text.count("no comparison") == 2  # LPIPS of so small images
    assert f"Tables of all results: {tmp_path / 's' / 'results.md'}" in capsys.readouterr().out
    scored = RunFolder(tmp_path / "s" / "run-recorded" / "01").read_manifest().protocols
    own = open_clip(tmp_path / "s" / "capture-recorded" / "UNION14_900")
    assert {*scored["self_reenactment"].keys} == {*own.splits["self_reenactment"]}
    others = {key for keys in own.splits.values() for key in keys} - {*own.splits["self_reenactment"]}
    assert {*scored["novel_view"].keys} == {key for key in others if key.camera == other}
    made = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.png")}
    assert cli.main(words) == 0
    assert all(path.stat().st_mtime_ns == time for path, time in made.items() if "renders" in path.parts)


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """What a suite with some options makes: (arguments of the capture, configuration of the run) of each run, in order."""

    def plan(*options, failed=(), driven=None):
        captures, runs = [], []
        driven = [] if driven is None else driven

        def capture(out, **given):
            captures.append(given | {"out": out})
            return [Path(out) / "one"]

        monkeypatch.setattr("headbench.datasets.synthetic.capture.synthesize", capture)
        monkeypatch.setattr("headbench.reports.suite.suite.suite_report", lambda folder, method: "tables")
        monkeypatch.setattr(
            module,
            "run",
            lambda config, execution: (
                runs.append(config) or SimpleNamespace(rows=SimpleNamespace(failed=[*failed]))
            ),
        )
        monkeypatch.setattr(module, "closing", lambda run, rows: "")
        monkeypatch.setattr(module, "extremes_run", lambda settings, progress: driven.append(settings))
        assert cli.main(["run", "suite", "--out", str(tmp_path / "s"), *options]) == bool(failed)
        exact = [run.out for run in runs if Path(run.out).parent.name == "run"]
        assert [settings.run for settings in driven] == ([] if "--extremes" in options else exact)
        return list(zip(captures, runs, strict=True))

    return plan


def test_every_subject_has_two_captures_and_a_run_of_each(asked):
    options = ("--methods", "mean-image", "ga", "ours", "insta", "--size", "40x58", "--repeated", "1")
    found = asked(*options, "--subjects", "3", "--first", "1")
    assert [(capture["only"], Path(run.out).parent.name) for capture, run in found] == [
        *((0, "run"), (0, "run-recorded"), (0, "run-seeds")),
        *((1, "run"), (1, "run-recorded"), (2, "run"), (2, "run-recorded")),
    ]
    (_, exact), (_, recorded), (_, seeds), *_ = found
    assert [[c.name for c in run.conditions] for run in (exact, recorded, seeds)] == [
        *(["", "coded", MOVED_LINES], ["", MOVED_LINES], [""])
    ]
    assert (recorded.methods, seeds.methods, seeds.seeds) == (exact.methods, ("ga", "ours"), (1,))
    assert found[1][0]["out"] == found[2][0]["out"] != found[0][0]["out"]
    assert "lpips-face" in recorded.metrics
    effects = ("tracking_error", "correctives", "hair_lag", "camera_colour", "dynamics")
    assert [[capture[name] for name in effects] for capture, _ in found[:2]] == [
        [0, 0, 0, 0, 2],
        [1, 1, 1, 1, 2],
    ]
    assert {(capture["seed"], capture["size"], capture["subjects"]) for capture, _ in found} == {
        (module.SEED, (40, 58), 3)
    }


ONE = ("--subjects", "1")


@pytest.mark.parametrize(
    ("options", "conditions"),
    [
        (["--methods", "mean-image", "ga"], []),
        (["--methods", "ga", "ours", "--ablations", "no-lines"], ["no-lines"]),
        (["--methods", "ga", "ours", "--ablations", "all"], [*OURS.ablations]),
    ],
)
def test_ablations_are_conditions_of_their_methods(asked, options, conditions):
    _, (_, recorded) = asked(*options, *ONE)
    assert [condition.name for condition in recorded.conditions] == ["", *conditions]
    assert {condition.methods for condition in recorded.conditions[1:]} == (
        {("ours",)} if conditions else set()
    )


def test_the_avatars_beside_a_failed_training_are_driven(asked):
    driven = []
    asked("--methods", "mean-image", "ga", "ours", "--subjects", "2", failed=["ga"], driven=driven)
    assert [settings.methods for settings in driven] == [("ours",)] * 2


def test_iterations_are_those_asked_for(asked):
    (_, config), _ = asked("--methods", "ga", "ours", "--iterations", "ga=70", "--preset", "demo", *ONE)
    iterations = {
        (m.spec.name, c.name): m.budget.iterations for m, c in resolve_cells(config) if not c.follows
    }
    preset = OURS.presets["demo"]["budget"]["iterations"]
    assert iterations == {("ga", ""): 70, ("ours", ""): preset, ("ours", MOVED_LINES): preset}


@pytest.mark.parametrize(
    ("options", "held_out"),
    [
        (("--cameras", "12"), [*module.HELD_OUT_CAMERAS]),
        (("--cameras", "4"), None),
        (("--cameras", "4", "--held-out-cameras", FRONTAL), [FRONTAL]),
    ],
)
def test_three_cameras_are_held_out_where_they_are(asked, options, held_out):
    (_, config), _ = asked("--methods", "ga", *ONE, *options)
    assert config.reader_settings.get("held_out_cameras") == held_out


def test_a_plan_counts_hours_and_makes_nothing(tmp_path, capsys):
    words = [
        "run",
        "suite",
        "--out",
        str(tmp_path / "s"),
        "--methods",
        "mean-image",
        "ga",
        "ours",
        "--subjects",
        "4",
    ]
    words += ["--iterations", "ga=100", "ours=50", "--cameras", "12", "--timesteps", "60", "--repeated", "2"]
    assert (
        cli.main([*words, "--plan", "ga=36000000", "ours=36000000", "capture=3600000", "frame=360000"]) == 0
    )
    found = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()
    ]
    # Of 60 timesteps 15 are held out: 45 of each of three cameras, and 15 of all 12, are scored.
    hours = {(line[0], line[1]): line[2:] for line in found if len(line) == 5}
    assert hours["run", "capture"] == ["4", "720", "2.88"]
    assert hours["run", "ga"] == ["4", "100", "4.00"]
    assert hours["run-recorded", "ours"] == ["4", "100", "4.00"]  # with the ablation
    assert hours["run-seeds", "ours"] == ["2", "50", "1.00"]
    assert hours["run", "frame"] == ["4", str(6 * 315), "0.76"]
    total = sum(float(line[2]) for line in hours.values() if line[2].replace(".", "").isdigit() and line[0])
    assert float(hours["all", ""][2]) == pytest.approx(total, abs=0.05)
    assert not (tmp_path / "s").exists()


def test_the_page_has_the_output_of_its_command(capsys):
    page = (Path(__file__).parents[3] / "docs" / "explanation" / "suite.md").read_text("utf-8")
    (words,) = re.findall(r"^headbench (run suite .*--plan .*)$", page, re.MULTILINE)
    assert cli.main(words.split()) == 0
    printed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    assert [line for line in printed if line not in page] == []
    assert f"seed {module.SEED}" in page
    (measured,) = re.findall(r"^headbench (run suite (?!.*--plan).*)$", page, re.MULTILINE)
    assert words.startswith(measured)


def test_ablations_change_ours_and_additions_make_ours_plus():
    additions = reduce(merge, ADDITIONS.values(), {})
    for preset in OURS.presets:
        plain = resolve_method(OURS, preset, {}).config
        assert all(resolve_method(OURS, preset, each).config != plain for each in OURS.ablations.values())
        assert resolve_method(OURS, preset, additions).config == resolve_method(OURS_PLUS, preset, {}).config


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["--preset", "huge"], "huge"),
        (["--ablations", "all", "--methods", "ga"], "ours among them"),
        (["--ablations", "no-lines", "fixed-sizes"], "fixed-sizes"),
        (["--methods", "ours", "ga-official"], "checkout"),
        (["--subjects", "2", "--first", "3"], "at most --subjects, 2"),
        (["--set", "preset=smoke"], "expected one of execution"),
        (["--seeds", "0", "0"], "--seeds: expected each once, found 0, 0"),
        (["--seeds", "-1"], "--seeds: expected whole numbers from 0, found -1"),
        (["--methods", "ga", "ga"], "--methods: expected each once, found ga, ga"),
        (["--iterations", "ga=0"], "NAME=NUMBER, whole numbers from 1"),
        (["--methods", "ga", "--iterations", "gq=5"], "'gq'"),
        (["--methods", "ga", "--plan", "ga=5", "capture=5"], "microseconds of capture, frame, ga"),
        (["--cameras", "4", "--held-out-cameras", FRONTAL, "222200044"], "which --cameras 4 makes"),
        (["--cameras", "2", "--held-out-cameras", "222200042", FRONTAL], "fewer than all cameras"),
    ],
)
def test_what_cannot_be_run_is_refused_before_a_capture_is_made(tmp_path, capsys, words, match):
    assert cli.main(["run", "suite", "--out", str(tmp_path / "s"), *words]) == 2
    assert match in capsys.readouterr().err
    assert not (tmp_path / "s" / "capture").exists()

"""The suite on two small subjects: its tables, and what is refused before any work."""

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
from headbench.bench.rows import ALL
from headbench.datasets.open import open_clip
from headbench.datasets.synthetic.command import SynthSettings
from headbench.datasets.synthetic.panels import default_samples
from headbench.datasets.synthetic.plan import FRONTAL, SyntheticSettings
from headbench.methods.ours.spec import ADDITIONS, OURS, OURS_PLUS
from headbench.reports.suite.suite import suite_runs

SMALL = ("--subjects", "2", "--cameras", "2", "--timesteps", "60", "--size", "16x16")


@pytest.mark.slow
def test_the_suite_makes_subjects_and_tables_by_region_and_part(tmp_path, capsys):
    words = ["run", "suite", "--out", str(tmp_path / "s"), "--methods", "mean-image", "ga", "ours"]
    words += ["--tracked", "ga", "--large", "1", "--equal-iterations", "none"]
    assert cli.main([*words, "--preset", "smoke", *SMALL]) == 0
    text = (tmp_path / "s" / "results.md").read_text()
    usual, large = (re.findall("^## (.*)", part, re.MULTILINE) for part in text.split("\n# "))
    parts = [f"Sequence FREE-{part}" for part in ("1-seen", "2-recombined", "3-beyond", "4-speech")]
    tables = ["All frames", *(f"Region {name}" for name in sorted(module.REGIONS)), *parts]
    tables += ["Cost", "Speed", "Mechanism"]
    assert large == [f"{title} (exploratory)" for title in tables]
    tracked = [f"Tracked from images{region} (exploratory)" for region in ("", ", face")]
    assert usual == ["Primary endpoints", *large, *tracked, "New poses and views (exploratory)"]
    assert text.count("2 subjects") >= len(large)
    assert "32 x 32 pixels" in text.split("\n# ")[1]
    assert text.count("\nMethods ") >= 2 * len(large)  # heads of the differences
    assert f"Tables of all results: {tmp_path / 's' / 'results.md'}" in capsys.readouterr().out
    made = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.png")}
    assert cli.main([*words, "--preset", "smoke", *SMALL]) == 0
    assert all(path.stat().st_mtime_ns == time for path, time in made.items() if "renders" in path.parts)


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """What a suite with some options makes: (arguments of the capture, configuration of the run) of each run, in order."""

    def plan(*options):
        captures, runs, driven = [], [], []

        def capture(out, **given):
            captures.append(given | {"out": out})
            return [Path(out) / "one"]

        monkeypatch.setattr("headbench.datasets.synthetic.capture.synthesize", capture)
        monkeypatch.setattr("headbench.reports.suite.suite.suite_report", lambda folder, method: "tables")
        monkeypatch.setattr(
            module,
            "run",
            lambda config, execution: runs.append(config) or SimpleNamespace(rows=SimpleNamespace(failed=[])),
        )
        monkeypatch.setattr(module, "closing", lambda run, rows: "")
        monkeypatch.setattr(module, "extremes_run", lambda settings, progress: driven.append(settings.run))
        assert cli.main(["run", "suite", "--out", str(tmp_path / "s"), *options]) == 0
        usual = [
            run.out for run in runs if Path(run.out).parent.name == "run" and run.methods != ("mean-image",)
        ]
        assert driven == ([] if "--extremes" in options else usual)
        return list(zip(captures, runs, strict=True))

    return plan


def test_the_page_has_the_command_of_the_stored_suite(asked):
    root = Path(__file__).parents[3]
    first, *_ = suite_runs(root / "reports" / "gallery" / "suite")
    stored = RunFolder(first).read_manifest()
    page = (root / "docs" / "explanation" / "suite.md").read_text("utf-8")
    (capture, config), *_ = asked(*re.search(r"^headbench run suite (.+)$", page, re.MULTILINE)[1].split())
    names = ("subjects", "cameras", "timesteps", "size", "seed", "performance", "tracking_error", "tracker")
    samples = default_samples(*capture["size"])
    planned = SyntheticSettings(
        head="procedural2023",
        tracking_noise=0.0,
        samples_per_pixel=samples,
        **{name: capture[name] for name in names},
    ).described()
    recorded = dict(stored.clips[0].steps[0]["parameters"]["synthetic"])
    del recorded["style"]
    assert recorded == planned | {"size": list(planned["size"])}
    assert config.conditions == stored.configuration.conditions


ONE = ("--subjects", "1", "--large", "0")


@pytest.mark.parametrize(
    ("options", "conditions"),
    [
        (["--methods", "mean-image", "ga", "insta"], {"tracked": ("ga",)}),
        (["--methods", "ours", "gbs"], {"as-tracked": ("gbs",), "tracked": ("gbs", "ours")}),
        (["--methods", "ga", "insta", "--tracked", "insta"], {"tracked": ("insta",)}),
        (["--methods", "ga", "--tracked", "none", "--levels", "3"], {}),
        (
            ["--methods", "ours", "--levels", "3", "--tracked-ablations", "no-lines"],
            dict.fromkeys(("tracked", "tracking-3", "no-lines-tracked", "no-lines-tracking-3"), ("ours",)),
        ),
    ],
)
def test_conditions_of_tracking_have_methods(asked, options, conditions):
    ((_, config),) = asked(*options, *ONE, "--equal-iterations", "none")
    coded = {"coded": tuple(name for name in config.methods if name != "mean-image")}
    assert {each.name: each.methods for each in config.conditions} == {"": (), **coded, **conditions}


def test_equal_iterations_are_those_of_ga(asked):
    given = ("--methods", "mean-image", "ga", "ours", "insta", "--preset", "fast", "--tracked", "none")
    ((_, config),) = asked(*given, *ONE)
    cells = {(m.spec.name, c.name): m.budget.iterations for m, c in resolve_cells(config)}
    assert cells["ours", "equal-iterations"] == cells["ga", ""] != cells["ours", ""]
    assert {name for name, condition in cells if condition == "equal-iterations"} == {"ours"}


def test_every_subject_has_a_run_and_the_first_also_large_images(asked):
    options = ("--methods", "ours", "ga", "--ablations", "no-lines", "--equal-iterations", "none")
    found = asked(*options, "--size", "40x58", "--subjects", "3", "--large", "1")
    assert [capture["only"] for capture, _ in found] == [0, 0, 1, 2]
    assert [capture["size"] for capture, _ in found] == [(40, 58), (80, 116), (40, 58), (40, 58)]
    assert {capture["subjects"] for capture, _ in found} == {3}
    assert [Path(run.out).relative_to(Path(found[0][1].out).parents[1]).as_posix() for _, run in found] == [
        *("run/01", "run-large/01", "run/02", "run/03")
    ]
    names = [[condition.name for condition in run.conditions] for _, run in found]
    every = ["", "coded", "tracked", "no-lines"]
    assert names == [every, ["", "coded"], every, every]
    later = asked(
        *options, "--subjects", "3", "--first", "3", "--large", "0", "--repeated", "3", "--extremes", "0"
    )
    assert [(capture["only"], run.seeds) for capture, run in later] == [(2, (0,)), (2, (1, 2))]
    assert [condition.name for condition in later[1][1].conditions] == [""]


RECORDED = ("--tracker", "video", "--tracking-error", "1", "--correctives", "1", "--hair-lag", "1")
RECORDED += ("--camera-colour", "1", "--dynamics", "2")


def test_captures_have_the_effects_of_recordings_at_every_size(asked):
    effects = {"tracker": "video", "tracking_error": 1.0, "correctives": 1.0, "hair_lag": 1.0}
    effects |= {"camera_colour": 1.0, "dynamics": 2.0}
    for (capture, _), size in zip(asked(*RECORDED, *ONE[:2], "--size", "40x58"), [(40, 58), (80, 116)]):
        assert {**effects, "size": size}.items() <= capture.items()
    ((plain, config),) = asked(*ONE)
    defaults = SynthSettings("")
    assert {name: plain[name] for name in effects} == {name: getattr(defaults, name) for name in effects}
    assert config.reader_settings == {}
    assert "lpips-face" in config.metrics


@pytest.mark.slow
def test_held_out_cameras_are_the_novel_views(tmp_path):
    """On the recorded capture, whose own split has the frontal camera; sequences and all else are as in it."""
    words = ["run", "suite", "--out", str(tmp_path / "s"), "--methods", "mean-image", "--preset", "smoke"]
    words += [*ONE, "--cameras", "3", "--timesteps", "60", "--size", "24x34", *RECORDED]
    held_out = [FRONTAL, "221501007"]
    assert cli.main([*words, "--held-out-cameras", *held_out]) == 0
    folder = RunFolder(tmp_path / "s" / "run" / "01")
    manifest = folder.read_manifest()
    own = open_clip(tmp_path / "s" / "capture")
    scored = {task: {*protocol.keys} for task, protocol in manifest.protocols.items()}
    every = {key for keys in own.splits.values() for key in keys}
    assert scored["self_reenactment"] == {*own.splits["self_reenactment"]}
    others = every - scored["self_reenactment"]
    assert scored["novel_view"] == {key for key in others if key.camera in held_out}
    assert {key.camera for key in own.splits["novel_view"]} == {FRONTAL}
    values = folder.read_rows(manifest).select(
        method="mean-image", metric="lpips-face", task="novel_view", region="full", seeds=ALL
    )
    assert len(values) == len(scored["novel_view"])
    assert (values["status"] == "ok").all()


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
        (["--tracked-ablations", "no-lines", "--tracked", "none"], "ours among those of --tracked"),
        (["--methods", "ours", "ga-official"], "checkout"),
        (["--tracked", "ours", "--methods", "ga"], "methods of tracked"),
        (["--subjects", "2", "--first", "3"], "at most --subjects, 2"),
        (["--levels", "5"], "above 0 and at most 4"),
        (["--set", "preset=smoke"], "expected one of execution"),
        (["--hair-lag", "5"], "--hair-lag: expected 0 to 4"),
        (["--cameras", "4", "--held-out-cameras", FRONTAL, "222200044"], "which --cameras 4 makes"),
        (["--cameras", "2", "--held-out-cameras", "222200042", FRONTAL], "fewer than all cameras"),
    ],
)
def test_what_cannot_be_run_is_refused_before_a_capture_is_made(tmp_path, capsys, words, match):
    assert cli.main(["run", "suite", "--out", str(tmp_path / "s"), *words]) == 2
    assert match in capsys.readouterr().err
    assert not (tmp_path / "s" / "capture").exists()

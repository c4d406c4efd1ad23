"""The suite on two small subjects: its tables, and what is refused before any work."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench import cli
from headbench.bench.condition import PLAIN
from headbench.bench.engine.config import resolve_method
from headbench.bench.engine.store import RunFolder
from headbench.bench.experiments import suite as module
from headbench.bench.experiments.suite_settings import ABLATIONS, SEED, SuiteSettings
from headbench.bench.registry import get
from headbench.datasets.synthetic.panels import default_samples
from headbench.datasets.synthetic.performance import EXPRESSION_CONTROLS
from headbench.datasets.synthetic.plan import RESIDUALS, SyntheticSettings, load_geometry, plan_subject
from headbench.reports.readme import SUITE, suite_options

SMALL = ("--subjects", "2", "--cameras", "2", "--timesteps", "60", "--size", "16x16")


@pytest.mark.slow
def test_the_suite_makes_subjects_and_tables_by_region_and_part(tmp_path, capsys):
    words = ["run", "suite", "--out", str(tmp_path / "s"), "--methods", "mean-image", "ga", "ours"]
    words += ["--tracked", "ga", "--large", "1"]
    assert cli.main([*words, "--preset", "smoke", *SMALL]) == 0
    text = (tmp_path / "s" / "results.md").read_text()
    usual, large = (re.findall("^## (.*)", part, re.MULTILINE) for part in text.split("\n# "))
    parts = [f"Sequence FREE-{part}" for part in ("1-seen", "2-recombined", "3-beyond", "4-speech")]
    tables = ["All frames", *(f"Region {name}" for name in sorted(module.REGIONS)), *parts]
    assert large == [f"{title} (exploratory)" for title in tables]
    tracked = [f"Tracked from images{region} (exploratory)" for region in ("", ", face")]
    assert usual == ["Primary endpoints", *large, *tracked]
    assert text.count("2 subjects") >= len(large)
    assert "32 x 32 pixels" in text.split("\n# ")[1]
    assert text.count("first - second") >= 2 * len(large)
    assert text in capsys.readouterr().out
    made = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.png")}
    assert cli.main([*words, "--preset", "smoke", *SMALL]) == 0
    assert all(path.stat().st_mtime_ns == time for path, time in made.items() if "renders" in path.parts)


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """What a suite with some options makes: (arguments of the capture, configuration of the run) of each part."""

    def plan(*options):
        captures, runs = [], []
        found = {
            get("datasets", "synthetic").implementation: lambda out, **given: captures.append(
                given | {"out": out}
            ),
            get("reports", "suite").implementation: lambda runs, method: "tables",
        }
        monkeypatch.setattr(module, "resolve", found.__getitem__)
        monkeypatch.setattr(
            module, "run", lambda config, execution: runs.append(config) or SimpleNamespace(failed=[])
        )
        monkeypatch.setattr(module, "closing", lambda run, rows: "")
        assert cli.main(["run", "suite", "--out", str(tmp_path / "s"), *options]) == 0
        return list(zip(captures, runs, strict=True))

    return plan


def test_the_stored_suite_can_be_made_again_by_its_options(asked):
    folder = Path(__file__).parents[3] / SUITE
    stored = RunFolder(folder / "run").read_manifest()
    ((capture, config),) = asked(*suite_options(folder))
    names = ("subjects", "cameras", "timesteps", "size", "seed", "performance", "tracking_error", "tracker")
    samples = default_samples(*capture["size"])
    planned = SyntheticSettings(
        head="procedural2023",
        tracking_noise=0.0,
        samples_per_pixel=samples,
        **{name: capture[name] for name in names},
    ).described()
    # Records of edition 2 leave out what has its default of then.
    usual = {"dynamics": 1.0, "tracker": "per-frame", **dict.fromkeys(RESIDUALS, 0.0)}
    recorded = usual | dict(stored.clips[0].steps[0]["parameters"]["synthetic"])
    del recorded["style"]
    assert recorded.pop("edition") < planned.pop("edition")
    assert recorded == planned | {"size": list(planned["size"])}
    assert not any(condition.clip for condition in config.conditions)


@pytest.mark.parametrize(
    ("options", "tracked"),
    [
        (["--methods", "mean-image", "ga", "insta"], ("ga",)),
        (["--methods", "ours", "ga", "gbs"], ("ga", "gbs", "ours")),
        (["--methods", "ga", "insta", "--tracked", "insta"], ("insta",)),
        (["--methods", "ga", "ours", "--tracked", "none"], None),
        (["--methods", "insta"], None),
    ],
)
def test_tracking_from_images_is_a_condition_of_methods(asked, options, tracked):
    ((_, config),) = asked(*options, "--large", "0")
    found = {
        condition.clip.name: condition.methods
        for condition in config.conditions
        if condition.clip or condition == PLAIN
    }
    assert found == {"": ()} | ({} if tracked is None else {"tracked": tracked})


def test_large_images_are_a_run_of_the_first_subjects(asked):
    options = ("--methods", "ours", "ga", "--ablations", "no-lines")
    (usual, run), (large, own) = asked(*options, "--size", "40x58", "--subjects", "3", "--large", "2")
    changed = {"out": own.data, "subjects": 2, "size": (80, 116)}
    assert large == usual | changed
    assert (usual["out"], usual["subjects"], usual["size"]) == (run.data, 3, (40, 58))
    assert len({usual["out"], large["out"], run.out, own.out}) == 4
    assert asked("--methods", "ours", "--subjects", "1")[1][0]["subjects"] == 1
    assert own.methods == run.methods
    assert [condition.name for condition in run.conditions] == ["", "coded", "tracked", "no-lines"]
    assert [condition.name for condition in own.conditions] == [""]


@pytest.mark.parametrize(("performance", "alike"), [("natural", False), ("parts", True)])
def test_subjects_of_natural_captures_have_own_choreographies(tmp_path, performance, alike):
    settings = SuiteSettings(out=str(tmp_path))
    captured = SyntheticSettings(
        2, 2, settings.timesteps, (16, 16), "procedural", SEED, 0.0, 4, performance=performance
    )
    geometry = load_geometry("procedural")
    plans = [plan_subject(tmp_path, index, geometry, captured) for index in range(captured.subjects)]
    assert not [*tmp_path.iterdir()]
    controls = [name for name in EXPRESSION_CONTROLS if not name.startswith("blink")]
    for name in plans[0].performed:
        first, second = (
            np.array(
                [[moment[control] for control in controls] for moment in plan.performed[name].activations]
            )
            for plan in plans
        )
        moving = [values - values.mean(axis=0) for values in (first, second)]
        if all(values.any() for values in moving):
            correlation = np.corrcoef(*map(np.ravel, moving))[0, 1]
            assert (correlation > 0.9) == alike, name
            assert alike or abs(correlation) < 0.5, name


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
        (["--tracked", "ours", "--methods", "ga"], "methods of tracked"),
        (["--tracked", "ga", "none"], "names of methods, or none"),
        (["--large", "-1"], "at least 0"),
        (["--performance", "still"], "natural"),
        (["--tracker", "none"], "per-frame"),
        (["--executor", "processes", "--workers", "0"], "at least 1"),
        (["--set", "preset=smoke"], "expected one of execution"),
        (["--executor", "slurm", "--set", "execution.slurm.gpus=-1"], "at least 0"),
    ],
)
def test_what_cannot_be_run_is_refused_before_a_capture_is_made(tmp_path, capsys, words, match):
    assert cli.main(["run", "suite", "--out", str(tmp_path / "s"), *words]) == 2
    assert match in capsys.readouterr().err
    assert not (tmp_path / "s" / "capture").exists()

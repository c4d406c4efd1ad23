"""The main job on real input, small: a synthetic capture, all methods, every metric, tables and pictures.

Then every command that the command line lists, over the folder of that run and from another directory.
"""

import io
import json
import random
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, redirect_stdout
from functools import partial

import cv2
import pandas as pd
import pytest

from headbench.bench import cli, machine
from headbench.bench.engine.config import RunConfig, resolve_metrics
from headbench.bench.engine.store import RunFolder
from headbench.bench.registry import SPEC_TYPES, discover
from headbench.datasets.ga.reader import read_capture
from headbench.metrics import speed

from .datasets.flat_renderer import flat_pictures
from .datasets.monocular.videos import Recording
from .datasets.nersemble.recordings import write_recording
from .datasets.tracker_files.trackers import write_metrical
from .world import SETTINGS

SMALL = (f"--set=settings.{name}={json.dumps(SETTINGS[name])}" for name in ("gbs", "gha", "insta"))
TINY = ("--preset", "smoke", "--set=frames_per_task=3", *SMALL)
"""Few frames; two iterations of the methods of which nothing but that they run is asked."""
pytestmark = pytest.mark.commands

METHODS = {"mean-image", "nearest-camera", "ga", "gbs", "gha", "insta", "ours", "ours-plus"}


@contextmanager
def timed_in_few_frames():
    """Time a few frames: how many decides how exact speeds are, which nothing here asks for."""
    short = {"warm_up": 2, "warm_up_s": 0.1, "window": 1, "latency": 3, "throughput": 3}
    few = partial(speed.SpeedProtocol, **short, stages=2, one_thread=2, static=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speed, "SpeedProtocol", few)
        patch.setattr(machine, "SHORTEST_LOAD_S", 0.02)
        yield


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Speed of few frames, and captures drawn in milliseconds: those that are ray-traced have tests of their own."""
    with timed_in_few_frames(), flat_pictures():
        yield


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """One small comparison from nothing, its paths given from a directory that is left afterwards: its folder, what it prints."""
    home = tmp_path_factory.mktemp("home")
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed):
        patch.chdir(home)
        assert cli.main(["demo", "--out", "demo", *TINY, "--json"]) == 0
    return RunFolder(home / "demo"), printed.getvalue()


@pytest.fixture(scope="module")
def run(demo):
    return demo[0]


def quality(folder: RunFolder):
    """Rows that must not depend on the machine's load, in one order."""
    rows = pd.read_parquet(folder.rows)
    columns = ["method", "task", "subject", "sequence", "timestep", "camera", "metric"]
    machine_bound = {
        s.name for s in resolve_metrics(RunConfig("", "")) if "speed" in s.tables or s.kind == "training"
    }
    return rows[~rows["metric"].isin(machine_bound)].sort_values(columns).reset_index(drop=True)


def test_every_cell_of_the_comparison_is_there(run):
    every = pd.read_parquet(run.rows)
    coded = every[(every["condition"] == "coded") & every["metric"].isin(["psnr", "storage"])]
    assert set(coded["method"]) == METHODS - {"mean-image", "nearest-camera"}
    assert (coded["status"] == "ok").all()
    rows = every[every["condition"] == ""]
    assert set(rows["method"]) == METHODS
    assert set(rows["metric"]) == {s.name for s in resolve_metrics(RunConfig("", ""))}
    measured = rows[rows["metric"] != "lpips"]  # whose weights may not be at hand
    # Stages, primitives and shared files are offers that a method may leave out; the splat methods on a mesh make them.
    mechanism = measured["metric"].str.contains("^dynamic_|_range$")
    shown = measured[measured["metric"] == "dynamic_splats"]
    assert set(shown[shown["status"] == "ok"]["method"]) == METHODS - {"mean-image", "nearest-camera"}
    measured = measured[~mechanism]
    offers = measured["metric"].str.startswith(("stage_", "primitive"))
    offers |= measured["metric"].isin(["storage_shared", "fps_without_head"])
    measured = measured[~offers | measured["method"].isin({"ga", "gbs", "ours"})]
    assert (measured["status"] == "ok").all()
    assert measured["value"].notna().all()
    psnr = rows[rows["metric"] == "psnr"]
    frames = psnr[psnr["region"] == "full"].groupby(["method", "task"])["camera"].count()
    assert (frames == 3).all()


def test_trained_methods_beat_the_mean_image_even_after_seconds(run):
    rows = pd.read_parquet(run.rows)
    psnr = rows[(rows["metric"] == "psnr") & (rows["task"] == "novel_view") & (rows["region"] == "full")]
    means = psnr.groupby("method")["value"].mean()
    assert means["ga"] > means["mean-image"] + 1
    assert means["ours"] > means["mean-image"] + 1


def test_tables_and_pictures_are_left_to_look_at(run):
    assert {path.suffix for path in run.tables.iterdir()} == {".md", ".csv", ".tex", ".html", ".json"}
    assert {path.stem for path in run.tables.iterdir()} == {"comparison", "speed", "cost", "mechanism"}
    assert '<script type="application/json" id="images">["' in run.page.read_text()
    sheet = cv2.imread(str(run.contact_sheet))
    assert sheet.shape[0] > 300
    assert sheet.std() > 10


@pytest.mark.slow
def test_killed_at_random_moments_it_ends_with_the_same_numbers(tmp_path):
    """Processes of their own, whose capture is ray-traced."""
    words = [sys.executable, "-m", "headbench.bench.start", "demo", *TINY, "--out"]
    subprocess.run([*words, str(tmp_path / "whole")], check=True, capture_output=True, cwd=tmp_path)
    command = [*words, str(tmp_path / "demo")]
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
    resumed, whole = (RunFolder(tmp_path / name) for name in ("demo", "whole"))
    assert quality(resumed).equals(quality(whole))
    assert resumed.contact_sheet.read_bytes() == whole.contact_sheet.read_bytes()


FORMATS = {
    "md": r"(?i)\| ours +\|",
    "csv": "(?im)^ours",
    "latex": r"\\toprule",
    "html": "<table",
    "json": '(?i)"ours"',
}
LAYOUTS = {
    "speed": "(?s)Raster.*ours",
    "cost": "(?s)Per primitive.*ours",
}


def case(words, prints, *leaves):
    """A command line, what it prints (a pattern), and the files it leaves in the directory."""
    return words, prints, leaves


def cell(method):
    return f"{{demo}}/{{subject}}/{method}/seed-0"


OTHERS = "synth --out others --subjects 2 --cameras 2 --timesteps 4 --size 24x32"
PLAIN = "run --data {capture} --out plain --methods mean-image,nearest-camera --preset smoke --set metrics=psnr,ssim,fps --set frames_per_task=3"
SUITE = "run suite --out suite --methods mean-image --preset smoke --subjects 1 --cameras 2 --timesteps 60 --size 16x16"
GATE = "compare plain --baseline baseline.json"
PREPARE = (
    "prepare nersemble --root recording/recording --tracking recording/tracking --head recording/head.npz"
)

FINDS_FAULTS = ("run extremes",)
"""Commands that end with 1: avatars trained for two iterations do not look like the person."""
EVERY_METHOD = "(?s)ga .*gbs .*gha .*insta .*ours "

# In the order in which they run: some need what an earlier one left.
CASES = {
    "demo": [],  # the run of this module
    "synth": [case(OTHERS, "others", "others/synthesis.json")],
    "run": [case(PLAIN, "(?m)^nearest-camera", "plain/rows.parquet", "plain/tables/comparison.md")],
    "status": [case("status plain", "2 cells: 0 waiting, 0 running, 2 done, 0 failed")],
    "run suite": [
        case(
            SUITE,
            "Tables of all results: suite/results.md",
            "suite/results.md",
            "suite/run/01/rows.parquet",
            "suite/run-recorded/01/rows.parquet",
        )
    ],
    "list": [
        *(case(f"list {what}", r"\w") for what in (*SPEC_TYPES, "presets", "papers", "protocols")),
        case("list methods --cite", "(?s)32.97 dB.*claimed.*31.28 dB.*run by others"),
    ],
    "table": [
        *(case(f"table {{demo}} --format {name}", mark) for name, mark in FORMATS.items()),
        *(case(f"table {{demo}} --layout {layout}", mark) for layout, mark in LAYOUTS.items()),
        case("table {demo} --as tensorial-2025 --table 4", "Printed in Table 4"),
        case("table {demo} --protocol suite", "Protocol suite: The suite of headbench"),
        case("table {demo} plain --details", "one seed"),
        case("table {demo} --columns psnr novel_view --digits 1 --out t.tex", "t.tex", "t.tex"),
        case("table {demo} --region face --sequences FREE", "Region: face. Sequences: FREE."),
    ],
    "protocols": [
        case("protocols {demo}", "pixels: face.*"),
        case("protocols {demo} --methods ga --out p.md", "p.md", "p.md"),
    ],
    "report": [
        case("report {demo} --out report.html --max-mb 5", "frames with pictures", "report.html"),
        case("report plain --split", "frames with pictures", "report/index.html"),
    ],
    "view": [case("view {demo} --port 0 --seconds 0", "the viewer of .*ours-plus has ended")],
    "verify": [case("verify plain --render", "as recorded")],
    "compare": [
        case("compare {demo} --metrics psnr", "ga - ours"),
        case("compare {demo} --metrics psnr --region face", "(?s)ga - ours.*Region: face"),
        case("compare {demo} --metrics psnr ssim --against ours --trivial --format csv", "ours"),
        case("compare {demo} --metrics psnr --equivalence psnr=0.3", "equivalence within 0.3 dB not shown"),
        case("compare {demo} --baseline demo.json --update", "numbers written", "demo.json"),
        case("compare {demo} --baseline demo.json", "nothing got worse"),
        case(f"{GATE} --update", "numbers written", "baseline.json"),
        case(f"{GATE} --junit gate.xml --markdown gate.md", "(?i)pass|nothing", "gate.xml", "gate.md"),
    ],
    "evaluate": [
        case(
            f"evaluate {cell('ours')} --like {{demo}} --out theirs --label theirs",
            r"\ntheirs ",
            "theirs/run.json",
        ),
        case(
            f"evaluate --avatar {cell('ours')}/avatar --clip {{capture}} --out stored --frames-per-task 1",
            r"(?s)Storage.*\nours ",
            "stored/rows.parquet",
        ),
        case("verify stored", "as recorded"),
    ],
    "render": [
        case(
            f"render {cell('ga')} --capture {{capture}} --out rendered --video --beside",
            "rendered/self_reenactment_FREE",
        ),
        case(
            f"render {cell('insta')}/avatar --capture {{capture}} --out rendered --frames orbit --views 2 --video",
            *("2 frames in orbit", "rendered/orbit/00001.png", "rendered/orbit.webm"),
        ),
        case(
            f"render {cell('gha')} --method gha --capture {{capture}} --out gha --frames novel_view --timesteps 0",
            "1 frame in novel_view",
        ),
    ],
    "drive": [
        case(
            f"drive {cell('ga')} --signal {{capture}} --capture {{capture}} --sequence FREE --out driven",
            "(?s)identity spill.*lips.*latency",
            "driven/drive.json",
        ),
        case(
            f"drive {cell('insta')} --signal {{capture}} --sequence FREE --size 64 --out driven.mp4",
            "jitter",
            "driven.mp4",
        ),
    ],
    "frames": [
        case("frames {demo} --out frames", "frames.csv and MAP.csv", "frames/frames.csv", "frames/MAP.csv"),
        case("frames {capture} --out listed --frames-per-task 2", "frames.csv", "listed/MAP.csv"),
    ],
    "report pareto": [
        case("report pareto {demo} --out front", r"(?m)^ours", "front/points.csv", "front/pareto.png"),
        case(
            "report pareto {demo} --out front --task self_reenactment --metric ssim --time processor_time",
            "ours",
        ),
    ],
    "report trackings": [
        *(
            case(PLAIN.replace("plain", name), "mean-image", f"{name}/rows.parquet")
            for name in ("first", "second")
        ),
        case("report trackings first second --metrics psnr", "(?s)first +second.*No trained method"),
    ],
    "run sweep": [
        case(
            "run sweep {demo} --out swept --methods ga --variants half --frames 1",
            r"ga\+half",
            "swept/points.csv",
        ),
        case("table swept --layout speed", r"ga\+half"),
    ],
    "run curve": [
        case(
            "run curve {demo} --out curve --methods ga --fractions 1/16 1/8 --frames 1",
            *(r"(?m)^ga +1/8", "curve/curve.csv", "curve/curve.png"),
        )
    ],
    "report curve": [
        case("report curve curve --out joined", "`ga` from", "joined/curve.csv", "joined/curve.png"),
    ],
    "run extremes": [
        case(
            "run extremes {demo} --out extremes --views 2 --dimensions 1 --samples 1 --path 2",
            *(EVERY_METHOD, "extremes/contact_sheet.png"),
        )
    ],
    "run reenact": [
        case(
            "run reenact {demo} --source others --out reenacted --frames 1",
            *(EVERY_METHOD, "reenacted/contact_sheet.png"),
        )
    ],
    "export compact": [
        case(f"export compact {cell('ours')}/avatar --out compact", "all", "compact/compact.safetensors")
    ],
    "export html": [
        case(
            f"export html {cell(name)} --out {name}.html --capture {{capture}}",
            "dB; minimum",
            f"{name}.html",
        )
        for name in ("ours",)
    ],
    "export lam": [
        case(f"export lam {cell('ga')} --out viewer", "blendshapes .* dB", "viewer/skin.glb"),
        case(f"export lam {cell('ours')} --out viewer.zip", "head turned", "viewer.zip"),
    ],
    "export ply": [
        case(f"export ply {cell(name)}/avatar --out {name}.ply", "splats", f"{name}.ply")
        for name in ("ours", "ga")
    ],
    **{
        f"export {form}": [
            case(f"export {form} {cell(name)} --out {name}.{form}", "dB or more", f"{name}.{form}")
            for name in ("ours", "gha")
        ]
        for form in ("glb", "sog")
    },
    "import ga": [
        case(
            f"import ga {cell('ga')}/avatar/point_cloud.ply --capture {{capture}} --out imported",
            *("splats on", "imported/point_cloud.ply"),
        )
    ],
    "import tracking": [
        case(
            "import tracking tracker --head tracker/head.npz --out from-tracker",
            "(?s)held out.*overlay.png",
            "from-tracker/overlay.png",
            "from-tracker/import.json",
        )
    ],
    "export colmap": [
        case(
            f"export colmap {{capture}} --out {names} --names {names}",
            "points",
            f"{names}/sparse/0/images.bin",
        )
        for names in ("nested", "flat")
    ],
    "doctor": [
        case("doctor", r"(?s)ours +ready.*All default methods can run here"),
        case("doctor gha --device cpu", "The methods named can run here"),
    ],
    "run reproduce": [],  # in tests/bench/experiments, with recordings
    "run parity": [],  # in tests/methods/official, with a stand-in for the authors' repository
    "prepare benchmark": [],  # these four in tests/datasets/nersemble, with a benchmark's folder
    "submission render": [],
    "submission write": [],
    "submission check": [],
    "doctor check": [
        case("doctor check mean-image --data {capture}", "keeps its contract"),
        case("doctor check psnr", "keeps its contract"),
    ],
    "lint": [case("lint {capture}", "HB110"), case("lint --list", "HB101")],
    "inspect": [case("inspect {capture} --out inspected", "head model", "inspected/inspection.png")],
    "inspect steps": [
        case("inspect steps {capture} --out steps", "jaw bases", "steps/jaw_bases.png", "steps/steps.json")
    ],
    "prepare tongue": [case("prepare tongue {capture} --out tongue", "left out", "tongue/tongue.yaml")],
    "prepare refit": [
        case("prepare refit {capture} --target 2020 --out refitted", "neutral head", "refitted/heat_map.png")
    ],
    "track": [
        case("track {capture} --out tracked", "a timestep", "tracked/overlay.png", "tracked/track.json")
    ],
    "prepare nersemble": [
        case(
            f"{PREPARE} --subjects 901 --sequences all --downscale 1 --out prepared",
            "FREE",
            "prepared",
        )
    ],
    "doctor bench": [case("doctor bench splats --quick --tradeoffs --out bench.json", "knob", "bench.json")],
    "doctor stress": [case("doctor stress splats --quick --json", '"verdicts"')],
}


@pytest.fixture(scope="module")
def elsewhere(run, tmp_path_factory):
    """The directory that commands run in, neither that of the run nor one above it, with a tracker's files."""
    folder = tmp_path_factory.mktemp("elsewhere")
    (folder / "board").mkdir()
    (union,) = (run.root / "capture").glob("UNION*")
    clip = read_capture(union)
    write_metrical(Recording(clip, next(iter(clip.cameras))), folder / "tracker")
    write_recording(folder / "recording")
    return folder


def test_every_listed_command_has_a_case(capsys):
    assert cli.main(["--help"]) == 0
    listed = set(re.findall(r"(?m)^  (\w+(?: \w+)?)  ", capsys.readouterr().out))
    offered = {plugin.spec.name for plugin in discover("commands").values() if plugin.spec is not None}
    assert set(CASES) == offered == listed


@pytest.mark.parametrize("command", [name for name, cases in CASES.items() if cases])
def test_the_command_works_from_another_directory(command, run, elsewhere, monkeypatch, capsys):
    monkeypatch.chdir(elsewhere)
    (union,) = (run.root / "capture").glob("UNION*")
    places = {"demo": run.root, "capture": union, "subject": union.name.rpartition("_")[2]}
    for words, prints, leaves in CASES[command]:
        code = cli.main(words.format(**places).split())
        printed = capsys.readouterr()
        assert code == (command in FINDS_FAULTS), printed.err
        assert re.search(prints, printed.out), printed.out
        for name in leaves:
            assert (elsewhere / name).stat().st_size > 0

"""Trackers of other authors: stand-ins for their checkouts that write what the programs write."""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from headbench.bench.contracts import no_progress
from headbench.bench.doctor import DoctorSettings, doctor
from headbench.bench.errors import InputError
from headbench.bench.process import ProgramError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.tracking.command import track_capture
from headbench.datasets.tracking.programs import LOG, PROGRAMS
from headbench.datasets.tracking.settings import TrackSettings

from ..monocular.videos import recording_of
from ..nersemble.recordings import write_video
from ..tiny_capture import rig
from ..tracker_files.test_import import LENGTHS, SIZE, TRACKED
from ..tracker_files.trackers import HEAD_FILE, write_pixel3dmm

SCRIPT = """
import json, os, shutil, sys, time
from dataclasses import replace
from pathlib import Path

checkout = Path(__file__).resolve().parents[1]
calls = checkout / "calls.txt"
name = Path(__file__).name
with calls.open("a") as stream:
    stream.write(" ".join([name, *sys.argv[1:]]) + "\\n")
behaviour = json.loads((checkout / "behaviour.json").read_text()).get(" ".join([name, *sys.argv[1:2]]).split("=")[0], "")
print("at work on", name, flush=True)
if behaviour == "crash":
    sys.exit("CUDA out of memory")
if behaviour == "sleep":
    (checkout / "asleep").touch()
    time.sleep(300)
if behaviour == "nothing":
    sys.exit(0)

def make(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()

def option(key):
    return Path(sys.argv[sys.argv.index(key) + 1])
"""
PIXEL3DMM = {
    "scripts/run_preprocessing.py": """
subject = option("--video_or_images_path").stem
for folder in ("cropped", "seg_og"):
    target = Path(os.environ["PIXEL3DMM_PREPROCESSED_DATA"]) / subject / folder
    shutil.copytree(checkout / "made" / folder, target, dirs_exist_ok=True)
""",
    "scripts/network_inference.py": """
kind, subject = (word.partition("=")[2] for word in sys.argv[1:])
make(Path(os.environ["PIXEL3DMM_PREPROCESSED_DATA"]) / subject / "p3dmm" / kind / "00000.png")
""",
    "scripts/track.py": """
subject = sys.argv[1].partition("=")[2]
target = Path(os.environ["PIXEL3DMM_TRACKING_OUTPUT"]) / (subject + "_nV1_noPho_uv2000.0_n1000.0")
shutil.copytree(checkout / "made" / "track", target, dirs_exist_ok=True)
""",
}
VHAP = {
    "vhap/preprocess_video.py": "make(option('--input').with_suffix('') / 'alpha_maps' / '000000.jpg')",
    "vhap/track.py": "make(option('--exp.output_folder') / '2026' / 'tracked_flame_params_30.npz')",
    "vhap/export_as_nerf_dataset.py": "make(option('--tgt_folder') / 'transforms_train.json')",
}
SCRIPTS = {"pixel3dmm": PIXEL3DMM, "vhap": VHAP}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What Pixel3DMM writes for a small capture."""
    root = tmp_path_factory.mktemp("made")
    square = rig(SIZE, SIZE, 0.45 * SIZE, 0.53 * SIZE)[:2]
    recording = recording_of(root / "capture", LENGTHS, neck=True, cameras=square)
    write_pixel3dmm(recording, root / "made", tracked=TRACKED)
    return root / "made"


@pytest.fixture
def settings(made, tmp_path):
    """Settings of a program in a complete checkout, whose scripts behave as told."""
    video = tmp_path / "my face.mp4"
    write_video(video, [np.full((48, 64, 3), 40 * level, np.uint8) for level in range(4)], 25)

    def make(name, behaviour=(), **changes):
        checkout = tmp_path / name
        program = PROGRAMS[name]
        for file in (*program.files, *(f"installed/{module}.py" for module in program.modules)):
            (checkout / file).parent.mkdir(parents=True, exist_ok=True)
            (checkout / file).touch()
        for script, body in SCRIPTS[name].items():
            (checkout / script).parent.mkdir(parents=True, exist_ok=True)
            (checkout / script).write_text(SCRIPT + body)
        (checkout / "behaviour.json").write_text(json.dumps(dict(behaviour)))
        shutil.copytree(made, checkout / "made", dirs_exist_ok=True)
        python = tmp_path / "environment" / "python"
        python.parent.mkdir(exist_ok=True)
        python.write_text(f'#!/bin/sh\nPYTHONPATH="{checkout / "installed"}" exec "{sys.executable}" "$@"\n')
        python.chmod(0o755)
        given = {"head": str(made / "track" / HEAD_FILE), "checkout": str(checkout), "python": str(python)}
        return TrackSettings(str(video), str(tmp_path / "out"), program=name, **(given | changes))

    return make


def calls(settings):
    return (Path(settings.checkout) / "calls.txt").read_text().splitlines()


@pytest.mark.commands
def test_a_kill_ends_the_program_and_finished_steps_stay(settings, tmp_path):
    given = settings("pixel3dmm", {"track.py video_name": "sleep"})
    command = [sys.executable, "-m", "headbench.bench.start", "track", given.capture, "--head", given.head]
    command += [
        "--with",
        "pixel3dmm",
        "--checkout",
        given.checkout,
        "--python",
        given.python,
        "--out",
        given.out,
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=(tmp_path / "errors").open("w"))
    asleep = Path(given.checkout) / "asleep"
    until = time.monotonic() + 120
    while not asleep.exists() and time.monotonic() < until and process.poll() is None:
        time.sleep(0.1)
    assert asleep.exists(), (tmp_path / "errors").read_text()
    process.terminate()
    process.wait(timeout=60)
    running = [
        p for p in psutil.process_iter(["cmdline"]) if str(tmp_path) in " ".join(p.info["cmdline"] or [])
    ]
    assert running == []
    again = settings("pixel3dmm")
    track_capture(again)
    assert [call.split()[0] for call in calls(again)][4:] == ["track.py"]


def test_vhap_runs_its_steps_and_names_the_capture(settings, tmp_path):
    given = settings("vhap")
    found, folder = track_capture(given), tmp_path / "out" / "vhap"
    assert found.data["capture"] == str(folder / "export" / "my-face_whiteBg_staticOffset_maskBelowLine")
    assert calls(given) == [
        f"preprocess_video.py --input {folder / 'my-face.mp4'} --matting_method robust_video_matting",
        f"track.py --data.root_folder {folder} --data.sequence my-face --exp.output_folder {folder / 'output'}",
        f"export_as_nerf_dataset.py --src_folder {folder / 'output'} --tgt_folder {found.data['capture']} --background-color white",
    ]


@pytest.mark.parametrize(
    ("behaviour", "message"),
    [
        ("crash", r"tracking ended with exit code 1.*CUDA out of memory.*program\.log"),
        ("nothing", r"tracking wrote no tracking/my-face_nV1\*/checkpoint/\*\.frame"),
    ],
)
def test_a_step_that_failed_is_repeated_alone(settings, tmp_path, behaviour, message):
    """Of Pixel3DMM, whose result is imported in the end."""
    with pytest.raises(ProgramError, match=message):
        track_capture(settings("pixel3dmm", {"track.py video_name": behaviour}))
    given = settings("pixel3dmm")
    clip = read_capture(track_capture(given).data["capture"])
    assert clip.subject
    assert len(clip.files) == 8
    assert (tmp_path / "out" / "capture" / "overlay.png").exists()
    tracking = "track.py video_name=my-face"
    assert [call for call in calls(given) if "preprocessing" not in call] == [
        "network_inference.py model.prediction_type=normals video_name=my-face",
        "network_inference.py model.prediction_type=uv_map video_name=my-face",
        *(tracking, tracking),
    ]
    assert "at work on track.py" in (tmp_path / "out" / "pixel3dmm" / LOG).read_text()


@pytest.mark.parametrize(
    ("missing", "kind"),
    [
        ("", ""),
        ("scripts/track.py", "checkout"),
        ("pretrained_weights/uv.ckpt", "checkout"),
        ("installed/pixel3dmm.py", "environment"),
    ],
)
def test_what_an_installation_lacks_is_said(settings, missing, kind):
    """By doctor, and before the program runs."""
    given = settings("pixel3dmm")
    if missing:
        (Path(given.checkout) / missing).unlink()
        with pytest.raises(InputError, match=Path(missing).stem):
            track_capture(given)
        assert not Path(given.out).exists()
    asked = tuple(f"settings.pixel3dmm.{name}={getattr(given, name)}" for name in ("checkout", "python"))
    found = doctor(DoctorSettings(set=asked), no_progress)
    states = {one["name"]: one["state"] for one in found.data["plugins"] if one["group"] == "programs"}
    assert states == {"vhap": "missing", "pixel3dmm": "missing" if missing else "ready"}
    assert (
        f"no {kind}." if missing else f"checkout: {given.checkout}; environment: {given.python}"
    ) in found.text

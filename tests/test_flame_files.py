"""Captures tracked with FLAME, whose files are given and not in the capture: every command that takes a head model."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from headbench.bench import cli
from headbench.bench.engine import run as runner
from headbench.datasets.ga.layout import DECLARATION_FILE, HEAD_FILE
from headbench.datasets.head.loaders import EYELID_FILES, MASKS_FILE, OPEN, load_head
from headbench.datasets.head.teeth import with_teeth

from .datasets.head.flame_files import write_flame
from .datasets.head.flame_stand_in import stand_in, write_stand_in
from .datasets.nersemble.recordings import write_recording
from .datasets.tiny_capture import make_plan, rig, write_tiny_capture
from .world import SETTINGS

pytestmark = pytest.mark.commands

LENGTHS = {"FREE": 2, "EMO-1-shout+laugh": 2, "SEN-01-cramp_small_danger": 1}
ALL = ("flashavatar", "ga", "gbs", "gha", "insta", "ours", "rgbavatar")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """``flame/`` with FLAME of both years and what belongs to them, ``bare/`` without that, and a capture of 2023."""
    folder = tmp_path_factory.mktemp("flame_files")
    write_stand_in(folder / "flame")
    other = replace(stand_in("flame2023"), expression_basis=stand_in().expression_basis[:, :, ::-1].copy())
    write_flame(folder / "flame" / "flame2023.pkl", other)
    (folder / "flame" / "open").mkdir()
    opened = replace(
        other,
        version=OPEN,
        template=other.template + 2 * other.shape_basis[:, :, 0],
        expression_basis=other.expression_basis[:, :, ::-1].copy(),
    )
    write_flame(folder / "flame" / "open" / "flame2023.pkl", opened)
    (folder / "bare").mkdir()
    shutil.copy(folder / "flame" / "flame2023.pkl", folder / "bare")
    head = replace(with_teeth(load_head(folder / "flame" / "flame2023.pkl")), eyelid_basis=None)
    plan = make_plan(lengths=LENGTHS, cameras=rig(24, 32, 12.3, 15.1)[:2], head=head)
    union = write_tiny_capture(folder / "data", plan).union
    for path in folder.glob("data/*/flame_param/*.npz"):
        with np.load(path) as arrays:
            np.savez(path, **{**arrays, "eyelids": np.full((1, 2), 0.5, np.float32)})
    # As VHAP leaves a capture: no head model in it, and nothing that names one.
    (union / HEAD_FILE).unlink()
    for path in folder.glob(f"data/*/{DECLARATION_FILE}"):
        path.unlink()
    (folder / "config.json").write_text(
        json.dumps(
            {
                "data": "capture",
                "out": "run",
                "methods": list(ALL),
                "preset": "smoke",
                "metrics": ["psnr"],
                "frames_per_task": 1,
                "reader_settings": {"head": "flame/flame2023.pkl", "cy": "bottom"},
                "heads": {"flame2020": "flame/generic_model.pkl"},
                "settings": {name: SETTINGS[name] for name in ALL},
            }
        )
    )
    (folder / "capture").symlink_to(union.resolve())
    write_recording(folder / "recording", size=(24, 32), head=load_head(folder / "flame" / "flame2023.pkl"))
    return folder


GIVEN = "--head flame/flame2023.pkl --cy bottom"
INSPECT = ["inspect", "capture", "--timesteps", "1", "--cameras", "1"]
PREPARE = (
    "prepare nersemble --root recording/recording --tracking recording/tracking --head flame/flame2023.pkl "
    "--subjects 901"
)
COMMANDS = (
    f"inspect capture {GIVEN} --out inspected",
    f"inspect steps capture {GIVEN} --out steps",
    "run --config config.json",
    f"prepare refit capture {GIVEN} --target flame/generic_model.pkl --out refitted",
    "prepare refit refitted/UNION3_901 --target flame/flame2023.pkl --out again",
    f"prepare refit capture {GIVEN} --target flame/open/flame2023.pkl --out open",
    "prepare refit open/UNION3_901 --target flame/generic_model.pkl --out closed",
    "prepare refit refitted/UNION3_901 --target 2023 --out procedural",
    f"export colmap capture {GIVEN} --out colmap --names flat --tracking",
    f"{PREPARE} --sequences EMO-1,FREE --downscale 1 --out prepared",
    "export ply run/901/ga/seed-0/avatar --out ga.ply",
    "render run/901/ours/seed-0/avatar --capture colmap --reader colmap --frames train --out rendered",
    f"import ga run/901/ga/seed-0/avatar/point_cloud.ply --capture capture {GIVEN} --out imported",
    f"prepare tongue capture {GIVEN} --out tongue",
    f"track capture {GIVEN} --out tracked",
    f"drive run/901/ga/seed-0/avatar --capture capture --signal capture {GIVEN} --sequence FREE --out driven",
    "drive run/901/gbs/seed-0/avatar --signal driven --sequence drive --size 32 --out other",
)


def test_every_command_takes_flame(files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    monkeypatch.setattr(runner, "write_reports", lambda out: [])  # they see no head
    for line in COMMANDS:
        code = cli.main(line.split())
        out = capsys.readouterr()
        assert code == 0, f"{line}\n{out.out[-2000:]}\n{out.err[-2000:]}"
        assert "UserWarning" not in out.err, line
    assert json.loads((files / "open" / "UNION3_901" / DECLARATION_FILE).read_text())["head_model"] == OPEN
    # The same bases in another order: exact, but for the static offset, which no basis has.
    opened, closed = (json.loads((files / name / "refit.json").read_text()) for name in ("open", "closed"))
    assert opened["mean_mm"] < opened["neutral_mm"] + 0.02
    assert closed["mean_mm"] < 0.02
    assert cli.main(f"lint capture {GIVEN}".split()) in (0, 1)
    seen = capsys.readouterr().out
    assert not {"HB100", "HB602", "HB603"} & set(seen.split())  # what cannot be read


@pytest.mark.parametrize(
    ("left_out", "code", "said"),
    [
        ((), 0, None),
        (EYELID_FILES, 0, "eyelids: closed by up to 0.50, left out: the head model has no basis"),
        ((MASKS_FILE,), 2, "expected lips, found none of that name"),
    ],
)
def test_what_is_missing_beside_the_pickle_is_said(
    files, tmp_path, monkeypatch, capsys, left_out, code, said
):
    monkeypatch.chdir(files)
    shutil.copytree(files / "flame", tmp_path / "flame")
    for name in left_out:
        (tmp_path / "flame" / name).unlink()
    words = [*INSPECT, "--head", str(tmp_path / "flame" / "flame2023.pkl"), "--cy", "bottom"]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == code
    err = capsys.readouterr().err
    assert said in err if said else "eyelids" not in err


def test_teeth_are_as_asked_for(files, tmp_path, monkeypatch):
    monkeypatch.chdir(files)
    for teeth, code in (("add", 0), ("auto", 0), ("keep", 0)):
        words = f"{GIVEN} --set teeth={teeth} --out {tmp_path / teeth}".split()
        assert cli.main([*INSPECT, *words]) == code
        seen = json.loads((tmp_path / teeth / "inspection.json").read_text())
        assert seen["vertices"] == len(stand_in().template) + (0 if teeth == "keep" else 120)

"""What is no capture is answered with the way from it to one."""

import json
import re
from itertools import takewhile

import pytest

from headbench.bench import cli
from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.open import describe

RIGID = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
FRAME = {"file_path": "images/1.png", "transform_matrix": RIGID}
PREPARE = "headbench prepare nersemble --root "

CASES = {
    "a video": (["my me.MP4"], "my me.MP4", "a video", "my me.MP4' --out"),
    "an archive": (["me.tar.gz"], "me.tar.gz", "an archive", "Unpack it"),
    "an image": (["me.jpg"], "me.jpg", "an image", "headbench track"),
    "a head model": (["flame2023.pkl"], "flame2023.pkl", "a file", "--head"),
    "a JSON of a capture": (["a/transforms_val.json"], "a/transforms_val.json", "its files", "its folder"),
    "nothing inside": ([".hidden"], "", "an empty folder", ""),
    "a folder of videos": (["a.mp4", "b.mp4"], "", "a folder of videos", "headbench track "),
    "a folder of images": (["a.png", "b.png", "notes.txt"], "", "a folder of images", "*.png"),
    "images in a folder": (["images/a.jpg"], "", "a folder of images", "images/*.jpg"),
    "NeRSemble, second release": (["074/calibration/x", "074/sequences/x"], "", "NeRSemble", PREPARE),
    "NeRSemble, first release": (["camera_params/x", "074/FREE/x"], "", "NeRSemble", "--subjects 074"),
    "NeRSemble, in parts": (["sequence_FREE_part-1/074/FREE/x"], "", "NeRSemble", PREPARE),
    "NeRSemble, a participant": (["074/camera_params.json", "074/x"], "074", "NeRSemble", "--subjects 074"),
    "COLMAP": (["images/a.png", "sparse/0/cameras.bin"], "", "COLMAP", "VHAP"),
    "a COLMAP model": (["cameras.txt", "images.txt", "points3D.txt"], "", "COLMAP", "VHAP"),
    "IMavatar": (["flame_params.json", "image/1.png", "mask/1.png"], "", "IMavatar", "list of frames"),
    "IMavatar, several": (
        ["train/flame_params.json", "test/flame_params.json"],
        "",
        "IMavatar",
        "monocular",
    ),
    "LAM": (["flame_params.json", "flame_param/00000.npz"], "", "LAM", "headbench drive"),
    "INSTA": (["canonical.obj", "meshes/1.obj", "images/1.png"], "", "INSTA", "generate.sh"),
    "Metrical Tracker": (["canonical.obj", "checkpoint/1.frame"], "", "Metrical Tracker", "import tracking"),
    "Gaussian Head Avatar": (["images/1/a", "cameras/1/a", "params/1/a"], "", "Gaussian Head", "NeRSemble"),
    "VHAP before its export": (["tracked_flame_params_30.npz", "config.yml"], "", "VHAP", "Export it"),
    "a trained model": (["cfg_args", "point_cloud/x"], "", "a model", "headbench import ga"),
    "a run": (["run.json", "capture/x"], "", "a run", "capture"),
    "captures below": (["a/transforms_train.json", "b/x"], "", "one folder below", "/a"),
    "captures two below": (["a/UNION10_1/transforms_train.json", "b/x"], "", "two folders below", "/a"),
    "one folder in a folder": (["download/a/b"], "", "one folder, download", "transforms_train.json"),
    "anything else": (["a.txt", "b.txt"], "", "a.txt, b.txt", ""),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_no_capture_is_answered_with_the_way_to_one(tmp_path, case):
    files, given, found, remedy = CASES[case]
    for file in files:
        path = tmp_path / "given" / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    with pytest.raises(InputError) as caught:
        read_capture(tmp_path / "given" / given)
    assert found in caught.value.found
    assert remedy in caught.value.remedy


def test_commands_of_the_advice_exist(tmp_path, capsys):
    """Every command that an answer names is one of today's, with the options it names."""
    named = set()
    for number, (files, given, *_) in enumerate(CASES.values()):
        for file in files:
            (tmp_path / str(number) / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / str(number) / file).touch()
        for advice in describe(tmp_path / str(number) / given).remedy.split("headbench ")[1:]:
            words = re.split(r"[`;:,]| makes ", advice)[0].split()
            command = tuple(takewhile(str.isalpha, words))
            named |= {(command, word) for word in words if word.startswith("--")} | {(command, "usage")}
    assert len({command for command, _ in named}) == 5
    for command, option in sorted(named):
        assert cli.main([*command, "--help"]) == 0
        assert option in capsys.readouterr().out, command


@pytest.mark.parametrize(
    ("file", "frame", "expected"),
    [
        ("transforms.json", {}, "nerfstudio"),
        ("transforms_train.json", {}, "nerfstudio"),
        ("transforms_train.json", {"mesh_path": "meshes/1.obj", "exp_path": "flame/exp/1.txt"}, "INSTA"),
    ],
)
def test_a_json_without_tracked_heads_names_whose_it_is(tmp_path, file, frame, expected):
    (tmp_path / file).write_text(json.dumps({"fl_x": 10, "w": 8, "h": 8, "frames": [FRAME | frame]}))
    with pytest.raises(InputError, match=expected) as caught:
        read_capture(tmp_path)
    assert caught.value.key == "frames[0].flame_param_path"


@pytest.mark.parametrize(
    "command", ["run --out o --data", "lint", "prepare tongue --out o", "inspect --out o"]
)
def test_every_command_on_captures_answers_alike(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "me.mp4").touch()
    assert cli.main([*command.split(), "me.mp4"]) == 2
    assert "found a video" in capsys.readouterr().err

"""The reader of a capture is found by what the folder holds, or by name; its settings are checked."""

import json
import re
from dataclasses import replace
from itertools import takewhile

import numpy as np
import pytest

from headbench.bench import cli, registry
from headbench.bench.contracts import no_progress
from headbench.bench.engine.adaptation import MethodNeeds, adapter
from headbench.bench.errors import InputError
from headbench.bench.specs import ResolutionRule
from headbench.datasets.clip import as_capture
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.open import describe, find_reader, open_clip
from headbench.datasets.steps.for_method import align_clip
from headbench.datasets.steps.masks import set_background


def test_a_capture_is_opened_by_the_reader_that_finds_it(pristine_capture):
    assert find_reader(pristine_capture.union).name == "ga"
    clip = open_clip(pristine_capture.union, wishes={"leaks": "record", "unheard of": 1})
    assert clip.fingerprint == read_capture(pristine_capture.union, leaks="record").fingerprint


def test_settings_that_the_reader_lacks_are_refused(pristine_capture):
    with pytest.raises(InputError, match="reader_settings, hed: expected .*head.*found"):
        open_clip(pristine_capture.union, settings={"hed": "x"})


@pytest.mark.parametrize(
    ("data", "found"),
    [("", "an empty folder"), ("a.mp4", "a folder of videos"), (None, "no such file or folder")],
)
def test_what_is_no_capture_is_described(tmp_path, data, found):
    folder = tmp_path / "data"
    if data is not None:
        folder.mkdir()
    if data:
        (folder / data).touch()
    with pytest.raises(InputError, match=rf"a reader knows .*colmap.*{found}"):
        open_clip(folder)


def fails(root):
    raise KeyError(root)


def test_readers_of_plug_ins_beside_the_one_that_fits(pristine_capture, monkeypatch, caplog):
    known = registry.discover("datasets")

    def offer(**finds):
        """Copies of the reader ga by name, each with its function that finds captures; None is ga's own."""
        ga = known["ga"]
        twins = {
            name: replace(ga, name=name, spec=replace(ga.spec, name=name, find=find or ga.spec.find))
            for name, find in finds.items()
        }
        monkeypatch.setattr(registry, "discover", lambda group: {**known, **twins})

    offer(other=None)
    assert find_reader(pristine_capture.union).name == "ga"
    offer(ga=f"{__name__}:fails", one=None, two=None)
    with pytest.raises(InputError, match=r"one for one, two. Choose with --reader"):
        open_clip(pristine_capture.union)
    assert open_clip(pristine_capture.union, "ga").poses
    assert "reader ga cannot check" in caplog.text


def test_a_clip_of_another_reader_passes_through_steps(plain_folder, pristine_capture):
    clip, same = open_clip(plain_folder, "plain_reader:SPEC"), read_capture(pristine_capture.union)
    assert as_capture(clip) is clip
    assert clip.source_fingerprint == f"plain-{same.fingerprint}"
    changed, expected = (
        align_clip(set_background(one, (0.0, 0.5, 1.0)), ResolutionRule(divide=2)) for one in (clip, same)
    )
    for key in sorted(same.files):
        np.testing.assert_array_equal(clip.image(key), same.image(key))
        np.testing.assert_array_equal(clip.mask(key), same.mask(key))
        np.testing.assert_array_equal(changed.image(key), expected.image(key))
        np.testing.assert_array_equal(changed.mask(key), expected.mask(key))
    assert clip.region_names == same.region_names


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda clip: {"shape": clip.shape[:-1]}, "shape"),
        (lambda clip: {"static_offset": clip.static_offset[:-1]}, "static_offset"),
        (lambda c: {"poses": {t: replace(p, expression=[0.0]) for t, p in c.poses.items()}}, "expression"),
    ],
)
def test_a_clip_of_another_head_model_is_refused(plain_folder, change, key):
    clip = open_clip(plain_folder, "plain_reader:SPEC").source
    vars(clip).update(change(clip))
    with pytest.raises(InputError) as caught:
        as_capture(clip)
    assert caught.value.key == key


def test_a_clip_of_another_reader_is_adapted_to_methods(plain_folder, pristine_capture, tmp_path):
    needs = MethodNeeds(monocular=True, resolution=ResolutionRule(divide=2))
    same = read_capture(pristine_capture.union)
    clips = open_clip(plain_folder, "plain_reader:SPEC").source, same
    adapted = [adapter()(clip, needs, {})(tmp_path, no_progress) for clip in clips]
    key = same.splits["novel_view"][0]
    images = [one.clip.image(one.key(key)) for one in adapted]
    np.testing.assert_array_equal(*images)


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

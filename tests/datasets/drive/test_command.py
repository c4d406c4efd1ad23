"""The command: videos, captures that are read and scored again, measures, and every input that is refused."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from headbench.bench import cli
from headbench.bench.io.documents import read_json
from headbench.bench.io.images import read_png
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import read_head, save_head

from ..head.skinning import skinned
from ..head.toy import toy_head
from .mesh_method import SPEC, VIDEO, write_mesh_avatar

HEAD = toy_head(24, eyelids=True, version="flame2020")
RNG = np.random.default_rng(0)
FRAMES = 9
EXPRESSION = 0.5 * RNG.normal(size=(FRAMES, 8))
JAW = np.column_stack([np.linspace(0, 0.3, FRAMES), np.zeros((FRAMES, 2))])
ROTATION = np.column_stack([np.zeros(FRAMES), np.linspace(-0.3, 0.3, FRAMES), np.zeros(FRAMES)])


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A directory with an avatar and a signal, in which the command runs."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    monkeypatch.chdir(tmp_path)
    write_mesh_avatar(tmp_path / "avatar", HEAD)
    np.savez("signal.npz", expression=EXPRESSION, jaw=JAW, rotation=ROTATION, shape=np.ones(100))
    return tmp_path


def drive(capsys, *words, signal="signal.npz", avatar="avatar", method="SPEC", out="out"):
    """Exit code, findings (JSON) and errors of the command."""
    method = f"mesh_method:{method}"
    line = ["drive", avatar, "--signal", signal, "--out", out, "--method", method, *words, "--json"]
    if not any(word in words for word in ("--capture", "--size")):
        line += ["--size", "64"]
    code = cli.main(line)
    printed = capsys.readouterr()
    return code, json.loads(printed.out) if printed.out else None, printed.err


@pytest.mark.parametrize("name", ["a.mp4", "a.webm"])
def test_a_video_has_every_frame(place, capsys, name):
    pytest.importorskip("av")
    code, data, error = drive(capsys, "--fps", "10", out=name)
    assert code == 0, error
    assert data["frames"] == FRAMES
    stream = cv2.VideoCapture(name)
    assert stream.get(cv2.CAP_PROP_FPS) == 10
    shown = []
    while (found := stream.read())[0]:
        shown.append(found[1].astype(float))
    assert len(shown) == FRAMES
    assert shown[0].shape == (64, 64, 3)
    assert np.abs(shown[-1] - shown[0]).mean() > 1


def test_a_folder_is_a_capture_of_the_driven_poses(place, capsys):
    code, data, error = drive(capsys)
    assert code == 0, error
    clip = read_capture("out")
    keys = clip.splits["self_reenactment"]
    assert [key.sequence for key in keys] == ["drive"] * FRAMES
    assert len(clip.splits["train"]) == 1
    poses = [clip.poses[key.timestep] for key in keys]
    np.testing.assert_allclose([pose.expression for pose in poses], EXPRESSION, atol=1e-6)
    np.testing.assert_allclose([pose.rotation for pose in poses], ROTATION, atol=1e-6)
    assert {*data["unused"]} == {"shape"}
    assert read_json(Path("out") / "drive.json")["frames"] == FRAMES
    # Another command renders the capture's poses and gives the capture's images.
    words = ["render", "avatar", "--capture", data["written"], "--out", "again"]
    assert cli.main([*words, "--method", "mesh_method:SPEC"]) == 0
    found = sorted(Path("again/self_reenactment").iterdir())
    assert len(found) == FRAMES
    for path, key in zip(found, keys):
        assert np.abs(read_png(path).astype(int) - clip.image(key)).mean() < 0.1


def test_frames_of_a_video_method_are_the_same(place, capsys):
    write_mesh_avatar(place / "video", HEAD, spec=VIDEO)
    assert drive(capsys)[0] == 0
    assert drive(capsys, avatar="video", method="VIDEO", out="video-out")[0] == 0
    one, other = read_capture("out"), read_capture("video-out")
    for key in one.splits["self_reenactment"]:
        gap = one.image(key).astype(int) - other.image(key)
        assert np.abs(gap).mean() < 1.0  # light comes from the camera, which moves instead of the head


def test_measures_agree_with_the_vertices(place, capsys):
    _, data, _ = drive(capsys, "--still-head")
    meshes = np.stack([skinned(HEAD, EXPRESSION[t], jaw=JAW[t]) for t in range(FRAMES)])
    face = HEAD.regions["face"]
    second = np.diff(meshes[:, face], 2, axis=0)
    assert data["jitter_mm"]["before"] == pytest.approx(1e3 * np.linalg.norm(second, axis=2).mean(), rel=1e-3)
    squares = np.square(meshes[0] - HEAD.template)[face].sum(axis=1)
    assert data["spill_mm"]["as_read"] == pytest.approx(1e3 * np.sqrt(squares.mean()), rel=1e-3)
    assert data["spill_mm"]["driven"] == data["spill_mm"]["as_read"]
    lips = HEAD.regions["lips"]
    x = HEAD.template[lips, 0]
    middle = lips[np.abs(x - (x.min() + x.max()) / 2) < 0.25 * np.ptp(x)]
    follows = HEAD.skinning_weights[middle, 2] / HEAD.skinning_weights[middle, 2].max() >= 0.5
    upper, lower = middle[~follows], middle[follows]
    gaps = np.linalg.norm(meshes[:, upper, None] - meshes[:, None, lower], axis=3).min(axis=(1, 2))
    assert data["lips_mm"]["smallest"] == pytest.approx(1e3 * gaps.min(), abs=1e-3)
    assert data["lips_mm"]["largest"] == pytest.approx(1e3 * gaps.max(), abs=1e-3)


def test_smoothing_reduces_jitter_and_a_neutral_frame_spill(place, capsys):
    _, data, error = drive(capsys, "--smooth", "0.2", "--fps", "25", "--neutral", "0")
    assert not error
    assert data["jitter_mm"]["after"] < 0.6 * data["jitter_mm"]["before"]
    _, data, _ = drive(capsys, "--neutral", "0", out="other")
    assert data["spill_mm"]["as_read"] > 1.0
    assert data["spill_mm"]["driven"] < 1e-3
    poses = read_capture("other").poses
    np.testing.assert_allclose(poses[3].expression, EXPRESSION[2] - EXPRESSION[0], atol=1e-5)


def test_the_head_rests_where_the_capture_shows_it(place, capsys, pristine_capture):
    plan = pristine_capture.writer.plan
    write_mesh_avatar(place / "seen", plan.head, shape=plan.shape, offset=plan.static_offset)
    union = str(pristine_capture.union)
    words = ("--capture", union, "--camera", plan.cameras[0].id, "--still-head", "--signal-head", "avatar")
    np.savez("short.npz", expression=np.zeros((2, 8)))
    code, _, error = drive(capsys, *words, signal="short.npz", avatar="seen")
    assert code == 0, error
    clip = read_capture("out")
    training = [pose for sequence in plan.sequences for pose in sequence.poses if sequence.name != "FREE"]
    middle = np.mean([pose.translation for pose in training], axis=0)
    for pose in clip.poses.values():
        np.testing.assert_allclose(pose.translation, middle, atol=1e-6)
    camera = clip.cameras[plan.cameras[0].id]
    np.testing.assert_allclose(camera.world_to_camera, plan.cameras[0].world_to_camera, atol=1e-9)


def csv(text):
    Path("signal.csv").write_text(text)
    return "signal.csv"


def lines(text):
    Path("signal.jsonl").write_text(text)
    return "signal.jsonl"


def npz(**arrays):
    np.savez("bad.npz", **arrays)
    return "bad.npz"


def mapped(text, table="a,b\n1,2\n"):
    Path("map.yaml").write_text(text)
    return csv(table)


ONE = np.zeros((FRAMES, 8))
MAP = ("--map", "map.yaml")


def arrays():
    """A folder of frames that are no parameter files."""
    Path("arrays").mkdir()
    np.save("arrays/0.npy", np.zeros(5))
    return "arrays"


def tracked():
    """A folder of Metrical Tracker, which has a file for each frame."""
    Path("tracked/checkpoint").mkdir(parents=True)
    Path("tracked/checkpoint/00000.frame").touch()
    return "tracked"


REFUSED = {
    "no file": (lambda: "none.csv", (), "no such file"),
    "empty csv": (lambda: csv(""), (), "empty file"),
    "header alone": (lambda: csv("jawOpen\n"), (), "at least one frame"),
    "unknown ending": (lambda: (Path("a.xml").write_text("x"), "a.xml")[1], (), "a file in .csv"),
    "unknown columns": (lambda: csv("smirk,laugh\n1,2\n"), (), "--map"),
    "a column misspelt": (lambda: csv("jawOpen,jawOpn\n1,2\n"), (), "jawOpn"),
    "a column twice": (lambda: csv("jawOpen,jawOpen\n1,2\n"), (), "distinct names"),
    "text": (lambda: csv("jawOpen\n0.1\nwide\n"), (), "jawOpen, line 3: expected a number"),
    "not finite": (lambda: csv("jawOpen\nnan\n"), (), "finite numbers"),
    "a short line": (lambda: csv("jawOpen,jawLeft\n1\n"), (), "line 2: expected 2 values"),
    "percent": (lambda: csv("jawOpen\n87\n"), (), "from -2 to 2, found 87"),
    "json lines that differ": (
        lambda: lines('{"jawOpen": 1}\n{"jawLeft": 1}\n'),
        (),
        "jawOpen, line 2: expected a",
    ),
    "damaged json": (lambda: lines('{"jawOpen": 1}\n{"jawO'), (), "line 2: expected valid JSON"),
    "null": (lambda: lines('{"jawOpen": null}\n'), (), "jawOpen, line 1"),
    "unequal lengths": (lambda: npz(expression=ONE, jaw=np.zeros((4, 3))), (), "jaw: expected 9 frames"),
    "lists of other lengths": (lambda: lines('{"exp": [1, 2]}\n{"exp": [1]}\n'), (), "exp, line 2"),
    "too many coefficients": (lambda: npz(expression=np.zeros((3, 50))), (), "at most 8 coefficients"),
    "half a jaw": (lambda: npz(expression=ONE, jaw=np.zeros((FRAMES, 2))), (), "jaw: expected 3"),
    "a pose of five": (lambda: npz(exp=ONE, pose=np.zeros((FRAMES, 5))), (), "pose: expected 6 numbers"),
    "pickled objects": (lambda: npz(expression=np.array([{}], object)), (), "expected"),
    "npz of text": (lambda: npz(expression=np.array([["a"]])), (), "numbers"),
    "no expression": (lambda: npz(pose=np.zeros((3, 6))), (), "columns"),
    "another form": (lambda: csv("jawOpen\n1\n"), ("--form", "coefficients"), "expression coefficients"),
    "unknown form": (lambda: csv("jawOpen\n1\n"), ("--form", "blendshape"), "Did you mean 'blendshapes'"),
    "map of an unknown column": (lambda: mapped("c: {jaw.0: 1}"), MAP, "expected one of a, b, found 'c'"),
    "map to nothing known": (lambda: mapped("a: {jaw.7: 1}"), MAP, "jaw.7"),
    "map of both kinds": (lambda: mapped("a: {jaw.0: 1, jawOpen: 1}"), MAP, "alone"),
    "map without numbers": (lambda: mapped("a: {jaw.0: much}"), MAP, "a.jaw.0"),
    "an empty map": (lambda: mapped(""), MAP, "an empty map"),
    "a map of nothing": (lambda: mapped("a: {}"), MAP, "an empty map"),
    "a huge number": (lambda: lines('{"jawOpen": 1' + "0" * 400 + "}"), (), "a number or a list of numbers"),
    "an empty list": (lambda: lines('{"jawOpen": []}'), (), "a number or a list of numbers"),
    "nested lists": (lambda: lines('{"exp": [[[1], [1, 2]]]}'), (), "a number or a list of numbers"),
    "two numbers": (lambda: lines('{"jawOpen": [0.1, 0.9]}'), (), "jawOpen: expected one number"),
    "no blendshape": (lambda: csv("time\n0\n"), ("--form", "blendshapes"), "a column with ARKit's name"),
    "a shape twice": (lambda: csv("jawOpen,JawOpen\n0.5,0.1\n"), (), "one column for jawOpen, found two"),
    "arrays as parameters": (
        arrays,
        ("--form", "flame_param", "--signal-head", "avatar"),
        ".npz file of parameters",
    ),
    "a missing head": (lambda: "signal.npz", ("--signal-head", "typo.pkl"), "--signal-head"),
    "no map": (lambda: csv("jawOpen\n1\n"), ("--map", "none.yaml"), "none.yaml"),
    "an unknown head": (lambda: "signal.npz", ("--signal-head", "2021"), "2020, 2023"),
    "no head with shapes": (lambda: csv("jawOpen\n1\n"), ("--signal-head", "avatar"), "ARKit's names"),
    "neutral beyond": (lambda: "signal.npz", ("--neutral", "9"), "from 0 to 8"),
    "a short window": (lambda: "signal.npz", ("--smooth", "0.04"), "--smooth"),
    "a long window": (lambda: "signal.npz", ("--smooth", "5"), "--smooth"),
    "sequence of no capture": (lambda: "signal.npz", ("--sequence", "FREE"), "a signal that is a capture"),
    "a video": (lambda: (Path("a.mp4").write_text("x"), "a.mp4")[1], (), "found a video"),
    "frames of Metrical Tracker": (tracked, (), "headbench import tracking"),
    "an empty folder": (lambda: (Path("empty").mkdir(), "empty")[1], (), "files npz, npy or json"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_input_is_refused_before_anything_is_written(place, capsys, name):
    make, words, said = REFUSED[name]
    code, _, error = drive(capsys, *words, signal=make())
    assert (code, said in error) == (2, True), error
    assert not Path("out").exists()


def test_signals_of_another_head_need_it_named(place, capsys):
    write_mesh_avatar(place / "new", replace(HEAD, version="flame2023"))
    code, _, error = drive(capsys, avatar="new")
    assert code == 2
    assert "--signal-head" in error
    assert "flame2020" in error
    save_head(Path("head.npz"), HEAD)
    code, data, error = drive(capsys, "--signal-head", "head.npz", avatar="new")
    assert (code, data["head_models"]) == (0, ["flame2020", "flame2023"]), error
    assert data["refit_residual_mm"] < 0.02


def test_other_inputs_are_refused(place, capsys, pristine_capture):
    """Options without effect, an avatar without a head or a capture, another subject's capture."""
    assert drive(capsys, "--camera", "1")[0] == drive(capsys, "--capture", "x", "--size", "64")[0] == 2
    union = pristine_capture.union
    write_mesh_avatar(place / "else", read_head(union / "head_model.npz"), subject="someone", spec=SPEC)
    code, _, error = drive(capsys, "--capture", str(union), avatar="else")
    assert (code, "an avatar of 901" in error) == (2, True), error
    (place / "avatar" / "head_model.npz").unlink()
    code, _, error = drive(capsys)
    assert (code, "--capture" in error) == (2, True)

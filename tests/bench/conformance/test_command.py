"""``headbench doctor check`` on plug-ins written outside, which import nothing but the root of headbench."""

import ast
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import headbench
from headbench import FrameKey, check_reader
from headbench.bench import cli, contracts, errors, specs
from headbench.bench.conformance import command
from headbench.bench.engine import captures
from headbench.datasets.specs import GA_LAYOUT

from ...world import capture


def everything(change):
    """Change a clip after it is read."""
    return lambda clip: [setattr(clip, name, value) for name, value in change(clip).items()]


def with_key(change):
    def altered(clip):
        first, *rest = clip.splits["train"]
        return {"splits": {**clip.splits, "train": (change(first), *rest)}}

    return everything(altered)


def with_camera(**fields):
    return everything(lambda c: {"cameras": {n: replace(one, **fields) for n, one in c.cameras.items()}})


def with_pose(**fields):
    return everything(lambda c: {"poses": {t: replace(one, **fields) for t, one in c.poses.items()}})


def with_image(change):
    def altered(clip):
        original = clip.image
        clip.image = lambda key: change(original(key), key)

    return altered


def split(name, keys):
    return everything(lambda c: {"splits": {**c.splits, name: keys(c)}})


SHARED: dict[FrameKey, np.ndarray] = {}
MIRROR = np.diag([-1.0, 1, 1, 1])
COUNT = iter(range(1000))

FAULTS = {
    "a frame in two splits": (split("novel_view", lambda c: c.splits["train"][:1]), "two splits"),
    "no training": (split("train", lambda c: ()), "train is empty"),
    "a split that is not there": (
        everything(lambda c: {"splits": {"train": c.splits["train"]}}),
        "lack novel_view, self_reenactment",
    ),
    "keys as tuples": (with_key(tuple), "FrameKeys"),
    "another subject": (with_key(lambda k: k._replace(subject="you")), "a subject"),
    "an unknown camera": (with_key(lambda k: k._replace(camera="top")), "a camera that the clip does not have"),
    "an unknown timestep": (with_key(lambda k: k._replace(timestep=99)), "a timestep that the clip"),
    "a timestep in two sequences": (with_key(lambda k: k._replace(sequence="sing")), "two sequences"),
    "training on a held-out camera": (
        split("novel_view", lambda c: tuple(k._replace(camera="view0") for k in c.splits["novel_view"][:0])
              or (c.splits["train"][0]._replace(timestep=3, sequence="rest"),)),
        "novel_view has cameras that are trained on",
    ),
    "training on a held-out timestep": (
        split("self_reenactment", lambda c: (c.splits["train"][0]._replace(camera="view2"),)),
        "self_reenactment has timesteps that are trained on",
    ),
    "an excluded frame in a split": (
        everything(lambda c: {"excluded": {c.splits["train"][0]: "blurred"}}), "excluded frame is in a split"),
    "an exclusion without a reason": (
        everything(lambda c: {"excluded": {c.splits["train"][0]._replace(timestep=50): ""}}), "without a reason"),
    "a name that leads out": (everything(lambda c: {"subject": "../me"}), "cannot name a folder"),
    "a camera's other name": (with_camera(id="x"), "has the id 'x'"),
    "no focal length": (with_camera(K=np.zeros((3, 3))), "positive focal lengths"),
    "K of another shape": (with_camera(K=np.eye(4)), "K of camera view0 has shape (4, 4)"),
    "a mirrored camera": (with_camera(world_to_camera=MIRROR), "no rigid motion"),
    "an infinite camera": (with_camera(world_to_camera=np.full((4, 4), np.inf)), "not finite"),
    "another image size": (with_camera(width=11), "has shape (12, 10, 3), expected (12, 11, 3)"),
    "poses of another head": (with_pose(head_model="other"), "the head model is fixed"),
    "short expressions": (with_pose(expression=np.zeros(2)), "expression of the pose of timestep 0 has shape (2,)"),
    "poses of nobody": (with_pose(subject=""), "subject and timestep of the pose"),
    "images of floats": (with_image(lambda image, key: image / 255.0), "dtype float64"),
    "images that can be changed": (
        with_image(lambda image, key: SHARED.setdefault(key, image)), "can be changed by who reads it"),
    "images that differ by order": (with_image(lambda image, key: image + np.uint8(next(COUNT))), "another order"),
    "an image for any key": (
        everything(lambda c: {"image": lambda key: np.zeros((12, 10, 3), np.uint8)}), "accepted instead of raising"),
    "a dark background": (everything(lambda c: {"background": -np.ones(3)}), "leaves [0, 1]"),
    "steps that are no record": (everything(lambda c: {"steps": [object()]}), "cannot be written as JSON"),
    "a mask of another size": (everything(lambda c: {"mask": lambda key: np.zeros((3, 3), np.uint8)}), "mask of"),
    "no head": (everything(lambda c: {"head": None}), "no HeadAsset"),
    "triangles of nothing": (
        everything(lambda c: {"head": replace(c.head, faces=c.head.faces + 100)}), "vertices that are not there"),
    "a property that fails": (everything(lambda c: {"poses": None}), "AttributeError"),
}  # fmt: skip


@pytest.fixture
def reader(outside, monkeypatch):
    import outside_reader

    SHARED.clear()

    def faulty(change):
        original = outside_reader.NpzClip.__init__

        def init(self, path, arrays):
            original(self, path, arrays)
            self.__class__ = type("Faulty", (outside_reader.NpzClip,), {"head": self.head})
            change(self)

        monkeypatch.setattr(outside_reader.NpzClip, "__init__", init)
        return outside_reader

    faulty.module = outside_reader
    return faulty


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_clip_is_found(reader, npz_capture, fault):
    change, breach = FAULTS[fault]
    found = check_reader(reader(change).SPEC, npz_capture)
    assert any(breach in one for one in found), found


def test_a_fingerprint_must_not_depend_on_time_or_place(reader, npz_capture, monkeypatch):
    spec, clip = reader.module.SPEC, reader.module.NpzClip
    monkeypatch.setattr(clip, "fingerprint", property(lambda self: str(next(COUNT))))
    assert check_reader(spec, npz_capture) == ["the fingerprint differs when the capture is read again"]
    original = reader.module.read

    def read(path, *, dark: bool = False):
        found = original(path)
        found.place = str(path)
        return found

    monkeypatch.setattr(reader.module, "read", read)
    monkeypatch.setattr(clip, "fingerprint", property(lambda self: self.place))
    assert check_reader(spec, npz_capture) == [
        "the fingerprint differs when the capture lies in another folder"
    ]


def test_what_is_no_capture_must_be_an_input_error(reader, npz_capture, monkeypatch):
    original = reader.module.read
    find = lambda root: [root / "me.npz"] if (root / "me.npz").exists() else [root]
    monkeypatch.setattr(reader.module, "find", find)

    def read(path, *, dark: bool = False):
        is_capture = path.is_file() and path.suffix == ".npz"
        return original(path if is_capture else npz_capture / "me.npz")

    monkeypatch.setattr(reader.module, "read", read)
    found = check_reader(reader.module.SPEC, npz_capture)
    for case in ("a path that does not exist", "an empty folder", "a text file"):
        assert f"{case} was accepted instead of raising InputError" in found


def test_a_reader_that_finds_nothing_does_not_conform(reader, tmp_path):
    (tmp_path / "empty").mkdir()
    assert check_reader(reader.module.SPEC, tmp_path / "empty")[0].startswith("find lists nothing under")


def test_our_own_reader_conforms():
    assert check_reader(GA_LAYOUT, capture().writer.root) == []


PLUGINS = ("camera_mean:SPEC", "outside_reader:SPEC", "mae:MAE") + tuple(
    f"outside_metric:{name}" for name in ("ERROR", "JUMP", "FACE", "WORST", "FILES", "HOURS")
)


@pytest.mark.parametrize("plugin", PLUGINS)
def test_plugins_written_outside_conform(outside, npz_capture, capsys, plugin):
    read_by = ["--reader", "outside_reader:SPEC", "--data", str(npz_capture)]
    data = {"camera_mean:SPEC": read_by, "outside_reader:SPEC": read_by[2:]}.get(plugin, [])
    assert cli.main(["doctor", "check", plugin, *data]) == 0
    assert "keeps its contract" in capsys.readouterr().out


def test_plugins_written_outside_import_the_root_alone(outside):
    for path in outside.glob("*.py"):
        names = {
            node.module for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)
        }
        assert {name for name in names if name.startswith("headbench")} <= {"headbench"}


def test_the_pages_experiment_and_report_show_each_condition(outside, npz_capture, tmp_path, monkeypatch):
    import best
    import noise

    monkeypatch.setattr("headbench.bench.api.reader_of", lambda data: "outside_reader:SPEC")
    how = {
        "methods": ("mean-image",),
        "preset": "smoke",
        "deviations": (40.0,),
        "progress": contracts.no_progress,
    }
    run = tmp_path / "run"
    means = noise.run_noise(data=str(npz_capture), out=str(run), **how).data
    assert means["mean-image"] != means["mean-image+noise-40"]
    (file,) = best.write_best(run)
    assert [frame["method"] for frame in json.loads(file.read_text())] == [*means]


@pytest.fixture
def check(npz_capture):
    """The words that check the tutorial's method."""
    return [
        "doctor",
        "check",
        "camera_mean:SPEC",
        "--reader",
        "outside_reader:SPEC",
        "--data",
        str(npz_capture),
    ]


def test_breaches_are_listed_and_the_exit_code_is_one(outside, check, capsys, monkeypatch):
    monkeypatch.setattr("camera_mean.CameraMeanAvatar.files", lambda self: [])
    assert cli.main(check) == 1
    assert "1 breach of the contract of a method\n- files() names no file" in capsys.readouterr().out
    assert cli.main([*check, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["breaches"] == ["files() names no file"]


def test_what_a_plugin_raises_is_a_breach_with_its_line(outside, check, capsys):
    method = outside / "camera_mean.py"
    method.write_text(method.read_text().replace("progress(done, len(cameras))", "1 / 0"))
    assert cli.main([*check, "--set", "timesteps=many"]) == 2  # not of its type
    assert cli.main(check) == 1
    assert "ZeroDivisionError: division by zero (camera_mean.py, line" in capsys.readouterr().out


def test_without_data_a_method_is_tried_on_a_synthetic_capture(monkeypatch):
    made = []
    monkeypatch.setattr(command, "resolve", lambda reference: lambda **arguments: made.append(arguments))
    monkeypatch.setattr(captures, "open_clips", lambda config: [made.append(config.data)])
    monkeypatch.setattr(command, "_adapted", lambda *_: None)
    monkeypatch.setattr(command, "check_method", lambda *_, **__: [])
    command.check_plugin(command.CheckPluginSettings("mean-image"))
    arguments, data = made[-2:]
    assert str(arguments["out"]) == data
    assert arguments["cameras"] * arguments["timesteps"] <= 12


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["ga"], "--kind, one of methods, datasets"),
        (["ga", "--kind", "datasets"], "--data: expected a capture"),
        (["nothing"], "a name that `headbench list` shows"),
        (["no_module:SPEC"], "PYTHONPATH"),
        (["outside_metric:hours"], "a MethodSpec, a DatasetSpec or a MetricSpec"),
        (["synthetic", "--data", "."], "one that makes captures"),
        (["outside_reader:SPEC", "--data", ".", "--set", "drak=true"], "dark"),
    ],
)
def test_wrong_usage_is_refused(outside, capsys, arguments, error):
    assert cli.main(["doctor", "check", *arguments]) == 2
    assert error in capsys.readouterr().err


def test_the_root_exports_what_plugins_need_and_imports_it_late():
    code = (
        "import sys, headbench\n"
        "assert 'numpy' not in sys.modules\n"
        "assert set(headbench.__all__) <= set(dir(headbench))\n"
        "scripts = {'evaluate', 'list_methods', 'open_clip', 'run', 'train'}\n"
        "for name in set(headbench.__all__) - scripts: getattr(headbench, name)\n"
        "assert not {'torch', 'cv2'} & set(sys.modules)\n"
        "for name in scripts: getattr(headbench, name)\n"
        "assert 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        headbench.Nothing  # noqa: B018


def test_every_specification_and_protocol_is_exported():
    public = {
        name
        for module in (contracts, specs, errors)
        for name, value in vars(module).items()
        if isinstance(value, type) and value.__module__ == module.__name__
    }
    assert public - set(headbench.__all__) <= {"CommandSpec", "ExitCode", "Interruption"}

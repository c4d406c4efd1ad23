"""What all adapters have in common: what is checked before any work, given to a program, kept of it, and read back of its renders."""

import os
import re
import shutil
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.contracts import Budget, ListedFrames, SharingAvatar
from headbench.bench.engine.guard import TrainingView
from headbench.bench.engine.stored import avatar_digest
from headbench.bench.errors import HeadbenchError, InputError, UnavailableError
from headbench.bench.io.documents import read_json
from headbench.bench.process import ProgramError
from headbench.datasets.head.subject import PosedSubject, pose_in_head_frame
from headbench.methods.official import checkout, needs, spec
from headbench.methods.official.flashavatar import method as flashavatar
from headbench.methods.official.gha.export import GHATracking
from headbench.methods.official.insta import export as insta
from headbench.methods.official.method import RENDERING, RENDERING_LOG, TRAINING, TRAINING_LOG
from headbench.methods.official.rgbavatar import method as rgbavatar
from headbench.methods.official.workplace import check_export
from headbench.methods.shared.avatar_files import Subject

from .conftest import OF_VIDEO
from .helpers import BUDGET, WHITE, export, fit, rendered, renders, views, with_an_odd_size
from .repository import ADAPTERS

every = pytest.mark.parametrize("name", ADAPTERS)
GREEN, BLACK = (0.0, 0.5, 1.0), (0.0, 0.0, 0.0)

# ------------------------------------------------------------------ training

KEPT = {
    "ga": "point_cloud.ply cfg_args",
    "tga": "point_cloud.ply cfg_args triplane.pth feat_line.pth sorted_jaw_poses.npz",
    "gbs": "fix_chkpnt.pth mouth0_chkpnt.pth mouth1_chkpnt.pth acc.npy",
    "gha": "gaussianhead_latest supres_latest square.json",
    "insta": "snapshot.msgpack",
    "rgbavatar": "model.ply config.yaml",
    "flashavatar": "chkpnt.pth options.json",
}
TOLD = {
    "ga": ["principal point in the middle of the image: images are cropped accordingly (2 of 3"],
    "tga": ["jaw bases from training poses", "clusters without random starts"],
    "gbs": ["placeholders of one pixel", "8 directions is padded"],
    "gha": ["Basel Face Model"],
    "insta": ["8 expression coefficients"],
    "rgbavatar": ["8 directions is padded"],
    "flashavatar": [
        "network that parses faces",
        "principal point",
        "8 directions",
        "'test_num = 500' read as",
    ],
}
SEVENTH = {"gha": "loss 0.5000", "rgbavatar": "", "flashavatar": "loss 0.50000", "ga": "loss 0.7"}
"""Note of the seventh iteration."""
LOGGED = {
    "gbs": "'test_iterations': '0'",
    "gha": "torch seeded with 0",
    "insta": "loads 6 1700",
    "rgbavatar": "train_offline.py --subject head --work_name headbench",
    "flashavatar": "--idname head --image_res 25 --seed 0 --iterations 20 --white_background",
}


@every
def test_an_avatar_is_trained_once_and_recorded(name, method, clip, trained):
    folder, calls = trained(name)
    avatar = method.load(folder, device="cpu")
    assert isinstance(avatar, ListedFrames)
    assert isinstance(avatar, SharingAvatar)
    assert {path.name for path in avatar.files()} == {*KEPT[name].split(), "subject.npz"}
    assert [path.name for path in avatar.shared_files()] == ["head_model.npz"]
    assert not (folder / TRAINING).exists()
    frames = len(clip.splits["train"])
    assert [done for done, *_ in calls] == sorted(done for done, *_ in calls)
    assert {total for _, total, _ in calls} == {frames + 20}
    assert (calls[0][0], calls[-1][0]) == (1, frames + 20)
    assert (frames + 7, frames + 20, SEVENTH.get(name, "loss 0.7")) in calls
    record = read_json(folder / "training.json")
    assert record["official"]["commit"] == method.config.commit
    assert record["official"]["changed"] == []
    assert record["leaks"] == []
    assert all(words in " ".join(record["differences"]) for words in TOLD[name])
    log = (folder / TRAINING_LOG).read_text()
    assert LOGGED.get(name, "") in log
    assert re.search("'PATH'", log) or name == "gha"
    assert not re.search("'(PYTEST|VIRTUAL|PYTHONPATH|OMP)", log)
    fit(method, clip, folder)
    assert (folder / TRAINING_LOG).read_text() == log, "nothing was run"
    with pytest.raises(InputError, match="another run"):
        fit(method, clip, folder, seed=1)
    assert not [*Path(method.config.checkout).rglob("__pycache__")] or name != "flashavatar"


TRAININGS = {
    name: {"crash": "out of memory", "no output": "no whole avatar"} for name in ADAPTERS if name != "tga"
}
TRAININGS["gha"]["stop"] = "ended before its 5 iterations"


@pytest.mark.parametrize("name", TRAININGS)
def test_a_training_that_fails_says_so_and_begins_anew(method, clip, behave, tmp_path, name):
    """What it left beside its input, renders among it, is none of the images that it may be given."""
    for fault, expected in TRAININGS[name].items():
        behave(fault)
        with pytest.raises(ProgramError, match=expected):
            fit(method, clip, tmp_path / "a")
    behave("")
    calls = []
    assert fit(method, clip, tmp_path / "a", lambda done, *_: calls.append(done)).files()
    assert min(calls) > len(clip.splits["train"]), "the export was kept"


class Killed(KeyboardInterrupt):
    """What a signal raises."""


def alive(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False
    return state.rpartition(")")[2].split()[0] != "Z"


@pytest.mark.parametrize("name", ["ga", "rgbavatar"])
def test_a_killed_or_too_long_training_ends_its_processes(method, clip, behave, tmp_path, name):
    frames = len(clip.splits["train"])

    def kill(done, total, note=""):
        if done >= frames + 5:
            raise Killed

    behave("hang")
    with pytest.raises(Killed):
        fit(method, clip, tmp_path / "a", kill)
    limited = type(method)(replace(method.config, time_limit_hours=0.5 / 3600))
    with pytest.raises(ProgramError, match="time limit|time_limit_hours"):
        fit(limited, clip, tmp_path / "b")
    pids = (Path(method.config.checkout) / "pids.txt").read_text().split()
    until = time.monotonic() + 5
    while any(map(alive, pids)) and time.monotonic() < until:
        time.sleep(0.02)
    assert not any(map(alive, pids))
    behave("")
    calls = []
    fit(method, clip, tmp_path / "a", lambda done, total, note="": calls.append(done))
    found = re.findall(r"finds (.*)", (tmp_path / "a" / TRAINING_LOG).read_text())
    assert found == ["[]", "[]"], "nothing of a broken training is left"
    assert min(calls) > frames, "the export was kept"


# ------------------------------------------------------------------ what a program is given

IMAGES = {"insta": 3, "gha": 6, "flashavatar": 4}
"""Files of a training frame."""


@every
def test_training_frames_alone_are_exported(name, method, clip, tmp_path):
    work, images = export(method, clip, tmp_path / "work")
    check_export(work, images, clip)
    keys = clip.splits["train"]
    assert sorted(images.values()) == sorted([*keys] * IMAGES.get(name, 1))
    held_out = clip.splits["novel_view"][0]
    with pytest.raises(HeadbenchError, match="not a training frame"):
        TrainingView(clip).image(held_out)
    first, second = sorted(images)[:2]
    for wrong in (
        {first: held_out},
        {first: images[second]} if images[first] != images[second] else {"a.png": keys[0]},
    ):
        with pytest.raises(InputError):
            check_export(work, images | wrong, clip)
    shutil.copyfile(work.root / first, work.program / "test.JPG")
    with pytest.raises(InputError, match="test.JPG"):
        check_export(work, images, clip)
    (work.program / "test.JPG").unlink()
    (work.root / first).unlink()
    with pytest.raises(InputError, match=re.escape(first)):
        check_export(work, images, clip)


# ------------------------------------------------------------------ renders

COVERED = ("gbs", "insta", "rgbavatar")
"""Programs whose renders have a coverage, which the stand-ins take to be 3/5."""


def levels_of(name, clip, key, camera, pose):
    """Levels that the stand-in draws of a frame: of its expression, of its jaw or rotation, and of its camera."""
    subject, red = PosedSubject.of(clip), float(pose.expression[0])
    motion = subject.motions([pose])[0]
    center, jaw = np.linalg.inv(camera.world_to_camera)[:3, 3], float(-np.sin(pose.jaw[0]))
    shift = (camera.world_to_camera @ motion)[0, 3]
    if name in ("ga", "tga"):  # of the tracking refined by the training, if there is one
        red += 0.25 * (name == "ga" and key.timestep in {k.timestep for k in clip.splits["train"]})
        return 100 + 40 * red, 100 + 900 * float(pose.rotation[0]), 100 + 200 * center[0]
    if name == "gha":
        values = GHATracking.of(clip.head, Subject.of(clip)).parameters(pose)
        return 100 + 40 * values["exp_coeff"][0, 0], 100 + 300 * values["pose"][0, 0], 100 + 200 * center[0]
    if name == "insta":
        return 30 + 20 * red, 5000 * subject.meshes([pose_in_head_frame(pose)])[0].std(), camera.K[0, 0]
    return 60 + 20 * red, 60 + 200 * jaw, camera.K[0, 0] if name == "flashavatar" else 60 + 100 * shift


def corner_of(name, clip, camera, pose):
    """Levels in the first pixel, where they are others."""
    if name == "insta":
        place = np.linalg.inv(camera.world_to_camera @ PosedSubject.of(clip).motions([pose])[0])[:3, 3]
        return np.clip(75 + 60 * place, 0, 153)
    return camera.K[0, 0], camera.K[0, 2], 300  # which is not 300 - 256


@every
def test_frames_come_back_under_their_keys(name, avatar, clip, tmp_path, monkeypatch):
    for module in (rgbavatar, flashavatar, insta):
        monkeypatch.setattr(
            module, "PART", 4 if module is insta else 8
        )  # more than one call for a camera's frames
    wanted, several = views(clip, "novel_view", "self_reenactment", "train"), name in (*OF_VIDEO, "insta")
    wanted, before = with_an_odd_size(wanted) if several else wanted, avatar_digest(tmp_path / "avatar")
    for ground in (WHITE, GREEN)[: 1 + (name in COVERED)]:
        found = rendered(avatar, wanted, ground)
        for key, (camera, pose) in wanted.items():
            rgb, alpha = found[key]
            most, share = (153, 0.4) if name in COVERED else (255, 0.0)
            assert alpha == pytest.approx(1 - share)
            levels = np.clip(levels_of(name, clip, key, camera, pose), 0, most)
            pixels = [(rgb[1, 1], levels), (rgb[-1, -1], levels)]
            if name in ("insta", "rgbavatar"):
                pixels.append((rgb[0, 0], corner_of(name, clip, camera, pose)))
            for pixel, shown in pixels:
                expected = np.clip(np.floor(shown) / 255 + share * np.array(ground), 0, 1)
                assert np.abs(pixel - expected).max() < 1.01 / 255
    assert not (tmp_path / "avatar" / RENDERING).exists()
    assert {path.name for path in (tmp_path / "avatar").glob("*.log")} == {TRAINING_LOG, RENDERING_LOG}
    assert avatar_digest(tmp_path / "avatar") == before, "logs are no part of an avatar"
    with pytest.raises(UnavailableError):
        avatar.render(*next(iter(wanted.values())))
    if name not in COVERED:
        with pytest.raises(InputError, match="background"):
            renders(avatar, clip, BLACK)


SIZE, MEMORY = r"expected \d+x\d+ pixels, found \d+x\d+", "exit code 1.*out of memory"
LISTS = {
    "ga": {"other size": SIZE, "reversed": "the mark of frame", "one too few": r"first 00001.png \(toy/"},
    "gbs": {
        "no coverage": "pred_mask_00000.png",
        "reversed": "the mark of frame 0",
        "one too few": r"first pred_00001.png \(toy/",
        "other size": SIZE,
    },
    "gha": {"reversed": "the mark of frame", "one too few": r"first 000001.png \(toy/"},
    "insta": {
        "no coverage": "colours and coverage",
        "other size": SIZE,
        "reversed": "exit code 1.*rendered by the camera of another",
        "no cameras": "exit code 1.*wrote no .*transforms_overlay.json",
        "one too few": r"first 000001.png \(toy/",
    },
    "rgbavatar": {"no coverage": "coverage", "other size": SIZE, "one too few": r"first 000001.png \(toy/"},
    "flashavatar": {
        "other size": SIZE,
        "reversed": "the mark of frame 0",
        "one too few": r"first 000001.png \(toy/",
    },
}


@pytest.mark.parametrize("name", LISTS)
def test_renders_that_are_not_what_was_listed_are_found(avatar, clip, behave, name):
    for fault, expected in ({"crash in rendering": MEMORY} | LISTS[name]).items():
        behave(fault)
        with pytest.raises(ProgramError, match=expected):
            renders(avatar, clip)


# ------------------------------------------------------------------ settings

NO_SHIM = ("gha", "insta")
URLS = {"insta": "Zielon/INSTA", "rgbavatar": "gapszju/RGBAvatar", "flashavatar": "USTC3DV/FlashAvatar-code"}
SETTINGS = [
    *((name, {"device": "cpu-shim"}, "device: expected cuda") for name in NO_SHIM),
    *((name, {"order": "native"}, "order: expected published") for name in NO_SHIM),
    *((name, {"python": ""}, f"settings.{name}-official.python=") for name in OF_VIDEO),
    *((name, {"commit": "0" * 40}, "expected commit 000000000000, found commit") for name in URLS),
    *((name, {"checkout": "/nowhere"}, f"no such folder.*git clone.*{url}") for name, url in URLS.items()),
    ("insta", {"program": "build/none"}, "build/none.*program: expected.*cmake"),
    ("insta", {"program": "no-such-program build/rta"}, "no-such-program"),
    ("insta", {"program": "'unclosed"}, "the program that was built"),
    ("insta", {"program": "/bin/true"}, "to --version.*cmake"),
]


@pytest.mark.parametrize(("name", "changes", "expected"), SETTINGS)
def test_faults_of_settings_are_named_before_any_work(method, clip, changes, expected):
    method.config = replace(method.config, **changes)
    with pytest.raises(InputError, match=expected):
        method.check(clip, BUDGET)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        *(
            ("gha", wrong)
            for wrong in ({"mesh_fraction": 0.0}, {"mesh_fraction": 1.0}, {"arguments": ("-x",)})
        ),
        *(("insta", wrong) for wrong in ({"python": "python"}, {"images_on_gpu": 0})),
        *(("rgbavatar", {"values": (value,)}) for value in ("tex_size", "iteration=5")),
        ("ga", {"time_limit_hours": 0.0}),
    ],
)
def test_settings_without_a_meaning_are_refused(name, changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        ADAPTERS[name][0].config_class(**changes)


@every
def test_budgets_in_seconds_are_refused(method, clip, tmp_path):
    for budget in (Budget(seconds=5.0), Budget(iterations=5, seconds=5.0)):
        with pytest.raises(InputError, match="seconds"):
            fit(method, clip, tmp_path / "a", budget=budget)
    assert not (tmp_path / "a").exists()


@every
def test_doctor_names_checkout_and_environment(method, monkeypatch, name):
    nothing = [*needs.official(type(method.config)(), "cpu")]
    assert [(need.what, need.found) for need in nothing] == [("checkout", ""), ("environment", "")]
    assert "git clone" in nothing[0].remedy
    monkeypatch.setitem(needs.METHODS, type(method.config), type(method))
    place, environment = needs.official(method.config, "cpu")
    assert place.found.endswith(method.config.commit[:12])
    assert environment.found.startswith("instant-ngp 1.0dev" if name == "insta" else "Python 3")
    compile(needs.METHODS[type(method.config)].repository.trial, "trial", "exec")


@pytest.mark.parametrize(("name", "remedy"), [("insta", "a CUDA device"), ("gha", "CUDA build of PyTorch")])
def test_doctor_misses_a_gpu(method, monkeypatch, name, remedy):
    monkeypatch.setattr(checkout, "_DEVICES", "print('headbench-devices', 0)")
    monkeypatch.setitem(needs.METHODS, type(method.config), type(method))
    if name != "insta":
        monkeypatch.setattr(type(method), "repository", replace(method.repository, modules=("torch",)))
    (_, environment) = needs.official(method.config, "cpu")
    assert remedy in environment.remedy
    assert "cpu-shim" not in environment.remedy, "the shim does not support this code"


def test_presets_and_head_models_are_those_of_the_publications():
    of_video = [spec.GBS_OFFICIAL, spec.INSTA_OFFICIAL, spec.RGBAVATAR_OFFICIAL, spec.FLASHAVATAR_OFFICIAL]
    for each in of_video:
        assert each.monocular
        assert set(each.presets) == {"smoke", "demo", "fast", "paper"}
    assert [each.head_models for each in of_video[2:]] == [("flame2020",)] * 2
    assert spec.FLASHAVATAR_OFFICIAL.presets["paper"]["budget"] == {"iterations": 150_000}
    demo = spec.GBS_OFFICIAL.presets["demo"]
    assert demo["budget"] == {"iterations": 2_000}
    assert demo["arguments"][-2:] == ("--init_face_point_number", "12000")
    assert "arguments" not in spec.GBS_OFFICIAL.presets["paper"]


@pytest.mark.parametrize("name", ["ga"])
def test_folders_may_be_relative(method, clip, avatar, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    method.config = replace(method.config, checkout=os.path.relpath(method.config.checkout))
    assert renders(method.load(Path("avatar"), device="cpu"), clip)


# ------------------------------------------------------------------ clips


def of_head(clip, **changes):
    return replace(clip, head=replace(clip.head, **changes))


def without(region, clip):
    return of_head(clip, regions={name: part for name, part in clip.head.regions.items() if name != region})


def of_camera(name, row, column, change, clip):
    """With another value in a camera's K."""
    camera = clip.cameras[name]
    K = camera.K.copy()
    K[row, column] = change(K[row, column])
    return replace(clip, cameras={**clip.cameras, name: replace(camera, K=K)})


def of_train(part, clip):
    return replace(clip, splits={**clip.splits, "train": clip.splits["train"][part]})


def grounded(level, clip):
    return replace(clip, background=np.full(3, level))


def no_mask(clip):
    return replace(clip, masks=dict.fromkeys(clip.masks))


def widened(value):
    return 1.05 * value


def skewed(name):
    return partial(of_camera, name, 0, 1, lambda value: value + 1)


INTRINSICS = (partial(of_camera, "01", 0, 0, widened), "camera 01")
PIXELS = (partial(of_camera, "02", 1, 1, widened), "square pixels")
MASK = (no_mask, "a mask")
BASIS = (
    lambda clip: of_head(clip, expression_basis=np.zeros((len(clip.head.template), 3, 101))),
    "expression basis",
)
CLIPS = {
    "ga": [
        *(BASIS, PIXELS, (partial(grounded, 0.5), "background"), (partial(of_head, regions={}), "lips")),
        (partial(of_head, parents=np.array([-1, 0, 0, 0, 0])), "parents"),
    ],
    "tga": [(partial(without, "face"), "a region face")],
    "gbs": [
        *(MASK, BASIS, (partial(of_head, regions={}), "scalp")),
        (partial(of_head, regions={"scalp": np.arange(2)}), "regions"),
    ],
    "gha": [
        *((partial(grounded, 0.0), "background"), (partial(without, "lips"), "region 'lips'")),
        *((partial(of_train, slice(1, None)), "timestep"), (skewed("02"), "camera 02")),
    ],
    "insta": [
        *(MASK, (skewed("00"), "no skew")),
        (lambda clip: replace(clip, static_offset=clip.static_offset + [0, 0.5, 0]), "template"),
    ],
    "rgbavatar": [
        *(MASK, BASIS, INTRINSICS, (skewed("02"), "no skew")),
        (partial(of_train, slice(9)), "10 training frames or more.*found 9"),
    ],
    "flashavatar": [
        *(MASK, INTRINSICS, PIXELS, (partial(grounded, 0.0), "background")),
        (partial(without, "boundary"), r"regions\[boundary\].*FLAME_masks.pkl"),
    ],
}


@pytest.mark.parametrize(("name", "case"), [(name, case) for name, of in CLIPS.items() for case in of])
def test_clips_that_their_code_cannot_take_are_refused(method, clip, case):
    change, expected = case
    with pytest.raises(InputError, match=expected):
        method.check(change(clip), BUDGET)


@pytest.mark.parametrize("name", ["gbs"])
def test_a_mask_that_is_missing_later_is_named(method, clip, tmp_path):
    last = clip.splits["train"][-1]
    with pytest.raises(InputError, match=f"{last}.*a mask"):
        fit(method, replace(clip, masks=clip.masks | {last: None}), tmp_path / "a")

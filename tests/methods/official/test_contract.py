"""What all adapters have in common: what is checked before any work, given to a program, kept of it, and read back of its renders."""

import shutil
import sys
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.configuration import deciding_settings
from headbench.bench.contracts import Budget, FrameKey, ListedFrames, SharingAvatar
from headbench.bench.engine.scoring import TrainingView
from headbench.bench.engine.stored import avatar_digest
from headbench.bench.errors import HeadbenchError, InputError, UnavailableError
from headbench.bench.io.documents import read_json
from headbench.bench.process import ProgramError
from headbench.datasets.head.model import PosedSubject, pose_in_head_frame
from headbench.methods.official import needs, workplace
from headbench.methods.official.checkout import Repository, inspect_checkout
from headbench.methods.official.flashavatar import method as flashavatar
from headbench.methods.official.gha.method import GHATracking
from headbench.methods.official.insta import method as insta
from headbench.methods.official.method import RENDERING, RENDERING_LOG, TRAINING, TRAINING_LOG
from headbench.methods.official.rgbavatar import method as rgbavatar
from headbench.methods.official.spec import GAOfficialConfig
from headbench.methods.official.workplace import check_export, gaussian_blendshapes
from headbench.methods.shared.avatar_files import Subject
from headbench.methods.shared.schedule import ShuffledEpochs

from .conftest import OF_VIDEO
from .helpers import BUDGET, WHITE, export, fit, rendered, renders, views
from .repository import ADAPTERS


def test_gaussianblendshapes_numbers_the_last_350_frames(tmp_path):
    keys = [FrameKey("s", "video", timestep, "0") for timestep in range(400)]
    clip = SimpleNamespace(subject="s", splits={"train": keys[:50]}, excluded=dict.fromkeys(keys[50:], "why"))
    for name, count in (("test", 350), ("seq", 400)):
        made = tmp_path / name / "split_40000"
        made.mkdir(parents=True)
        for index in range(count):
            (made / f"pred_{index:05d}.png").touch()
        found = gaussian_blendshapes(tmp_path, clip, {})
        assert {render.truth.name for render in found.values()} >= {"gt_00000.png"}
        for key in keys[-count:]:
            index = key.timestep - (400 - count) if name == "test" else key.timestep
            assert found[key].image.name == f"pred_{index:05d}.png" or name == "seq"
        assert len(found) == count
    (tmp_path / "seq/split_40000/pred_00399.png").unlink()
    with pytest.raises(InputError, match="400 images.*found 399"):
        gaussian_blendshapes(tmp_path, clip, {})


def test_insta_numbers_the_frames_that_are_held_out(tmp_path):
    parts = ("video",) * 4 + ("video-held-out",) * 3
    keys = [FrameKey("s", sequence, timestep, "0") for timestep, sequence in enumerate(parts)]
    splits = {"train": keys[:3], "self_reenactment": keys[4:6]}
    clip = SimpleNamespace(subject="s", splits=splits, excluded={keys[3]: "why", keys[6]: "why"})
    (tmp_path / "overlay").mkdir()
    for index in range(3):
        (tmp_path / "overlay" / f"{index:05d}.png").touch()
    found = workplace.insta(tmp_path, clip, {})
    assert {key: render.image.name for key, render in found.items()} == {
        key: f"{index:05d}.png" for index, key in enumerate(keys[4:])
    }
    (tmp_path / "overlay/00002.png").unlink()
    with pytest.raises(InputError, match="3 images.*transforms_test.json, found 2"):
        workplace.insta(tmp_path, clip, {})
    with pytest.raises(InputError, match="expected overlay, as the program leaves it"):
        workplace.insta(tmp_path / "overlay", clip, {})


NAME = "ga"


def settings(checkout, commit, **changes):
    """Settings that find the stand-in."""
    return GAOfficialConfig(
        **({"checkout": str(checkout), "python": sys.executable, "commit": commit} | changes)
    )


REPOSITORY = Repository("https://example.org/code", "0" * 40, ("train.py", "render.py"), ("json",))


def test_a_checkout_as_it_should_be_is_recorded(repository):
    python = f"env {sys.executable}"
    found = inspect_checkout("ga-official", settings(*repository, python=python), REPOSITORY)
    assert found.python[1:] == (sys.executable,)
    assert found.folder == repository[0].resolve()
    assert found.record["commit"] == repository[1]
    assert found.record["changed"] == []
    assert found.record["python"] == sys.version.split()[0]
    (repository[0] / "train.py").write_text("changed")
    changed = inspect_checkout("ga-official", settings(repository[0], repository[1][:8]), REPOSITORY).record
    assert changed["changed"] == ["train.py"]
    assert len(changed["difference"]) == 64


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("checkout", folder) for folder in ("", "nowhere", ".")),
        *(("commit", commit) for commit in ("0" * 40, "main")),
        *(("python", name) for name in ("", "no-such-python", "'unclosed", "/bin/false", "/bin/echo")),
    ],
)
def test_faults_of_settings_are_named(repository, tmp_path, monkeypatch, key, value):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=key):
        inspect_checkout("ga-official", replace(settings(*repository), **{key: value}), REPOSITORY)


def test_modules_that_are_missing_are_named(repository):
    lacking = replace(REPOSITORY, modules=("json", "no_such_module"))
    with pytest.raises(InputError, match="no_such_module: ModuleNotFoundError"):
        inspect_checkout("ga-official", settings(*repository), lacking)


def test_a_folder_without_git_needs_an_empty_commit(repository, tmp_path):
    folder = tmp_path / "unpacked"
    folder.mkdir()
    for name in ("train.py", "render.py"):
        (folder / name).write_text("")
    with pytest.raises(InputError, match="not a git checkout"):
        inspect_checkout("ga-official", settings(folder, repository[1]), REPOSITORY)
    assert inspect_checkout("ga-official", settings(folder, ""), REPOSITORY).record["commit"] == ""


def test_where_the_checkout_lies_does_not_make_another_avatar():
    one, other = (GAOfficialConfig(checkout=place, python=place) for place in ("a", "b"))
    assert deciding_settings(one) == deciding_settings(other)
    assert deciding_settings(one) != deciding_settings(replace(one, commit="1234567"))


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
SEVENTH = {"gha": "loss 0.5000", "rgbavatar": "", "flashavatar": "loss 0.50000"}
"""Note of the seventh iteration."""


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
    assert record["official"]["changed"] == record["leaks"] == []
    assert record["differences"]
    log = (folder / TRAINING_LOG).read_text()
    fit(method, clip, folder)
    assert (folder / TRAINING_LOG).read_text() == log, "nothing was run"
    with pytest.raises(InputError, match="another run"):
        fit(method, clip, folder, seed=1)


class Killed(KeyboardInterrupt):
    """What a signal raises."""


@pytest.mark.parametrize("name", ["ga"])
def test_a_training_that_ends_early_begins_anew(method, clip, behave, tmp_path):
    """It crashes, is killed or takes too long; the export is kept."""
    frames = len(clip.splits["train"])

    def kill(done, total, note=""):
        if done >= frames + 5:
            raise Killed

    behave("crash")
    with pytest.raises(ProgramError, match="out of memory"):
        fit(method, clip, tmp_path / "a")
    behave("hang")
    with pytest.raises(Killed):
        fit(method, clip, tmp_path / "a", kill)
    limited = type(method)(replace(method.config, time_limit_hours=0.5 / 3600))
    with pytest.raises(ProgramError, match="time_limit_hours"):
        fit(limited, clip, tmp_path / "b")
    behave("")
    calls = []
    assert fit(method, clip, tmp_path / "a", lambda done, *_: calls.append(done)).files()
    assert min(calls) > frames


@pytest.mark.parametrize(
    ("name", "fault", "expected"),
    [("insta", "no output", "no whole avatar"), ("gha", "stop", "ended before its 5 iterations")],
)
def test_a_training_that_fails_says_so(method, clip, behave, tmp_path, fault, expected):
    behave(fault)
    with pytest.raises(ProgramError, match=expected):
        fit(method, clip, tmp_path / "a")


@pytest.mark.parametrize("name", ["ga"])
def test_the_order_may_be_that_of_the_native_method(method, clip, behave, tmp_path):
    behave("crash")
    method.config = replace(method.config, order="native")
    with pytest.raises(ProgramError):
        fit(method, clip, tmp_path / "a", seed=2)
    images = read_json(tmp_path / "a" / TRAINING / "exported.json")["images"]
    keys = {path.rpartition("/")[2]: FrameKey(*key) for path, key in images.items()}
    train, sampler = clip.splits["train"], ShuffledEpochs(len(images), 2)
    found = [keys[name] for name in read_json(tmp_path / "a" / TRAINING / "launch.json")["order"]]
    assert found == [train[sampler(i)] for i in range(1, BUDGET.iterations + 1)]


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
    other = {first: images[second]} if images[first] != images[second] else {"a.png": keys[0]}
    for wrong in ({first: held_out}, other):
        with pytest.raises(InputError):
            check_export(work, images | wrong, clip)
    shutil.copyfile(work.root / first, work.program / "test.JPG")
    with pytest.raises(InputError, match="test.JPG"):
        check_export(work, images, clip)
    (work.program / "test.JPG").unlink()
    (work.root / first).unlink()
    with pytest.raises(InputError, match=first):
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
    for module in (rgbavatar, flashavatar, insta):  # more than one call for a camera's frames
        monkeypatch.setattr(module, "PART", 5)
    before, splits = avatar_digest(tmp_path / "avatar"), ("novel_view", "self_reenactment")
    wanted = views(clip, *splits, *(() if name in OF_VIDEO else ("train",)))
    if name in (*OF_VIDEO, "insta"):
        odd, (camera, pose) = next(iter(wanted.items()))
        wanted[odd] = replace(camera, width=30), pose
    ground, most, share = (GREEN, 153, 0.4) if name in COVERED else (WHITE, 255, 0.0)
    found = rendered(avatar, wanted, ground)
    for key, (camera, pose) in wanted.items():
        rgb, alpha = found[key]
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


MARK, CAMERA, SIZE = "the mark of frame", "rendered by the camera of another", "expected .* pixels"
RENDERS = {
    "ga": {
        "crash in rendering": "exit code 1.*out of memory",
        "reversed": MARK,
        "one too few": "first 00001.png",
    },
    "gbs": {"no coverage": "pred_mask_00000.png"},
    "gha": {"reversed": MARK},
    "insta": {"reversed": CAMERA, "no cameras": "transforms_overlay"},
    "rgbavatar": {"no coverage": "coverage"},
    "flashavatar": {"other size": SIZE},
}


@pytest.mark.parametrize("name", RENDERS)
def test_renders_that_are_not_what_was_listed_are_found(avatar, clip, behave, name):
    for fault, expected in RENDERS[name].items():
        behave(fault)
        with pytest.raises(ProgramError, match=expected):
            renders(avatar, clip)


# ------------------------------------------------------------------ settings

FAULTS = [
    *((name, {"device": "cpu-shim"}, "device") for name in ("gha", "insta")),
    *((name, {"order": "native"}, "order") for name in ("gha", "insta")),
    *((name, {"python": ""}, f"settings.{name}-official.python") for name in OF_VIDEO),
    *((name, {"checkout": "/nowhere"}, "checkout.*git clone") for name in ADAPTERS),
    *(("insta", {"program": program}, "program") for program in ("build/none", "'unclosed", "/bin/true")),
]


@pytest.mark.parametrize(("name", "changes", "expected"), FAULTS)
def test_faults_of_settings_are_named_before_any_work(method, clip, changes, expected):
    method.config = replace(method.config, **changes)
    with pytest.raises(InputError, match=expected):
        method.check(clip, BUDGET)


MEANINGLESS = [
    *(("gha", wrong) for wrong in ({"mesh_fraction": 0.0}, {"mesh_fraction": 1.0}, {"arguments": ("-x",)})),
    *(("insta", wrong) for wrong in ({"python": "python"}, {"images_on_gpu": 0})),
    *(("rgbavatar", {"values": (value,)}) for value in ("tex_size", "iteration=5")),
    ("ga", {"time_limit_hours": 0.0}),
]


@pytest.mark.parametrize(("name", "changes"), MEANINGLESS)
def test_settings_without_a_meaning_are_refused(name, changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        ADAPTERS[name][0].config_class(**changes)


@pytest.mark.parametrize("name", ["ga"])
def test_budgets_in_seconds_are_refused(method, clip, tmp_path):
    for budget in (Budget(seconds=5.0), Budget(iterations=5, seconds=5.0)):
        with pytest.raises(InputError, match="seconds"):
            fit(method, clip, tmp_path / "a", budget=budget)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("name", ["ga", "insta"])
def test_doctor_names_checkout_and_environment(method, monkeypatch, name):
    nothing = [*needs.official(type(method.config)(), "cpu")]
    assert [(need.what, need.found) for need in nothing] == [("checkout", ""), ("environment", "")]
    assert "git clone" in nothing[0].remedy
    monkeypatch.setitem(needs.METHODS, type(method.config), type(method))
    place, environment = needs.official(method.config, "cpu")
    assert place.found.endswith(method.config.commit[:12])
    assert environment.found.startswith("instant-ngp 1.0dev" if name == "insta" else "Python 3")
    compile(needs.METHODS[type(method.config)].repository.trial, "trial", "exec")


# ------------------------------------------------------------------ clips


def of_head(clip, **changes):
    return replace(clip, head=replace(clip.head, **changes))


def without(region, clip):
    return of_head(clip, regions={name: part for name, part in clip.head.regions.items() if name != region})


def of_camera(name, row, column, factor, more, clip):
    """With another value in a camera's K."""
    camera = clip.cameras[name]
    K = camera.K.copy()
    K[row, column] = factor * K[row, column] + more
    return replace(clip, cameras={**clip.cameras, name: replace(camera, K=K)})


def of_train(part, clip):
    return replace(clip, splits={**clip.splits, "train": clip.splits["train"][part]})


def grounded(level, clip):
    return replace(clip, background=np.full(3, level))


MASK = (lambda clip: replace(clip, masks=dict.fromkeys(clip.masks)), "a mask")
INTRINSICS = (partial(of_camera, "01", 0, 0, 1.05, 0), "camera 01")
PIXELS = (partial(of_camera, "02", 1, 1, 1.05, 0), "square pixels")
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
        (partial(of_train, slice(1, None)), "timestep"),
        (partial(of_camera, "02", 0, 1, 1, 1), "camera 02"),
    ],
    "insta": [
        *(MASK, (partial(of_camera, "00", 0, 1, 1, 1), "no skew")),
        (lambda clip: replace(clip, static_offset=clip.static_offset + [0, 0.5, 0]), "template"),
    ],
    "rgbavatar": [
        *(MASK, BASIS, INTRINSICS, (partial(of_camera, "02", 0, 1, 1, 1), "no skew")),
        (partial(of_train, slice(9)), "10 training frames or more.*found 9"),
    ],
    "flashavatar": [
        *(MASK, INTRINSICS, PIXELS, (partial(grounded, 0.0), "background")),
        (partial(without, "boundary"), r"regions\[boundary\]"),
    ],
}


@pytest.mark.parametrize(("name", "case"), [(name, case) for name, of in CLIPS.items() for case in of])
def test_clips_that_their_code_cannot_take_are_refused(method, clip, case):
    change, expected = case
    with pytest.raises(InputError, match=expected):
        method.check(change(clip), BUDGET)

"""What all adapters have in common: faults of trainings, renders, settings and clips are found and named."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.errors import HeadbenchError, InputError
from headbench.bench.io.images import read_pixels
from headbench.bench.process import ProgramError
from headbench.methods.official import checkout, needs, spec
from headbench.methods.official.method import TRAINING_LOG
from headbench.methods.official.workplace import check_export

from .conftest import ADAPTERS, OF_VIDEO
from .repository import BUDGET, Killed, export, fit, kill_at, renders

MEMORY = "exit code 1.*out of memory"
TRAININGS = {
    "ga": {"crash": MEMORY, "no ply": "left no whole avatar.*point_cloud.ply"},
    "gha": {"crash": MEMORY, "stop": "ended before its 5 iterations"},
    "insta": {"crash": MEMORY, "no snapshot": "no whole avatar.*snapshot.msgpack"},
    "rgbavatar": {"crash": MEMORY, "no ply": "no whole avatar.*model.ply"},
    "flashavatar": {"crash": MEMORY, "no checkpoint": "no whole avatar.*chkpnt20.pth"},
}


@pytest.mark.parametrize(("name", "fault"), [(name, fault) for name, of in TRAININGS.items() for fault in of])
def test_a_training_that_fails_says_so_and_begins_anew(method, clip, behave, tmp_path, name, fault):
    """What it left beside its input, renders among it, is none of the images that it may be given."""
    behave(fault)
    with pytest.raises(ProgramError, match=TRAININGS[name][fault]):
        fit(method, clip, tmp_path / "a")
    behave("")
    calls = []
    assert fit(method, clip, tmp_path / "a", lambda done, *_: calls.append(done)).files()
    assert min(calls) > len(clip.splits["train"]), "the export was kept"


@pytest.mark.parametrize(("name", "nothing"), {"rgbavatar": "False", "flashavatar": "[]"}.items())
def test_a_killed_training_starts_again_on_its_export(method, clip, behave, tmp_path, nothing):
    behave("hang")
    with pytest.raises(Killed):
        fit(method, clip, tmp_path / "a", kill_at(5, clip))
    behave("")
    calls = []
    assert fit(method, clip, tmp_path / "a", lambda done, *_: calls.append(done)).files()
    assert min(calls) > len(clip.splits["train"]), "the export was kept"
    found = re.findall(r"^finds (.*)", (tmp_path / "a" / TRAINING_LOG).read_text(), re.MULTILINE)
    assert found == [nothing, nothing], "nothing of the killed training is left"


SIZE, RENDERING = r"expected \d+x\d+ pixels, found \d+x\d+", {"crash in rendering": MEMORY}
COVERED = RENDERING | {
    "other size": "expected 28x36 pixels, found 27x36",
    "no coverage": "expected colours and coverage",
}
LISTS = {
    "ga": RENDERING
    | {
        "one too few": r"lacks 1 of 3 renders, first 00001.png \(toy/",
        "other size": SIZE,
        "reversed": "the mark of frame",
    },
    "gha": {
        "one too few": r"lacks 1 of 3 renders, first 000001.png \(toy/",
        "other size": "expected 128x64 pixels, found 124x62",
        "reversed": "the mark of frame",
    },
    "insta": COVERED
    | {
        "one too few": r"lacks 1 of 3 renders, first 000001.png \(toy/",
        "reversed": "exit code 1.*rendered by the camera of another",
        "no cameras": "exit code 1.*wrote no .*transforms_overlay.json",
    },
    "rgbavatar": COVERED | {"one too few": r"lacks 1 of 6 renders, first 000001.png \(toy/"},
    "flashavatar": RENDERING
    | {
        "one too few": r"lacks 1 of 6 renders, first 000001.png \(toy/",
        "other size": SIZE,
        "reversed": "the mark of frame 0",
    },
}


@pytest.mark.parametrize("name", LISTS)
def test_renders_that_are_not_what_was_listed_are_found(method, clip, behave, tmp_path, name):
    avatar = fit(method, clip, tmp_path / "a")
    for fault, expected in LISTS[name].items():
        behave(fault)
        with pytest.raises(ProgramError, match=expected):
            renders(avatar, clip)
    behave("")
    assert renders(avatar, clip)
    assert issubclass(ProgramError, HeadbenchError)


# ------------------------------------------------------------------ settings

NO_SHIM = ("gha", "insta")
REPOSITORIES = {
    "insta": "Zielon/INSTA .*built as its installation page says",
    "rgbavatar": "gapszju/RGBAvatar",
    "flashavatar": "USTC3DV/FlashAvatar-code",
}
SETTINGS = [
    *((name, {"device": "cpu-shim"}, "device: expected cuda; the shim does not support") for name in NO_SHIM),
    *((name, {"order": "native"}, "order: expected published; the shim does not") for name in NO_SHIM),
    *((name, {"python": ""}, f"settings.{name}-official.python=") for name in OF_VIDEO),
    *((name, {"commit": "0" * 40}, "expected commit 000000000000, found commit") for name in REPOSITORIES),
    *(
        (name, {"checkout": "/nowhere"}, f"no such folder.*git clone.*{url}")
        for name, url in REPOSITORIES.items()
    ),
    ("insta", {"program": "build/none"}, "build/none.*program: expected a program that can be run.*cmake"),
    ("insta", {"program": "no-such-program build/rta"}, "no-such-program"),
    ("insta", {"program": "'unclosed"}, "the program that was built"),
    ("insta", {"program": "/bin/true"}, "to --version.*cmake"),
]


@pytest.mark.parametrize(("name", "changes", "expected"), SETTINGS)
def test_faults_of_settings_are_named_before_any_work(method, clip, changes, expected):
    method.config = replace(method.config, **changes)
    with pytest.raises(InputError, match=expected):
        method.check(clip, BUDGET)


@pytest.mark.parametrize("name", ADAPTERS)
def test_doctor_names_checkout_and_environment(method, monkeypatch, name):
    nothing = [*needs.official(type(method.config)(), "cpu")]
    assert [(need.what, need.found) for need in nothing] == [("checkout", ""), ("environment", "")]
    assert "git clone" in nothing[0].remedy
    monkeypatch.setitem(needs.METHODS, type(method.config), type(method))
    place, environment = needs.official(method.config, "cpu")
    assert place.found.endswith(method.config.commit[:12])
    assert environment.found.startswith("instant-ngp 1.0dev" if name == "insta" else "Python 3")


@pytest.mark.parametrize(("name", "remedy"), [("insta", "a CUDA device"), ("gha", "CUDA build of PyTorch")])
def test_doctor_misses_a_gpu(method, monkeypatch, name, remedy):
    monkeypatch.setattr(checkout, "_DEVICES", "print('headbench-devices', 0)")
    monkeypatch.setitem(needs.METHODS, type(method.config), type(method))
    if name != "insta":
        monkeypatch.setattr(type(method), "repository", replace(method.repository, modules=("torch",)))
    (_, environment) = needs.official(method.config, "cpu")
    assert remedy in environment.remedy
    assert "cpu-shim" not in environment.remedy, "the shim does not support this code"


@pytest.mark.parametrize("method", needs.METHODS.values())
def test_a_trial_can_be_compiled(method):
    compile(method.repository.trial, "trial", "exec")


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


def large_basis(clip):
    return of_head(clip, expression_basis=np.zeros((len(clip.head.template), 3, 101)))


def widened(value):
    return 1.05 * value


def skewed(name):
    return partial(of_camera, name, 0, 1, lambda value: value + 1)


INTRINSICS = (partial(of_camera, "01", 0, 0, widened), "camera 01: expected size and intrinsics of camera 00")
PIXELS = (partial(of_camera, "02", 1, 1, widened), "square pixels")
MASK, BASIS = (no_mask, "a mask"), (large_basis, "at most 100 directions")
CLIPS = {
    "ga": [
        (partial(grounded, 0.5), "white or black"),
        (partial(of_head, parents=np.array([-1, 0, 0, 0, 0])), "FLAME's joints"),
        (partial(of_head, regions={}), "lips"),
        *(BASIS, PIXELS),
    ],
    "tga": [(partial(without, "face"), "a region face")],
    "gbs": [
        (partial(of_head, regions={"scalp": np.arange(2)}), "regions"),
        (partial(of_head, regions={}), "scalp"),
        *(MASK, BASIS),
    ],
    "gha": [
        (partial(grounded, 0.0), "expected white"),
        (partial(without, "lips"), "region 'lips'"),
        (partial(of_train, slice(1, None)), "training frame of each of 2 cameras"),
        (skewed("02"), "no skew"),
    ],
    "insta": [
        MASK,
        (skewed("00"), "no skew"),
        (lambda clip: replace(clip, static_offset=clip.static_offset + [0, 0.5, 0]), "of the origin"),
    ],
    "rgbavatar": [
        *(MASK, BASIS, INTRINSICS),
        (skewed("02"), "no skew"),
        (partial(of_train, slice(9)), "expected 10 training frames or more.*found 9"),
    ],
    "flashavatar": [
        *(MASK, INTRINSICS, PIXELS),
        (partial(grounded, 0.0), r"white, or green \(0, 1, 0\)"),
        (partial(without, "boundary"), r"regions\[boundary\].*FLAME_masks.pkl"),
    ],
}


@pytest.mark.parametrize(("name", "case"), [(name, case) for name, of in CLIPS.items() for case in of])
def test_clips_that_their_code_cannot_take_are_refused(method, clip, case):
    change, expected = case
    with pytest.raises(InputError, match=expected):
        method.check(change(clip), BUDGET)


# ------------------------------------------------------------------ what the program is given


@pytest.mark.parametrize("name", ["gbs", "rgbavatar"])
def test_images_times_their_alpha_are_the_frames_on_black(method, clip, tmp_path, name):
    work, images = export(method, clip, tmp_path / "work")
    check_export(work, images, clip)
    folder = "input/head/images" if name == "rgbavatar" else "input/images"
    assert sorted(images) == [f"{folder}/{number:05d}.png" for number in range(len(images))]
    assert set(images.values()) == set(clip.splits["train"])
    for place, key in images.items():
        pixels = read_pixels(work.root / place).astype(float)
        share = clip.masks[key][..., None] / 255
        assert np.array_equal(pixels[..., 3:], clip.masks[key][..., None])
        on_black = clip.images[key][..., ::-1] - (1 - share) * 255 * clip.background
        assert np.abs(pixels[..., :3] * share - np.clip(on_black, 0, 255 * share)).max() < 0.51


@pytest.mark.parametrize(
    ("name", "place"),
    {"gbs": "FLAME/blendshapes", "rgbavatar": "data/FLAME2020", "flashavatar": "flame/blendshapes"}.items(),
)
def test_eyelid_bases_are_those_of_the_clips_head(method, clip, tmp_path, place):
    basis = np.random.default_rng(0).standard_normal((*clip.head.template.shape, 2))
    work, _ = export(method, of_head(clip, eyelid_basis=basis), tmp_path / "work")
    for index, side in enumerate("lr"):
        file = f"{place}/{side}_eyelid.npy"
        assert np.array_equal(np.load(work.program / file), basis[..., index])
        assert not np.load(Path(method.config.checkout) / file).any()

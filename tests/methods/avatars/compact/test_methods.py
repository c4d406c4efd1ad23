"""The codec on small avatars of every method: what is near, what is smaller, what is refused."""

import numpy as np
import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.bench.registry import get, resolve
from headbench.methods.avatars.compact import layouts
from headbench.methods.avatars.compact.codecs import parts_of, write_coded
from headbench.methods.avatars.compact.coder import Content, read_content
from headbench.methods.avatars.derived.recipes import STEPS, coded_name
from headbench.methods.avatars.settings import EXACT, Precision
from headbench.methods.flashavatar.method import FlashAvatar
from headbench.methods.flashavatar.spec import FlashAvatarConfig
from headbench.methods.ga.method import GA
from headbench.methods.ga.spec import GAConfig
from headbench.methods.gbs.method import GBS
from headbench.methods.gbs.spec import GBSConfig
from headbench.methods.gha.method import GHA
from headbench.methods.gha.spec import GHAConfig
from headbench.methods.insta.method import Insta
from headbench.methods.insta.spec import InstaConfig
from headbench.methods.ours.method import Ours
from headbench.methods.rgbavatar.method import RGBAvatar
from headbench.methods.rgbavatar.spec import RGBAvatarConfig
from headbench.methods.shared.avatar_files import COMPACT_FILE, read_shared_head
from headbench.methods.shared.config import SplatTraining
from headbench.methods.trivial.method import NearestCamera

from ...flashavatar.small import SMALL as SMALL_FLASHAVATAR
from ...gha.small import SMALL as SMALL_GHA
from ...insta.small import SMALL as SMALL_INSTA
from ...ours.toy import CASES, store
from ...rgbavatar.small import SMALL as SMALL_RGBAVATAR

TRAINED = {
    "ga": lambda: GA(GAConfig(splats=SplatTraining(max_splats=900, min_settle=4), min_sh_every=5)),
    "gbs": lambda: GBS(GBSConfig(samples=300)),
    "gha": lambda: GHA(GHAConfig(**SMALL_GHA)),
    "insta": lambda: Insta(InstaConfig(**SMALL_INSTA)),
    "flashavatar": lambda: FlashAvatar(FlashAvatarConfig(**SMALL_FLASHAVATAR)),
    "rgbavatar": lambda: RGBAvatar(RGBAvatarConfig(**SMALL_RGBAVATAR)),
}


@pytest.fixture(scope="module", params=[*TRAINED, *(f"ours, {case}" for case in CASES)])
def trained(request, clip, tmp_path_factory):
    """Method, folder and avatar: of a short training, or of random numbers."""
    folder, name = tmp_path_factory.mktemp("avatar"), request.param
    if name in TRAINED:
        options = {"device": "cpu", "seed": 0, "progress": no_progress}
        method = TRAINED[name]()
        return method, folder, method.fit(clip, folder, Budget(iterations=24), **options)
    store(clip, folder, CASES[name.removeprefix("ours, ")], copies=3)
    return Ours(), folder, Ours().load(folder, device="cpu")


def pictures(avatar, clip):
    keys = clip.splits["train"][:2]
    return np.stack([avatar.render(clip.cameras[k.camera], clip.poses[k.timestep]).rgb for k in keys])


def size(avatar):
    return sum(path.stat().st_size for path in avatar.files())


def test_coded_avatars_are_smaller_and_near(trained, clip, tmp_path):
    method, folder, whole = trained
    head, truth, errors, sizes = read_shared_head(folder), pictures(whole, clip), [], [size(whole)]
    for step in (1.0, 8.0):
        parts = write_coded(
            parts_of(whole, head, clip), head, tmp_path, Precision(step=step), folder / "driving.npz"
        )
        avatar = method.load(tmp_path, device="cpu")
        assert [path.name for path in avatar.files()] == [COMPACT_FILE]
        assert avatar.codec == f"4, steps x{step:g}"
        assert sum(parts.values()) < size(avatar) < sizes[-1]
        sizes.append(size(avatar))
        shown = pictures(avatar, clip)
        errors.append(float(np.mean((shown - truth) ** 2)))
    # Equal avatars give equal files, and equal files equal pictures.
    first = (tmp_path / COMPACT_FILE).read_bytes()
    np.testing.assert_array_equal(pictures(method.load(tmp_path, device="cpu"), clip), shown)
    write_coded(parts_of(whole, head, clip), head, tmp_path, Precision(step=step), None)
    assert (tmp_path / COMPACT_FILE).read_bytes() == first
    assert errors[0] < errors[1]
    assert -10 * np.log10(errors[0]) > 33


def test_without_rounding_nothing_changes(trained, clip, tmp_path):
    method, folder, whole = trained
    write_coded(
        parts_of(whole, read_shared_head(folder), None),
        read_shared_head(folder),
        tmp_path,
        EXACT,
        folder / "driving.npz",
    )
    after = method.load(tmp_path, device="cpu")
    np.testing.assert_allclose(pictures(after, clip), pictures(whole, clip), atol=2e-3)


def test_arrays_that_are_missing_cut_or_foreign_are_refused(trained, tmp_path, monkeypatch):
    method, folder, whole = trained
    write_coded(
        parts_of(whole, read_shared_head(folder), None),
        read_shared_head(folder),
        tmp_path,
        Precision(),
        folder / "driving.npz",
    )
    content = read_content(tmp_path / COMPACT_FILE)

    def refused(arrays, text=content.text, steps=content.steps):
        monkeypatch.setattr(layouts, "read_content", lambda path: Content(arrays, text, steps))
        with pytest.raises(InputError, match=COMPACT_FILE):
            method.load(tmp_path, device="cpu")

    arrays = dict(content.arrays)
    # A file without one of these is that of another kind of avatar.
    optional = ("color_residual", "lines", "plane_")
    for name, values in arrays.items():
        others = {key: value for key, value in arrays.items() if key != name}
        if not name.startswith(optional):
            refused(others)
        if len(values) > 1 and name != "landmarks":  # of which there may be any number
            refused({**others, name: values[:-1]})
    refused({**arrays, "shape": np.full_like(arrays["shape"], np.nan)})
    refused(arrays, {**content.text, "head_model": "another"})
    refused(arrays, {})
    refused(arrays, steps={})
    refused(arrays, steps={**content.steps, "positions": -1.0})


def test_a_coded_avatar_is_made_for_each_step(clip, tmp_path):
    store(clip, tmp_path / "avatar")
    variants = {v.name: v for v in resolve(get("methods", "ours").variants)(tmp_path / "avatar", clip, "cpu")}
    sizes = [size(variants[coded_name(s)].make(tmp_path / coded_name(s))) for s in sorted(STEPS)]
    assert sizes == sorted(sizes, reverse=True)


def test_only_trained_avatars_are_coded(clip, tmp_path):
    store(clip, tmp_path)
    head = read_shared_head(tmp_path)
    write_coded(parts_of(Ours().load(tmp_path, device="cpu"), head, None), head, tmp_path, Precision(), None)
    options = {"device": "cpu", "seed": 0, "progress": no_progress}
    other = NearestCamera().fit(clip, tmp_path / "nearest", Budget(iterations=1), **options)
    for avatar, found in ((Ours().load(tmp_path, device="cpu"), "a coded one"), (other, "Nearest")):
        with pytest.raises(InputError, match=f"found {found}|found a {found}"):
            write_coded(parts_of(avatar, head, None), head, tmp_path / "out", Precision(), None)
    assert not (tmp_path / "out").exists()


def test_hidden_splats_are_rounded_more_coarsely(clip, tmp_path, monkeypatch):
    store(clip, tmp_path, CASES["harmonics"], copies=8)
    whole = Ours().load(tmp_path, device="cpu")
    table = whole.field.tensors["splats"].numpy()
    weights = np.where(np.arange(len(table)) % 2, 1.0, 2.0**-8)
    monkeypatch.setattr("headbench.methods.avatars.compact.codecs.importance", lambda *_: weights)
    write_coded(
        parts_of(whole, read_shared_head(tmp_path), clip),
        read_shared_head(tmp_path),
        tmp_path / "coded",
        Precision(),
        None,
    )
    found = Ours().load(tmp_path / "coded", device="cpu").field.tensors["splats"].numpy()
    visible = np.count_nonzero(weights == 1)
    for part, rows in ((weights == 1, found[:visible]), (weights < 1, found[visible:])):
        assert sorted(rows[:, -1]) == sorted(table[part, -1])
    errors = [
        np.abs(np.sort(table[part, 4:7], 0) - np.sort(rows[:, 4:7], 0)).max()
        for part, rows in ((weights == 1, found[:visible]), (weights < 1, found[visible:]))
    ]
    assert errors[1] > 1.5 * errors[0]

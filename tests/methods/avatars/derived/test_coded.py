"""The codec on small avatars of every method: what is near, what is smaller, what the steps do, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.bench.registry import get, resolve
from headbench.methods.avatars.compact import container
from headbench.methods.avatars.compact.codecs import encode_avatar, write_coded
from headbench.methods.avatars.compact.container import read_content, write_content
from headbench.methods.avatars.compact.precision import EXACT, Precision
from headbench.methods.avatars.derived.coded import STEPS, coded_name
from headbench.methods.flashavatar.config import FlashAvatarConfig
from headbench.methods.flashavatar.method import FlashAvatar
from headbench.methods.ga.config import GAConfig
from headbench.methods.ga.method import GA
from headbench.methods.gbs.config import GBSConfig
from headbench.methods.gbs.method import GBS
from headbench.methods.gha.config import GHAConfig
from headbench.methods.gha.method import GHA
from headbench.methods.insta.config import InstaConfig
from headbench.methods.insta.method import Insta
from headbench.methods.ours.method import Ours
from headbench.methods.rgbavatar.config import RGBAvatarConfig
from headbench.methods.rgbavatar.method import RGBAvatar
from headbench.methods.shared.avatar_files import COMPACT_FILE, read_shared_head
from headbench.methods.shared.config import SplatTraining

from ...flashavatar.small import SMALL as SMALL_FLASHAVATAR
from ...gha.small import SMALL as SMALL_GHA
from ...insta.small import SMALL as SMALL_INSTA
from ...ours.toy import SMALL as SMALL_OURS
from ...rgbavatar.small import SMALL as SMALL_RGBAVATAR

SPLATS = SplatTraining(max_splats=900, min_settle=4)
METHODS = {
    "ours": lambda: Ours(replace(SMALL_OURS, splats=SPLATS)),
    "ga": lambda: GA(GAConfig(splats=SPLATS, min_sh_every=5)),
    "gbs": lambda: GBS(GBSConfig(samples=300)),
    "gha": lambda: GHA(GHAConfig(**SMALL_GHA)),
    "insta": lambda: Insta(InstaConfig(**SMALL_INSTA)),
    "flashavatar": lambda: FlashAvatar(FlashAvatarConfig(**SMALL_FLASHAVATAR)),
    "rgbavatar": lambda: RGBAvatar(RGBAvatarConfig(**SMALL_RGBAVATAR)),
}


@pytest.fixture(scope="module", params=sorted(METHODS))
def trained(request, clip, tmp_path_factory):
    """Method, folder and avatar of a short training."""
    folder, method = tmp_path_factory.mktemp(request.param), METHODS[request.param]()
    budget = Budget(iterations=40)
    return method, folder, method.fit(clip, folder, budget, device="cpu", seed=0, progress=no_progress)


def pictures(avatar, clip):
    keys = clip.splits["train"][:3]
    return np.stack([avatar.render(clip.cameras[k.camera], clip.poses[k.timestep]).rgb for k in keys])


def size(avatar):
    return sum(path.stat().st_size for path in avatar.files())


def test_variants_are_smaller_and_nearer_with_finer_steps(trained, clip, tmp_path):
    method, folder, whole = trained
    variants = {v.name: v for v in resolve(get("methods", method.name).variants)(folder, clip, "cpu")}
    truth, sizes, errors = pictures(whole, clip), [], []
    for step in sorted(STEPS):
        avatar = variants[coded_name(step)].make(tmp_path / coded_name(step))
        assert [path.name for path in avatar.files()] == [COMPACT_FILE]
        sizes.append(size(avatar))
        errors.append(float(np.mean((pictures(avatar, clip) - truth) ** 2)))
    assert sizes == sorted(sizes, reverse=True)
    assert max(sizes) < size(whole)
    assert errors[0] < errors[-1]
    assert -10 * np.log10(errors[0]) > 40
    # What is read again is the same.
    again = method.load(tmp_path / "coded", device="cpu")
    np.testing.assert_array_equal(pictures(again, clip), pictures(again, clip))


def test_without_rounding_nothing_changes(trained, clip, tmp_path):
    method, folder, whole = trained
    write_coded(whole, read_shared_head(folder), tmp_path, EXACT, None, folder / "driving.npz")
    after = method.load(tmp_path, device="cpu")
    np.testing.assert_allclose(pictures(after, clip), pictures(whole, clip), atol=2e-3)


def test_equal_avatars_give_equal_files(trained, clip, tmp_path):
    _, folder, whole = trained
    head = read_shared_head(folder)
    for name in ("a", "b"):
        write_coded(whole, head, tmp_path / name, Precision(), clip, None)
    first, second = ((tmp_path / name / COMPACT_FILE).read_bytes() for name in ("a", "b"))
    assert first == second


def test_a_coded_avatar_is_not_coded_again(trained, clip, tmp_path):
    method, folder, whole = trained
    head = read_shared_head(folder)
    write_coded(whole, head, tmp_path, Precision(), None, folder / "driving.npz")
    with pytest.raises(InputError, match="coded avatar"):
        encode_avatar(method.load(tmp_path, device="cpu"), head, Precision())
    with pytest.raises(InputError, match="found a NoneType"):
        encode_avatar(None, head, Precision())


def test_arrays_that_are_missing_or_cut_are_refused(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(container, "MAX_ROWS", 0)  # no tables, whose coding takes a hundred times as long
    method, folder, whole = trained
    head = read_shared_head(folder)
    write_coded(whole, head, tmp_path, Precision(), None, folder / "driving.npz")
    content = read_content(tmp_path / COMPACT_FILE)
    optional = (
        "classes",
        "lines_samples",
        "color_weight_0_inputs",
        "line_direction_0_inputs",
        "color_residual",
    )
    for name, values in content.arrays.items():
        others = {key: value for key, value in content.arrays.items() if key != name}
        changes = [] if name.startswith(optional) else [others]
        if values.ndim and values.shape[-1] > 1:
            changes.append({**content.arrays, name: values[..., :-1]})
        for arrays in changes:
            write_content(tmp_path / COMPACT_FILE, replace(content, arrays=arrays))
            try:
                method.load(tmp_path, device="cpu")
            except InputError:
                continue
            # A table of one part less may be another avatar's, but never an error of another kind.
            assert name not in ("shape", "static_offset", "triangles", "positions", "logits")


@pytest.mark.parametrize("trained", ["flashavatar", "gbs", "gha", "rgbavatar"], indirect=True)
def test_rotations_of_three_components_are_refused(trained, tmp_path):
    """Differences are added to these quaternions, so that their length counts."""
    method, folder, avatar = trained
    head = read_shared_head(folder)
    write_coded(avatar, head, tmp_path, Precision(), None, None)
    content = read_content(tmp_path / COMPACT_FILE)
    arrays = {**content.arrays, "rotations": content.arrays["rotations"][:3]}
    write_content(tmp_path / COMPACT_FILE, replace(content, arrays=arrays))
    with pytest.raises(InputError, match=r"rotations: expected shape \(4, "):
        method.load(tmp_path, device="cpu")

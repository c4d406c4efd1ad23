"""Every method of ours that is registered keeps the contract, and none learns from what is held out."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.configuration import merge
from headbench.bench.conformance.methods import check_method
from headbench.bench.contracts import no_progress
from headbench.bench.engine.config import resolve_method
from headbench.bench.engine.stored import TRAINING_FILE
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import digest_file
from headbench.bench.registry import discover
from headbench.bench.specs import MethodSpec

from .flashavatar.small import SMALL as SMALL_FLASHAVATAR
from .gha.small import SMALL as SMALL_GHA
from .insta.small import SMALL as SMALL_INSTA
from .rgbavatar.small import SMALL as SMALL_RGBAVATAR
from .toy_clip import toy_pose

SHORT = {"budget": {"iterations": 12}, "checkpoint_every_s": 0.0}
TRAINED = {
    "budget": SHORT["budget"],
    # Rounds at 4 and 8.
    "splats": {"min_densify_every": 4, "min_settle": 2, "checkpoint_every_s": 0.0},
}
OWN_TRAINING = {
    "flashavatar": {**SHORT, **SMALL_FLASHAVATAR},
    "gha": {**SHORT, **SMALL_GHA, "motion_steps": 20},
    "insta": {**SHORT, **SMALL_INSTA},
    "rgbavatar": {**SHORT, **SMALL_RGBAVATAR},
}
"""Methods that do not train splats bound to the mesh, with their own short settings."""
SMALL = {
    "ours": {"planes": {"resolution": 16}, "lines": {"resolution": 8, "channels": 4}, "hidden": 16},
    "gbs": {"samples": 300, "teeth_samples": 30},
}
SPECS = {
    name: plugin.spec
    for name, plugin in discover("methods").items()
    if isinstance(plugin.spec, MethodSpec) and plugin.spec.native and plugin.origin.startswith("headbench ")
}


def resolved(name, **more):
    """The method at its smoke preset, shorter and smaller where it trains."""
    settings = {} if SPECS[name].trivial else OWN_TRAINING.get(name, TRAINED)
    return resolve_method(SPECS[name], "smoke", merge({**settings, **SMALL.get(name, {})}, more))


def stored(method, clip, folder):
    """Digests of the files of a freshly fitted avatar."""
    avatar = method.create().fit(clip, folder, method.budget, device="cpu", seed=0, progress=no_progress)
    return {path.name: digest_file(path) for path in avatar.files()}


@pytest.fixture
def altered(clip, head):
    """The clip with other images, masks and driving signals wherever training has no business to look."""
    rng = np.random.default_rng(1)
    kept = set(clip.splits["train"])
    seen = {key.timestep for key in kept}
    return replace(
        clip,
        images={key: image if key in kept else 255 - image for key, image in clip.images.items()},
        masks={key: mask if key in kept else 255 - mask for key, mask in clip.masks.items()},
        poses={t: pose if t in seen else toy_pose(head, rng, t, "toy") for t, pose in clip.poses.items()},
    )


@pytest.mark.parametrize("name", SPECS)
def test_keeps_the_contract(name, clip, tmp_path):
    assert check_method(resolved(name), clip, tmp_path) == []


@pytest.mark.parametrize("name", SPECS)
def test_nothing_held_out_reaches_the_avatar(name, clip, altered, tmp_path):
    assert altered.fingerprint != clip.fingerprint
    expected = stored(resolved(name), clip, tmp_path / "one")
    assert stored(resolved(name), altered, tmp_path / "other") == expected


def test_the_published_leak_would_be_noticed(clip, altered, tmp_path):
    leaky = resolved("ours", lines={"jaw_bases_variant": "official"})
    assert stored(leaky, clip, tmp_path / "one") != stored(leaky, altered, tmp_path / "other")


def test_the_published_leak_is_on_the_avatars_record(clip, tmp_path):
    for variant in ("paper", "official"):
        stored(resolved("ours", lines={"jaw_bases_variant": variant}), clip, tmp_path / variant)
        leaks = read_json(tmp_path / variant / TRAINING_FILE)["leaks"]
        assert bool(leaks) == (variant == "official")

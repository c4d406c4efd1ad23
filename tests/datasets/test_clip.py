"""The clip: lazy pixels, records, use from threads."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import FrameKey, HeadPose, RegionalClip
from headbench.bench.engine.scoring import check_regions
from headbench.bench.errors import InputError
from headbench.datasets import images
from headbench.datasets.clip import HeadRegions, select
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import HeadArrays

from .head.toy import toy_head
from .tiny_capture import FRONTAL, look_at, posed_vertices, silhouette


def test_pixels_are_read_when_asked_for(pristine_capture, monkeypatch):
    decoded = []
    original = images.read_pixels
    monkeypatch.setattr(images, "read_pixels", lambda path: decoded.append(path) or original(path))
    clip = read_capture(pristine_capture.union, cache_mb=1)
    assert decoded == []
    key = next(iter(clip.files))
    for _ in range(2):
        clip.image(key)
    assert decoded == [clip.files[key].image]


def test_unknown_frame_is_named(pristine_capture):
    clip = read_capture(pristine_capture.union)
    with pytest.raises(InputError, match="901/FREE/00099/222200037"):
        clip.image(FrameKey("901", "FREE", 99, FRONTAL))


def test_derived_clip_shares_pixels_and_differs_in_fingerprint(pristine_capture):
    clip = read_capture(pristine_capture.union)
    derived = clip.derive("halve", {"factor": 2}, splits={"train": clip.splits["train"]})
    assert derived.steps[-1].input_fingerprint == clip.fingerprint != derived.fingerprint
    assert derived.store is clip.store
    assert derived.fingerprint == clip.derive("halve", {"factor": 2}, splits=derived.splits).fingerprint
    assert derived.fingerprint != clip.derive("halve", {"factor": 3}, splits=derived.splits).fingerprint


def test_fingerprint_covers_what_a_method_sees(pristine_capture):
    clip = read_capture(pristine_capture.union)
    changes = {
        "source_fingerprint": "other",
        "splits": {**clip.splits, "train": clip.splits["train"][1:]},
        "excluded": {},
        "background": np.zeros(3),
        "steps": clip.steps[:1],
    }
    found = {clip.fingerprint} | {
        replace(clip, **{name: value}).fingerprint for name, value in changes.items()
    }
    assert len(found) == len(changes) + 1


HEAD = toy_head(24)
SHAPE, OFFSET = np.zeros(HEAD.shape_basis.shape[2]), np.zeros_like(HEAD.template)
WIDTH, HEIGHT = 96, 128


def camera(x, y, z):
    return look_at("c", np.array([x, y, z], float), WIDTH, HEIGHT, WIDTH / 2, HEIGHT / 2)


FRONT, BACK = camera(0, 0, 1), camera(0, 0, -1)


def pose(jaw=0.0):
    zero = np.zeros(3)
    expression = np.zeros(HEAD.expression_basis.shape[2])
    return HeadPose("toy", expression, zero, zero, np.array([jaw, 0, 0]), np.zeros(6), zero)


def labels(view=FRONT, mask=None, head: HeadArrays = HEAD, jaw=0.0):
    return HeadRegions(head, SHAPE, OFFSET).labels(view, pose(jaw), mask)


def pixel(view, point):
    """Row and column of a point of the world."""
    seen = view.K @ (view.world_to_camera[:3, :3] @ point + view.world_to_camera[:3, 3])
    return int(seen[1] / seen[2]), int(seen[0] / seen[2])


def test_parts_are_where_their_vertices_are_seen():
    found = labels()
    parts = {"lips": "mouth", "left_eyeball": "eyes", "right_eyeball": "eyes", "face": "face"}
    for region, part in parts.items():
        vertices = HEAD.template[HEAD.regions[region]]
        foremost = vertices[vertices[:, 2].argmax()]
        assert select(found, part)[pixel(FRONT, foremost)], part


def test_nothing_of_the_face_is_seen_from_behind():
    found = labels(BACK)
    assert (found != 0).any()
    assert not any(select(found, part).any() for part in ("face", "mouth", "eyes"))
    assert select(found, "hair").any()
    bald = replace(
        HEAD, regions={name: HEAD.regions[name] for name in ("face", "lips", "scalp")}
    )  # no eyeballs
    assert not select(labels(BACK, head=bald), "face").any()


def test_mouth_and_eyes_lie_in_the_face_and_the_hair_beside_it():
    found = labels(camera(0.3, 0.1, 0.9))
    face, hair = select(found, "face"), select(found, "hair")
    for part in ("mouth", "eyes"):
        assert select(found, part).any()
        assert not (select(found, part) & ~face).any()
    assert hair.any()
    assert not (face & hair).any()


def test_the_foreground_is_the_mask_from_a_half_on():
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[10:, 20:76] = 255
    mask[10:, 76:80] = 127
    found = labels(mask=mask)
    np.testing.assert_array_equal(select(found, "foreground"), mask >= 128)
    covered = silhouette(HEAD.template, HEAD.faces, FRONT)
    beyond = select(found, "hair") & ~covered
    assert beyond[12, 48]  # above the crown
    assert not (beyond & (mask < 128)).any()
    assert not beyond[HEIGHT - 4, 48]  # below the chin: nearest to the neck


def test_parts_are_offered_where_the_head_has_their_regions():
    bare = replace(HEAD, regions={"lips": HEAD.regions["lips"]})
    assert HeadRegions(HEAD, SHAPE, OFFSET).names == ("face", "mouth", "eyes", "hair", "neck", "ears")
    assert HeadRegions(bare, SHAPE, OFFSET).names == ("mouth",)
    lips_alone = HeadRegions(bare, SHAPE, OFFSET).labels(FRONT, pose(), None)
    np.testing.assert_array_equal(select(lips_alone, "mouth"), select(labels(), "mouth"))


def test_ears_are_at_the_sides_and_the_neck_below_the_face():
    found = labels(camera(1, 0, 0))
    rows, _ = np.nonzero(select(found, "ears"))
    below, _ = np.nonzero(select(found, "neck"))
    assert len(rows)
    assert rows.max() < below.min()
    turned_away = select(labels(), "ears").sum()
    assert turned_away < 0.5 * select(found, "ears").sum()
    assert not (select(found, "neck") & select(found, "face")).any()


def test_a_clip_gives_its_regions_by_key_to_any_thread(pristine_capture):
    clip = read_capture(pristine_capture.union)
    assert isinstance(clip, RegionalClip)
    assert check_regions(clip, None) == ("face",)
    keys = sorted(clip.files)[:6]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda key: clip.region_masks(key, ["face", "foreground"]), keys * 2))
    for key, masks in zip(keys * 2, found):
        np.testing.assert_array_equal(masks["foreground"], clip.mask(key) >= 128)
        vertices = posed_vertices(pristine_capture.writer.plan, clip.poses[key.timestep])
        covered = silhouette(vertices, clip.head.faces, clip.cameras[key.camera])
        assert 0 < masks["face"].sum() <= covered.sum()
        assert (masks["face"] & ~covered).mean() < 0.002

"""What GHA's adapter has beyond the others: two stages, squares, smoothing undone, renders of each camera by number."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from headbench.bench.contracts import Budget, Camera
from headbench.bench.errors import InputError
from headbench.bench.io.images import read_png
from headbench.methods.official.ga.head_files import square, square_side
from headbench.methods.official.gha.method import MOUTH_ROWS, GHATracking, overshot
from headbench.methods.official.method import TRAINING_LOG
from headbench.methods.shared.avatar_files import Subject

from .helpers import BUDGET, export

NAME = "gha"


def test_both_stages_are_run(trained):
    folder, _ = trained(NAME)
    log = (folder / TRAINING_LOG).read_text()
    assert log.count("torch seeded with 0") == 2
    assert [int(n) for n in re.findall(r"^headbench: iteration (\d+)", log, re.MULTILINE)] == [*range(1, 21)]
    assert (folder / "gaussianhead_latest").read_text() == "15"  # its last of 20, after 5 of the mesh head


def test_images_and_landmarks_are_those_of_the_clip(method, official_clip, tmp_path):
    # A neck that is not bent has no pose correctives and skins nothing: the face moves rigidly.
    straight = {t: replace(pose, neck=np.zeros(3, np.float32)) for t, pose in official_clip.poses.items()}
    official_clip = replace(official_clip, poses=straight)
    work, images = export(method, official_clip, tmp_path / "work")
    side = square_side(official_clip.cameras[name] for name in ("00", "01"))
    for place, key in images.items():
        if "/image_0" not in place:
            continue
        camera = official_clip.cameras[key.camera]
        window = square(camera, side)
        shown = read_png(work.root / place)
        assert np.array_equal(window.uncut(shown, camera), official_clip.images[key])
        seen = read_png(work.root / place.replace("/image_", "/visible_"))[..., 0]
        assert seen.sum() == 255 * camera.width * camera.height
        assert (shown[seen == 0] == 255).all()
    folders = sorted((work.input / "params").iterdir())
    timesteps = sorted({key.timestep for key in official_clip.splits["train"]})
    assert len(folders) == len(timesteps)
    tracking = GHATracking.of(official_clip.head, Subject.of(official_clip))
    for folder, timestep in zip(folders, timesteps, strict=True):
        values = dict(np.load(folder / "params.npz"))
        rotation, _ = cv2.Rodrigues(values["pose"][0, :3].astype(np.float64))
        still = tracking.driver.unposed(tracking.driver.arguments([official_clip.poses[timestep]]))[0].numpy()
        moved = values["scale"] * still[tracking.rows] @ rotation.T + values["pose"][0, 3:]
        assert np.abs(moved - np.load(folder / "lmk_3d.npy")).max() < 1e-6
    lips = set(official_clip.head.regions["lips"])
    assert set(tracking.rows[MOUTH_ROWS]) <= lips


def test_what_is_missing_of_checkout_and_length_is_named(method, repository, official_clip):
    with pytest.raises(InputError, match="2 or more"):
        method.check(official_clip, Budget(iterations=1))
    (repository[0] / "assets" / "tets_data.npz").unlink()
    with pytest.raises(InputError, match=r"tets_data.npz.*link on the repository's page"):
        method.check(official_clip, BUDGET)


def test_smoothing_over_time_is_undone():
    rng = np.random.default_rng(0)
    shown, before = {}, None
    for _ in range(500):
        wanted = {"exp_coeff": rng.normal(size=(1, 40)), "pose": rng.normal(size=(1, 6)), "scale": np.ones(1)}
        given = overshot(wanted, shown)
        for name in ("exp_coeff", "pose"):
            drawn = given[name] if before is None else before[name] * 0.5 + given[name] * 0.5
            assert np.abs(drawn - wanted[name]).max() < 2e-6
            given[name] = drawn
        before = given


@pytest.mark.parametrize("offset", [(0, 0), (0.5, -0.5), (7.3, -2.8), (-3.5, 11.25)])
def test_a_square_has_the_principal_point_in_its_middle(offset):
    width, height = 60, 81
    K = np.array([[90.0, 0, width / 2 + offset[0]], [0, 93.0, height / 2 + offset[1]], [0, 0, 1]])
    camera = Camera("a", width, height, K, np.eye(4))
    side = square_side([camera])
    window = square(camera, side)
    with pytest.raises(InputError):
        square(camera, side - 1)
    image = np.arange(width * height * 3, dtype=np.uint8).reshape(height, width, 3)
    assert np.array_equal(window.uncut(window.padded(image, 9), camera), image)
    points = np.random.default_rng(1).uniform([-0.25, -0.3, 1], [0.25, 0.3, 1], (200, 3))
    there = points @ window.camera.world_to_camera[:3, :3].T @ window.camera.K.T
    here = points @ K.T
    found = there[:, :2] / there[:, 2:] + [window.left, window.top]
    assert np.abs(found - here[:, :2]).max() < 0.15  # half a pixel taken up by a turn of a camera of 60 by 81
    assert window.camera.K[0, 2] == window.camera.K[1, 2] == side / 2

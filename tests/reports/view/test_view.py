"""What the viewer shows, without a browser: poses, cameras, panels, and what is not there."""

import shutil
import socket
import sys
from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.io.images import read_png
from headbench.reports.view.scene import FreeView, Sliders, State, ViewSettings, open_scene
from headbench.reports.view.server import view_avatars
from headbench.reports.view.session import (
    CAPTURED,
    LABEL_PX,
    arrangement,
    draw,
    key_of,
    moved,
    rotations,
    splats_of,
)


def keys(scene, split="train"):
    return sorted(scene.first.clip.splits[split])


def project(points, camera):
    """(N, 2) pixels."""
    seen = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    return (seen @ camera.K.T)[:, :2] / seen[:, 2:]


def test_a_camera_of_the_capture_shows_the_frames_of_the_run(run, scene):
    key = keys(scene, "self_reenactment")[0]
    state = State(
        recording=f"{key.subject}: {key.sequence}, held out", timestep=key.timestep, camera=key.camera
    )
    camera = scene.first.clip.cameras[key.camera]
    size = 3 * camera.width, camera.height + LABEL_PX
    drawn = draw(scene, state, FreeView.of(camera), size)
    assert drawn.image.shape == (size[1], size[0], 3)
    panels = np.split(drawn.image[LABEL_PX:], 3, axis=1)
    assert np.array_equal(panels[0], scene.first.clip.image(key))
    for panel, method in zip(panels[1:], ("ga", "gbs")):
        render = run.cell(key.subject, method, 0).render("self_reenactment", key)
        assert np.array_equal(panel, read_png(render))
    assert [*drawn.milliseconds] == ["ga", "gbs"]


@pytest.mark.parametrize("number", [0, 1])
def test_other_cameras_see_the_head_as_the_method_does(scene, number):
    """Against the camera that the method was given for the other view of the same moment."""
    shown = scene.shown[number]
    first, *others = [key for key in keys(scene) if key.timestep == keys(scene)[-1].timestep]
    for other in others:
        free = moved(scene, shown, scene.first.clip.cameras[other.camera], first)
        theirs = shown.form.clip.cameras[shown.form.key(other).camera]
        assert free.world_to_camera == pytest.approx(theirs.world_to_camera, abs=1e-6)


@pytest.mark.parametrize("number", [0, 1])
def test_splats_are_where_the_method_draws_them(scene, number):
    shown, key = scene.shown[number], keys(scene)[-1]
    state = State(recording=f"{key.subject}: {key.sequence}", timestep=key.timestep, camera=key.camera)
    assert key_of(scene, state) == key
    camera = scene.first.clip.cameras[key.camera]
    splats = splats_of(scene, shown, state, FreeView.of(camera))
    form = shown.form.clip
    theirs = form.cameras[shown.form.key(key).camera]
    means = shown.avatar.splats(form.poses[shown.form.key(key).timestep]).means
    assert project(splats.centers, camera) == pytest.approx(project(means, theirs), abs=1e-3)
    assert np.linalg.eigvalsh(splats.covariances).min() > 0
    assert all(np.isfinite(values).all() for values in splats)
    assert splats.colors.min() >= 0
    assert splats.colors.max() <= 1


def test_rotations_turn_about_their_axis():
    half = np.sqrt(0.5)
    turned = rotations(np.array([[half, 0, 0, half], [half, half, 0, 0]])) @ [0.0, 1.0, 0.0]
    assert turned == pytest.approx(np.array([[-1.0, 0, 0], [0, 0, 1.0]]))


def test_sliders_are_added_to_the_recorded_pose(scene):
    shown = scene.first
    pose = shown.pose(keys(scene)[0])
    rest = Sliders({pose.head_model: (0.0, 0.0)})
    assert rest.added(pose) is pose
    sliders = Sliders({pose.head_model: (0.0, 0.5), "another": (9.0,)}, jaw=(0.2, 0.0, 0.0), eyes=(0.1, -0.1))
    moved_pose = sliders.added(pose)
    assert moved_pose.expression - pose.expression == pytest.approx(
        [0, 0.5] + [0] * (len(pose.expression) - 2), abs=1e-6
    )
    assert moved_pose.jaw - pose.jaw == pytest.approx([0.2, 0, 0], abs=1e-6)
    assert moved_pose.eyes - pose.eyes == pytest.approx([0.1, -0.1, 0, 0.1, -0.1, 0], abs=1e-6)
    assert moved_pose.timestep is None
    assert pose.timestep is not None
    assert moved_pose.expression.dtype == pose.expression.dtype


def test_neutral_is_a_face_at_rest_in_the_place_of_the_head(scene):
    for shown in scene.shown:
        pose = shown.pose(None)
        assert not any(np.any(part) for part in (pose.expression, pose.jaw, pose.neck, pose.eyes))
        assert np.array_equal(pose.translation, shown.pose(keys(scene)[0]).translation)


@pytest.mark.parametrize(
    ("count", "width", "height", "expected"),
    [(1, 900, 700, (1, 1)), (3, 900, 400, (1, 3)), (2, 400, 900, (2, 1)), (5, 950, 700, (2, 3))],
)
def test_panels_are_arranged_for_the_largest_head(count, width, height, expected):
    assert arrangement(count, width, height) == expected


def test_drafts_are_smaller(scene):
    view = FreeView.of(scene.first.clip.cameras[keys(scene)[0].camera])
    whole, draft = (draw(scene, State(), view, (120, 90), scale).image for scale in (1.0, 0.5))
    assert draft.shape[0] < 0.6 * whole.shape[0]
    assert CAPTURED not in draw(scene, State(), view, (120, 90)).milliseconds


# ------------------------------------------------------------------ what is not there


def test_an_avatar_of_a_run_is_shown_alone(run, tmp_path):
    for folder in (run.cell("901", "ga", 0).folder, run.cell("901", "ga", 0).avatar):
        scene = open_scene(ViewSettings((str(folder),)), tmp_path)
        assert [shown.label for shown in scene.shown] == ["ga"]


def test_what_is_not_trained_is_named(run, tmp_path):
    shutil.copytree(run.root, tmp_path / "out")
    shutil.copytree(run.root.parent / "data", tmp_path / "data")
    (tmp_path / "out" / "901" / "gbs" / "seed-0" / "cell.json").unlink()
    (tmp_path / "out" / "901" / "ga" / "seed-0" / "avatar" / "head_model.npz").write_bytes(b"")
    with pytest.raises(
        InputError, match="ga, subject 901, seed 0: .*head_model.npz.*gbs, subject 901, seed 0: not trained"
    ):
        open_scene(ViewSettings((str(tmp_path / "out"),)), tmp_path / "kept")
    shutil.copyfile(
        run.cell("901", "ga", 0).avatar / "head_model.npz",
        tmp_path / "out/901/ga/seed-0/avatar/head_model.npz",
    )
    scene = open_scene(ViewSettings((str(tmp_path / "out"),)), tmp_path / "kept")
    assert [shown.label for shown in scene.shown] == ["ga"]
    assert scene.missing == ["gbs, subject 901, seed 0: not trained"]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"methods": ("nobody",)}, "--methods.*mean-image, ga, gbs.*nobody"),
        ({"subjects": ("902",)}, "--subjects.*901.*902"),
        ({"avatars": ("nowhere",)}, "no such folder"),
        ({"data": "nowhere"}, "found nothing there"),
        ({"source": "nowhere"}, "no such folder"),
    ],
)
def test_bad_settings_are_refused(run, tmp_path, changes, expected):
    settings = replace(ViewSettings((str(run.root),)), **changes)
    with pytest.raises(InputError, match=expected):
        open_scene(settings, tmp_path)


def test_an_avatar_of_no_run_needs_its_capture(run, tmp_path):
    shutil.copytree(run.cell("901", "ga", 0).avatar, tmp_path / "avatar")
    settings = ViewSettings((str(tmp_path / "avatar"),), method="ga")
    with pytest.raises(InputError, match="--data.*the capture that the avatar was made from"):
        open_scene(settings, tmp_path / "kept")
    data = str(run.read_manifest().configuration.data)
    scene = open_scene(replace(settings, data=data), tmp_path / "kept")
    assert [shown.label for shown in scene.shown] == ["ga"]


def test_a_port_that_is_taken_is_refused_at_once(run):
    pytest.importorskip("viser")
    taken = socket.create_server(("127.0.0.1", 0))
    with taken, pytest.raises(InputError, match="--port.*free.*in use"):
        view_avatars(ViewSettings((str(run.root),), port=taken.getsockname()[1]))


def test_without_viser_the_error_says_what_to_install(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(UnavailableError, match=r"pip install -e '.\[view\]'"):
        view_avatars(ViewSettings((str(run.root),)))


def test_the_viewer_ends_after_the_seconds_asked_for(run, capsys):
    pytest.importorskip("viser")
    findings = view_avatars(ViewSettings((str(run.root),), port=0, seconds=0.0))
    assert findings.data["address"].startswith("http://127.0.0.1:")
    assert capsys.readouterr().out == ""

"""FlashAvatar's adapter: images, masks and numbers that their loader reads, texts changed, renders read back by key."""

import sys
import tempfile

import numpy as np
import pytest
import torch

from headbench.bench.errors import InputError
from headbench.bench.io.images import read_pixels
from headbench.datasets.head.model import pose_in_head_frame
from headbench.methods.flashavatar.method import FlashAvatarTraining
from headbench.methods.flashavatar.model import layer_of_points, network_outputs
from headbench.methods.flashavatar.spec import FlashAvatarConfig
from headbench.methods.official.flashavatar.method import (
    SHRINK,
    SPLATS,
    ParsingMasks,
    chart_of_points,
    flame_subject,
    grid_of,
    image_names,
    native_network,
    native_points,
)
from headbench.methods.official.ga.head_files import inside
from headbench.methods.official.shim.blendshapes import Mesh, load_obj, rasterize_meshes
from headbench.methods.official.video import VisibleMesh, training_frames
from headbench.methods.shared.avatar_files import Subject

from .helpers import check_tracked, read_tracked

NAME = "flashavatar"


def test_frames_begin_with_0_and_images_with_1(exported, video_clip):
    work, images = exported
    keys = sorted(video_clip.splits["train"], key=lambda key: (key.timestep, key.camera))
    tracked = work.program / "metrical-tracker/output/head/checkpoint"
    assert sorted(path.name for path in tracked.iterdir()) == [f"{n:05d}.frame" for n in range(len(keys))]
    data = work.program / "dataset/head"
    for name, suffixes in (
        ("imgs", [".jpg"]),
        ("alpha", [".jpg"]),
        ("parsing", ["_mouth.png", "_neckhead.png"]),
    ):
        made = sorted(path.name for path in (data / name).iterdir())
        assert made == [f"{n:05d}{suffix}" for n in range(1, len(keys) + 1) for suffix in suffixes]
    for number, key in enumerate(keys):
        assert {images[f"program/{place}"] for place in image_names("head", number)} == {key}
        found = read_tracked(tracked / f"{number:05d}.frame")
        window = inside(video_clip.cameras[key.camera])
        assert check_tracked(found, video_clip, key, window) < 0.05  # a part of a pixel is taken up by a turn
        middle = np.array([window.camera.width, window.camera.height]) / 2
        assert np.array_equal(found.K[:2, 2], middle), "which their code takes it to be"


def test_images_are_the_frames_around_the_principal_point(exported, video_clip):
    work, images = exported
    for number in range(len(images) // 4):
        image, alpha, head, mouth = (read_pixels(work.program / name) for name in image_names("head", number))
        key = images[f"program/{image_names('head', number)[0]}"]
        window = inside(video_clip.cameras[key.camera])
        mask = window.cut(video_clip.masks[key])
        assert np.array_equal(alpha, mask)
        share = mask[..., None] / 255
        truth = window.cut(video_clip.images[key])[..., ::-1]
        on_black = np.clip(truth - (1 - share) * 255 * video_clip.background, 0, 255 * share)
        assert np.abs(image * share - on_black).max() < 0.51
        for parsed in (head, mouth):
            assert set(np.unique(parsed)) <= {0, 255}
            assert not parsed[mask == 0].any()


def test_masks_of_head_and_mouth_are_those_of_the_mesh(method, video_clip):
    """Of triangles that nothing is in front of: lips are mouth, the forehead is head alone, the boundary neither."""
    head = video_clip.head
    subject = flame_subject(Subject.of(video_clip), head, method.inspect(), own_chart=False)
    masks = ParsingMasks(head, subject)
    frames = [
        frame
        for frame in training_frames(video_clip, subject.posed)
        if (frame.camera.id, frame.key.timestep) in (("00", 0), ("01", 3))
    ]
    counts = np.zeros(3, int)
    for camera, pose in ((frame.camera, frame.pose) for frame in frames):
        large = camera.resized(16 * camera.width, 16 * camera.height)
        whole = np.full((large.height, large.width), 255, np.uint8)
        inside_head, mouth = masks.of(pose, large, whole)
        mesh = subject.posed.meshes([pose_in_head_frame(pose)])[0]
        world = large.world_to_camera
        points = mesh[head.faces].mean(1) @ world[:3, :3].T + world[:3, 3]
        columns, rows = ((points @ large.K.T)[:, :2] / points[:, 2:]).T.astype(int)
        surface = VisibleMesh(head, subject.posed).seen(pose, large, whole)
        first = np.full(whole.shape, -1)
        first[surface.rows, surface.columns] = surface.triangles
        shown = first[rows, columns] == np.arange(len(points))
        lips, forehead, boundary = (
            shown & np.isin(head.faces, head.regions[name]).any(1)
            for name in ("lips", "forehead", "boundary")
        )
        counts += [lips.sum(), forehead.sum(), boundary.sum()]
        assert mouth[rows[lips], columns[lips]].all()
        assert not mouth[rows[forehead], columns[forehead]].any()
        assert inside_head[rows[forehead], columns[forehead]].all()
        assert not inside_head[rows[boundary], columns[boundary]].any()
        # Beside the mesh: hair above it, shoulders below it.
        assert inside_head[0, large.width // 2]
        assert not inside_head[-1, large.width // 2]
    assert counts.min() > 10


def test_their_network_at_the_start_is_the_native_one(method, video_clip):
    """By a plain network of their layers, with the inputs that are exported for a frame."""
    training = FlashAvatarTraining(video_clip, FlashAvatarConfig(samples=100), "cpu", 3)
    subject = flame_subject(Subject.of(video_clip), video_clip.head, method.inspect(), own_chart=False)
    frame = training_frames(video_clip, subject.posed)[-1]
    flame = subject.frame(frame.camera, frame.pose)["flame"]
    tracked = [torch.from_numpy(flame[name]).float() for name in ("exp", "jaw", "eyes", "eyelids")]
    values = torch.cat([training._encoded, torch.cat(tracked, 1).expand(len(training._encoded), -1)], 1)
    state = native_network(video_clip.head, 3)
    for layer in range(6):
        values = (values @ state[f"fcs.{layer}.weight"].T + state[f"fcs.{layer}.bias"]).relu()
    values = (values @ state["output_linear.weight"].T + state["output_linear.bias"]).tanh()
    tensors, config = training.tensors(), training._config
    inputs = training._inputs[training._tracked.row[frame.key.timestep]]
    expected = network_outputs(tensors, layer_of_points(tensors, training._encoded), inputs, config)
    torch.testing.assert_close(values, expected.detach(), atol=1e-5, rtol=1e-4)


def test_a_chart_of_points_has_them_as_its_texels(video_clip):
    """By the shim's reader and rasteriser, as the authors' code calls them."""
    head = video_clip.head
    points = native_points(Subject.of(video_clip), head, 300, 0)
    weights = points.barycentric.copy()
    weights[0] = 0.3, 0.7, 0.0  # on an edge
    grid = grid_of(300)
    faces = np.asarray(head.faces)[points.triangles]
    text = chart_of_points(np.asarray(head.template), faces, weights, grid)
    with tempfile.NamedTemporaryFile("w", suffix=".obj") as stream:
        stream.write(text)
        stream.flush()
        vertices, found, extra = load_obj(stream.name)
    assert np.abs(vertices.numpy() - head.template).max() < 1e-8
    assert np.array_equal(found.verts_idx.numpy(), faces)
    coordinates = 2 * extra.verts_uvs - 1
    coordinates[:, 1] *= -1
    flat = torch.cat([-coordinates, torch.ones(len(coordinates), 1)], dim=1)
    triangles, _, barycentric, _ = rasterize_meshes(
        Mesh(flat[None], found.textures_idx[None]), image_size=grid
    )
    hit = triangles.flatten() >= 0
    assert torch.equal(triangles.flatten()[hit], torch.arange(len(faces)))
    assert np.abs(barycentric.view(-1, 3)[hit].numpy() - weights).max() < 2e-4
    with pytest.raises(InputError, match="at most 256, as many as texels"):
        chart_of_points(np.asarray(head.template), faces, weights, 16)


def test_checkpoints_lose_their_optimisers_and_nothing_else(tmp_path, monkeypatch, capsys):
    def trained(*values):
        parameters = [torch.nn.Parameter(value) for value in values]
        optimiser = torch.optim.Adam(parameters)
        sum(parameter.sum() for parameter in parameters).backward()
        optimiser.step()
        return parameters, optimiser

    network, first = trained(torch.arange(4.0))
    splats, second = trained(torch.arange(3.0), torch.ones(2))
    path = tmp_path / "chkpnt20.pth"
    state = ({"weight": network[0].detach()}, first.state_dict())
    torch.save((state, (3, *splats, second.state_dict(), 0), 20), path)
    before = [value.detach().clone() for value in (*network, *splats)]
    size = path.stat().st_size
    monkeypatch.setattr(sys, "argv", ["-c", str(path)])
    exec(SHRINK, {})  # noqa: S102 - as their interpreter runs it
    assert SPLATS.search(f"before\n{capsys.readouterr().out}")[1] == "3"
    (net, lean), (degree, *found, leaner, scale), iteration = torch.load(path, weights_only=True)
    assert path.stat().st_size < size
    assert (degree, scale, iteration) == (3, 0, 20)
    assert [torch.equal(a, b) for a, b in zip(before, (net["weight"], *found), strict=True)] == [True] * 3
    for optimiser, values in ((first, lean), (second, leaner)):
        assert values["state"] == {}
        optimiser.load_state_dict(values)  # as their renderer does

"""Masks by the difference from the empty room, on drawings of the head before a room."""

import sys
import types

import cv2
import numpy as np
import pytest

from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.io.videos import TimedFrame
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.mesh_pictures import draw_mesh, rasterize_mesh
from headbench.datasets.tracking.settings import VideoOptions
from headbench.datasets.video import clip as video_masks
from headbench.datasets.video.clip import (
    FrameView,
    MaskSource,
    SelfieSegmentation,
    check_background,
    learn_background,
)
from headbench.datasets.video.faces import Crop, FoundFaces
from headbench.datasets.video.matting import refined_mask

from ..tiny_capture import look_at


@pytest.fixture
def network(monkeypatch, tmp_path):
    """A stand-in whose coverage is the red channel of what it is given."""
    shapes = {"input": (1, 8, 4, 3), "output": (1, 8, 4, 1)}

    class Interpreter:
        def __init__(self, model_path, num_threads):
            self.given = None

        def allocate_tensors(self):
            pass

        def get_input_details(self):
            return [{"index": 0, "shape": np.array(shapes["input"])}]

        def get_output_details(self):
            return [{"index": 1, "shape": np.array(shapes["output"])}]

        def set_tensor(self, index, value):
            assert (index, value.shape, value.dtype) == (0, shapes["input"], np.float32)
            self.given = value

        def invoke(self):
            pass

        def get_tensor(self, index):
            return self.given[..., :1]

    module = types.ModuleType("ai_edge_litert.interpreter")
    module.Interpreter = Interpreter
    monkeypatch.setitem(sys.modules, "ai_edge_litert", types.ModuleType("ai_edge_litert"))
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", module)
    (tmp_path / "selfie.tflite").write_bytes(b"")
    return tmp_path / "selfie.tflite", shapes


def test_the_mask_has_the_size_of_the_image(network):
    image = np.zeros((32, 16, 3), np.uint8)
    image[:16, :, 0] = 255
    mask = SelfieSegmentation(network[0]).mask(image)
    assert (mask.shape, mask.dtype) == ((32, 16), np.uint8)
    assert (mask[:12] == 255).all()
    assert (mask[20:] == 0).all()


def test_what_cannot_segment_is_refused(network, monkeypatch, tmp_path):
    path, shapes = network
    with pytest.raises(InputError, match="no such file"):
        SelfieSegmentation(tmp_path / "none.tflite")
    shapes["output"] = (1, 8, 4, 2)
    with pytest.raises(InputError, match=r"an output of shape \(1, 8, 4, 2\)"):
        SelfieSegmentation(path)
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(UnavailableError, match="ai-edge-litert"):
        SelfieSegmentation(path)


HEIGHT, WIDTH, SHOWN, EMPTY = 200, 300, 6, 12


@pytest.fixture(scope="module")
def filmed():
    """Images with noise and changing exposure, true masks and landmarks; and images of the room alone."""
    rng = np.random.default_rng(0)
    head = procedural_head("2023")
    template = np.asarray(head.template)
    camera = look_at("0", np.array([0.0, 0.1, 1.0]), WIDTH, HEIGHT, WIDTH / 2, HEIGHT / 2)
    noise = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH, 3)), (0, 0), 6)
    room = (120 + 50 * noise / noise.std()).clip(0, 255)
    room[40:160, 30:90] = (60, 90, 150)
    colors = np.tile([0.8, 0.6, 0.5], (len(template), 1))
    images, masks, faces = [], [], []
    for x in np.linspace(-0.06, 0.06, SHOWN):
        mesh = template + [x, 0, 0]
        mask = rasterize_mesh(mesh, head.faces, camera).face >= 0
        image = draw_mesh(mesh, head.faces, camera, colors)
        images.append(np.where(mask[..., None], image, room))
        points = mesh[head.regions["face"]] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        points = points @ camera.K.T
        faces.append(points[:, :2] / points[:, 2:])
        masks.append(mask)
    taken = [
        (image * rng.uniform(0.97, 1.03) + rng.normal(0, 2, image.shape)).clip(0, 255).astype(np.uint8)
        for image in [*images, *[room] * EMPTY]
    ]
    return taken[:SHOWN], np.stack(masks), np.stack(faces), taken[SHOWN:]


def test_masks_overlap_the_true_ones(filmed):
    images, masks, faces, empty = filmed
    background = learn_background("me.mp4", empty)
    check_background("me.mp4", background, images, faces)
    for image, true, face in zip(images, masks, faces):
        found = background.mask(image, face)
        refined = refined_mask(image, found.mask, face)
        overlap = [(mask & true).sum() / (mask | true).sum() for mask in (found.mask > 0, refined > 127)]
        assert 0.93 < overlap[0] < overlap[1]
        assert found.unsure < 0.3


def test_what_shows_no_empty_room_is_refused(filmed):
    images, _, faces, empty = filmed
    moved = [np.roll(image, 9 * number, axis=1) for number, image in enumerate(empty)]
    for shown, found in ((empty[:9], "at least 10 frames"), (moved, "the same empty room")):
        with pytest.raises(InputError, match=found):
            learn_background("me.mp4", shown)
    background = learn_background("me.mp4", [images[2]] * EMPTY)  # somebody without a face that is found
    with pytest.raises(InputError, match="pixels are unsure"):
        check_background("me.mp4", background, [images[2]], faces[2:3])


def test_frames_with_another_person_are_no_empty_room(monkeypatch):
    learnt = []
    monkeypatch.setattr(
        video_masks,
        "learn_background",
        lambda path, images: learnt.extend(image[0, 0, 0] for image in images),
    )
    monkeypatch.setattr(video_masks, "check_background", lambda *given: None)
    pixels = np.where(np.arange(9)[:, None, None] < 3, np.ones((9, 5, 2)), np.nan)
    faces = FoundFaces(np.arange(9), pixels, np.array([0, 1, 0, 0, 1, 1, 0, 2, 0]))
    frames = [TimedFrame(number, number / 25, np.full((4, 4, 3), number, np.uint8)) for number in range(9)]
    view = FrameView.of(Crop(0, 0, 4, 4), 64)
    MaskSource(VideoOptions(masks="background")).learn("me.mp4", frames, faces, view)
    assert learnt == [3, 6, 8]

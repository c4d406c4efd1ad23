"""PIPNet: the authors' parameters, the decoding of maps whose landmarks are known, crops, and files that are refused."""

from itertools import cycle, islice

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from headbench.bench.errors import InputError
from headbench.metrics import pipnet

RNG = np.random.default_rng(0)
FACE = RNG.uniform(0.1, 0.9, (98, 2))


@pytest.fixture(scope="module")
def network(one_torch_thread):
    torch.manual_seed(0)
    return pipnet.Network().eval()


@pytest.fixture(scope="module")
def finder(network, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pipnet")
    torch.save(network.state_dict(), folder / "epoch59.pth")
    (folder / "meanface.txt").write_text(" ".join(map(str, FACE.ravel())))
    return pipnet.PipNet(folder / "epoch59.pth")


def test_parameters_are_those_of_the_authors(network):
    heads = 3 * (512 + 1) * 98 + 2 * (512 + 1) * 980
    resnet18, classifier = 11_689_512, (512 + 1) * 1000  # published
    assert sum(value.numel() for value in network.parameters()) == resnet18 - classifier + heads
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    assert (
        len(shapes) == 120 + 10
    )  # torchvision's 122 without the classifier's, weights and biases of the five layers
    assert shapes["layer1.1.bn2.running_var"] == (64,)
    assert shapes["layer2.0.downsample.0.weight"] == (128, 64, 1, 1)
    assert shapes["layer4.0.downsample.1.num_batches_tracked"] == ()
    assert shapes["nb_y_layer.weight"] == (980, 512, 1, 1)


def test_a_landmark_has_the_votes_of_those_whose_neighbour_it_is():
    near = cKDTree(FACE).query(FACE, 11)[1][:, 1:]
    voters = [[(i, list(row).index(k)) for i, row in enumerate(near) if k in row] for k in range(98)]
    most = max(map(len, voters))
    expected = [list(islice(cycle(10 * i + j for i, j in one), most)) for one in voters]
    np.testing.assert_array_equal(pipnet.votes(FACE), expected)


def test_maps_of_known_landmarks_are_decoded():
    side, votes = 8, pipnet.votes(FACE)
    rows, columns = RNG.integers(0, side, (2, 98))
    maps = [np.full((count, side, side), np.nan) for count in (98, 98, 98, 980, 980)]
    maps[0][:] = RNG.uniform(-1, 0, maps[0].shape)
    near = cKDTree(FACE).query(FACE, 11)[1][:, 1:]
    for i, (row, column) in enumerate(zip(rows, columns)):
        maps[0][i, row, column] = 1.0
        # Places relative to the cell: its own 0.1 of the crop too far to the right, its neighbours' 0.2 too far down.
        maps[1][i, row, column] = side * (FACE[i, 0] + 0.1) - column
        maps[2][i, row, column] = side * FACE[i, 1] - row
        maps[3][10 * i : 10 * i + 10, row, column] = side * FACE[near[i], 0] - column
        maps[4][10 * i : 10 * i + 10, row, column] = side * (FACE[near[i], 1] + 0.2) - row
    most = votes.shape[1]
    np.testing.assert_allclose(
        pipnet.decode(maps, votes), FACE + np.array([0.1, 0.2 * most]) / (most + 1), atol=1e-12
    )


@pytest.mark.parametrize(
    ("box", "corner", "size"),
    [
        (
            (60, 40, 55, 35),
            (55, 43),
            (65, 35),
        ),  # 5 columns more on both sides; 3 rows from the top to the bottom
        ((60, 40, 50, 30), (56, 42), (58, 30)),  # in the authors' arithmetic 0.1 of 50 is less than 5
        ((170, 100, 65, 55), (164, 105), (36, 15)),
    ],
)
def test_the_crop_is_that_of_the_demonstration(finder, monkeypatch, box, corner, size):
    image = np.empty((120, 200, 3), np.uint8)
    image[..., 0], image[..., 1], image[..., 2] = np.arange(200), np.arange(120)[:, None], 51
    seen = []

    def middle(x):
        seen.append(x[0].numpy())
        return [torch.full((1, count, 1, 1), 0.5) for count in (98, 98, 98, 980, 980)]

    monkeypatch.setattr(finder, "_network", middle)
    found = finder.find_in(image, np.array(box))
    np.testing.assert_allclose(found, np.tile(np.array(corner) + np.array(size) / 2, (98, 1)))
    # The authors cut off the last column and row.
    means = (corner[0] + (size[0] - 2) / 2, corner[1] + (size[1] - 2) / 2, 51)
    expected = (np.array(means) / 255 - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    np.testing.assert_allclose(seen[0].mean(axis=(1, 2)), expected, atol=4e-3)  # a fifth of a level
    assert seen[0].shape == (3, 256, 256)


def test_a_box_beside_the_picture_has_no_face(finder):
    assert finder.find_in(np.zeros((50, 50, 3), np.uint8), np.array([70, 10, 20, 20])) is None


def test_the_face_lies_in_the_crop_as_the_mean_face_does(finder):
    landmarks = FACE * (120, 130) + (90, 60)  # in a crop of 120 x 130 pixels at (90, 60)
    box = pipnet.face_box(landmarks, FACE)
    np.testing.assert_array_equal(box, [90 + 10, 60 - 13, 120 / 1.2, 130])
    image = RNG.integers(0, 256, (240, 320, 3), dtype=np.uint8)
    np.testing.assert_array_equal(finder(image, landmarks), finder.find_in(image, box))


def test_weights_are_those_of_the_file_and_no_other_network_s(finder, network, tmp_path):
    state = network.state_dict()
    assert all(torch.equal(value, state[name]) for name, value in finder._network.state_dict().items())
    torch.save(
        {name: value[:68] if "cls" in name else value for name, value in state.items()}, tmp_path / "x"
    )
    (tmp_path / "meanface.txt").write_text(" ".join(map(str, FACE.ravel())))
    with pytest.raises(InputError, match=r"cls_layer\.weight: expected a float tensor of shape \(98, 512"):
        pipnet.PipNet(tmp_path / "x")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (None, "no such file"),
        ("0.5 " * 195, "195"),
        ("0.5 " * 195 + "nan", "1 that are NaN"),
        ("0.5 " * 195 + "47", "47"),
        (" ".join(f"{x:.3f} 0.5" for x in FACE[:, 0]), "on a line"),
        ("0 0 1 1 " + "0.5 " * 192, "neighbour of none"),
    ],
)
def test_another_mean_face_is_refused(tmp_path, text, found):
    if text is not None:
        (tmp_path / "meanface.txt").write_text(text)
    with pytest.raises(InputError, match=f"meanface.txt.*{found}"):
        pipnet.read_mean_face(tmp_path / "meanface.txt")

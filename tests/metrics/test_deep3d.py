"""Deep3DFaceRecon: the network in functional calls, the crop of a known face, the distances, and files that are refused."""

import numpy as np
import pytest
import torch
from scipy.io import savemat
from torch.nn import functional

from headbench.bench.errors import InputError
from headbench.metrics import coefficients
from headbench.metrics.deep3d import CoefficientNetwork, Deep3D, aligned, five_corners, read_landmarks

RNG = np.random.default_rng(0)
MEAN_FACE = RNG.normal(0, 1, (68, 3))


@pytest.fixture(scope="module")
def state(one_torch_thread):
    """Random parameters, whose features neither vanish nor grow."""
    torch.manual_seed(0)
    state = CoefficientNetwork().state_dict()
    for name, value in state.items():
        if value.is_floating_point():
            value.uniform_(0.5, 1.0) if "var" in name or "bn" in name else value.mul_(1.5)
    return state


@pytest.fixture(scope="module")
def path(state, tmp_path_factory):
    folder = tmp_path_factory.mktemp("deep3d")
    torch.save({"net_recon": state, "opt_00": {"step": 1}}, folder / "epoch_20.pth")
    savemat(folder / "similarity_Lm3D_all.mat", {"lm": MEAN_FACE})
    return folder / "epoch_20.pth"


def resnet50(state, x):
    """The coefficients of torchvision's ResNet-50 with the authors' layers, written out."""

    def conv(x, name, norm, stride=1, padding=0):
        x = functional.conv2d(x, state[f"{name}.weight"], None, stride, padding)
        parts = (state[f"{norm}.{part}"] for part in ("running_mean", "running_var", "weight", "bias"))
        return functional.batch_norm(x, *parts, eps=1e-5)

    x = functional.relu(conv(x, "backbone.conv1", "backbone.bn1", 2, 3))
    x = functional.max_pool2d(x, 3, 2, 1)
    for stage, count in enumerate((3, 4, 6, 3), 1):
        for block in range(count):
            at = f"backbone.layer{stage}.{block}"
            stride = 2 if stage > 1 and block == 0 else 1
            y = functional.relu(conv(x, f"{at}.conv1", f"{at}.bn1"))
            y = functional.relu(conv(y, f"{at}.conv2", f"{at}.bn2", stride, 1))
            y = conv(y, f"{at}.conv3", f"{at}.bn3")
            same = x if block else conv(x, f"{at}.downsample.0", f"{at}.downsample.1", stride)
            x = functional.relu(y + same)
    features = functional.adaptive_avg_pool2d(x, 1).flatten(1)
    layers = (f"final_layers.{number}" for number in (1, 3))
    return torch.cat([features @ state[f"{n}.weight"][:, :, 0, 0].T + state[f"{n}.bias"] for n in layers], 1)


def face(scale, x, y):
    """(68, 2) landmarks of the mean face, seen from the front with its origin at a pixel."""
    return np.stack([x + scale * MEAN_FACE[:, 0], y - scale * MEAN_FACE[:, 1]], axis=1)


def test_parameters_are_those_of_resnet50(state):
    numbers = sum(v.numel() for n, v in state.items() if "num_batches" not in n and "running" not in n)
    assert numbers == 25_557_032 - (2048 + 1) * 1000 + (2048 + 1) * (64 + 3)


def test_the_crop_has_the_authors_scale_and_place():
    columns, rows = np.meshgrid(np.arange(200), np.arange(160))
    image = np.stack([columns, rows, np.full_like(rows, 255)], axis=2).astype(np.uint8)
    landmarks = face(60, 110, 70)
    crop = aligned(image, five_corners(landmarks), five_corners(MEAN_FACE))
    assert crop.shape == (224, 224, 3)
    zoom = 102 / 60
    middle = crop[107:117, 107:117].mean(axis=(0, 1))
    np.testing.assert_allclose(middle[:2], (110, 70), atol=1.5)
    assert crop[112, 162, 0] - int(crop[112, 62, 0]) == pytest.approx(100 / zoom, abs=1)
    low = aligned(image, five_corners(face(60, 30, 150)), five_corners(MEAN_FACE))
    assert low[-1].max() == low[:, 0].max() == 0  # outside of the image


def test_coefficients_are_those_of_the_crop(path, state):
    image = RNG.integers(0, 256, (120, 120, 3), dtype=np.uint8)
    landmarks = face(30, 61, 52)
    crop = aligned(image, five_corners(landmarks), five_corners(MEAN_FACE))
    expected = resnet50(state, torch.from_numpy(crop / np.float32(255)).permute(2, 0, 1)[None])[0]
    found = Deep3D(path)(image, landmarks)
    assert np.abs(found).max() > 0.1
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


def test_distances_are_means_and_a_sum_of_differences():
    first, second = RNG.normal(size=(2, 67))
    exp, angle = first[:64] - second[:64], first[64:] - second[64:]
    found = [
        metric().score(first, second) for metric in (coefficients.Aed, coefficients.AedSum, coefficients.Apd)
    ]
    aed = torch.nn.functional.l1_loss(torch.from_numpy(first[:64]), torch.from_numpy(second[:64])).item()
    assert found == pytest.approx([aed, np.linalg.norm(exp, 1), np.linalg.norm(angle, 1) / 3])


@pytest.mark.parametrize(
    ("content", "found"),
    [({"lm": MEAN_FACE[:60]}, r"shape \(60, 3\)"), ({"x": 1}, "lm"), ({"lm": np.nan * MEAN_FACE}, "68|NaN")],
    ids=["shape", "entry", "numbers"],
)
def test_another_mean_face_is_refused(tmp_path, content, found):
    savemat(tmp_path / "lm.mat", content)
    with pytest.raises(InputError, match=f"lm.mat.*{found}"):
        read_landmarks(tmp_path / "lm.mat")


def test_weights_of_another_program_are_refused(path, tmp_path, state):
    (tmp_path / "similarity_Lm3D_all.mat").write_bytes(path.with_name("similarity_Lm3D_all.mat").read_bytes())
    torch.save(state, tmp_path / "x.pth")
    with pytest.raises(InputError, match="net_recon: expected a dictionary of tensors"):
        Deep3D(tmp_path / "x.pth")

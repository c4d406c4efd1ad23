"""The head model against smplx, against a float64 loop in numpy, and against what rigid motion must do."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.bench.contracts import Camera, HeadPose
from headbench.datasets.head.model import (
    BATCH,
    HeadModel,
    PosedSubject,
    camera_in_head_frame,
    pose_in_head_frame,
)

from .flame_files import flame_content
from .skinning import skinned
from .toy import toy_head

HEAD = toy_head(16, eyelids=True)
MODEL = HeadModel(HEAD, dtype=torch.float64)
SIZES = {"shape": 6, "expression": 8, "rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}


def zeros(**given_values):
    values = {name: torch.zeros(size, dtype=torch.float64) for name, size in SIZES.items()}
    return values | {name: torch.as_tensor(value).double() for name, value in given_values.items()}


def random_arguments(batch=3, seed=0, sizes=SIZES, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return {name: torch.randn(batch, size, generator=generator, dtype=dtype) for name, size in sizes.items()}


def test_agrees_with_smplx(tmp_path):
    smplx = pytest.importorskip("smplx")
    head = toy_head(16, shape_size=300, expression_size=100)
    (tmp_path / "FLAME_NEUTRAL.pkl").write_bytes(pickle.dumps(flame_content(head)))
    landmarks = {"lmk_face_idx": np.zeros(51, int), "lmk_b_coords": np.full((51, 3), 1 / 3)}
    (tmp_path / "flame_static_embedding.pkl").write_bytes(pickle.dumps(landmarks))
    theirs = smplx.FLAME(str(tmp_path), num_betas=300, num_expression_coeffs=100, dtype=torch.float64)
    a = random_arguments(4, sizes=SIZES | {"shape": 300, "expression": 100})
    expected = theirs(
        betas=a["shape"],
        expression=a["expression"],
        global_orient=a["rotation"],
        neck_pose=a["neck"],
        jaw_pose=a["jaw"],
        leye_pose=a["eyes"][:, :3],
        reye_pose=a["eyes"][:, 3:],
        transl=a["translation"],
    ).vertices.detach()
    assert (HeadModel(head, dtype=torch.float64)(**a) - expected).abs().max() < 1e-6
    single = HeadModel(head)(**{name: value.float() for name, value in a.items()})
    assert (single - expected).abs().max() < 1e-6


# Stored weights sum to 1 to their own precision only, and count as they are.
UNEVEN = HEAD.skinning_weights * np.linspace(1 - 1e-4, 1 + 1e-4, len(HEAD.template))[:, None]


@pytest.mark.parametrize("head", [HEAD, replace(HEAD, skinning_weights=UNEVEN)], ids=["even", "uneven"])
def test_agrees_with_a_loop(head):
    a = random_arguments(3)
    offset = torch.randn(*MODEL.template.shape, dtype=torch.float64) * 0.01
    eyelids = torch.randn(3, 2, dtype=torch.float64)
    ours = HeadModel(head, dtype=torch.float64)(**a, static_offset=offset, eyelids=eyelids)
    for index in range(3):
        one = {name: value[index].numpy() for name, value in (a | {"eyelids": eyelids}).items()}
        expected = skinned(head, offset=offset.numpy(), **one)
        np.testing.assert_allclose(ours[index], expected, atol=1e-13)


def test_canonical_stands_for_shape_and_offset():
    a = random_arguments(3)
    offset = torch.randn(3, *MODEL.template.shape, dtype=torch.float64) * 0.01
    canonical = MODEL.canonical(a["shape"], offset)
    expected = MODEL(**a, static_offset=offset)
    without = {name: value for name, value in a.items() if name != "shape"}
    np.testing.assert_array_equal(MODEL(**without, canonical=canonical), expected)


def test_one_row_stands_for_all():
    a = random_arguments(4)
    for name in a:
        mixed = a | {name: a[name][:1]}
        full = a | {name: a[name][:1].expand(4, -1)}
        np.testing.assert_allclose(MODEL(**mixed), MODEL(**full), atol=1e-14, err_msg=name)
    assert MODEL(**{name: value[0] for name, value in a.items()}).shape == (1, *HEAD.template.shape)


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_gradients_of_every_input(scale):
    a = {name: (scale * value).requires_grad_() for name, value in random_arguments(2).items()}
    offset = torch.zeros(*MODEL.template.shape, dtype=torch.float64, requires_grad=True)
    eyelids = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
    direction = torch.randn(2, *MODEL.template.shape, dtype=torch.float64)

    def probe(*values):
        vertices = MODEL(**dict(zip(a, values)), static_offset=values[-2], eyelids=values[-1])
        return (vertices * direction).sum(-1)

    assert torch.autograd.gradcheck(probe, (*a.values(), offset, eyelids), fast_mode=True)


def test_module_moves_between_precisions():
    model = HeadModel(HEAD)
    assert model.faces.dtype == torch.int64
    a = random_arguments(2)
    single = model(**{name: value.float() for name, value in a.items()})
    assert single.dtype == torch.float32
    double = model.double()(**a)
    assert double.dtype == torch.float64
    np.testing.assert_allclose(single, double, atol=2e-6)
    assert not list(model.parameters())
    assert not model.state_dict()  # the head model is an asset, not part of a checkpoint


def pose(**changes):
    values = {name: np.full(size, 0.1) for name, size in SIZES.items() if name != "shape"}
    return HeadPose(**{"head_model": "toy", **values, **changes})


def test_pose_arguments_stack():
    model = HeadModel(HEAD)
    poses = [pose(), pose(jaw=np.array([0.3, 0, 0]), eyelids=np.array([1.0, 0.5]))]
    arguments = model.pose_arguments(poses)
    np.testing.assert_allclose(arguments["jaw"], [[0.1, 0.1, 0.1], [0.3, 0, 0]])
    np.testing.assert_allclose(arguments["eyelids"], np.array([[0, 0], [1, 0.5]]))
    assert all(value.dtype == torch.float32 for value in arguments.values())
    assert model(shape=torch.zeros(6), **arguments).shape == (2, *HEAD.template.shape)
    assert "eyelids" not in HeadModel(toy_head(16)).pose_arguments(poses)


@pytest.fixture(scope="module")
def head():
    return toy_head(16)


def make_poses(head, count, seed=0):
    rng = np.random.default_rng(seed)
    sizes = (head.expression_basis.shape[2], 3, 3, 3, 6, 3)
    scales = (1, 1, 1, 0.2, 0.1, 1)
    return [
        HeadPose("toy", *(scale * rng.normal(size=size) for size, scale in zip(sizes, scales)))
        for _ in range(count)
    ]


def test_driven_vertices_are_those_of_forward():
    driving = pose(jaw=np.array([0.3, 0, 0.1]), eyelids=np.array([1.0, 0.5]))
    for asset in (HEAD, toy_head(16)):
        model = HeadModel(asset, dtype=torch.float64)
        neutral = model.canonical(torch.ones(model.shape_size, dtype=torch.float64))
        joints = model.rest_joints(neutral, torch.zeros(1, model.expression_size, dtype=torch.float64))
        expected = model(canonical=neutral, **model.pose_arguments([driving]))[0]
        found = model.driven(neutral[0], joints[0].numpy(), driving)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_motions_take_rigid_vertices_to_world_space(head):
    """By the whole model, for more poses than one batch holds; the neck's correctives are left out of it."""
    rng = np.random.default_rng(1)
    shape, offset = rng.normal(size=6), 0.002 * rng.normal(size=head.template.shape)
    poses = make_poses(head, BATCH + 3)
    motions = PosedSubject(head, shape, offset).motions(poses)
    assert motions.shape == (BATCH + 3, 4, 4)
    correctives = head.pose_basis.copy()
    correctives[:, :, :9] = 0
    model = HeadModel(replace(head, pose_basis=correctives), dtype=torch.float64)
    canonical = model.canonical(torch.tensor(shape), torch.tensor(offset))
    rigid = head.skinning_weights[:, 1] > 1 - 1e-9

    def vertices(poses):
        return model(canonical=canonical, **model.pose_arguments(poses)).numpy()[:, rigid]

    world = vertices(poses)
    still = [pose_in_head_frame(pose) for pose in poses]
    local = vertices(still)
    assert PosedSubject(head, shape, offset).motions(still[:1])[0] == pytest.approx(np.eye(4), abs=1e-15)
    carried = local @ motions[:, :3, :3].transpose(0, 2, 1) + motions[:, None, :3, 3]
    assert np.abs(carried - world).max() < 1e-12


def test_a_moved_camera_sees_the_head_frame_as_it_saw_the_world(head):
    motion = PosedSubject(head, np.zeros(6), np.zeros_like(head.template)).motions(make_poses(head, 1))[0]
    world_to_camera = np.eye(4)
    world_to_camera[:3, 3] = [0.1, -0.2, 1.5]
    camera = Camera("c", 10, 10, np.eye(3), world_to_camera)
    moved = camera_in_head_frame(camera, motion)
    point = np.array([0.03, 0.01, 0.08, 1.0])
    assert moved.world_to_camera @ point == pytest.approx(world_to_camera @ (motion @ point))
    assert (moved.id, moved.width) == ("c", 10)

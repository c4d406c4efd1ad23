"""Canonical space of the tensorial method: bounds, positions, directions, sizes."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import Budget, no_progress
from headbench.datasets.head.model import HeadModel
from headbench.methods.ops.splats import directions_to, triangle_frames
from headbench.methods.ours.appearance import OursAppearance
from headbench.methods.ours.field import (
    RESIDUAL,
    CanonicalFrames,
    blend_lines,
    initial_line_network,
    initial_parameters,
    line_box,
    normalised_weight,
    plane_box,
)
from headbench.methods.ours.method import Ours
from headbench.methods.ours.spec import Lines, OursConfig, Planes
from headbench.methods.shared.config import SplatTraining
from headbench.methods.shared.optimisation import Optimiser
from headbench.methods.shared.rendering import view_of
from headbench.methods.shared.schedule import Timeline
from headbench.methods.shared.surface_points import SubjectMesh

from .toy import changed

CONFIG = OursConfig(
    splats=SplatTraining(min_densify_every=10, min_settle=4),
    hidden=6,
    planes=Planes(resolution=7, channels=(4, 3, 2)),
    lines=Lines(resolution=5, channels=3, expressions=5, jaw_bases=3, lr=0.05),
)
CONFIGS = {
    "published": CONFIG,
    "repaired": changed(CONFIG, planes={"residual_lr": 0.05, "direction_smoothing": 0.3}),
}


def frame(vertices, triangle):
    """Rotation, size and centre of a triangle, as GaussianAvatars defines them."""
    v0, v1, v2 = vertices[triangle]
    a0 = F.normalize(v1 - v0, dim=0)
    a1 = F.normalize(torch.linalg.cross(a0, v2 - v0), dim=0)
    a2 = -F.normalize(torch.linalg.cross(a1, a0), dim=0)
    size = 0.5 * (torch.linalg.vector_norm(v1 - v0) + (a2 @ (v2 - v0)).abs())
    return torch.stack([a0, a1, a2], dim=1), size, (v0 + v1 + v2) / 3


def color(tensors, box, position, direction, spread):
    """Tri-plane, encoded direction known to ``spread`` radians, two layers."""
    x, y, z = 2 * (position - box[0]) / (box[1] - box[0]) - 1
    features = []
    for name, point in {"xy": (x, y), "xz": (x, z), "yz": (y, z)}.items():
        plane = tensors[f"plane_{name}"]
        side = round(len(plane) ** 0.5)
        image = plane.view(side, side, -1).permute(2, 0, 1)[None]
        grid = torch.stack(point).view(1, 1, 1, 2)
        features.append(F.grid_sample(image, grid, padding_mode="border", align_corners=True).flatten())
    waves = [
        np.exp(-0.5 * (scale * spread) ** 2) * wave(direction * scale)
        for scale in (1, 2, 4, 8)
        for wave in (torch.sin, torch.cos)
    ]
    hidden = torch.relu(tensors["color_weight_0"] @ torch.cat([*features, direction, *waves]))
    return torch.relu(0.5 + tensors["color_weight_1"] @ hidden / (2 * np.sqrt(np.pi)))


def offset(tensors, box, position, expression, jaw):
    """Feature lines, three weight-normalised layers; nothing outside the box."""
    if not ((position >= box[0]) & (position <= box[1])).all():
        return torch.zeros((), dtype=torch.float64)
    unit = (position - box[0]) / (box[1] - box[0])
    lines, features = tensors["lines"], []
    for weights, own in ((expression, lines[: len(expression)]), (jaw, lines[len(expression) :])):
        for axis in range(3):
            line = sum(weight * one[axis] for weight, one in zip(weights, own))  # (L, C)
            grid = torch.stack([2 * unit[axis] - 1, torch.zeros_like(unit[axis])]).view(1, 1, 1, 2)
            features.append(F.grid_sample(line.T[None, :, None], grid, align_corners=True).flatten())
    value = torch.cat(features)
    for layer in range(3):
        direction, gain = tensors[f"line_direction_{layer}"], tensors[f"line_gain_{layer}"]
        weight = torch._weight_norm(direction, gain, dim=0)
        value = weight @ value + tensors[f"line_bias_{layer}"]
        value = torch.relu(value) if layer < 2 else value
    return value[0]


def definition(clip, key, tensors, splats, boxes, jaw_bases, spread=0.0):
    """World means, colours and opacities of all splats, from the clip's arrays alone.

    Of a stored avatar the spread of directions is part of the weights.
    """
    model = HeadModel(clip.head, dtype=torch.float64)
    pose = clip.poses[key.timestep]
    canonical = model.canonical(torch.from_numpy(clip.shape), torch.from_numpy(clip.static_offset))
    vertices = model(canonical=canonical, **model.pose_arguments([pose]))[0]
    quaternion = Rotation.from_rotvec(np.asarray(pose.jaw, float)).as_quat()[[3, 0, 1, 2]]
    likeness = np.abs(np.asarray(jaw_bases, float) @ quaternion)
    jaw = likeness / likeness.sum()
    expression = np.asarray(pose.expression, float)[: len(tensors["lines"]) - len(jaw)]
    camera = torch.from_numpy(clip.cameras[key.camera].center)
    means, colors, opacities = [], [], []
    own = splats.get(RESIDUAL, torch.zeros(len(splats["means"]), 3))
    for mean, logit, triangle, residual in zip(*(splats[n] for n in ("means", "opacities", "binding")), own):
        corners = torch.tensor(np.asarray(clip.head.faces, np.int64)[int(triangle)])
        rotation, size, center = frame(vertices, corners)
        own_rotation, own_size, own_center = frame(canonical[0], corners)
        means.append(size * rotation @ mean + center)
        position = own_size * own_rotation @ mean + own_center
        direction = F.normalize(own_rotation @ rotation.T @ F.normalize(camera - means[-1], dim=0), dim=0)
        colors.append(torch.relu(color(tensors, boxes[0], position, direction, spread) + residual))
        delta = offset(tensors, boxes[1], position.detach(), expression, jaw)
        opacities.append(torch.sigmoid(logit + delta))
    return torch.stack(means), torch.stack(colors), torch.stack(opacities)


@pytest.mark.parametrize("case", CONFIGS)
def test_a_stored_avatar_shows_the_definition(case, clip, tmp_path):
    avatar = Ours(CONFIGS[case]).fit(
        clip, tmp_path, Budget(iterations=40), device="cpu", seed=0, progress=no_progress
    )
    key = clip.splits["self_reenactment"][0]
    found = avatar.splats(clip.poses[key.timestep], clip.cameras[key.camera])
    stored = {name: value.double() for name, value in avatar.field.tensors.items()}
    some = torch.arange(0, len(found.means), 7)
    table = stored["splats"][some]
    splats = {"means": table[:, :3], "opacities": table[:, 3], "binding": table[:, 11]}
    if RESIDUAL in stored:
        splats[RESIDUAL] = stored[RESIDUAL][some]
    boxes = stored["plane_box"], stored["line_box"]
    means, colors, opacities = definition(clip, key, stored, splats, boxes, stored["jaw_bases"].numpy())
    np.testing.assert_allclose(found.means[some], means, atol=1e-6)
    np.testing.assert_allclose(found.colors[some], colors, atol=1e-5)
    np.testing.assert_allclose(found.opacities[some], opacities, atol=1e-5)
    assert stored["lines"].abs().max() > 0.01


@pytest.fixture(scope="module", params=[*CONFIGS])
def both(clip, request):
    """Training's shading with lines on and the definition's, each with the gradients of one scalar of both."""
    mesh = SubjectMesh(clip.head, clip.shape, clip.static_offset, "cpu")
    appearance = OursAppearance(mesh, clip, CONFIGS[request.param], "cpu", 0)
    appearance.begin(Timeline(600_000, 600_000))
    count = len(mesh.faces)
    binding = torch.arange(0, count, 5)
    generator = torch.Generator().manual_seed(0)
    values = {name: value for name, (value, _) in appearance.parameters().items()}
    values["lines"] = torch.randn(values["lines"].shape, generator=generator)
    for plane in ("plane_xy", "plane_xz", "plane_yz"):
        values[plane] = 5 * values[plane]  # so that no colour is cut at 0 and all depend on their features
    values["means"] = 0.3 * torch.randn(len(binding), 3, generator=generator)
    values["opacities"] = torch.randn(len(binding), generator=generator)
    own = appearance.splat_parameters(len(binding))
    values |= {name: 0.2 * torch.randn(value.shape, generator=generator) for name, (value, _) in own.items()}
    still = {"log_scales": torch.zeros(len(binding), 3), "quats": torch.ones(len(binding), 4)}
    optimiser = Optimiser(
        {name: torch.nn.Parameter(value.clone()) for name, value in {**values, **still}.items()},
        dict.fromkeys([*values, *still], 0.1),
    )
    key = clip.splits["train"][1]
    frames = appearance.frames(key.timestep, optimiser)
    view = view_of(clip.cameras[key.camera], "cpu")
    shading = appearance.place(frames, binding, view, key.timestep, optimiser, 60_001)
    mix = torch.randn(len(binding), 4, generator=generator)
    ((shading.colors * mix[:, :3]).sum() + (shading.opacities * mix[:, 3]).sum()).backward()

    exact = {name: value.double().requires_grad_() for name, value in values.items()}
    splats = {**{name: exact[name] for name in ("means", "opacities", *own)}, "binding": binding}
    boxes = [torch.stack(list(box)).double() for box in (appearance.plane_box, appearance.line_box)]
    spread = CONFIGS[request.param].planes.direction_smoothing
    _, colors, opacities = definition(clip, key, exact, splats, boxes, appearance.jaw_bases, spread)
    ((colors * mix[:, :3]).sum() + (opacities * mix[:, 3]).sum()).backward()
    return shading, optimiser, colors, opacities, exact


def test_training_shades_by_the_definition(both):
    shading, _, colors, opacities, _ = both
    np.testing.assert_allclose(shading.colors.detach(), colors.detach(), atol=1e-5)
    np.testing.assert_allclose(shading.opacities.detach(), opacities.detach(), atol=1e-5)


def test_training_has_the_definitions_gradients(both):
    _, optimiser, _, _, exact = both
    for name, value in exact.items():
        found, expected = optimiser[name].grad, value.grad
        scale = float(expected.abs().max())
        assert scale > 0, name
        np.testing.assert_allclose(found / scale, expected / scale, atol=2e-4, err_msg=name)


GENERATOR = torch.Generator().manual_seed(0)


def mesh(seed=0, faces=5):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.normal(size=(3 * faces, 3))), torch.arange(3 * faces).view(faces, 3)


@pytest.mark.parametrize("variant", ["mesh", "paper"])
def test_plane_bounds(variant):
    vertices = torch.tensor([[-0.1, -0.2, -0.05], [0.08, 0.15, 0.12]])
    low, high = plane_box(vertices, variant)
    width = (-0.25, 0.25) if variant == "paper" else (-0.105, 0.085)
    np.testing.assert_allclose(low, [width[0], -0.2 - 0.005 - 0.025, -0.055], atol=1e-7)
    np.testing.assert_allclose(high, [width[1], 0.155, 0.125], atol=1e-7)


def test_line_bounds_are_the_mesh_itself_faces_included():
    vertices, _ = mesh()
    box = line_box(vertices)
    assert box.contains(vertices).all()
    assert not box.contains(vertices.amax(0)[None] + 1e-9).any()
    unit = box.unit(vertices)
    np.testing.assert_allclose([unit.min(), unit.max()], [0, 1], atol=1e-12)


def test_canonical_directions_follow_head_and_camera_together():
    vertices, faces = mesh()
    canonical = CanonicalFrames.of(triangle_frames(vertices, faces))
    means = torch.randn(4, 3, dtype=torch.float64, generator=GENERATOR)
    binding, center = torch.tensor([0, 1, 2, 4]), torch.tensor([0.0, 0.0, 9.0], dtype=torch.float64)
    turn = torch.from_numpy(Rotation.from_rotvec([0.4, -1.2, 0.3]).as_matrix())
    moved = triangle_frames(vertices @ turn.T, faces)
    still = directions_to(means, center, canonical.turns(triangle_frames(vertices, faces)), binding)
    np.testing.assert_allclose(still, torch.nn.functional.normalize(center - means, dim=1), atol=1e-12)
    after = directions_to(means @ turn.T, turn @ center, canonical.turns(moved), binding)
    np.testing.assert_allclose(after, still, atol=1e-12)


def test_published_sizes_and_initial_values():
    """The sizes the paper's files have."""
    initial = initial_parameters(OursConfig(), 80, 16, GENERATOR)
    parameters = {name: value for name, (value, _) in initial.items()}

    def size(start):
        return sum(4 * value.numel() for name, value in parameters.items() if name.startswith(start))

    assert [size(start) for start in ("plane_", "color_weight_", "lines")] == [4_194_304, 48_128, 2_359_296]
    assert size("line_") == 166_408
    for name in ("plane_xy", "plane_xz", "plane_yz"):
        assert 0.099 < parameters[name].abs().max() <= 0.1
    assert not parameters["lines"].any()
    assert parameters["color_weight_0"].abs().max() <= 91**-0.5
    assert parameters["color_weight_1"].abs().max() <= 128**-0.5


def test_the_network_starts_within_its_fan_in_with_its_norms():
    network = initial_line_network(32, 128, 1, torch.Generator().manual_seed(1))
    direction = network["line_direction_0"]
    assert direction.shape == (128, 192)
    assert direction.abs().max() <= 192**-0.5
    assert direction.abs().max() > 0.95 * 192**-0.5
    np.testing.assert_allclose(normalised_weight(network, 0), direction, atol=1e-7)


def test_lines_are_summed_by_expression_and_jaw_weights():
    lines, coefficients = torch.randn(5, 3, 4, 2), torch.tensor([[0.3, -2, 1, 0, 0], [0, 0, 0, 0.8, 0.2]])
    expected = [np.einsum("k,kalc->alc", row, lines) for row in coefficients]
    np.testing.assert_allclose(blend_lines(lines, coefficients), expected, atol=1e-6)

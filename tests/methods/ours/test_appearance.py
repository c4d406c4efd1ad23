"""The training side of the tensorial method: what is detached, when lines start, whom the penalty asks."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.bench.errors import InputError
from headbench.bench.native import dispatch
from headbench.datasets.head.arrays import faces_in_region
from headbench.datasets.steps.clusters import jaw_quaternions, jaw_weights
from headbench.methods.ops.planes import Bounds, line_offsets
from headbench.methods.ours.appearance import (
    driving_coefficients,
    expressive_triangles,
    outer_layers_start,
    penalty_weights,
    softened,
)
from headbench.methods.ours.field import (
    LocalSplats,
    apply_offsets,
    blend_lines,
    changed_colors,
    line_table,
    normalised_weight,
    offset_layers,
    offset_width,
)
from headbench.methods.ours.method import LineOffsets, Ours, OursAvatar
from headbench.methods.ours.spec import Lines, OursConfig, OuterLayers, Penalty
from headbench.methods.shared.schedule import Timeline
from headbench.methods.shared.splat_training import BoundTraining
from headbench.methods.shared.surface_points import SubjectMesh, pose_key
from headbench.methods.splats.cpu import instruction_sets

from ..toy_clip import first_view
from .toy import CASES, REPAIRED, SMALL, changed, make, place, store, write

OTHERS = ("position", "rotation", "scale", "color")


def splats(count=4):
    generator = torch.Generator().manual_seed(0)
    return LocalSplats(*(torch.randn(count, *shape, generator=generator) for shape in ((3,), (3,), (4,), ())))


def test_each_part_gets_its_own_columns():
    order = ("scale", "opacity", "color", "rotation", "position")
    offsets = torch.arange(4.0 * offset_width(order)).view(4, -1)
    before = splats()
    after = apply_offsets(before, offsets, order)
    np.testing.assert_allclose(after.log_scales, before.log_scales + offsets[:, 0:3])
    np.testing.assert_allclose(after.logits, before.logits + offsets[:, 3])
    np.testing.assert_allclose(after.quats, before.quats + offsets[:, 7:11])
    np.testing.assert_allclose(after.means, before.means + offsets[:, 11:14])
    np.testing.assert_allclose(changed_colors(torch.zeros(4, 3), after), offsets[:, 4:7])


def test_colours_do_not_fall_below_zero():
    dark = splats()._replace(color_change=torch.full((4, 3), -2.0))
    assert changed_colors(torch.ones(4, 3), dark).abs().max() == 0


ABLATIONS = {
    "opacity": SMALL,
    "others": changed(SMALL, lines={"dynamic": OTHERS}),
    "everything": changed(SMALL, lines={"dynamic": ("color", "opacity", "position")}),
    "repaired": changed(REPAIRED, lines={"dynamic": ("color", "opacity")}),
    "harmonics": replace(SMALL, color="sh", sh_degree=2),
    "harmonics, others": changed(SMALL, color="sh", lines={"dynamic": OTHERS}),
}


@pytest.mark.parametrize("case", ABLATIONS)
def test_a_stored_avatar_places_its_splats_as_training_does(case, clip, tmp_path):
    appearance, optimiser, binding = make(clip, ABLATIONS[case])
    for name in appearance.splat_parameters(1):
        optimiser[name].data.normal_(generator=torch.Generator().manual_seed(2))
    key = clip.splits["train"][0]
    placed = place(clip, appearance, optimiser, binding, 600_000)
    stored = OursAvatar.read(write(tmp_path, clip, ABLATIONS[case], appearance, optimiser, binding), "cpu")
    stored = stored.splats(clip.poses[key.timestep], clip.cameras[key.camera])
    for name in ("means", "quats", "scales"):
        np.testing.assert_allclose(getattr(stored, name), getattr(placed.world, name).detach(), atol=1e-5)
    np.testing.assert_allclose(stored.opacities, placed.opacities.detach(), atol=1e-5)
    np.testing.assert_allclose(stored.colors, placed.colors.detach(), atol=2e-5)


def test_the_others_change_geometry_and_leave_opacity(clip):
    appearance, optimiser, binding = make(clip, ABLATIONS["others"])
    before = place(clip, appearance, optimiser, binding, 60_000)
    after = place(clip, appearance, optimiser, binding, 60_001)
    assert torch.equal(before.opacities, after.opacities)
    for name in ("means", "quats", "scales"):
        assert not torch.equal(getattr(before.world, name), getattr(after.world, name))
    assert after.penalty > 0


def test_a_foreign_name_in_a_file_is_refused(clip, tmp_path):
    foreign = changed(SMALL, lines={"dynamic": ("opacity", "velocity")})
    write(tmp_path, clip, foreign, *make(clip))
    with pytest.raises(InputError, match="velocity"):
        OursAvatar.read(tmp_path, "cpu")


@pytest.fixture
def mesh(clip):
    return SubjectMesh(clip.head, clip.shape, clip.static_offset, "cpu")


def test_the_published_start_is_one_splat_at_each_centroid(clip, mesh):
    for config in (OursConfig(), OursConfig(outer_layers=OuterLayers(count=2), lines=Lines(enabled=False))):
        start = outer_layers_start(mesh, clip, config, "cpu")
        np.testing.assert_array_equal(start.binding, np.arange(len(mesh.faces)))
        assert not start.means.any()


def test_outer_layers_lie_a_gap_apart_along_the_normal(clip, mesh):
    config = OursConfig(
        outer_layers=OuterLayers(count=2, gap=0.002, opacity=0.2), penalty=Penalty(face_mm=0.01)
    )
    start = outer_layers_start(mesh, clip, config, "cpu")
    frames, count = mesh.frames(mesh.canonical), len(mesh.faces)
    more = len(start.binding) - count
    assert more > 0
    assert more % 2 == 0
    b = start.binding[count:]
    world = torch.einsum("nij,nj->ni", frames.rotation[b], start.means[count:] * frames.size[b, None])
    corners = mesh.canonical[mesh.faces[b]]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / torch.linalg.vector_norm(normal, dim=1, keepdim=True)
    expected = 0.002 * torch.tensor([1.0, 2.0]).repeat_interleave(more // 2)
    np.testing.assert_allclose(world, normal * expected[:, None], atol=1e-7)
    np.testing.assert_array_equal(start.opacities[count:], np.float32(0.2))


def test_face_triangles_that_expressions_move_are_expressive(clip, mesh):
    face = faces_in_region(clip.head, "face")
    timesteps = {key.timestep for key in clip.splits["train"]}
    moved = np.zeros(len(face))
    for t in timesteps:  # independent: vertex means in numpy
        unposed = mesh.unposed(mesh.arguments([clip.poses[t]])).numpy()
        d = (unposed - mesh.canonical.numpy())[mesh.faces.numpy()[face]].mean(1)
        moved = np.maximum(moved, np.linalg.norm(d, axis=1))
    threshold = float(np.median(moved)) + 1e-9
    found = expressive_triangles(mesh, clip, 1000 * threshold, "cpu")
    np.testing.assert_array_equal(found, face[moved >= threshold])
    assert 0 < len(found) < len(face)


def test_a_static_face_has_no_outer_layers(clip, mesh):
    assert len(expressive_triangles(mesh, clip, 1e6, "cpu")) == 0
    start = outer_layers_start(
        mesh, clip, OursConfig(outer_layers=OuterLayers(count=1), penalty=Penalty(face_mm=1e6)), "cpu"
    )
    assert len(start.binding) == len(mesh.faces)


def test_expressions_and_jaw_bases_blend_apart(clip):
    pose, bases = clip.poses[next(iter(clip.poses))], jaw_quaternions([*clip.poses.values()])[:2]
    found = driving_coefficients(pose, 3, bases)
    expected = np.zeros((2, 5))
    expected[0, :3], expected[1, 3:] = pose.expression[:3], jaw_weights(jaw_quaternions([pose]), bases)[0]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert found.dtype == np.float32


def directions(count, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=1)


def test_offsets_are_those_of_training(clip, tmp_path):
    tensors = OursAvatar.read(store(clip, tmp_path), "cpu").field.tensors
    low, high = tensors["line_box"]
    generator = torch.Generator().manual_seed(4)
    points = low + (high - low) * (1.4 * torch.rand(15000, 3, generator=generator) - 0.2)
    coefficients = torch.randn(2, len(tensors["lines"]), generator=generator)
    found = LineOffsets(tensors, points)(coefficients)
    table = line_table(blend_lines(tensors["lines"], coefficients), normalised_weight(tensors, 0))
    expected = line_offsets(points, Bounds(low, high), table, offset_layers(tensors))
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert 1000 < (found == 0).all(1).sum() < 14000
    exact = {name: value.double() for name, value in tensors.items()}
    slow = LineOffsets(exact, points.double())(coefficients.double())
    np.testing.assert_allclose(found, slow, atol=1e-5)


@pytest.mark.parametrize("case", CASES)
def test_frames_do_not_depend_on_what_was_drawn_before(case, clip, tmp_path):
    """Any walk over poses and cameras gives each frame bit for bit as a fresh avatar does."""
    folder = store(clip, tmp_path, CASES[case])
    avatar = OursAvatar.read(folder, "cpu")
    cameras, poses = list(clip.cameras.values()), list(clip.poses.values())
    walk = [(0, 0), (1, 0), (1, 0), (1, 1), (0, 1), (0, 0), (2, 3), (2, 2)]
    fresh = {step: OursAvatar.read(folder, "cpu").render(cameras[step[0]], poses[step[1]]) for step in walk}
    for step in walk:
        found = avatar.render(cameras[step[0]], poses[step[1]])
        np.testing.assert_array_equal(found.rgb, fresh[step].rgb)
        np.testing.assert_array_equal(found.alpha, fresh[step].alpha)


def test_colours_are_kept_for_the_same_pose_and_place_alone(clip, tmp_path, monkeypatch):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    asked, usual = [], avatar.colors
    monkeypatch.setattr(avatar, "colors", lambda *seen: asked.append(seen) or usual(*seen))
    one, other = list(clip.cameras.values())[:2]
    first, second = list(clip.poses.values())[:2]
    counts = []
    for camera, pose in ((one, first), (one, first), (other, first), (one, first), (one, second)):
        avatar.render(camera, pose)
        counts.append(len(asked))
    assert counts == [1, 1, 2, 3, 4]


def test_what_an_avatar_hands_out_is_not_what_it_keeps(clip, tmp_path):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    camera, pose = first_view(clip)
    before = avatar.render(camera, pose).rgb.copy()
    splats = avatar.splats(pose, camera)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        getattr(splats, name)[:] = 0
    avatar.render(camera, pose).rgb[:] = 0
    np.testing.assert_array_equal(avatar.render(camera, pose).rgb, before)


def test_a_pose_is_known_by_its_numbers_and_not_by_its_timestep(clip, tmp_path):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    pose = clip.poses[0]
    camera = next(iter(clip.cameras.values()))
    first = avatar.render(camera, pose).rgb
    for name in ("expression", "jaw", "rotation", "neck", "eyes", "translation"):
        other = replace(pose, **{name: np.asarray(getattr(pose, name)) + np.float32(0.02)})
        assert pose_key(other) != pose_key(pose)
        if name != "eyes":  # the toy's eyes are small
            assert np.abs(avatar.render(camera, other).rgb - first).max() > 0
    with pytest.raises(InputError, match="head_model"):
        avatar.render(camera, replace(pose, head_model="another"))
    assert pose_key(replace(pose, eyelids=np.zeros(2))) != pose_key(pose)
    assert pose_key(replace(pose, subject="b", timestep=99)) == pose_key(pose)


def test_lines_start_after_their_iteration_and_within_their_box(clip):
    appearance, optimiser, binding = make(clip)
    optimiser["means"].data[3] = torch.tensor([0.0, 1000.0, 0.0])
    before = place(clip, appearance, optimiser, binding, 60_000)
    assert before.penalty is None
    np.testing.assert_array_equal(before.opacities.detach(), np.full(len(binding), 0.5))
    after = place(clip, appearance, optimiser, binding, 60_001)
    assert after.opacities[3] == 0.5
    assert after.opacities[4] != 0.5
    assert after.penalty > 0


def test_face_bounds_reach_fewer_splats_than_head_bounds(clip):
    moved = {}
    for bounds in ("head", "face"):
        appearance, optimiser, binding = make(clip, changed(SMALL, lines={"bounds": bounds}))
        shading = place(clip, appearance, optimiser, binding, 60_001)
        moved[bounds] = int((shading.opacities != 0.5).sum())
    assert 0 < moved["face"] < moved["head"]


@pytest.mark.parametrize(
    ("iteration", "part"), [(60_001, 1e-3), (90_000, 10**-1.5), (120_000, 1.0), (500_000, 1.0)]
)
def test_the_penalty_rises_geometrically_over_its_ramp(clip, iteration, part):
    """By a factor of 1000, whose logarithm is linear in the iterations since the start of the lines."""
    config = changed(SMALL, penalty={"ramp": 60_000})
    full, risen = (place(clip, *make(clip, each), iteration).penalty.item() for each in (SMALL, config))
    assert risen / full == pytest.approx(part, rel=1e-3)


@pytest.mark.parametrize("switch", ["lines", "penalty"])
def test_switches(clip, switch):
    settings = {"lines": {"enabled": False}} if switch == "lines" else {"penalty": {"weight": 0.0}}
    appearance, optimiser, binding = make(clip, changed(SMALL, **settings))
    shading = place(clip, appearance, optimiser, binding, 60_001)
    assert shading.penalty is None
    assert (shading.opacities.detach().std() > 0) == (switch == "penalty")
    assert ("lines" in appearance.parameters()) == (switch == "penalty")


def test_penalty_weights_equal_a_loop_over_triangles(clip, head):
    appearance, _, _ = make(clip)
    mesh = appearance._mesh
    canonical = mesh.canonical.double().numpy()
    rng = np.random.default_rng(0)
    # Displacements around both thresholds.
    unposed = canonical + rng.normal(size=(len(canonical), 1)) * np.array([0.002, 0.001, 0.001])
    face = set(faces_in_region(head, "face").tolist())
    expected = []
    for number, triangle in enumerate(np.asarray(head.faces)):
        moved = np.linalg.norm(unposed[triangle].mean(0) - canonical[triangle].mean(0))
        if number in face:
            expected.append(1.0 if moved < 0.001 else 0.0)
        else:
            expected.append(10.0 if moved < 0.002 else 0.0)
    is_face = torch.tensor([number in face for number in range(len(head.faces))])
    meshes = torch.from_numpy(unposed), torch.from_numpy(canonical)
    found = penalty_weights(*meshes, mesh.faces, is_face, SMALL)
    np.testing.assert_array_equal(found, expected)
    assert set(expected) == {0.0, 1.0, 10.0}
    assert len({e for n, e in enumerate(expected) if n in face}) == 2


def test_penalty_is_the_mean_over_all_splats(clip):
    appearance, optimiser, binding = make(clip)
    shading = place(clip, appearance, optimiser, binding, 60_001)
    offsets = torch.logit(shading.opacities.detach())
    weights = appearance._prepared(clip.splits["train"][0].timestep).penalty
    assert float(shading.penalty.detach()) == pytest.approx(float((offsets.abs() * weights).mean()), rel=1e-4)


@pytest.mark.parametrize("moved", [True, False])
def test_colours_of_the_planes_move_splats_only_where_they_may(clip, moved):
    appearance, optimiser, binding = make(clip, changed(SMALL, planes={"move_splats": moved}))
    place(clip, appearance, optimiser, binding, 1).colors.sum().backward()
    assert (optimiser["means"].grad is not None) == moved
    assert optimiser["plane_xy"].grad.any()


def test_view_directions_waver_in_training_and_only_they(clip):
    steady, optimiser, binding = make(clip)
    wavering = make(clip, changed(SMALL, direction_jitter=0.2))[0]
    one, other = (place(clip, wavering, optimiser, binding, i) for i in (1, 2))
    again = place(clip, wavering, optimiser, binding, 1)
    straight = place(clip, steady, optimiser, binding, 1)
    assert torch.equal(one.colors, again.colors)  # so that a resumed run draws the same
    assert not torch.equal(one.colors, other.colors)
    assert not torch.equal(one.colors, straight.colors)
    for left, right in zip(one.world, straight.world):
        assert torch.equal(left, right)
    turns = torch.stack([wavering._turn(i) for i in range(1, 2001)])
    np.testing.assert_allclose(turns @ turns.transpose(1, 2), np.tile(np.eye(3), (2000, 1, 1)), atol=1e-5)
    # Each of three angles has the deviation asked for: the mean squared angle is three times its square.
    angles = torch.acos(((turns.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1))
    assert float(angles.square().mean()) == pytest.approx(3 * 0.2**2, rel=0.1)


def test_a_softened_penalty_is_published_but_for_a_parabola_at_0():
    offsets = torch.tensor([-3.0, -0.1, -0.05, 0.0, 0.02, 0.1, 0.5], dtype=torch.float64, requires_grad=True)
    np.testing.assert_array_equal(softened(offsets, 0.0).detach(), offsets.detach().abs())
    soft = softened(offsets, 0.1)
    soft.sum().backward()
    np.testing.assert_allclose(soft.detach(), [2.95, 0.05, 0.0125, 0.0, 0.002, 0.05, 0.45])
    np.testing.assert_allclose(offsets.grad, [-1, -1, -0.5, 0, 0.2, 1, 1], atol=1e-12)


@pytest.mark.skipif(not instruction_sets(), reason="the compiled kernel is missing")
def test_training_by_compiled_forms_follows_that_by_definitions(clip, monkeypatch):
    config = changed(SMALL, splats={"schedule_length": 100}, lines={"start": 10})
    losses = {}
    for compiled in (True, False):
        monkeypatch.setattr(dispatch, "fits", lambda kernel, values, compiled=compiled: compiled)
        shading, _, binding = make(clip, config)
        sampler = Ours(config)._sampler(clip, 0)
        training = BoundTraining(clip, config.splats, shading, sampler, len(binding), "cpu", 0)
        training.begin(Timeline(100, 100))
        losses[compiled] = []
        for iteration in range(1, 31):
            loss = training.loss(iteration, sampler(iteration))
            loss.backward()
            losses[compiled].append(loss.item())
            training.optimiser.step()
            training.optimiser.zero_grad()
        training.close()
    np.testing.assert_allclose(losses[True], losses[False], rtol=1e-3)
    assert losses[True] != losses[False]  # so that the compiled forms were used

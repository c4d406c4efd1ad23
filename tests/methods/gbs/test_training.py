"""What one iteration adds up and changes, how many splats a run starts with, and avatars driven to extremes."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from skimage.metrics import structural_similarity

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.methods.gbs.blendshapes import (
    EXPRESSIONS,
    MEMBERS,
    Entries,
    PointMotions,
    apply_pose,
    difference_widths,
    stored_of,
    write_avatar,
)
from headbench.methods.gbs.method import (
    DIFFERENCES,
    GBS,
    GBSTraining,
    MouthCylinder,
    mouth_cylinder,
    padded_offset,
    rows_of_teeth,
    sample_count,
    with_mouth,
)
from headbench.methods.gbs.spec import BlendshapeTraining, GBSConfig
from headbench.methods.shared.avatar_files import AVATAR_FILE, Subject
from headbench.methods.shared.schedule import Timeline
from headbench.methods.shared.surface_points import SurfacePoints, full_barycentric
from headbench.methods.shared.tensor_files import read_safetensors
from headbench.methods.splats import rasterize

from ..toy_clip import check_frame, look_at

FACES, EXPRESSION_SIZE = 40, 60
PUBLISHED_BYTES = 4 * 3128  # what the authors' viewer reads for each splat


def write(path, count=30, expressions=50, degree=3, difference_degree=3, share=0.4):
    """A random avatar; returns what was written."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    rest = (degree + 1) ** 2 - 1
    widths = {
        "means": (3,),
        "log_scales": (3,),
        "quats": (4,),
        "opacities": (),
        "sh_dc": (3,),
        "sh_rest": (3, rest),
    }
    neutral = {name: normal(count, *shape) for name, shape in widths.items()}
    moved_by = torch.rand(count, expressions, generator=generator) < share
    owners, moving = moved_by.nonzero().unbind(1)
    entries = Entries.of(moved_by.sum(1), moving, torch.ones(len(owners)))
    differences = normal(len(owners), sum(difference_widths(difference_degree).values()))
    rng = np.random.default_rng(0)
    inside = rng.dirichlet(np.ones(3), count)[:, 1:].astype(np.float32)
    points = SurfacePoints(rng.integers(0, FACES, count), full_barycentric(inside))
    write_avatar(path, neutral, points, expressions, entries, differences)
    return neutral, points, entries, differences


def read(path):
    head = SimpleNamespace(faces=range(FACES), expression_basis=np.zeros((1, 3, EXPRESSION_SIZE)))
    return stored_of(path, *read_safetensors(path), head, "cpu")


@pytest.mark.parametrize(("degree", "difference_degree"), [(3, 3), (3, 0), (2, 1), (0, 0)])
def test_everything_comes_back_to_the_bit(tmp_path, degree, difference_degree):
    path = tmp_path / AVATAR_FILE
    degrees = {"degree": degree, "difference_degree": difference_degree}
    neutral, points, entries, differences = write(path, expressions=37, **degrees)
    found = read(path)
    assert found.expressions == 37
    assert set(found.neutral) == set(neutral)
    for name, value in neutral.items():
        assert torch.equal(found.neutral[name], value), name
    assert torch.equal(found.differences, differences)
    for one, other in zip(found.entries, entries):
        assert torch.equal(one, other)
    np.testing.assert_array_equal(found.points.triangles, points.triangles)
    np.testing.assert_array_equal(found.points.barycentric, points.barycentric)


@pytest.mark.parametrize(("share", "moving"), [(1.1, 50), (-1.0, 0)], ids=["all expressions", "none"])
def test_bytes_of_a_splat_are_fewer_than_published(tmp_path, share, moving):
    sizes = []
    for count in (100, 300):
        write(tmp_path / "x", count, share=share)
        sizes.append((tmp_path / "x").stat().st_size)
    per_splat = (sizes[1] - sizes[0]) / 200
    assert per_splat == pytest.approx(4 * 59 + 12 + 7 + moving * 4 * 59, abs=0.2)
    assert per_splat < PUBLISHED_BYTES


def cut(name):
    return lambda tensors: tensors.update({name: tensors[name][:-1].contiguous()})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        *((cut(name), "x") for name in MEMBERS),
        *((lambda t, name=name: t.pop(name), name) for name in MEMBERS),
        (lambda t: t["splats"].__setitem__((0, 0), float("nan")), "splats"),
        (lambda t: t["differences"].__setitem__((0, 0), float("inf")), "differences"),
        (lambda t: t["triangles"].__setitem__(0, FACES), "triangles"),
        (lambda t: t["triangles"].__setitem__(0, -1), "triangles"),
        (lambda t: t.update(triangles=t["triangles"].float()), "triangles"),
        (lambda t: t.update(splats=t["splats"].double()), "splats"),
        (lambda t: t.update(splats=t["splats"][:, :-1].contiguous()), "splats"),
        (lambda t: t.update(differences=t["differences"][:, :-1].contiguous()), "differences"),
        (lambda t: t["moved_by"].__setitem__((0, 0), 255 - t["moved_by"][0, 0]), "differences"),
        *((said, "expressions|moved_by") for said in ("", "-3", "fifty", "61", "20")),
    ],
)
def test_tensors_and_texts_that_cannot_be_are_refused(tmp_path, change, says):
    path = tmp_path / "x"
    write(path)
    tensors = load_file(path)
    if callable(change):
        change(tensors)
    save_file(tensors, path, {EXPRESSIONS: "50" if callable(change) else change})
    with pytest.raises(InputError, match=says):
        read(path)


def test_distances_to_the_cylinder_are_those_of_its_sides():
    cylinder = MouthCylinder(torch.tensor([0.0, 1.0, 0.0]), 2.0, 3.0)
    inside = torch.tensor([[1.0, 0.5, -1.0], [0, 1, 0]])
    assert cylinder.violation(inside) == 0
    sideways = torch.tensor([[3.0, 1.0, 4.0]])  # 5 from the axis
    assert cylinder.violation(sideways) == pytest.approx(9.0)
    upwards = torch.tensor([[0.0, 6.0, 0.0]])
    assert cylinder.violation(upwards) == pytest.approx(4.0)
    both = torch.cat([sideways + torch.tensor([0, 5.0, 0]), inside])
    assert cylinder.violation(both) == pytest.approx((9 + 4) / 3)
    on_axis = torch.zeros(1, 3, requires_grad=True)
    cylinder.violation(on_axis).backward()
    assert torch.isfinite(on_axis.grad).all()


def test_teeth_at_rest_fit_their_cylinder(head):
    mouth = with_mouth(head, GBSConfig())
    teeth = torch.from_numpy(mouth.template[mouth.regions["teeth"]]).float()
    cylinder = mouth_cylinder(teeth.numpy())
    assert cylinder.violation(teeth) == 0
    assert cylinder.violation(teeth + torch.tensor([0, 0, cylinder.radius])) > 0
    assert cylinder.violation(teeth + torch.tensor([0, 2 * cylinder.half_height, 0])) > 0


def test_teeth_hang_on_neck_and_jaw_and_know_no_expression(head):
    mouth = with_mouth(head, GBSConfig())
    upper, lower = rows_of_teeth(mouth)
    assert len(upper) == len(lower) > 0
    for row, joint in ((upper, 1), (lower, 2)):
        corners = np.unique(mouth.faces[row])
        assert (mouth.skinning_weights[corners, joint] == 1).all()
        assert not mouth.expression_basis[corners].any()
    again = with_mouth(mouth, GBSConfig())
    assert len(again.template) == len(mouth.template)
    offset = padded_offset(np.ones_like(head.template), len(mouth.template))
    assert (offset[: len(head.template)] == 1).all()
    assert not offset[len(head.template) :].any()


def test_a_head_without_lips_stays_without_teeth(head, caplog):
    bald = replace(head, regions={}, landmarks={})
    mouth = with_mouth(bald, GBSConfig(lower_teeth_variant="official"))
    assert rows_of_teeth(mouth) == []
    assert len(mouth.template) == len(head.template)
    assert "no teeth" in caplog.text


def test_the_official_variants_of_the_mouth(head):
    official = GBSConfig(correctives_variant="official", lower_teeth_variant="official")
    plain, odd = with_mouth(head, GBSConfig()), with_mouth(head, official)
    lower = odd.regions["teeth_lower"]
    np.testing.assert_allclose(odd.skinning_weights[lower[0]], [0.0131, 0.0426, 0.9443, 0, 0])
    np.testing.assert_allclose(odd.skinning_weights.sum(1), 1, atol=1e-3)
    others = np.setdiff1d(np.arange(len(odd.template)), lower)
    np.testing.assert_array_equal(odd.skinning_weights[others], plain.skinning_weights[others])
    np.testing.assert_allclose(odd.pose_basis, 3 * plain.pose_basis)


SMALL = GBSConfig(
    splats=BlendshapeTraining(densify_gradient=1e9, initial_opacity=0.5),
    samples=300,
    teeth_samples=40,
    teeth_densify_gradient=1e9,
    mask_floor_mm=1.0,
    difference_sh_degree=1,
)


def make(clip, config=SMALL):
    head = with_mouth(clip.head, config)
    offset = padded_offset(clip.static_offset.astype(np.float32), len(head.template))
    subject = Subject("toy", head.version, clip.shape.astype(np.float32), offset)
    training = GBSTraining(clip, config, subject, head, lambda iteration: 0, "cpu", 0)
    training.begin(Timeline(40_000, 40_000))
    return training, head


@pytest.fixture
def training(clip):
    made, head = make(clip)
    yield made, head
    made.close()


def scatter(training):
    """Give every tensor values that matter; teeth leave the mouth."""
    generator = torch.Generator().manual_seed(0)
    for name, spread in (("means", 0.01), ("opacities", 1.0), ("log_scales", 0.3), ("sh_dc", 0.5)):
        values = training.optimiser[name].data
        values += spread * torch.randn(values.shape, generator=generator)
    table = training.optimiser[DIFFERENCES].data
    table += 2e-5 * torch.randn(table.shape, generator=generator)


def test_the_loss_is_the_papers_sum(training, clip):
    training, head = training
    scatter(training)
    index = 2
    found = float(training.loss(1, index).detach())
    key = clip.splits["train"][index]
    camera, pose = clip.cameras[key.camera], clip.poses[key.timestep]
    neutral = {name: training.optimiser[name].detach() for name in training.splat_names}
    arguments = training.rig.arguments([pose])
    # The table as a dense one, in float64.
    entries, table = training.entries, training.merged_differences().double().numpy()
    dense = np.zeros((len(training.binding), training.rig.expressions, table.shape[1]))
    dense[entries.owners, entries.expressions] = table
    blended = torch.from_numpy(np.einsum("k,nkc->nc", pose.expression, dense)).float()
    assert blended.abs().max() > 1e-4
    posed = apply_pose(neutral, blended, PointMotions.of(training.rig.motions(arguments)))
    colors = posed.colors(torch.from_numpy(camera.center).float(), 0)
    view = camera.world_to_camera, camera.K, camera.width, camera.height
    rendering = rasterize(*posed.world, posed.opacities, colors, *view)
    coverage = clip.mask(key) / 255.0
    assert np.any(clip.background), "on black already, nothing would be masked"
    image = rendering.image.double().numpy()
    truth = clip.image(key) / 255.0 - (1 - coverage[:, :, None]) * clip.background
    padded = [np.pad(x, ((10, 10), (10, 10), (0, 0))) for x in (image, truth)]
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, similarity = structural_similarity(*padded, channel_axis=2, full=True, **options)
    expected = 0.8 * np.abs(image - truth).mean() + 0.2 * (1 - similarity[10:-10, 10:-10].mean())
    expected += 10 * np.mean((rendering.alpha.double().numpy() - coverage) ** 2)
    vertices = training.rig.mesh.canonical.numpy()
    cylinder = mouth_cylinder(vertices[head.regions["teeth"]])
    for row in ("teeth_upper", "teeth_lower"):
        of_row = np.flatnonzero(np.isin(head.faces, head.regions[row]).any(1))
        on_row = np.isin(training.points.triangles, of_row)
        x, y, z = (neutral["means"].double().numpy()[on_row] - cylinder.center.double().numpy()).T
        outward = np.maximum(np.hypot(x, z) - cylinder.radius, 0)
        upward = np.maximum(np.abs(y) - cylinder.half_height, 0)
        violation = np.mean(outward**2 + upward**2)
        assert violation > 0
        expected += 100 * violation
    assert found == pytest.approx(expected, rel=1e-4)


def test_without_masks_alpha_and_background_are_unused(clip):
    bare = replace(clip, masks=dict.fromkeys(clip.masks))
    opaque = {key: np.full_like(mask, 255) for key, mask in clip.masks.items()}
    covered = replace(clip, masks=opaque, background=np.zeros(3))
    found = []
    for one, weight in ((replace(bare, background=np.zeros(3)), 1e3), (covered, 0.0), (bare, 1e3)):
        training, _ = make(one, replace(SMALL, alpha_weight=weight))
        found.append(float(training.loss(1, 0).detach()))
        training.close()
    assert found[0] == pytest.approx(found[1], rel=1e-6)
    assert found[2] != pytest.approx(found[1], rel=1e-2), "on the background that the clip has"


def test_differences_step_at_their_rates_times_the_mask(training):
    """Adam's first step is the learning rate wherever there is a gradient; round splats have none by rotation."""
    training, _ = training
    training.optimiser["log_scales"].data += torch.tensor([0.3, 0.0, -0.3])
    training.loss(1, 0).backward()
    training.after_backward(1)
    training.optimiser.step()
    step = training.merged_differences().abs() / training.entries.weights[:, None]
    widths = difference_widths(1)
    rates = {"means": 3.2e-7, "log_scales": 5e-4, "quats": 1e-4, "opacities": 5e-5, "sh_dc": 1.25e-3}
    for name, part in zip(widths, step.split(list(widths.values()), dim=1)):
        moved = part[part > 0]
        if name == "sh_rest":  # harmonics above degree 0 are not yet on
            assert len(moved) == 0
            continue
        assert len(moved) > 10
        torch.testing.assert_close(moved, torch.full_like(moved, rates[name]), rtol=0.01, atol=0)


def test_positions_settle_after_three_quarters(training):
    training, _ = training

    def rate(iteration):
        training.loss(iteration, 0)
        training.after_backward(iteration)
        return training.optimiser.state()["means"]["lr"]

    assert rate(15_000) == pytest.approx(1.6e-5)
    assert rate(30_000) == rate(39_999) == pytest.approx(1.6e-6)


def test_teeth_and_unmoved_triangles_have_no_differences(training):
    training, head = training
    counts = torch.bincount(training.entries.owners, minlength=len(training.binding)).numpy()
    corners = head.faces[training.points.triangles]
    still = np.isin(corners, np.concatenate([head.regions["teeth"], head.regions["neck"]])).all(1)
    assert (counts[still] == 0).all()
    assert 0 < counts[~still].mean() < training.rig.expressions


def test_initial_splats_are_limited_by_image_resolution(clip):
    camera = look_at(np.array([0, 0, 0.5]), np.zeros(3), "a", 100, 100)
    key = clip.splits["train"][0]._replace(camera="a")
    poses = {key.timestep: replace(clip.poses[key.timestep], translation=np.array([0, 0, 0.1]))}
    near = replace(clip, cameras={"a": camera}, splits={"train": (key,)}, poses=poses)
    config = GBSConfig(samples=1_000, sample_spacing=2.0)
    pixel = 0.4 / camera.K[0, 0]
    assert sample_count(near, config, 100 * (2 * pixel) ** 2, np.zeros(3)) == 100
    assert sample_count(near, config, 1e6 * (2 * pixel) ** 2, np.zeros(3)) == 1_000
    assert sample_count(near, replace(config, sample_spacing=0.0), 1e-9, np.zeros(3)) == 1_000


@pytest.fixture(scope="module")
def avatar(clip, tmp_path_factory):
    folder = tmp_path_factory.mktemp("gbs")
    config = replace(SMALL, difference_opacity_lr=0.05, difference_scale_lr=0.05, difference_sh_lr=0.05)
    return GBS(config).fit(clip, folder, Budget(iterations=25), device="cpu", seed=0, progress=no_progress)


def test_learnt_differences_show(avatar, clip):
    pose = clip.poses[0]
    flat, bent = (replace(pose, expression=np.full(len(pose.expression), e)) for e in (0.0, 2.0))
    one, other = avatar.splats(flat), avatar.splats(bent)
    moved = np.zeros(len(one.means), bool)
    moved[avatar.stored.entries.owners.numpy()] = True
    assert np.abs(one.opacities - other.opacities)[moved].mean() > 1e-3
    np.testing.assert_array_equal(one.opacities[~moved], other.opacities[~moved])
    np.testing.assert_array_equal(one.scales[~moved], other.scales[~moved])


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("expression", 3.0),
        ("expression", -3.0),
        ("expression", 1e3),
        ("jaw", 0.0),
        ("jaw", np.pi),
        ("jaw", 100.0),
    ],
)
def test_extreme_poses_are_finite_and_bounded(avatar, clip, part, value):
    pose = replace(clip.poses[0], **{part: np.full(len(getattr(clip.poses[0], part)), value)})
    for view in (clip.cameras["00"], look_at(np.array([-0.3, 0.4, -0.2]), np.zeros(3), "behind", 28, 36)):
        splats, frame = avatar.splats(pose, view), avatar.render(view, pose)
        for values in vars(splats).values():
            assert np.isfinite(values).all()
        assert splats.scales.max() <= 0.1 + 1e-6
        check_frame(frame, view.width, view.height)

"""What one iteration adds up and changes, how many splats a run starts with, and avatars driven to extremes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from headbench.bench.contracts import Budget, no_progress
from headbench.methods.gbs.blendshapes import PointMotions, apply_pose, difference_widths
from headbench.methods.gbs.method import (
    DIFFERENCES,
    GBS,
    GBSTraining,
    mouth_cylinder,
    padded_offset,
    sample_count,
    with_mouth,
)
from headbench.methods.gbs.spec import BlendshapeTraining, GBSConfig
from headbench.methods.shared.avatar_files import Subject
from headbench.methods.shared.schedule import Timeline
from headbench.methods.splats import rasterize

from ..toy_clip import check_frame, look_at

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

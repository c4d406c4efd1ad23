"""Light of panels: closed forms, Mitsuba's path integrator, equal bytes."""

import mitsuba
import numpy as np
import pytest

from headbench.bench.contracts import Camera
from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.native.dispatch import Kernel
from headbench.datasets.synthetic.capture import synthesize
from headbench.datasets.synthetic.panels import (
    KERNEL,
    AreaLight,
    PanelTracer,
    panels,
    rig_middle,
    sample_count,
)
from headbench.datasets.synthetic.plan import FRONTAL
from headbench.datasets.synthetic.renderer import develop

from .conftest import hull_faces, settled

pytestmark = pytest.mark.skipif(not KERNEL.instruction_sets, reason="the compiled kernel is missing")


def panel(center, half_width, half_height, normal, radiance=(1.0, 2.0, 3.0)):
    return AreaLight(*(np.array(v, float) for v in (center, half_width, half_height, normal, radiance)))


OVERHEAD = panel([0.1, 1.0, 0.2], [0.3, 0, 0], [0, 0, 0.4], [0, -1, 0])


def grid(count, size, height=0.0):
    """Points (n, 3) and triangles of a square in the plane y = ``height``, facing up."""
    along = np.linspace(-size, size, count)
    x, z = (a.ravel() for a in np.meshgrid(along, along, indexing="ij"))
    index = np.arange(count * count).reshape(count, count)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    return np.stack([x, np.full(len(x), height), z], axis=1), faces


def tracer(meshes, lights, surroundings=(0.0, 0.0, 0.0), albedo=0.5, material="cloth", **options):
    made = PanelTracer(lights, options.pop("samples", 16), surroundings=surroundings, **options)
    for name, (vertices, faces) in meshes.items():
        made.add(name, vertices, faces, np.full((len(vertices), 3), albedo), material)
    return made


def polygon_radiance(corners, normal):
    """Of a white diffuse surface at the origin under a polygon of radiance 1 above its horizon (Lambert 1760)."""
    unit = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    total = np.zeros(3)
    for a, b in zip(unit, np.roll(unit, -1, axis=0)):
        edge = np.cross(a, b)
        total += np.arccos(a @ b) * edge / np.linalg.norm(edge)
    return abs(total @ normal) / (2 * np.pi)


@pytest.mark.parametrize("turn", [0.0, 0.5, -0.8])
def test_a_rectangle_gives_the_light_of_its_closed_form(turn):
    flat, faces = grid(20, 0.001)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    scene = tracer({"plate": (flat @ rotation.T, faces)}, [OVERHEAD])
    direct, total, visible = scene.light("plate", np.arange(400))
    signs = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
    corners = OVERHEAD.center + signs @ np.stack([OVERHEAD.half_width, OVERHEAD.half_height])
    expected = polygon_radiance(corners, rotation[:, 1]) * OVERHEAD.radiance
    np.testing.assert_allclose(direct.mean(0), expected, rtol=0.005)
    np.testing.assert_allclose(direct.std(0) / expected, 0.0, atol=0.1)
    np.testing.assert_array_equal(visible[:, 0], 1.0)
    np.testing.assert_array_equal(total, direct)
    dark, _, hidden = scene.light("plate", np.arange(400), back=True)
    assert not dark.any()
    assert not hidden.any()


def test_gloss_scales_reflections_alone():
    rng = np.random.default_rng(1)
    unit = rng.standard_normal((300, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    frontal = panel([0.0, 0.5, 1.0], [0.4, 0, 0], [0, 0.3, 0.15], [0, -0.45, -0.9])
    scene = tracer({"ball": (0.1 * unit, hull_faces(unit))}, [frontal], material="skin", albedo=0.3)
    shown = []
    for gloss in (1.0, 0.0, 2.5):
        scene.move("ball", 0.1 * unit, gloss=np.full(300, gloss))
        shown.append(scene.image(front_camera(32, 24), 0)[0])
    plain = tracer({"ball": (0.1 * unit, hull_faces(unit))}, [frontal], material="skin", albedo=0.3)
    np.testing.assert_array_equal(plain.image(front_camera(32, 24), 0)[0], shown[0])
    reflected = shown[0] - shown[1]
    assert reflected.max() > 0.02
    np.testing.assert_allclose(shown[2] - shown[1], 2.5 * reflected, atol=1e-5)


def front_camera(width, height, focal=100.0, shift=(0.0, 0.0)):
    """At one metre before the origin."""
    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    world_to_camera[2, 3] = 1.0
    K = np.array([[focal, 0, 0.5 * width + shift[0]], [0, focal, 0.5 * height + shift[1]], [0, 0, 1.0]])
    return Camera("a", width, height, K, world_to_camera)


def psnr(a, b):
    return -10 * np.log10(np.mean((a / 255.0 - b / 255.0) ** 2))


@pytest.fixture(scope="module")
def posed(plan, subject):
    activations = plan.performed["FREE"].activations[1]
    state = settled(activations, plan.person)
    return subject.rest_meshes(), subject.posed_meshes(plan.poses["FREE"][1], activations, state)


def head(posed, made):
    for name, mesh in posed[0].items():
        moved = posed[1][name]
        albedo = mesh.albedo if moved.albedo is None else moved.albedo
        made.add(name, moved.vertices, mesh.faces, albedo, mesh.material)
    return made


def lit_head(plan, posed, samples=25, **options):
    return head(posed, PanelTracer(panels(rig_middle(plan.cameras[FRONTAL])), samples, **options))


def test_two_seeds_of_rays_and_of_light_agree_to_40_db(plan, posed):
    camera, background = plan.cameras[FRONTAL], np.ones(3)
    scene = lit_head(plan, posed)
    first = develop(*scene.image(camera, 1), background)[0]
    np.testing.assert_array_equal(first, develop(*scene.image(camera, 1), background)[0])
    other = develop(*lit_head(plan, posed, seed=5).image(camera, 2), background)[0]
    assert 40 < psnr(first, other) < 70


def test_threads_and_instruction_sets_leave_all_bytes(plan, posed):
    camera = plan.cameras[FRONTAL].resized(12, 18)
    images = [
        lit_head(plan, posed, 4, threads=threads, instruction_set=name).image(camera, 3)
        for threads, name in [(3, None), *((1, name) for name in KERNEL.instruction_sets)]
    ]
    for rgb, alpha in images[1:]:
        assert rgb.tobytes() == images[0][0].tobytes()
        assert alpha.tobytes() == images[0][1].tobytes()


def test_light_does_not_depend_on_what_was_rendered_before(plan, posed):
    camera = plan.cameras[FRONTAL].resized(12, 18)
    fresh = lit_head(plan, posed, 4).image(camera, 3)[0]
    scene = lit_head(plan, posed, 4)
    scene.move(
        "skin", posed[1]["skin"].vertices + [0.01, 0.0, 0.02], np.full_like(posed[1]["skin"].albedo, 0.3)
    )
    scene.image(camera, 3)
    scene.move("skin", posed[1]["skin"].vertices, posed[1]["skin"].albedo)
    scene.light("hair", np.arange(50))
    assert scene.image(camera, 3)[0].tobytes() == fresh.tobytes()


def mitsuba_picture(meshes, lights, camera, samples):
    """Path-traced with the same panels as area lights, of diffuse surfaces; one bounce."""
    mitsuba.set_variant("scalar_rgb")
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3, "hide_emitters": True},
        "sensor": {
            "type": "perspective",
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * camera.width / camera.K[0, 0]))),
            "fov_axis": "x",
            "near_clip": 0.01,
            "far_clip": 100.0,
            # Mitsuba offsets the film, not the point: the sign turns.
            "principal_point_offset_x": float(0.5 - camera.K[0, 2] / camera.width),
            "principal_point_offset_y": float(0.5 - camera.K[1, 2] / camera.height),
            "to_world": mitsuba.ScalarTransform4f(
                (np.linalg.inv(camera.world_to_camera) @ np.diag([-1.0, -1.0, 1.0, 1.0])).tolist()
            ),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "gaussian", "stddev": 0.55},
            },
            "sampler": {"type": "orthogonal", "sample_count": samples},
        },
    }
    for index, light in enumerate(lights):
        to_world = np.eye(4)
        to_world[:3] = np.stack([light.half_width, light.half_height, light.normal, light.center], axis=1)
        if np.linalg.det(to_world[:3, :3]) < 0:  # the rectangle shines along +z
            to_world[:, 0] *= -1
        scene[f"light{index}"] = {
            "type": "rectangle",
            "to_world": mitsuba.ScalarTransform4f(to_world.tolist()),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": light.radiance.tolist()}},
        }
    for name, (vertices, faces) in meshes.items():
        properties = mitsuba.Properties()
        surface = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5] * 3}}
        properties["mesh_bsdf"] = mitsuba.load_dict({"type": "twosided", "surface": surface})
        mesh = mitsuba.Mesh(name, len(vertices), len(faces), has_vertex_normals=True, props=properties)
        parameters = mitsuba.traverse(mesh)
        parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
        parameters["faces"] = faces.astype(np.uint32).ravel()
        parameters.update()
        scene[name] = mesh
    pixels = np.array(mitsuba.render(mitsuba.load_dict(scene)))
    return pixels[..., :3] / np.maximum(pixels[..., 3:], 1e-6), pixels[..., 3]


def test_a_ball_over_a_floor_looks_as_mitsuba_traces_it():
    """Soft shadow, light that the floor sends back up, principal point off the middle."""
    rng = np.linspace(0, 1, 4000)
    turn = np.pi * (1 + 5**0.5) * np.arange(4000)
    polar = np.arccos(1 - 2 * (rng * 0.9998 + 0.0001))
    unit = np.stack([np.sin(polar) * np.cos(turn), np.cos(polar), np.sin(polar) * np.sin(turn)], -1)
    meshes = {"ball": (0.08 * unit, hull_faces(unit)), "floor": grid(90, 0.3, -0.1)}
    placed = [
        panel([-0.6, 0.9, 0.5], [0.3, 0, 0], [0, 0.2, -0.3], [0.45, -0.75, -0.5], (2, 2, 2)),
        panel([0.9, 0.3, 0.6], [0, 0.25, 0], [-0.2, 0, 0.3], [-0.83, 0, -0.55], (1.5, 1.2, 1.0)),
    ]
    for light in placed:
        normal = np.cross(light.half_width, light.half_height)
        normal /= np.linalg.norm(normal)
        light.normal[:] = normal * np.sign(normal @ light.normal)
    camera = front_camera(64, 48, shift=(3.0, -2.0))
    rgb, alpha = tracer(meshes, placed, samples=25).image(camera, 1)
    expected, covered = mitsuba_picture(meshes, placed, camera, 289)
    assert np.abs(alpha - covered).mean() < 0.005
    pictures = [develop(*image, np.ones(3))[0] for image in ((rgb, alpha), (expected, covered))]
    assert pictures[1].std() > 30
    assert psnr(*pictures) > 42


def test_missing_kernel_and_bad_input_are_said_first(tmp_path, monkeypatch):
    assert [sample_count(n) for n in (1, 4, 5, 16, 17)] == [1, 4, 9, 16, 25]
    with pytest.raises(InputError, match="samples per pixel"):
        sample_count(1000)
    small = {"cameras": 2, "timesteps": 8, "size": (32, 46)}
    missing = Kernel("headbench.none", "The renderer")
    monkeypatch.setattr("headbench.datasets.synthetic.capture.KERNEL", missing)
    with pytest.raises(UnavailableError, match="The renderer"):
        synthesize(tmp_path / "capture", **small)
    assert not (tmp_path / "capture").exists()

"""Every operation against its definition in float64: values and gradients, and the same bits on any number of threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from skimage.metrics import structural_similarity
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_map

from headbench.bench.native.dispatch import Operation
from headbench.methods.ops import kernel, photometric, planes, splats
from headbench.methods.ops.photometric import mean_ssim
from headbench.methods.shared.threads import torch_threads
from headbench.methods.splats.cpu import instruction_sets


def images(height=30, width=26, seed=0):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(3, height, width, generator=generator, dtype=torch.float64)
    noise = 0.2 * torch.randn(3, height, width, generator=generator, dtype=torch.float64)
    return (truth + noise).clamp(0, 1), truth


def test_ssim_equals_scikit_images_where_the_window_stays_inside():
    # A zero border of at least the window makes zero padding the same as any other.
    image, truth = (torch.nn.functional.pad(x, (11, 11, 11, 11)) for x in images())
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    expected = structural_similarity(image.numpy(), truth.numpy(), channel_axis=0, full=True, **options)[1]
    assert float(mean_ssim(image, truth)) == pytest.approx(float(expected.mean()), abs=1e-7)


def test_gradient_of_ssim():
    image, truth = images(13, 12)
    image.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: mean_ssim(x, truth), image)


COUNTS = (0, 1, 3, 8, 15, 16, 17, 33, 1025, 2077)
"""No splat, parts of a vector, more than one task."""
VERTICES, FACES = 211, 310
BOX = planes.Bounds(torch.tensor([-1.0, -0.5, -1.1]), torch.tensor([1.0, 1.3, 0.9]))
needs_kernel = pytest.mark.skipif(not instruction_sets(), reason="the compiled kernel is missing")


class Case(NamedTuple):
    """Arguments of an operation by a number of splats, in float32.

    Attributes
    ----------
    differentiated : arguments whose tensors of floats have gradients to compare.
    call : calls a form with the arguments.
    tolerance : of the largest difference as part of the largest value, or of norms if ``norms``.
    """

    operation: Operation[Any, Any]
    arguments: Callable[[Callable[..., Tensor], int], tuple[Any, ...]]
    differentiated: tuple[int, ...] = ()
    call: Callable[..., Any] = lambda form, *arguments: form(*arguments)
    tolerance: float = 2e-6
    norms: bool = False


def numbers(seed: int) -> Callable[..., Tensor]:
    """Normal numbers of a shape."""
    generator = torch.Generator().manual_seed(seed)
    return lambda *shape: torch.randn(shape, generator=generator)


def unit(vectors: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vectors, dim=1)


def faces_of(count: int) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    chosen = [torch.randperm(VERTICES, generator=generator)[:3] for _ in range(count)]
    return torch.stack(chosen) if chosen else torch.empty(0, 3, dtype=torch.int64)


def bound(count: int, faces: int = FACES) -> Tensor:
    return torch.randint(0, faces, (count,), generator=torch.Generator().manual_seed(2))


def rotations(normal: Callable[..., Tensor], count: int) -> Tensor:
    return torch.linalg.qr(normal(count, 3, 3)).Q


def frames(normal: Callable[..., Tensor]) -> splats.TriangleFrames:
    return splats.TriangleFrames(
        *(value.clone() for value in splats.triangle_frames(normal(VERTICES, 3), faces_of(FACES)))
    )


def places(normal: Callable[..., Tensor], count: int) -> Tensor:
    """Positions, some outside of the box, some on its faces."""
    positions = 0.8 * normal(count, 3)
    positions[:3] = torch.stack([BOX.low, BOX.high, torch.tensor([1.0, 0.2, -1.1])])[:count]
    return positions


def places_off_faces(normal: Callable[..., Tensor], count: int) -> Tensor:
    """The same without those on faces, where releases of torch differ in the derivative of a clamped number."""
    positions = places(normal, count)
    on_face = (positions == BOX.low) | (positions == BOX.high)
    return torch.where(on_face, 0.999 * positions, positions)


def color_network(
    normal: Callable[..., Tensor], hidden: int, channels: tuple[int, int, int], samples: int
) -> planes.ColorNetwork:
    inputs = sum(channels) + planes.ENCODING_SIZE
    return planes.ColorNetwork(
        *(0.1 * normal(samples**2, width) for width in channels),
        normal(hidden, inputs) / inputs**0.5,
        normal(3, hidden) / hidden**0.5,
    )


def offset_layers(
    normal: Callable[..., Tensor], hidden: int, outputs: int, units: int | None = None, off: float = 0.0
) -> planes.OffsetLayers:
    """``units`` of the first layer, which ``off`` turns off."""
    units = hidden if units is None else units
    return planes.OffsetLayers(
        *(0.1 * normal(units) - off, normal(hidden, units) / hidden**0.5, 0.1 * normal(hidden)),
        *(normal(outputs, hidden) / hidden**0.5, normal(outputs)),
    )


def shading(form: Any, *arguments: Any) -> Tensor:
    """Compiled, with more samples than usual, which are nearer to the definition."""
    of_samples = {} if form is planes.shader.definition else {"samples": 4 * planes.SAMPLES}
    shade: planes.Shader = form(*arguments[:3], **of_samples)
    return shade(*arguments[3:])


def shader_arguments(hidden: int) -> Callable[[Callable[..., Tensor], int], tuple[Any, ...]]:
    return lambda normal, count: (
        *(normal(count, hidden), 0.3 * normal(planes.ENCODING_SIZE, hidden), normal(3, hidden) / hidden**0.5),
        *(normal(count, 3), 3 * normal(3), rotations(normal, FACES), bound(count)),
    )


def written(form: Any, layers: planes.OffsetLayers, rows: Tensor, weights: Tensor, *rest: Any) -> Tensor:
    """All rows; those that are not named keep what they have."""
    splats_named, out, table = rest
    out = out.clone()
    form(layers, planes.LinePosition(rows, weights))(out, splats_named, table)
    return out


def writer_arguments(
    units: int, hidden: int, outputs: int, off: float
) -> Callable[[Callable[..., Tensor], int], tuple[Any, ...]]:
    def make(normal: Callable[..., Tensor], count: int) -> tuple[Any, ...]:
        samples = 5
        position = planes.line_position(normal(count, 3).sigmoid(), samples)
        named = torch.randperm(count + 5, generator=torch.Generator().manual_seed(count))[:count]
        layers = offset_layers(normal, hidden, outputs, units, off)
        return layers, *position, named, torch.full((count + 5, outputs), 7.0), normal(3 * samples, units)

    return make


NETWORKS = {
    "published sizes": (128, (32, 16, 16), 128),
    "odd sizes": (7, (4, 19, 1), 9),
    "two samples": (16, (1, 2, 17), 2),
}

CASES = {
    "triangle frames": Case(
        splats.triangle_frames, lambda normal, count: (normal(VERTICES, 3), faces_of(count)), (0,)
    ),
    "turns between meshes": Case(
        splats.turns_between,
        lambda normal, count: (rotations(normal, count), rotations(normal, count)),
        (0, 1),
    ),
    "activation": Case(splats.activate, lambda normal, count: (normal(count, 3), normal(count, 4))),
    "to world, activated before": Case(
        splats.to_world,
        lambda normal, count: (
            *(frames(normal), bound(count), normal(count, 3), normal(count, 3), normal(count, 4)),
            splats.Activated(normal(count, 3).exp(), unit(normal(count, 4))),
        ),
    ),
    "to world": Case(
        splats.to_world,
        lambda normal, count: (
            frames(normal),
            bound(count),
            normal(count, 3),
            normal(count, 3),
            normal(count, 4),
        ),
        (0, 2, 3, 4),
    ),
    "points on a mesh": Case(
        splats.points_on,
        lambda normal, count: (normal(count, 3), bound(count), normal(FACES, 9), normal(FACES, 3)),
        (0,),
    ),
    "penalties": Case(
        splats.splat_penalties,
        lambda normal, count: (
            *(normal(count, 3), normal(count, 3) - 0.5, torch.arange(count) % 3 > 0, (1.0, 0.6), (0.01, 2.0)),
        ),
        (0, 1),
    ),
    "directions": Case(
        splats.directions_to,
        lambda normal, count: (normal(count, 3), 3 + normal(3), normal(FACES, 3, 3), bound(count)),
        (0,),
        tolerance=1e-5,
    ),
    "rotated directions": Case(
        splats.directions_to,
        lambda normal, count: (
            normal(count, 3),
            3 + normal(3),
            normal(FACES, 3, 3),
            bound(count),
            normal(3, 3),
        ),
        (0,),
        tolerance=1e-5,
    ),
    **{
        f"harmonics of degree {degree}": Case(
            planes.harmonic_colors,
            lambda normal, count, degree=degree: (
                normal(count, 3),
                normal(count, 3, 15),
                normal(count, 3),
                degree,
            ),
            (0, 1, 2),
        )
        for degree in range(4)
    },
    **{
        f"harmonic shader of degree {degree}, {'turned' if turned else 'in the world'}": Case(
            planes.harmonic_shader,
            lambda normal, count, degree=degree, turned=turned: (
                *(
                    normal(count, 3),
                    0.3 * normal(count, 3, (degree + 1) ** 2 - 1),
                    normal(count, 3),
                    3 * normal(3),
                ),
                *((rotations(normal, FACES), bound(count)) if turned else ()),
            ),
            call=lambda form, dc, rest, *seen: form(dc, rest)(*seen),
            tolerance=1e-5,
        )
        for degree in range(4)
        for turned in (False, True)
    },
    "harmonics without coefficients to spare": Case(
        planes.harmonic_colors,
        lambda normal, count: (normal(count, 3), normal(count, 3, 3), normal(count, 3), 1),
        (0, 1, 2),
    ),
    **{
        f"photometric loss, {name}": Case(
            photometric.photometric_loss,
            lambda normal, count, size=size, weight=weight: (
                *(normal(*size, 3).sigmoid(), normal(*size, 3).sigmoid(), weight),
            ),
            (0,),
        )
        for name, size, weight in (
            ("usual", (131, 70), 0.2),
            ("SSIM alone, smaller than the window", (5, 7), 1.0),
            ("L1 alone, one column", (100, 1), 0.0),
        )
    },
    **{
        f"plane colours, {name}": Case(
            planes.plane_colors,
            lambda normal, count, sizes=sizes: (
                *(
                    places_off_faces(normal, count),
                    unit(normal(count, 3)),
                    BOX,
                    color_network(normal, *sizes),
                ),
            ),
            (0, 1, 3),
            tolerance=2e-5,
            norms=True,
        )
        for name, sizes in NETWORKS.items()
    },
    **{
        f"line offsets, {name}, {outputs}": Case(
            planes.line_offsets,
            lambda normal, count, hidden=hidden, samples=samples, outputs=outputs: (
                *(
                    places(normal, count),
                    BOX,
                    normal(3 * samples, hidden),
                    offset_layers(normal, hidden, outputs),
                ),
            ),
            (2, 3),
            tolerance=2e-5,
            norms=True,
        )
        for name, (hidden, _, samples) in NETWORKS.items()
        for outputs in (1, 5)
    },
    **{
        f"shader, {hidden} units": Case(planes.shader, shader_arguments(hidden), call=shading, tolerance=1e-4)
        for hidden in (1, 8, 16, 40, 128)
    },
    **{
        f"offset writer, {units}, {hidden}, {outputs}, {off:g}": Case(
            planes.offset_writer, writer_arguments(units, hidden, outputs, off), call=written, tolerance=1e-5
        )
        for units, hidden in ((1, 1), (16, 48), (30, 16), (128, 128))
        for outputs in (1, 13)
        for off in (0.0, 3.0, 100.0)
    },
}


def run(case: Case, form: Any, arguments: tuple[Any, ...], dtype: torch.dtype) -> list[Tensor]:
    """Outputs, and gradients of a fixed weighting of them."""
    leaves: list[Tensor] = []

    def copied(value: Any, differentiated: bool) -> Any:
        if not isinstance(value, Tensor) or not value.is_floating_point():
            return value
        copy = value.detach().to(dtype, copy=True).requires_grad_(differentiated)
        leaves.extend([copy] if differentiated else [])
        return copy

    given = [
        tree_map(lambda value, place=place: copied(value, place in case.differentiated), argument)
        for place, argument in enumerate(arguments)
    ]
    outputs = tree_flatten(case.call(form, *given))[0]
    if not leaves:
        return outputs
    # Every third splat has no gradient.
    weights = [numbers(9)(*value.shape).to(value) for value in outputs]
    for weight in weights:
        if weight.ndim:
            weight[::3] = 0
    weighted = sum((value * weight).sum() for value, weight in zip(outputs, weights))
    gradients = torch.autograd.grad(weighted, leaves, allow_unused=True, materialize_grads=True)
    return [*(value.detach() for value in outputs), *gradients]


@needs_kernel
@pytest.mark.parametrize("name", CASES)
def test_the_compiled_form_is_its_definition_with_gradients(name: str) -> None:
    case = CASES[name]
    order = 2 if case.norms else float("inf")
    for count in COUNTS:
        arguments = case.arguments(numbers(count), count)
        expected = run(case, case.operation.definition, arguments, torch.float64)
        for backend in instruction_sets():
            with kernel.backend(backend):
                found = run(case, case.operation.kernel_form, arguments, torch.float32)
            for one, other in zip(found, expected, strict=True):
                assert one.shape == other.shape
                if one.numel():
                    off, size = (torch.linalg.vector_norm(v.flatten(), order) for v in (one - other, other))
                    allowed = case.tolerance * max(float(size), 1e-6)
                    assert float(off) <= allowed, (backend, count, float(off / size))


@needs_kernel
@pytest.mark.parametrize("name", CASES)
def test_bits_do_not_depend_on_the_number_of_threads(name: str) -> None:
    case = CASES[name]
    arguments = case.arguments(numbers(0), 9000)
    found = []
    for threads in (1, 2, 3):
        with torch_threads(threads):
            found.append(run(case, case.operation.kernel_form, arguments, torch.float32))
    for other in found[1:]:
        assert all(torch.equal(one, two) for one, two in zip(found[0], other, strict=True))


def test_every_operation_is_compared() -> None:
    modules = (photometric, planes, splats)
    found = {value for module in modules for value in vars(module).values() if isinstance(value, Operation)}
    assert found == {case.operation for case in CASES.values()}


def test_the_definition_runs_where_the_kernel_takes_no_tensor() -> None:
    vertices, faces = numbers(0)(VERTICES, 3).double(), faces_of(FACES)
    found, expected = (
        form(vertices, faces) for form in (splats.triangle_frames, splats.triangle_frames.definition)
    )
    assert all(torch.equal(one, other) for one, other in zip(found, expected))


@needs_kernel
@pytest.mark.parametrize("backend", instruction_sets())
def test_a_triangle_without_area_has_a_finite_frame(backend: str) -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 0, 0]])
    with kernel.backend(backend):
        found = splats.triangle_frames(vertices, faces)
    for one, other in zip(found, splats.triangle_frames.definition(vertices, faces)):
        assert torch.isfinite(one).all()
        torch.testing.assert_close(one, other, rtol=0, atol=1e-6)


@needs_kernel
def test_degenerate_splats_and_triangles_have_finite_gradients() -> None:
    vertices = torch.zeros(3, 3)
    of_triangles = splats.triangle_frames(vertices.requires_grad_(), torch.tensor([[0, 1, 2], [0, 0, 1]]))
    local = [torch.zeros(4, 3, requires_grad=True), torch.full((4, 3), -200.0, requires_grad=True)]
    quats = torch.zeros(4, 4, requires_grad=True)
    world = splats.to_world(of_triangles, torch.tensor([0, 1, 1, 0]), *local, quats)
    colors = planes.harmonic_colors(torch.ones(4, 3), torch.ones(4, 3, 15), world.means, 3)
    sum(value.sum() for value in (*world, colors)).backward()
    for leaf in (vertices, *local, quats):
        assert leaf.grad is not None
        assert torch.isfinite(leaf.grad).all()
    assert torch.isfinite(world.scales).all()


@needs_kernel
@pytest.mark.parametrize(
    ("name", "place", "values"),
    [
        ("triangle frames", 1, torch.tensor([[0, 1, -1]])),
        ("triangle frames", 1, torch.tensor([[0, 1, VERTICES]])),
        ("to world", 1, torch.tensor([-1])),
        ("to world", 1, torch.tensor([FACES])),
        ("plane colours, odd sizes", 1, torch.ones(2, 3)),
        ("offset writer, 16, 48, 1, 0", 1, torch.tensor([[0, 5, -1, 1, 6, 0]])),
        ("offset writer, 16, 48, 1, 0", 1, torch.tensor([[0, 5, 14, 1, 6, 15]])),
    ],
)
def test_what_would_read_beyond_an_array_is_refused(name: str, place: int, values: Tensor) -> None:
    case = CASES[name]
    arguments = list(case.arguments(numbers(0), 1))
    arguments[place] = values
    with pytest.raises(ValueError, match="fit"):
        case.call(case.operation.kernel_form, *arguments)


@needs_kernel
@pytest.mark.parametrize(
    "out",
    [
        torch.zeros(4, 3, dtype=torch.float64).numpy(),
        torch.zeros(3, 4).t().numpy(),
        torch.zeros(5, 3).numpy(),
        torch.zeros(12).numpy(),
        None,
    ],
    ids=["another type", "columns", "more rows", "another rank", "none"],
)
def test_memory_for_results_that_does_not_fit_is_refused(out: Any) -> None:
    normal = numbers(0)
    with pytest.raises(ValueError, match="array 3 does not fit"):
        kernel.call("activate", normal(4, 3), normal(4, 4), out, torch.zeros(4, 4))

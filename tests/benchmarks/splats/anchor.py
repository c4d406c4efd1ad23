"""The anchor of the speed bench: a plain tile rasteriser in numba, as one would write it in an afternoon.

Scalar loops over splats and pixels, tiles touched by the bounding box, one thread. It has the renderer's constants and
draws the same image. Its backward pass ends at the 2D means, inverse covariances, opacities and colours: leaving out the
rest flatters it. numba is the optional extra ``bench`` and is imported when `load` is called.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ....bench.contracts import FloatArray, IntArray
from ....bench.errors import UnavailableError, install_extra
from ....methods.splats.constants import ALPHA_MAX, ALPHA_MIN, FRUSTUM_MARGIN, TILE, TRANSMITTANCE_MIN
from .scenes import Scene

EPS2D = 0.3
NEAR = 0.01


class AnchorFrame(NamedTuple):
    """What the backward pass needs of the forward pass, and the image."""

    image: FloatArray  # (H, W, C) float32
    transmittance: FloatArray  # (H, W)
    last: IntArray  # (H, W) one past the pixel's last splat in `lists`
    means2d: FloatArray  # (N, 2)
    conics: FloatArray  # (N, 3) inverse covariances: xx, xy, yy
    starts: IntArray  # (tiles + 1,)
    lists: IntArray  # splats, tile by tile, each by depth


class AnchorGradients(NamedTuple):
    """Gradients of what was drawn; see the module's text for what is left out."""

    means2d: FloatArray  # (N, 2)
    conics: FloatArray  # (N, 3)
    opacities: FloatArray  # (N,)
    colors: FloatArray  # (N, C)


class Anchor(NamedTuple):
    """The two passes, compiled."""

    forward: Callable[[Scene], AnchorFrame]
    backward: Callable[[Scene, AnchorFrame, FloatArray], AnchorGradients]


@functools.cache
def load() -> Anchor:
    """Compile the anchor. Raises `UnavailableError` where numba is missing."""
    try:
        import numba
    except ImportError as error:
        raise UnavailableError(f"The anchor needs numba: {error}.", install_extra("bench")) from error
    compiled: dict[str, Any] = {
        function.__name__: numba.njit(error_model="numpy")(function)
        for function in (_project, _fill_tiles, _draw, _draw_backward)
    }

    def forward(scene: Scene) -> AnchorFrame:
        means, quats, scales, opacities, colors, view, K, background = _arrays(scene)
        depths, means2d, conics, extents = compiled["_project"](
            means, quats, scales, opacities, view, K, scene.width, scene.height
        )
        order = np.argsort(depths, kind="stable")
        starts, lists = compiled["_fill_tiles"](order, means2d, extents, scene.width, scene.height)
        image, light, last = compiled["_draw"](
            means2d, conics, opacities, colors, background, starts, lists, scene.width, scene.height
        )
        return AnchorFrame(image, light, last, means2d, conics, starts, lists)

    def backward(scene: Scene, frame: AnchorFrame, upstream: FloatArray) -> AnchorGradients:
        _, _, _, opacities, colors, _, _, background = _arrays(scene)
        drawn = (frame.means2d, frame.conics, opacities, colors, background, frame.starts, frame.lists)
        return AnchorGradients(*compiled["_draw_backward"](*drawn, frame.transmittance, frame.last, upstream))

    return Anchor(forward, backward)


def _arrays(scene: Scene) -> tuple[FloatArray, ...]:
    tensors = (*scene[:7], scene.background)
    return tuple(np.ascontiguousarray(value.detach().numpy(), np.float32) for value in tensors)


def _project(means, quats, scales, opacities, view, K, width, height):
    """Depths (infinite where culled), 2D means, inverse covariances, half sizes of the bounding boxes."""
    count = len(means)
    depths = np.full(count, np.inf, np.float32)
    means2d = np.zeros((count, 2), np.float32)
    conics = np.zeros((count, 3), np.float32)
    extents = np.zeros((count, 2), np.float32)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin = FRUSTUM_MARGIN * 0.5
    for n in range(count):
        m = means[n]
        x = view[0, 0] * m[0] + view[0, 1] * m[1] + view[0, 2] * m[2] + view[0, 3]
        y = view[1, 0] * m[0] + view[1, 1] * m[1] + view[1, 2] * m[2] + view[1, 3]
        z = view[2, 0] * m[0] + view[2, 1] * m[1] + view[2, 2] * m[2] + view[2, 3]
        if z <= NEAR or opacities[n] < ALPHA_MIN:
            continue
        slope_x = min(max(x / z, (-cx - margin * width) / fx), (width - cx + margin * width) / fx)
        slope_y = min(max(y / z, (-cy - margin * height) / fy), (height - cy + margin * height) / fy)
        q = quats[n] / math.sqrt((quats[n] * quats[n]).sum())
        w, i, j, k = q[0], q[1], q[2], q[3]
        rotation = np.array(
            [
                [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
                [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
                [2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)],
            ],
            np.float32,
        )
        xx, xy, yy = np.float32(EPS2D), np.float32(0), np.float32(EPS2D)
        for a in range(3):
            axis_x = axis_y = axis_z = np.float32(0)
            for b in range(3):
                r = rotation[b, a] * scales[n, a]
                axis_x += view[0, b] * r
                axis_y += view[1, b] * r
                axis_z += view[2, b] * r
            u = fx / z * (axis_x - slope_x * axis_z)
            v = fy / z * (axis_y - slope_y * axis_z)
            xx += u * u
            xy += u * v
            yy += v * v
        determinant = xx * yy - xy * xy
        if determinant <= 0:
            continue
        level = 2 * math.log(opacities[n] / ALPHA_MIN)
        extent_x, extent_y = math.sqrt(level * xx), math.sqrt(level * yy)
        mean_x, mean_y = fx * x / z + cx, fy * y / z + cy
        if mean_x + extent_x < 0 or mean_x - extent_x > width:
            continue
        if mean_y + extent_y < 0 or mean_y - extent_y > height:
            continue
        depths[n] = z
        means2d[n, 0], means2d[n, 1] = mean_x, mean_y
        conics[n, 0], conics[n, 1], conics[n, 2] = yy / determinant, -xy / determinant, xx / determinant
        extents[n, 0], extents[n, 1] = extent_x, extent_y
    return depths, means2d, conics, extents


def _fill_tiles(order, means2d, extents, width, height):
    """Lists of splats by tile, in the order given: counted first, then filled. Culled splats have no extent."""
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    counts = np.zeros(columns * rows + 1, np.int64)
    lists = np.empty(0, np.int32)
    for filling in range(2):
        if filling:
            lists = np.empty(counts.sum(), np.int32)
            counts[1:] = np.cumsum(counts[:-1])
            counts[0] = 0
        for n in order:
            if extents[n, 0] == 0:
                continue
            x0 = max(int((means2d[n, 0] - extents[n, 0]) // TILE), 0)
            x1 = min(int((means2d[n, 0] + extents[n, 0]) // TILE), columns - 1)
            y0 = max(int((means2d[n, 1] - extents[n, 1]) // TILE), 0)
            y1 = min(int((means2d[n, 1] + extents[n, 1]) // TILE), rows - 1)
            for y in range(y0, y1 + 1):
                for x in range(x0, x1 + 1):
                    tile = y * columns + x
                    if filling:
                        lists[counts[tile]] = n
                    counts[tile] += 1
    # Every start was moved to the end of its list, which is the next one's start.
    counts[1:] = counts[:-1].copy()
    counts[0] = 0
    return counts, lists


def _draw(means2d, conics, opacities, colors, background, starts, lists, width, height):
    """Composite every pixel front to back."""
    channels, columns = colors.shape[1], (width + TILE - 1) // TILE
    image = np.zeros((height, width, channels), np.float32)
    light = np.ones((height, width), np.float32)
    last = np.zeros((height, width), np.int64)
    for tile in range(len(starts) - 1):
        left, top = tile % columns * TILE, tile // columns * TILE
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                remaining = np.float32(1)
                last[y, x] = starts[tile]
                for k in range(starts[tile], starts[tile + 1]):
                    n = lists[k]
                    dx, dy = x + np.float32(0.5) - means2d[n, 0], y + np.float32(0.5) - means2d[n, 1]
                    half = np.float32(0.5) * (conics[n, 0] * dx * dx + conics[n, 2] * dy * dy)
                    alpha = opacities[n] * math.exp(-half - conics[n, 1] * dx * dy)
                    if alpha < np.float32(ALPHA_MIN):
                        continue
                    alpha = min(alpha, np.float32(ALPHA_MAX))
                    after = remaining * (np.float32(1) - alpha)
                    if after <= np.float32(TRANSMITTANCE_MIN):
                        break
                    for c in range(channels):
                        image[y, x, c] += alpha * remaining * colors[n, c]
                    remaining = after
                    last[y, x] = k + 1
                light[y, x] = remaining
                for c in range(channels):
                    image[y, x, c] += remaining * background[c]
    return image, light, last


def _draw_backward(
    means2d, conics, opacities, colors, background, starts, lists, transmittance, last, upstream
):
    """Differentiate `_draw`, every pixel back to front."""
    height, width, channels = upstream.shape
    columns = (width + TILE - 1) // TILE
    d_means2d, d_conics = np.zeros_like(means2d), np.zeros_like(conics)
    d_opacities, d_colors = np.zeros_like(opacities), np.zeros_like(colors)
    for tile in range(len(starts) - 1):
        left, top = tile % columns * TILE, tile // columns * TILE
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                remaining = transmittance[y, x]
                behind = np.float32(0)
                for c in range(channels):
                    behind += remaining * background[c] * upstream[y, x, c]
                for k in range(last[y, x] - 1, starts[tile] - 1, -1):
                    n = lists[k]
                    dx, dy = x + np.float32(0.5) - means2d[n, 0], y + np.float32(0.5) - means2d[n, 1]
                    half = np.float32(0.5) * (conics[n, 0] * dx * dx + conics[n, 2] * dy * dy)
                    falloff = math.exp(-half - conics[n, 1] * dx * dy)
                    raw = opacities[n] * falloff
                    if raw < np.float32(ALPHA_MIN):
                        continue
                    alpha = min(raw, np.float32(ALPHA_MAX))
                    remaining /= np.float32(1) - alpha
                    along = np.float32(0)
                    for c in range(channels):
                        along += colors[n, c] * upstream[y, x, c]
                        d_colors[n, c] += alpha * remaining * upstream[y, x, c]
                    d_alpha = remaining * along - behind / (np.float32(1) - alpha)
                    behind += alpha * remaining * along
                    if raw > np.float32(ALPHA_MAX):
                        continue
                    d_opacities[n] += falloff * d_alpha
                    v = alpha * d_alpha
                    d_means2d[n, 0] += v * (conics[n, 0] * dx + conics[n, 1] * dy)
                    d_means2d[n, 1] += v * (conics[n, 1] * dx + conics[n, 2] * dy)
                    d_conics[n, 0] -= np.float32(0.5) * v * dx * dx
                    d_conics[n, 1] -= v * dx * dy
                    d_conics[n, 2] -= np.float32(0.5) * v * dy * dy
    return d_means2d, d_conics, d_opacities, d_colors

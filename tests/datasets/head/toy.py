"""A small random head in FLAME's layout for tests: everything a real one has, in a few hundred vertices."""

import numpy as np

from headbench.datasets.head.arrays import HeadArrays

_LATITUDES = 13
_MOUTH_ROW = 8  # row of the upper lip, counted from the crown


def toy_head(
    n: int = 24,
    *,
    seed: int = 0,
    shape_size: int = 6,
    expression_size: int = 8,
    eyelids: bool = False,
    version: str = "toy",
    dtype: type = np.float64,
) -> HeadArrays:
    """Make a closed head with a mouth pocket, eyeballs, lips, regions and random smooth bases, V = 13 n + 2 + 2 (2 n + 2).

    ``n`` (a multiple of 8, at least 16) are the vertices around it; it is about 0.2 m high, near the origin, +y up,
    +z front, +x the subject's left.
    """
    rng = np.random.default_rng(seed)
    skin, skin_faces = _sphere(_LATITUDES, n)
    front = np.arange(n) * 2 * np.pi / n  # 0 is straight ahead
    front = np.where(front > np.pi, front - 2 * np.pi, front)
    mouth = np.flatnonzero(np.abs(front) < 0.55)
    mouth = mouth[np.argsort(front[mouth])]
    upper, middle, lower = (1 + (_MOUTH_ROW + k) * n + mouth for k in range(3))

    skin = skin * np.array([0.075, 0.11, 0.09])
    between = 0.5 * (skin[upper, 1] + skin[lower, 1])
    skin[upper, 1], skin[lower, 1] = between + 0.003, between - 0.003
    skin[middle, 1] = between
    skin[middle, 2] -= 0.03  # the pocket behind the lips
    ball, ball_faces = _sphere(2, n)
    centers = np.array([[0.03, 0.025, 0.076], [-0.03, 0.025, 0.076]])
    count, ball_count = len(skin), len(ball)
    template = np.concatenate([skin, *(center + 0.012 * ball for center in centers)])
    faces = np.concatenate([skin_faces, ball_faces + count, ball_faces + count + ball_count])

    regions = _regions(skin, np.tile(front, _LATITUDES), n)
    regions["left_eyeball"] = np.arange(count, count + ball_count)
    regions["right_eyeball"] = np.arange(count + ball_count, count + 2 * ball_count)
    regions["lips"] = np.sort(np.concatenate([upper, middle, lower]))
    regions["lip_outside_ring_upper"], regions["lip_outside_ring_lower"] = upper, lower

    weights = _weights(template, regions, lower)
    regressor = _regressor(template, regions, weights)
    total = len(template)
    return HeadArrays(
        version=version,
        template=template.astype(dtype),
        faces=faces,
        shape_basis=_smooth(template, shape_size, 0.006, rng).astype(dtype),
        expression_basis=_smooth(template, expression_size, 0.003, rng).astype(dtype),
        pose_basis=_smooth(template, 36, 0.002, rng).astype(dtype),
        joint_regressor=regressor.astype(dtype),
        skinning_weights=weights.astype(dtype),
        parents=np.array([-1, 0, 1, 1, 1]),
        eyelid_basis=rng.normal(size=(total, 3, 2)).astype(dtype) * 0.001 if eyelids else None,
        regions=regions,
        landmarks={"nose_tip": int(1 + 6 * n), "chin": int(1 + 11 * n)},
    ).validate("toy head")


def _sphere(latitudes: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere with poles on y: crown, ``latitudes`` rows of ``n`` from +z towards +x, chin pole."""
    polar = np.pi * np.arange(1, latitudes + 1) / (latitudes + 1)
    around = 2 * np.pi * np.arange(n) / n
    rows = np.stack(
        [
            np.sin(polar)[:, None] * np.sin(around),
            np.cos(polar)[:, None] * np.ones(n),
            np.sin(polar)[:, None] * np.cos(around),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = np.concatenate([[[0.0, 1.0, 0.0]], rows, [[0.0, -1.0, 0.0]]])
    here, right = np.arange(n), (np.arange(n) + 1) % n
    triangles = [np.stack([np.zeros(n, int), 1 + here, 1 + right], 1)]
    for row in range(latitudes - 1):
        a, b = 1 + row * n + here, 1 + row * n + right
        triangles += [np.stack([a, a + n, b], 1), np.stack([b, a + n, b + n], 1)]
    last = 1 + (latitudes - 1) * n
    triangles.append(np.stack([last + here, np.full(n, len(vertices) - 1), last + right], 1))
    return vertices, np.concatenate(triangles)


def _regions(skin: np.ndarray, front: np.ndarray, n: int) -> dict[str, np.ndarray]:
    angle = np.concatenate([[np.pi], front, [np.pi]])
    height = skin[:, 1]
    face = (np.abs(angle) < 1.4) & (height < 0.06) & (height > -0.085)
    eye = (np.abs(np.abs(angle) - 0.45) < 0.35) & (np.abs(height - 0.025) < 0.02)
    masks = {
        "face": face,
        "eye_region": eye,
        "left_eye_region": eye & (skin[:, 0] > 0),
        "right_eye_region": eye & (skin[:, 0] < 0),
        "forehead": face & (height > 0.035),
        "nose": (np.abs(angle) < 0.3) & (height < 0.02) & (height > -0.03),
        "left_ear": (np.abs(angle - 1.6) < 0.15) & (np.abs(height) < 0.03),
        "right_ear": (np.abs(angle + 1.6) < 0.15) & (np.abs(height) < 0.03),
        "neck": height < -0.09,
        "scalp": ((np.abs(angle) > 1.3) | (height > 0.05)) & (height > -0.06),
    }
    return {name: np.flatnonzero(mask) for name, mask in masks.items()}


def _weights(template: np.ndarray, regions: dict[str, np.ndarray], lower: np.ndarray) -> np.ndarray:
    """Neck low down, jaw at the lower front, eyeballs rigid."""
    x, y, z = template.T
    root = np.clip((-0.07 - y) / 0.04, 0, 1) * 0.8
    jaw = (1 - root) * np.clip((-0.03 - y) / 0.03, 0, 1) * np.clip((z + 0.01) / 0.06, 0, 1)
    jaw[lower] = 1 - root[lower]
    jaw[regions["lip_outside_ring_upper"]] *= 0.1
    weights = np.stack([root, 1 - root - jaw, jaw, np.zeros_like(x), np.zeros_like(x)], axis=1)
    weights[regions["left_eyeball"]] = [0, 0, 0, 1, 0]
    weights[regions["right_eyeball"]] = [0, 0, 0, 0, 1]
    return weights


def _regressor(template: np.ndarray, regions: dict[str, np.ndarray], weights: np.ndarray) -> np.ndarray:
    """Convex combinations: eyes at the balls' centres, the others near where they belong."""
    rows = []
    for target in ([0, -0.12, -0.03], [0, -0.07, -0.03], [0, -0.01, 0.0]):
        nearness = np.exp(-np.sum((template - target) ** 2, axis=1) / 0.05**2)
        rows.append(nearness / nearness.sum())
    for side in ("left", "right"):
        row = np.zeros(len(template))
        row[regions[f"{side}_eyeball"]] = 1 / len(regions[f"{side}_eyeball"])
        rows.append(row)
    return np.stack(rows)


def _smooth(template: np.ndarray, count: int, scale: float, rng: np.random.Generator) -> np.ndarray:
    """Random smooth displacement fields (V, 3, count), `scale` metres in size: a few plane waves each."""
    waves = rng.normal(size=(4, 3, 3, count)) * 12
    phases = rng.uniform(0, 2 * np.pi, size=(4, 3, count))
    fields = np.sin(np.einsum("vi,wiak->wvak", template, waves) + phases[:, None])
    return scale * fields.mean(axis=0)

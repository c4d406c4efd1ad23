"""A head of the structure of FLAME's files: its mouth, its masks, its eyelid files; with invented shapes and few vertices.

As in the real ``FLAME_masks.pkl`` the lips are a band of eight rows of vertices around the mouth, all of which belong to the
face, too; behind them lies a wall that is in no mask and ends in a hole.
"""

from pathlib import Path

import numpy as np

from headbench.datasets.head.arrays import HeadArrays
from headbench.datasets.head.loaders import EYELID_FILES, MASKS_FILE

from .flame_files import legacy_pickle, write_flame

SIDES = 32
WALL, LIPS, FACE, SKULL = 3, 8, 6, 8
"""Rows of vertices: inside the mouth, the lips, the face around them, the rest of the head."""
UPPER, LOWER = WALL + LIPS - 1 - 3, WALL + LIPS - 1 - 2
"""Rows of GaussianAvatars' rings: three and two edges inside the lips' outer border."""
LID = 0.008
"""Metres by which a closed lid moves."""


def row(number: int) -> np.ndarray:
    """(32,) vertices of a row; 0 lies at the subject's left corner of the mouth, 8 above, 16 at the right corner."""
    return number * SIDES + np.arange(SIDES)


def rings() -> tuple[np.ndarray, np.ndarray]:
    """The rings that GaussianAvatars' rule gives, (15,) each, from the subject's left to the right."""
    return row(UPPER)[1:16], row(LOWER)[:16:-1]


def stand_in(version: str = "flame2020") -> HeadArrays:
    """The head without regions and eyelids, as its pickle holds it: 300 identity and 100 expression directions."""
    template, faces = _mesh()
    rng = np.random.default_rng(5)
    bases = np.zeros((len(template), 3, 400))
    for column in [*range(8), *range(300, 308)]:
        centre = template[rng.integers(len(template))]
        near = np.exp(-((template - centre) ** 2).sum(axis=1) / (2 * 0.04**2))
        bases[:, :, column] = near[:, None] * rng.normal(size=3) * 0.002
    left, right = _balls()
    weights = np.zeros((len(template), 5))
    weights[:, 2] = (template[:, 2] > 0.02) / (1 + np.exp(np.clip((template[:, 1] + 0.04) / 0.0008, -50, 50)))
    # Within the lips the half of the row decides, as they touch.
    angle = np.arange(SIDES)
    for number in range(WALL + LIPS):
        weights[row(number), 2] = np.where((angle > 16) | (angle == 0), 0.95, 0.05)
    weights[:, 1] = 1 - weights[:, 2]
    weights[left], weights[right] = [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]
    regressor = np.zeros((5, len(template)))
    low, back = np.argsort(template[:, 1])[:20], np.argsort(template[:, 2])[:20]
    for joint, members in enumerate((low, back, row(0), left, right)):
        regressor[joint, members] = 1 / len(members)
    return HeadArrays(
        version,
        template,
        faces,
        bases[:, :, :300],
        bases[:, :, 300:],
        np.zeros((len(template), 3, 36)),
        regressor,
        weights,
        np.array([-1, 0, 1, 1, 1]),
    )


def masks() -> dict[str, np.ndarray]:
    """``FLAME_masks.pkl``: its fourteen regions."""
    x, y, _ = _mesh()[0].T
    lips = np.concatenate([row(number) for number in range(WALL, WALL + LIPS)])
    face = np.arange(WALL * SIDES, (WALL + LIPS + FACE) * SIDES)
    skull = np.arange((WALL + LIPS + FACE) * SIDES, (WALL + LIPS + FACE + SKULL) * SIDES)
    outer = np.setdiff1d(face, lips)
    left, right = _balls()
    lids = [outer[np.hypot(x[outer] - side * 0.03, y[outer] - 0.025) < 0.02] for side in (1, -1)]
    return {
        "eye_region": np.union1d(*lids),
        "left_eye_region": lids[0],
        "right_eye_region": lids[1],
        "neck": skull[y[skull] < -0.06],
        "left_eyeball": left,
        "right_eyeball": right,
        "left_ear": skull[x[skull] > 0.06],
        "right_ear": skull[x[skull] < -0.06],
        "forehead": outer[y[outer] > 0.04],
        "lips": lips,
        "nose": outer[(np.abs(x[outer]) < 0.015) & (y[outer] < 0.01) & (y[outer] > -0.03)],
        "scalp": skull[y[skull] > 0.02],
        "boundary": row(WALL + LIPS + FACE + SKULL - 1),
        "face": face,
    }


def lids() -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) metres by which a closed left and right lid moves."""
    template, _ = _mesh()
    bases = []
    for side in (1, -1):
        near = np.exp(-((template[:, :2] - [0.03 * side, 0.04]) ** 2).sum(axis=1) / (2 * 0.012**2))
        near *= (template[:, 2] > 0) & (np.arange(len(template)) < _balls()[0][0])
        bases.append(np.stack([0 * near, -LID * near / near.max(), 0 * near], axis=1))
    return bases[0], bases[1]


def write_stand_in(
    folder: Path, name: str = "generic_model.pkl", *, with_masks: bool = True, with_eyelids: bool = True
) -> Path:
    """Write the files of the head into a folder, as Python 2 wrote FLAME's; return the pickle's path."""
    folder.mkdir(parents=True, exist_ok=True)
    if with_masks:
        (folder / MASKS_FILE).write_bytes(legacy_pickle(masks()))
    if with_eyelids:
        for file, basis in zip(EYELID_FILES, lids()):
            np.save(folder / file, basis)
    return write_flame(folder / name, stand_in())


def _mesh() -> tuple[np.ndarray, np.ndarray]:
    """Vertices, metres, +y up and +z front, and triangles: rows around the mouth, from its wall outwards; two eyeballs."""
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    x, y = np.cos(angle), np.sin(angle)
    rows = []
    for number in range(WALL):  # inwards from the lips
        depth = 0.062 + 0.006 * number
        rows.append(np.stack([0.014 * x, 0.001 * y - 0.04, np.full(SIDES, depth)], axis=1))
    for number in range(LIPS):
        share = number / (LIPS - 1)
        rows.append(
            np.stack(
                [
                    (0.015 + 0.012 * share) * x,
                    (0.0015 + 0.009 * share) * y - 0.04,
                    np.full(SIDES, 0.082 + 0.006 * np.sin(np.pi * share)),
                ],
                axis=1,
            )
        )
    for number in range(FACE + SKULL):
        polar = np.radians(24 + 136 * number / (FACE + SKULL - 1))
        share = min(1.0, (number + 1) / FACE)  # the mouth lies below the middle of the face
        height = 0.11 * np.sin(polar) * y - 0.035 * (1 - share)
        rows.append(
            np.stack([0.078 * np.sin(polar) * x, height, np.full(SIDES, 0.09 * np.cos(polar))], axis=1)
        )
    faces = []
    for number in range(len(rows) - 1):
        a, b = row(number), row(number + 1)
        right = np.roll(np.arange(SIDES), -1)
        faces += [np.stack([a, b, b[right]], axis=1), np.stack([a, b[right], a[right]], axis=1)]
    ball = 0.012 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    octahedron = np.array(
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    )
    for side in (1, -1):
        faces.append(octahedron + sum(map(len, rows)))
        rows.append(ball + [0.03 * side, 0.025, 0.07])
    return np.concatenate(rows), np.concatenate(faces)


def _balls() -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the left and the right eyeball."""
    first = (WALL + LIPS + FACE + SKULL) * SIDES
    return first + np.arange(6), first + 6 + np.arange(6)

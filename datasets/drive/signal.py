"""A driving signal as poses of a head model.

The 52 blendshapes of ARKit and MediaPipe, and their effect on a head model with jaw and eye joints. FLAME has no such
shapes. They are applied to a head that has them, the embedded one or one with ARKit's expression names such as
ICT-FaceKit's, and its vertices are transferred to the avatar's head.

Formats read:

- Live Link Face CSV. Written by Epic Games' Live Link Face for iPhone, and like it by AnimaVR/NeuroSync_Player
  (`utils/csv/save_csv.py`). Checked on alexdjulin/LiveLinkFace-CSV-Retarget-For-Motionbuilder@6492a4a1 `anim/alex_rom_3.csv`
  and AnimaVR/NeuroSync_Player@f31b8fad `livelink/animations/Sad/MySlate_167_iPhone_cal.csv`.
- MediaPipe Face Landmarker results, JavaScript. Written by google-ai-edge/mediapipe
  (`mediapipe/tasks/web/vision/face_landmarker`). Not checked on a file of the program.
- MediaPipe Face Landmarker results, Python and Unity. Written by google-ai-edge/mediapipe
  (`mediapipe/tasks/python/vision/face_landmarker.py`) and homuler/MediaPipeUnityPlugin. Not checked on a file of the program.
- Audio2Face-3D CSV. Written by NVIDIA/Audio2Face-3D-Samples
  (`scripts/audio2face_3d_api_client/a2f_3d/client/service.py`). Checked on walkoncross/NIM-audio2face-visualization@e563d13b
  `viz-threejs/assets/animation_frames.csv`.
- Audio2Face JSON. Written by NVIDIA Omniverse Audio2Face. Not checked on a file of the program.
- LAM JSON. Written by aigc3d/LAM_Audio2Expression (`models/utils.py`). Checked on aigc3d/LAM_WebRender@12174e94
  `asset/test_expression_1s.json`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

from ...bench.contracts import FloatArray, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ..head.arrays import HeadArrays
from ..head.procedural.expressions import SEMANTIC_NAMES
from ..head.procedural.model import procedural_head
from ..head.procedural.versions import VERSIONS, semantic_to_coefficients
from ..head.refit.command import target_head
from ..options import CaptureOptions
from .table import SignalTable
from .timing import Timing

POSE_PARTS = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
"""Parts of a pose beside expression and eyelids, and their numbers."""

NO_EYELIDS = "the head model has no eyelid basis"
AVATAR = "avatar"
"""Name of the avatar's own head model in ``--signal-head``."""


@dataclass(frozen=True, eq=False)
class DrivingSignal:
    """A driving signal."""

    form: str
    """Name of its format."""
    head: HeadArrays
    """Head model of its poses."""
    poses: Sequence[HeadPose]
    """One for each frame, at least one."""
    timing: Timing
    """Times of the poses."""
    unused: Mapping[str, str] = field(default_factory=dict)
    """Channels of the signal that drive nothing, each with the reason."""


@dataclass(frozen=True, eq=False)
class SignalRequest:
    """Input of a reader of signals; see `settings.DriveSettings` for the fields of the same name."""

    path: Path
    """File or folder of the signal."""
    target: HeadArrays
    """Head model of the avatar."""
    table: SignalTable | None = None
    """Content of a signal that is a table."""
    signal_head: str = ""
    map: str = ""
    sequence: str = ""
    fps: float | None = None
    options: CaptureOptions = field(default_factory=CaptureOptions)
    progress: Progress = no_progress

    @property
    def columns(self) -> SignalTable:
        """The table."""
        if self.table is None:
            raise InputError(self.path, "", "a table of numbers, or files of each frame", "a capture")
        return self.table

    def head(self, default: str = "") -> HeadArrays:
        """Head model of the signal's coefficients: the one given, or the avatar's if that is ``default`` ("" for any)."""
        if self.signal_head and self.signal_head != AVATAR:
            return _loaded(self.signal_head)
        if self.signal_head == AVATAR or default in ("", self.target.version):
            return self.target
        expected = f"the head model of the signal, as the avatar's is {self.target.version}"
        remedy = f"Signals of this format usually are of {default}. Name its file, or `{AVATAR}` if they are of the avatar's."
        raise InputError("command line", "--signal-head", expected, "none", remedy)


@lru_cache(maxsize=2)
def _loaded(name: str) -> HeadArrays:
    """A head model, which the frames of a live signal share."""
    return target_head(name, "--signal-head")


def make_poses(path: Path, head: HeadArrays, parts: Mapping[str, FloatArray]) -> list[HeadPose]:
    """Poses of (T, n) arrays by name: expression, eyelids and those of `POSE_PARTS`; missing ones are 0. Fewer
    expression coefficients than the head model has are padded with zeros; eyelids are left out if it has no basis."""
    length = len(next(iter(parts.values())))
    size = head.expression_basis.shape[2]
    lids = 0 if head.eyelid_basis is None else head.eyelid_basis.shape[2]
    columns = {name: np.zeros((length, n)) for name, n in {**POSE_PARTS, "expression": size}.items()}
    for name, values in parts.items():
        if name == "eyelids" and not lids:
            continue
        wanted = POSE_PARTS.get(name, lids if name == "eyelids" else size)
        given = values.shape[1]
        if given > wanted or (given < wanted and name != "expression"):
            expected = f"{'at most ' if name == 'expression' else ''}{wanted} coefficients of {head.version}"
            raise InputError(
                path, name, expected, str(given), "Name the signal's head model with --signal-head."
            )
        columns[name] = np.pad(values, ((0, 0), (0, wanted - given)))
    if lids:
        columns.setdefault("eyelids", np.zeros((length, lids)))
    return [
        HeadPose(head.version, **{name: values[row] for name, values in columns.items()})
        for row in range(length)
    ]


JAW_OPEN = 0.44
"""Radians of the jaw at jawOpen 1: the hinge that explains the shape of that name of ICT-FaceKit."""
JAW_SIDE = 0.10
"""Radians of the jaw about the upward axis at jawLeft 1."""
LOOK = 0.5
"""Radians of an eye at eyeLookUpLeft 1 and its like."""
RANGE = 2.0
"""Largest magnitude of a blendshape; trackers give 0 to 1, with calibration somewhat beyond."""

JOINTS: Mapping[str, Mapping[str, float]] = {
    "jawOpen": {"jaw.0": JAW_OPEN},
    "mouthClose": {"jaw.0": -JAW_OPEN},
    "jawLeft": {"jaw.1": JAW_SIDE},
    "jawRight": {"jaw.1": -JAW_SIDE},
    "eyeLookUpLeft": {"eyes.0": -LOOK},
    "eyeLookDownLeft": {"eyes.0": LOOK},
    "eyeLookInLeft": {"eyes.1": -LOOK},
    "eyeLookOutLeft": {"eyes.1": LOOK},
    "eyeLookUpRight": {"eyes.3": -LOOK},
    "eyeLookDownRight": {"eyes.3": LOOK},
    "eyeLookInRight": {"eyes.4": LOOK},
    "eyeLookOutRight": {"eyes.4": -LOOK},
}
"""Blendshapes that turn joints, by component of the pose. mouthClose keeps the lips together while the jaw opens; the jaw is
opened less instead, to no less than 0."""

SHAPES: Mapping[str, Mapping[str, float]] = {
    "eyeBlink*": {"blink_*": 1},
    "eyeSquint*": {"squint_*": 1},
    "eyeWide*": {"eye_wide_*": 1},
    "browDown*": {"brow_down_*": 1},
    "browOuterUp*": {"brow_outer_up_*": 1},
    "cheekSquint*": {"cheek_raise_*": 1},
    "noseSneer*": {"nose_sneer_*": 1},
    "mouthSmile*": {"smile_*": 1},
    "mouthFrown*": {"mouth_frown": 0.5},
    "mouthDimple*": {"dimple_*": 1},
    "mouthStretch*": {"mouth_stretch_*": 1},
    "mouthPress*": {"lip_press": 0.5},
    "mouthLowerDown*": {"lower_lip_down_*": 1},
    "mouthUpperUp*": {"upper_lip_up_*": 1},
    "mouth*": {"mouth_*": 1},
    "jawForward": {"jaw_forward": 1},
    "mouthFunnel": {"funnel": 1},
    "mouthPucker": {"pucker": 1},
    "mouthRollLower": {"lip_roll": 0.5},
    "mouthRollUpper": {"lip_roll": 0.5},
    "mouthShrugLower": {"chin_raise": 1},
    "browInnerUp": {"brow_inner_up": 1},
    "cheekPuff": {"cheek_puff": 1},
}
"""Shapes of the embedded head; ``*`` is Left and left, Right and right."""

NOT_DRIVEN = ("mouthShrugUpper", "tongueOut")
"""Blendshapes for which the embedded head has no shape."""

SIDES = ("Left", "Right")
_EMBEDDED = {
    name.replace("*", side): {shape.replace("*", side.lower()): weight for shape, weight in shapes.items()}
    for name, shapes in SHAPES.items()
    for side in (SIDES if "*" in name else ("",))
}
ARKIT = tuple(sorted({*JOINTS, *_EMBEDDED, *NOT_DRIVEN}))
"""The 52 names."""

MISSPELT = 0.85
"""Similarity to one of ARKit's names from which a column is taken for it, misspelt."""
_SPELLINGS = {name.lower(): name for name in ARKIT}


def arkit_name(name: str) -> str:
    """ARKit's name of a column, in any case, also after a dot, or with ``_L`` and ``_R`` for Left and Right; "" for others."""
    sided = re.sub("_L$", "Left", re.sub("_R$", "Right", name.rpartition(".")[2]))
    return _SPELLINGS.get(sided.replace("_", "").lower(), "")


def is_blendshapes(table: SignalTable) -> bool:
    """Whether a table has columns of ARKit's names."""
    return any(map(arkit_name, table.columns))


def read_blendshapes(request: SignalRequest) -> DrivingSignal:
    """Blendshapes of each frame with a face."""
    arkit_names = {name: arkit_name(name) for name in request.columns.columns}
    table = request.columns.with_face([name for name, arkit in arkit_names.items() if arkit])
    unused = {}
    for name in table.columns:
        if not arkit_names[name] and name != table.timing.column:
            similar = get_close_matches(name.lower(), [*_SPELLINGS], 1, MISSPELT)
            if similar:
                expected = f"ARKit's name {_SPELLINGS[similar[0]]}"
                remedy = "Use a map of columns: --map FILE.yaml."
                raise InputError(table.path, "columns", expected, repr(name), remedy)
            unused[name] = "no blendshape"
    channels: dict[str, FloatArray] = {}
    for name, arkit in arkit_names.items():
        if arkit:
            if arkit in channels:
                raise InputError(table.path, "columns", f"one column for {arkit}", "two")
            channels[arkit] = table.single(name)
    if not channels:
        raise InputError(table.path, "columns", "a column with ARKit's name of a blendshape", "none")
    for name, values in channels.items():
        if np.abs(values).max() > RANGE:
            expected = f"values of blendshapes, from {-RANGE:g} to {RANGE:g}"
            raise InputError(table.path, name, expected, f"{values[np.abs(values).argmax()]:g}")
    signal = apply_blendshapes(request, channels, table.timing)
    return replace(signal, unused={**unused, **signal.unused})


def apply_blendshapes(
    request: SignalRequest, channels: Mapping[str, FloatArray], timing: Timing
) -> DrivingSignal:
    """Poses of the head that performs the blendshapes: the one given, else the embedded one. ``channels``: (T,) values
    by ARKit's name."""
    if request.signal_head:
        head = request.head()
    elif is_embedded(request.target):
        head = request.target
    else:
        head = _embedded_head()
    parts = blendshape_parts(head)
    length = len(next(iter(channels.values())))
    sizes = {**POSE_PARTS, "expression": head.expression_basis.shape[2], "eyelids": 2}
    columns = {name: np.zeros((length, size)) for name, size in sizes.items()}
    unused = {}
    for name, values in channels.items():
        if name not in parts:
            unused[name] = f"{head.version} has no such shape"
        for part, direction in parts.get(name, {}).items():
            columns[part] += values[:, None] * direction
    columns["jaw"][:, 0] = np.maximum(columns["jaw"][:, 0], 0.0)
    return DrivingSignal("blendshapes", head, make_poses(request.path, head, columns), timing, unused)


def is_embedded(head: HeadArrays) -> bool:
    """Whether a head has the expressions of the embedded one; files of that version may have fewer."""
    if head.version not in VERSIONS:
        return False
    (expression,) = {len(parts["expression"]) for parts in _embedded_parts(head.version).values()}
    return head.expression_basis.shape[2] == expression


def blendshape_parts(head: HeadArrays) -> dict[str, dict[str, FloatArray]]:
    """Effect of each blendshape at 1 on the parts of a pose, by name: expression (E,), jaw (3,), eyes (6,), eyelids (2,)."""
    weights_by_shape: dict[str, dict[str, FloatArray]] = {
        name: _joint(weights) for name, weights in JOINTS.items()
    }
    if is_embedded(head):
        return weights_by_shape | _embedded_parts(head.version)
    columns = arkit_columns(head)
    if not columns:
        expected = "the embedded head, or one with expressions of ARKit's names such as ICT-FaceKit's"
        raise InputError("command line", "--signal-head", expected, head.version)
    for name, direction in columns.items():
        if name == "jawOpen":  # the shape replaces the joint
            weights_by_shape.pop(name)
        weights_by_shape.setdefault(name, {})["expression"] = direction
    if "jawLeft" in columns:
        del weights_by_shape["jawLeft"]["jaw"], weights_by_shape["jawRight"]["jaw"]
    return weights_by_shape


@cache
def _embedded_head() -> HeadArrays:
    return procedural_head()


@cache
def _embedded_parts(version: str) -> dict[str, dict[str, FloatArray]]:
    """Parts of the shapes of a version of the embedded head."""
    matrix, lids = semantic_to_coefficients(version)
    rotations = {}
    for name, shapes in _EMBEDDED.items():
        rows = [SEMANTIC_NAMES.index(shape) for shape in shapes]
        weights = np.array([*shapes.values()])
        rotations[name] = {"expression": weights @ matrix[rows]}
        if lids is not None:
            rotations[name]["eyelids"] = weights @ lids[rows]
    return rotations


def _joint(weights: Mapping[str, float]) -> dict[str, FloatArray]:
    """Directions of parts of a pose from weights of components such as ``jaw.0``."""
    parts: dict[str, FloatArray] = {}
    for name, weight in weights.items():
        part, index = name.split(".")
        parts.setdefault(part, np.zeros(POSE_PARTS[part]))[int(index)] += weight
    return parts


def arkit_columns(head: HeadArrays) -> dict[str, FloatArray]:
    """(E,) directions by ARKit's name of the head's named expressions; ``_L`` and ``_R`` stand for Left and Right."""
    shapes: dict[str, FloatArray] = {}
    for name, column in zip(head.expression_names, np.eye(len(head.expression_names))):
        # browInnerUp is one shape in ARKit and a pair in others
        arkit = arkit_name(name) or arkit_name(re.sub("_[LR]$", "", name))
        if arkit:
            shapes[arkit] = shapes.get(arkit, 0.0) + column
    return shapes

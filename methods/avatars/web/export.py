"""Export of an avatar as a web page, with its sliders and recorded sequences, and the loss of quality."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from ....bench.contracts import Camera, Clip, FloatArray, HeadPose, Progress, no_progress
from ....bench.engine.stored import AVATAR_FILE, HEAD_FILE
from ....bench.errors import InputError
from ....bench.experiments.extremes import head_center
from ....bench.expressions import expressions_of
from ....bench.io.files import check_writable, write_text
from ....bench.io.images import encode_image, quantise
from ....bench.io.provenance import RENDER, note, source_type, tool
from ....bench.io.style import policy_hash, stylesheet
from ....bench.protocol import evenly_with_ends
from ....bench.specs import CommandResult, ResolutionRule
from ....datasets.head.arrays import HeadArrays
from ....datasets.novelty import displacement_metric
from ...shared.avatar_files import read_shared_head
from ...shared.rendering import view_of
from ...splats import rasterize
from ..export import neutral_pose, open_splats
from ..views import direction_of, orbit_camera
from .bake import Source, bake
from .model import JOINTS, Moved, Slider, WebAvatar
from .payload import decode, encode, quaternions
from .settings import ExportHtmlSettings

JAW, JAW_SIDE, NECK, EYES = 0.4, 0.12, 0.4, 0.4
"""Radians."""
MOST_HIDDEN = 6
"""Maximum number of additional expression directions for recorded sequences, which increase the page's size."""
STILL_M = 2e-4
"""Root mean square error of vertices below which no further direction is added."""
SEQUENCES = {"train": "", "novel_view": "", "self_reenactment": "held out"}
"""Splits with frames to replay, and their description in a page."""
MOST_TIMESTEPS = 500
"""Maximum length of a sequence; longer ones are cut to limit the page's size."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recorded sequence: its poses in order, and whether it was held out of training."""

    name: str
    note: str
    poses: Sequence[HeadPose]


def recorded_sequences(clip: Clip, version: str) -> list[Recorded]:
    """The sequences of a capture in order, those held out last; none if it was tracked with another head model."""
    found: dict[tuple[str, str], dict[int, HeadPose]] = {}
    for split, remark in SEQUENCES.items():
        for key in sorted(clip.splits.get(split, ())):
            pose = clip.poses[key.timestep]
            if pose.head_model == version:
                found.setdefault((key.sequence, remark), {})[key.timestep] = pose
    return [
        Recorded(*name, [poses[timestep] for timestep in sorted(poses)][:MOST_TIMESTEPS])
        for name, poses in found.items()
    ]


def make_sliders(head: HeadArrays, count: int, poses: Sequence[HeadPose]) -> tuple[Slider, ...]:
    """The strongest expressions, then jaw, neck and eyes; then directions without a name that ``poses`` need."""
    chosen = [_expression(*shape) for shape in expressions_of(head, count, poses)]
    both = (JOINTS.index("left eye"), JOINTS.index("right eye"))
    return (
        *chosen,
        Slider("jaw open", (1,), 0, (), 0.0, JAW, 0.75 * JAW),
        Slider("jaw sideways", (1,), 1, (), -JAW_SIDE, JAW_SIDE, JAW_SIDE),
        *(
            Slider(f"neck {name}", (0,), axis, (), -NECK, NECK, 0.75 * NECK)
            for axis, name in enumerate(("nod", "turn", "tilt"))
        ),
        *(
            Slider(f"eyes {name}", both, axis, (), -EYES, EYES, 0.75 * EYES)
            for axis, name in enumerate(("up and down", "sideways"))
        ),
        *_hidden(head, chosen, poses),
    )


def slider_values(head: HeadArrays, sliders: Sequence[Slider], poses: Sequence[HeadPose]) -> FloatArray:
    """(T, M) values of the sliders that replay poses: expressions by least squares over the vertices."""
    values = np.zeros((len(poses), len(sliders)))
    columns = [number for number, slider in enumerate(sliders) if not slider.joints]
    directions = np.array([sliders[number].direction for number in columns])
    values[:, columns] = _fitted(_root(head), directions, np.array([pose.expression for pose in poses]))
    for number, slider in enumerate(sliders):
        if slider.joints:
            turns = [_turn(poses, joint)[:, slider.axis] for joint in slider.joints]
            values[:, number] = np.mean(turns, axis=0)
    return values


def packed_sequences(
    head: HeadArrays, sliders: Sequence[Slider], sequences: Sequence[Recorded]
) -> list[dict[str, Any]]:
    """The sequences for the header of a page, their values relative to the step of each slider."""
    steps = np.array([slider.step for slider in sliders])
    packed = []
    for sequence in sequences:
        values = slider_values(head, sliders, sequence.poses) / steps
        packed.append({"name": sequence.name, "note": sequence.note, "values": values.round(3).tolist()})
    return packed


def _expression(name: str, direction: FloatArray, low: float, high: float) -> Slider:
    return Slider(name, (), 0, tuple(float(value) for value in direction.round(5)), low, high, high / 2)


def _root(head: HeadArrays) -> FloatArray:
    """(E, E) R with \\|R c\\| the root mean square displacement of the vertices, metres, by coefficients c."""
    return displacement_metric(head.expression_basis).T


def _fitted(root: FloatArray, directions: FloatArray, wanted: FloatArray) -> FloatArray:
    """(T, K) values of (K, E) directions for (T, E) coefficients."""
    if not len(directions):
        return np.zeros((len(wanted), 0))
    return np.asarray(np.linalg.lstsq(root @ directions.T, root @ wanted.T, rcond=1e-6)[0].T)


def _hidden(head: HeadArrays, chosen: Sequence[Slider], poses: Sequence[HeadPose]) -> list[Slider]:
    """Principal directions of the residual of the poses' expressions after the fit by the chosen sliders."""
    if not poses:
        return []
    root, wanted = _root(head), np.array([pose.expression for pose in poses], np.float64)
    directions = np.array([slider.direction for slider in chosen]).reshape(-1, wanted.shape[1])
    left = wanted - _fitted(root, directions, wanted) @ directions
    _, sizes, axes = np.linalg.svd(left @ root.T, full_matrices=False)
    rms = np.sqrt(np.cumsum(sizes[::-1] ** 2)[::-1] / len(poses))  # residual before each direction
    found = []
    for axis in axes[: min(MOST_HIDDEN, int((rms > STILL_M).sum()))]:
        direction = np.linalg.lstsq(root, axis, rcond=1e-6)[0]
        far = float(np.abs(left @ root.T @ axis).max())
        found.append(_expression("", far * direction, -1.0, 1.0))
    return found


def _turn(poses: Sequence[HeadPose], joint: int) -> FloatArray:
    name, first = (("neck", 0), ("jaw", 0), ("eyes", 0), ("eyes", 3))[joint]
    return np.array([getattr(pose, name)[first : first + 3] for pose in poses], np.float64)


DIRECTIONS = 96
"""Number of viewing directions, evenly spread over the sphere, in which colours are sampled."""
VIEWS = ((0.0, 0.0), (0.6, 0.0), (-0.6, 0.2))
"""Azimuth and elevation, radians, of the views in which the loss is measured."""
SIZE = 320
MOST_MOMENTS = 8
"""Moments of the recorded sequences in which the loss is measured."""
PICTURE_PX, PICTURE_NEAR, PICTURE_UP = 96, 0.36, 0.02
"""Pictures of expressions: side in pixels; distance, and height above the middle, relative to the distance of the page's view."""
DISTANCE_BY_HEIGHT = 2.6
"""Distance of the camera relative to the extent of the splats."""


def export_page(settings: ExportHtmlSettings, progress: Progress = no_progress) -> CommandResult:
    """Bake, write, read back and compare; see the settings."""
    out = Path(settings.out)
    check_writable(out, "--out")
    stored, avatar = open_splats(settings)
    head = read_shared_head(stored.folder)
    rest, sequences, trained = neutral_pose(head), [], None
    if settings.capture is not None:
        clip = settings.open(settings.capture, progress)
        first = clip.poses[min(key.timestep for key in clip.splits["train"])]
        rest = replace(rest, rotation=first.rotation, translation=first.translation)
        sequences = recorded_sequences(clip, head.version)
        trained = training_images(clip, stored.record["resolution"])
    shape, size = np.asarray(stored.record["shape"]), head.shape_basis.shape[2]
    if len(shape) > size:
        expected = f"at most {size} coefficients, as {HEAD_FILE} beside it has"
        raise InputError(stored.folder / AVATAR_FILE, "shape", expected, str(len(shape)))
    shaped = head.template + head.shape_basis[..., : len(shape)] @ shape
    joints = np.asarray(head.joint_regressor @ shaped, np.float64)
    source = Source(avatar, rest, joints[0], joints[1 : 1 + len(JOINTS)])
    poses = [pose for sequence in sequences for pose in sequence.poses]
    sliders = make_sliders(head, settings.expressions, poses)
    baked = bake(source, sliders, settings.degree, DIRECTIONS, progress)
    low, high = np.quantile(baked.means, (0.005, 0.995), axis=0)
    view = {
        "distance": round(DISTANCE_BY_HEIGHT * float((high - low).max()), 4),
        "target": ((low + high) / 2).round(5).tolist(),
    }
    more = {
        "trained": trained,
        "sequences": packed_sequences(head, sliders, sequences),
        "pictures": pictures(source, sliders, view),
    }
    content = encode(baked, view, more)
    page = fill_page(content, settings.title or f"{stored.record['subject']}, {stored.record['method']}")
    write_text(out, page)
    read = decode(content)
    losses = measure_losses(source, read, view, progress)
    if poses:
        chosen = [poses[number] for number in _spread(len(poses))]
        losses["recorded"] = recorded_loss(source, read, view, chosen, slider_values(head, sliders, chosen))
    size = out.stat().st_size
    worst = min(losses, key=lambda name: losses[name])
    shown = [slider.name for slider in sliders if slider.name]
    text = f"{out}: {len(baked.means)} splats, {len(shown)} sliders, {len(sequences)} recorded sequences, {size / 1e6:.2f} MB; "
    text += "PSNR against headbench's renderer: "
    text += ", ".join(f"{name} {value:.1f}" for name, value in losses.items()) + f" dB; minimum: {worst}"
    if settings.capture is not None and not sequences:
        text += f"\nThe capture was tracked with another head model than {head.version}; the page has no sequences to play."
    data = {"out": out, "splats": len(baked.means), "bytes": size, "psnr": losses, "sliders": shown}
    return CommandResult(text, data | {"sequences": [sequence.name for sequence in sequences]})


def training_images(clip: Clip, rule: ResolutionRule) -> dict[str, Any]:
    """Size of the images of the training and the width of their pixels at the head, metres, both at the size of a rule."""
    center = head_center(clip)
    cameras = [clip.cameras[name] for name in sorted({key.camera for key in clip.splits["train"]})]
    widths = [float(np.linalg.norm(camera.center - center) / camera.K[1, 1]) for camera in cameras]
    camera = cameras[0]
    side = {"pad": max, "crop": min}.get(rule.square, lambda width, height: height)(
        camera.width, camera.height
    )
    reduced = side / (rule.size[1] if rule.size else side / rule.divide * rule.multiply)
    size = [max(1, round(length / rule.divide)) for length in (camera.width, camera.height)]
    return {"size": size, "pixel": float(f"{reduced * np.median(widths):.4g}")}


def pictures(source: Source, sliders: Sequence[Slider], view: Mapping[str, Any]) -> list[str]:
    """A small picture of the face at the upper end of each slider of an expression, as data URIs; "" for others."""
    center = np.array(view["target"]) + [0.0, PICTURE_UP * view["distance"], 0.0]
    camera = orbit_camera(direction_of(0.0, 0.0), PICTURE_NEAR * view["distance"], center, PICTURE_PX)
    found = []
    for slider in sliders:
        if slider.joints or not slider.name:
            found.append("")
            continue
        pose = source.pose([slider], [slider.high])
        image = quantise(source.avatar.render(source.camera(camera), pose).rgb)
        small = np.asarray(
            cv2.resize(image, (PICTURE_PX, PICTURE_PX), interpolation=cv2.INTER_AREA), np.uint8
        )
        encoded = encode_image(small, ".webp", (cv2.IMWRITE_WEBP_QUALITY, 80), place="a page")
        found.append(f"data:image/webp;base64,{base64.b64encode(encoded).decode()}")
    return found


def fill_page(content: bytes, title: str) -> str:
    """The self-contained page with an avatar's data, script and style; it loads nothing else."""
    from jinja2 import Environment, FileSystemLoader

    here = Path(__file__).parent
    script, own = ((here / name).read_text(encoding="utf-8") for name in ("page.js", "page.css"))
    style = stylesheet() + own
    allowed = f"script-src '{policy_hash(script)}'; style-src '{policy_hash(style)}'"
    environment = Environment(autoescape=True, loader=FileSystemLoader(here))
    return environment.get_template("page.html").render(
        policy=f"default-src 'none'; img-src data:; {allowed}; base-uri 'none'; form-action 'none'",
        tool=tool(),
        source_type=source_type(RENDER),
        note=f"Drawn by a trained model, not recorded. {note(RENDER)}",
        title=title,
        style=style,
        script=script,
        avatar=base64.b64encode(content).decode(),
    )


def measure_losses(
    source: Source, page: WebAvatar, view: Mapping[str, Any], progress: Progress
) -> dict[str, float]:
    """Minimum PSNR in dB against the avatar itself, by group of sliders, each at its ends, over `VIEWS`."""
    trials = [("rest", np.zeros(len(page.sliders)))]
    for number, slider in enumerate(page.sliders):
        if not slider.name:
            continue
        group = "expressions" if not slider.joints else slider.name.split()[0]
        for value in {slider.low, slider.high} - {0.0}:
            values = np.zeros(len(page.sliders))
            values[number] = value
            trials.append((group, values))
    # Several at once, since avatars are not necessarily additive, unlike morphs.
    names = [slider.name for slider in page.sliders if slider.name and not slider.joints][:2] + ["jaw open"]
    trials.append(("together", np.array([slider.high * (slider.name in names) for slider in page.sliders])))
    losses: dict[str, float] = {}
    for done, (group, values) in enumerate(trials):
        lost = [
            _psnr(source, page, source.pose(page.sliders, values), values, _camera(view, *angles))
            for angles in VIEWS
        ]
        losses[group] = min(losses.get(group, np.inf), *lost)
        progress(done + 1, len(trials), f"comparing, {group}")
    return losses


def recorded_loss(
    source: Source, page: WebAvatar, view: Mapping[str, Any], poses: Sequence[HeadPose], values: FloatArray
) -> float:
    """Minimum PSNR in dB of recorded poses, (T, M) values of the sliders, from the front."""
    place: dict[str, Any] = {
        "rotation": source.rest.rotation,
        "translation": source.rest.translation,
        "timestep": None,
    }
    camera = _camera(view, *VIEWS[0])
    return min(_psnr(source, page, replace(pose, **place), row, camera) for pose, row in zip(poses, values))


def _psnr(source: Source, page: WebAvatar, pose: HeadPose, values: FloatArray, camera: Camera) -> float:
    wanted = source.avatar.render(source.camera(camera), pose).rgb
    error = float(np.square(draw(page.moved(values, camera.center), camera) - wanted).mean())
    return -10 * float(np.log10(max(error, 1e-12)))


def _camera(view: Mapping[str, Any], azimuth: float, elevation: float) -> Camera:
    return orbit_camera(direction_of(azimuth, elevation), view["distance"], np.array(view["target"]), SIZE)


def _spread(count: int) -> list[int]:
    """At most `MOST_MOMENTS` numbers below ``count``, evenly spread."""
    return evenly_with_ends(range(count), MOST_MOMENTS)


def draw(moved: Moved, camera: Camera) -> FloatArray:
    """(H, W, 3) image of splats given by axes, on white, by headbench's renderer."""
    turns, scales, _ = np.linalg.svd(moved.axes)
    turns = turns * np.sign(np.linalg.det(turns))[:, None, None]
    means, quats, sizes, opacities, colors = (
        torch.from_numpy(np.asarray(values, np.float32))
        for values in (moved.means, quaternions(turns), scales, moved.opacities, moved.colors)
    )
    view = view_of(camera, "cpu", (1.0, 1.0, 1.0))
    rendering = rasterize(
        *(means, quats, sizes, opacities, colors, view.world_to_camera, view.K),
        *(camera.width, camera.height),
        background=view.background,
    )
    return np.asarray(rendering.image.clamp(0, 1).numpy())

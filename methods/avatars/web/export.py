"""Export of an avatar as a web page, with its sliders and recorded sequences, and the loss of quality."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from ....bench.contracts import Camera, Clip, FloatArray, HeadPose, Progress, no_progress
from ....bench.engine.stored import AVATAR_FILE, HEAD_FILE, StoredAvatar
from ....bench.errors import InputError
from ....bench.experiments.viewpoints import head_center
from ....bench.expressions import expressions_of
from ....bench.io.files import check_writable, write_text
from ....bench.io.images import encode_image, quantise
from ....bench.io.provenance import RENDER, note, source_type, tool
from ....bench.io.style import policy_hash, stylesheet
from ....bench.protocol import evenly_with_ends
from ....bench.specs import CommandResult, ResolutionRule, command
from ....datasets.head.arrays import HeadArrays
from ....datasets.head.rotations import matrix_to_quaternion
from ....datasets.inspect.statistics import displacement_metric
from ...shared.avatar_files import read_shared_head
from ...shared.rendering import view_of
from ...splats import rasterize
from ...splats.reference import rotation_matrices
from ..export import neutral_pose, open_splats
from ..harmonics import direction_of, extent, orbit_camera
from ..settings import ExportHtmlSettings, ExportLamSettings
from .bake import JOINTS, Moved, Slider, Source, WebAvatar, bake

FORMAT = 1
LOWEST_LOG_SCALE = -14.0
"""A micrometre; thinner splats look the same."""
LEAST = {
    "harmonics": 0.006,
    "d_means": 2e-5,
    "d_turns": 0.01,
    "d_log_scales": 0.01,
    "d_logits": 0.04,
    "d_colors": 0.004,
}
"""Minimum steps, in the units of each (metres, radians, powers of e, logits, 1); finer steps would be invisible."""
MOST_OF = 0.9995
"""Fraction of the harmonics of an order that the range of their column has to contain; a few outliers would make all
others coarse."""


def encode(avatar: WebAvatar, view: Mapping[str, Any], more: Mapping[str, Any] | None = None) -> bytes:
    """Quantise and pack. Means have 16 bits, everything else 8.

    ``view`` is the initial view: ``distance`` in metres from ``target``, (3,). ``more`` are further entries of the header,
    for the page alone.
    """
    count = len(avatar.means)
    arrays: list[dict[str, Any]] = []
    planes: list[bytes] = []

    def add(name: str, values: FloatArray, low: FloatArray, step: FloatArray, bits: int = 8) -> None:
        columns = np.asarray(values, np.float64).reshape(count, -1)
        step = np.maximum(step, 1e-12)
        levels = np.round((columns - low) / step).clip(0, 2**bits - 1).astype(np.uint16).T
        arrays.append(
            {
                "name": name,
                "bits": bits,
                "low": [float(f"{v:.7g}") for v in low],
                "step": [float(f"{v:.7g}") for v in step],
            }
        )
        for level in levels:
            planes.append((level & 255).astype(np.uint8).tobytes())
            if bits == 16:
                planes.append((level >> 8).astype(np.uint8).tobytes())

    def add_range(name: str, values: FloatArray, bits: int = 8) -> None:
        columns = values.reshape(count, -1)
        low, high = columns.min(axis=0), columns.max(axis=0)
        add(name, columns, low, (high - low) / (2**bits - 1), bits)

    def add_signed(name: str, values: FloatArray, largest: FloatArray, least: float = 0.0) -> None:
        # Level 128 is exactly 0, since most sliders do not move most splats.
        step = np.maximum(np.asarray(largest) / 127, least)
        add(name, values, -128 * step, step)

    add_range("means", avatar.means, bits=16)
    add_signed("quats", quaternions(avatar.rotations), np.ones(4))
    add_range("log_scales", avatar.log_scales.clip(min=LOWEST_LOG_SCALE))
    add_range("logits", avatar.logits[:, None])
    harmonics = avatar.harmonics.transpose(0, 2, 1)  # (N, K, 3)
    of_order = np.quantile(np.abs(harmonics), MOST_OF, axis=(0, 2))
    add_signed("harmonics", harmonics, np.repeat(of_order, 3), LEAST["harmonics"])
    add("weights", avatar.weights, np.zeros(4), np.full(4, 1 / 255))
    for number in range(len(avatar.sliders)):
        parts = {
            "d_means": avatar.d_means[number],
            "d_turns": avatar.d_turns[number],
            "d_log_scales": avatar.d_log_scales[number],
            "d_logits": avatar.d_logits[number][:, None],
            "d_colors": avatar.d_colors[number],
        }
        for name, part in parts.items():
            largest = (
                np.quantile(np.abs(part), MOST_OF, axis=0) if name != "d_means" else np.abs(part).max(axis=0)
            )
            add_signed(f"{name} {number}", part, np.full(part.shape[1], largest.max()), LEAST[name])
    header = {
        "format": FORMAT,
        "by": tool(),
        "count": count,
        "turned": avatar.turned,
        "joints": np.round(avatar.joints, 6).tolist(),
        "view": dict(view),
        **(more or {}),
        "sliders": [slider._asdict() for slider in avatar.sliders],
        "arrays": arrays,
    }
    text = json.dumps(header, separators=(",", ":")).encode()
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(b"".join([struct.pack("<I", len(text)), text, *planes])) + packer.flush()


def decode(content: bytes) -> WebAvatar:
    """Decode the bytes as a page does; the reference for its script."""
    whole = zlib.decompress(content, -15)
    (length,) = struct.unpack_from("<I", whole)
    header = json.loads(whole[4 : 4 + length])
    count, place = header["count"], 4 + length
    arrays = {}
    for array in header["arrays"]:
        columns = []
        for low, step in zip(array["low"], array["step"], strict=True):
            levels = np.frombuffer(whole, np.uint8, count, place).astype(np.float64)
            place += count
            if array["bits"] == 16:
                levels += 256.0 * np.frombuffer(whole, np.uint8, count, place)
                place += count
            columns.append(low + step * levels)
        arrays[array["name"]] = np.stack(columns, axis=1)
    sliders = tuple(
        Slider(**slider | {name: tuple(slider[name]) for name in ("joints", "direction")})
        for slider in header["sliders"]
    )
    morphs = {
        name: np.stack([arrays[f"{name} {number}"] for number in range(len(sliders))])
        for name in ("d_means", "d_turns", "d_log_scales", "d_logits", "d_colors")
    }
    return WebAvatar(
        means=arrays["means"],
        rotations=rotation_matrices(torch.from_numpy(arrays["quats"])).numpy(),
        log_scales=arrays["log_scales"],
        logits=arrays["logits"][:, 0],
        harmonics=arrays["harmonics"].reshape(count, -1, 3).transpose(0, 2, 1),
        turned=header["turned"],
        weights=arrays["weights"],
        joints=np.array(header["joints"]),
        sliders=sliders,
        **{**morphs, "d_logits": morphs["d_logits"][..., 0]},
    )


def quaternions(rotations: FloatArray) -> FloatArray:
    """(N, 4) unit quaternions wxyz of (N, 3, 3) rotations."""
    return matrix_to_quaternion(torch.from_numpy(np.ascontiguousarray(rotations))).numpy()


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
    sequences: dict[tuple[str, str], dict[int, HeadPose]] = {}
    for split, remark in SEQUENCES.items():
        for key in sorted(clip.splits.get(split, ())):
            pose = clip.poses[key.timestep]
            if pose.head_model == version:
                sequences.setdefault((key.sequence, remark), {})[key.timestep] = pose
    return [
        Recorded(*name, [poses[timestep] for timestep in sorted(poses)][:MOST_TIMESTEPS])
        for name, poses in sequences.items()
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
    hidden = []
    for axis in axes[: min(MOST_HIDDEN, int((rms > STILL_M).sum()))]:
        direction = np.linalg.lstsq(root, axis, rcond=1e-6)[0]
        far = float(np.abs(left @ root.T @ axis).max())
        hidden.append(_expression("", far * direction, -1.0, 1.0))
    return hidden


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


@command("export html", group="export")
def export_page(settings: ExportHtmlSettings, progress: Progress = no_progress) -> CommandResult:
    """Write an avatar as one HTML file with sliders for expressions and joints."""
    out = Path(settings.out)
    check_writable(out, "--out")
    stored, head, source, clip = open_source(settings, progress)
    sequences, trained = [], None
    if clip is not None:
        sequences = recorded_sequences(clip, head.version)
        trained = training_images(clip, stored.record["resolution"])
    poses = [pose for sequence in sequences for pose in sequence.poses]
    sliders = make_sliders(head, settings.expressions, poses)
    baked = bake(source, sliders, settings.degree, DIRECTIONS, progress)
    view = view_around(baked.means)
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
    names = [slider.name for slider in sliders if slider.name]
    text = f"{out}: {len(baked.means)} splats, {len(names)} sliders, {len(sequences)} recorded sequences, {size / 1e6:.2f} MB; "
    text += "PSNR against headbench's renderer: "
    text += ", ".join(f"{name} {value:.1f}" for name, value in losses.items()) + f" dB; minimum: {worst}"
    if settings.capture is not None and not sequences:
        text += f"\nThe capture was tracked with another head model than {head.version}; the page has no sequences to play."
    data = {"out": out, "splats": len(baked.means), "bytes": size, "psnr": losses, "sliders": names}
    return CommandResult(text, data | {"sequences": [sequence.name for sequence in sequences]})


class Opened(NamedTuple):
    """A stored avatar to sample."""

    stored: StoredAvatar
    head: HeadArrays
    source: Source
    clip: Clip | None
    """The capture of the settings, if one is named."""


def open_source(settings: ExportHtmlSettings | ExportLamSettings, progress: Progress) -> Opened:
    """The avatar of a command in the neutral pose, its head as in the first training frame of a capture."""
    stored, avatar = open_splats(settings)
    head = read_shared_head(stored.folder)
    rest, clip = neutral_pose(head), None
    if settings.capture is not None:
        clip = settings.open(settings.capture, progress)
        first = clip.poses[min(key.timestep for key in clip.splits["train"])]
        rest = replace(rest, rotation=first.rotation, translation=first.translation)
    shape, size = np.asarray(stored.record["shape"]), head.shape_basis.shape[2]
    if len(shape) > size:
        expected = f"at most {size} coefficients, as {HEAD_FILE} beside it has"
        raise InputError(stored.folder / AVATAR_FILE, "shape", expected, str(len(shape)))
    shaped = head.template + head.shape_basis[..., : len(shape)] @ shape
    joints = np.asarray(head.joint_regressor @ shaped, np.float64)
    return Opened(stored, head, Source(avatar, rest, joints[0], joints[1 : 1 + len(JOINTS)]), clip)


def view_around(means: FloatArray) -> dict[str, Any]:
    """The view of `encode` in which (N, 3) splats fill the picture."""
    low, high = extent(means)
    return {
        "distance": round(DISTANCE_BY_HEIGHT * float((high - low).max()), 4),
        "target": ((low + high) / 2).round(5).tolist(),
    }


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
    uris = []
    for slider in sliders:
        if slider.joints or not slider.name:
            uris.append("")
            continue
        pose = source.pose([slider], [slider.high])
        image = quantise(source.avatar.render(source.camera(camera), pose).rgb)
        small = np.asarray(
            cv2.resize(image, (PICTURE_PX, PICTURE_PX), interpolation=cv2.INTER_AREA), np.uint8
        )
        encoded = encode_image(small, ".webp", (cv2.IMWRITE_WEBP_QUALITY, 80), place="a page")
        uris.append(f"data:image/webp;base64,{base64.b64encode(encoded).decode()}")
    return uris


def fill_page(content: bytes, title: str) -> str:
    """The self-contained page with an avatar's data, script and style; it loads nothing else."""
    from jinja2 import Environment, FileSystemLoader

    here = Path(__file__).parent
    script, page_style = ((here / name).read_text(encoding="utf-8") for name in ("page.js", "page.css"))
    style = stylesheet() + page_style
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
        pose = source.pose(page.sliders, values)
        cameras = [camera_of(view, *angles) for angles in VIEWS]
        lost = [psnr(source, page.moved(values, camera.center), pose, camera) for camera in cameras]
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
    camera = camera_of(view, *VIEWS[0])
    return min(
        psnr(source, page.moved(row, camera.center), replace(pose, **place), camera)
        for pose, row in zip(poses, values)
    )


def psnr(source: Source, moved: Moved, pose: HeadPose, camera: Camera) -> float:
    """PSNR in dB of splats against the avatar in a pose, in a view of the head's frame, on white."""
    wanted = source.avatar.render(source.camera(camera), pose).rgb
    error = float(np.square(draw(moved, camera) - wanted).mean())
    return -10 * float(np.log10(max(error, 1e-12)))


def camera_of(view: Mapping[str, Any], azimuth: float, elevation: float) -> Camera:
    """A camera around the target of a view; angles in radians."""
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

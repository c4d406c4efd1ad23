"""Export of an avatar as a web page, and the loss of quality."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ....bench.contracts import Camera, FloatArray, HeadPose, Progress, no_progress
from ....bench.engine.stored import AVATAR_FILE, HEAD_FILE
from ....bench.errors import InputError
from ....bench.io.files import check_writable, write_text
from ....bench.io.provenance import RENDER, note, source_type, tool
from ....bench.specs import CommandResult
from ...shared.avatar_files import read_shared_head
from ...shared.rendering import view_of
from ...splats import rasterize
from ..export import neutral_pose, open_splats
from ..views import direction_of, orbit_camera
from .bake import Source, bake
from .model import JOINTS, Moved, Slider, WebAvatar
from .payload import decode, encode, quaternions
from .settings import ExportHtmlSettings

DIRECTIONS = 96
"""Number of viewing directions, evenly spread over the sphere, in which colours are sampled."""
COEFFICIENT = 2.0
"""Range of expression sliders without a capture: standard deviations of FLAME's coefficients."""
BEYOND = 1.5
"""Range of expression sliders with a capture, relative to the largest coefficient tracked in training."""
JAW, JAW_SIDE, NECK, EYES = 0.4, 0.12, 0.4, 0.4
"""Radians."""
VIEWS = ((0.0, 0.0), (0.6, 0.0), (-0.6, 0.2))
"""Azimuth and elevation, radians, of the views in which the loss is measured."""
SIZE = 320
TOGETHER = ("expression 1", "expression 2", "jaw open")
"""Number of sliders that are also tested together at their upper ends, since avatars need not be additive as morphs
are."""
DISTANCE_BY_HEIGHT = 2.6
"""Distance of the camera relative to the extent of the splats."""


def export_page(settings: ExportHtmlSettings, progress: Progress = no_progress) -> CommandResult:
    """Bake, write, read back and compare; see the settings."""
    out = Path(settings.out)
    check_writable(out, "--out")
    stored, avatar = open_splats(settings)
    head = read_shared_head(stored.folder)
    rest, reach = neutral_pose(head), np.full(head.expression_basis.shape[2], COEFFICIENT)
    if settings.capture is not None:
        clip = settings.open(settings.capture, progress)
        poses = [clip.poses[t] for t in sorted({key.timestep for key in clip.splits["train"]})]
        rest = replace(rest, rotation=poses[0].rotation, translation=poses[0].translation)
        reach = _reach(poses, head.version, reach)
    shape, size = np.asarray(stored.record["shape"]), head.shape_basis.shape[2]
    if len(shape) > size:
        expected = f"at most {size} coefficients, as {HEAD_FILE} beside it has"
        raise InputError(stored.folder / AVATAR_FILE, "shape", expected, str(len(shape)))
    shaped = head.template + head.shape_basis[..., : len(shape)] @ shape
    joints = np.asarray(head.joint_regressor @ shaped, np.float64)
    source = Source(avatar, rest, joints[0], joints[1 : 1 + len(JOINTS)])
    sliders = make_sliders(reach[: settings.expressions])
    baked = bake(source, sliders, settings.degree, DIRECTIONS, progress)
    low, high = np.quantile(baked.means, (0.005, 0.995), axis=0)
    view = {
        "distance": round(DISTANCE_BY_HEIGHT * float((high - low).max()), 4),
        "target": ((low + high) / 2).round(5).tolist(),
    }
    content = encode(baked, view)
    page = fill_page(content, settings.title or stored.record["subject"])
    write_text(out, page)
    losses = measure_losses(source, decode(content), view, progress)
    size = out.stat().st_size
    worst = min(losses, key=lambda name: losses[name])
    text = f"{out}: {len(baked.means)} splats, {len(sliders)} sliders, {size / 1e6:.2f} MB; PSNR against headbench's renderer: "
    text += ", ".join(f"{name} {value:.1f}" for name, value in losses.items()) + f" dB; minimum: {worst}"
    return CommandResult(text, {"out": out, "splats": len(baked.means), "bytes": size, "psnr": losses})


def _reach(poses: Sequence[HeadPose], version: str, reach: FloatArray) -> FloatArray:
    if poses[0].head_model != version:
        return reach  # tracked with another head model, as for gbs
    largest = np.abs([pose.expression for pose in poses]).max(axis=0)
    return np.asarray(np.where(largest > 0, BEYOND * largest, reach))


def make_sliders(reach: FloatArray) -> tuple[Slider, ...]:
    """One for each expression, then jaw, neck and eyes."""
    expressions = [
        Slider(f"expression {n + 1}", (), 0, n, -float(r), float(r), float(r) / 2)
        for n, r in enumerate(reach.round(4))
    ]
    both = (JOINTS.index("left eye"), JOINTS.index("right eye"))
    return (
        *expressions,
        Slider("jaw open", (1,), 0, 0, 0.0, JAW, 0.75 * JAW),
        Slider("jaw sideways", (1,), 1, 0, -JAW_SIDE, JAW_SIDE, JAW_SIDE),
        *(
            Slider(f"neck {name}", (0,), axis, 0, -NECK, NECK, 0.75 * NECK)
            for axis, name in enumerate(("nod", "turn", "tilt"))
        ),
        *(
            Slider(f"eyes {name}", both, axis, 0, -EYES, EYES, 0.75 * EYES)
            for axis, name in enumerate(("up and down", "sideways"))
        ),
    )


def fill_page(content: bytes, title: str) -> str:
    """The page with the bytes of an avatar, script and style in it; it may load nothing else."""
    from jinja2 import Environment, FileSystemLoader

    here = Path(__file__).parent
    script, style = ((here / name).read_text(encoding="utf-8") for name in ("page.js", "page.css"))
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    environment = Environment(autoescape=True, loader=FileSystemLoader(here))
    return environment.get_template("page.html").render(
        policy=f"default-src 'none'; script-src 'sha256-{allowed}'; style-src 'unsafe-inline'",
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
        group = "expressions" if not slider.joints else slider.name.split()[0]
        for value in {slider.low, slider.high} - {0.0}:
            values = np.zeros(len(page.sliders))
            values[number] = value
            trials.append((group, values))
    trials.append(
        ("together", np.array([slider.high * (slider.name in TOGETHER) for slider in page.sliders]))
    )
    losses: dict[str, float] = {}
    for done, (group, values) in enumerate(trials):
        pose = source.pose(page.sliders, values)
        for azimuth, elevation in VIEWS:
            camera = orbit_camera(
                direction_of(azimuth, elevation), view["distance"], np.array(view["target"]), SIZE
            )
            wanted = source.avatar.render(source.camera(camera), pose).rgb
            error = float(np.square(draw(page.moved(values, camera.center), camera) - wanted).mean())
            losses[group] = min(losses.get(group, np.inf), -10 * float(np.log10(max(error, 1e-12))))
        progress(done + 1, len(trials), f"comparing, {group}")
    return losses


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

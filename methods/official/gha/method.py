"""Gaussian Head Avatar by its authors' code.

Xu et al., "Gaussian Head Avatar: Ultra High-fidelity Head Avatar via Dynamic Gaussians", CVPR 2024.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from ....bench.contracts import (
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    Frame,
    FrameKey,
    HeadAsset,
    HeadPose,
    Progress,
)
from ....bench.errors import InputError
from ....bench.io.documents import read_json
from ....bench.io.files import write_json
from ....bench.io.images import write_png
from ....datasets.ga.writer import save_npz
from ...gha.driving import Driver, code_size, landmark_vertices
from ...gha.spec import GHAConfig
from ...shared.avatar_files import SUBJECT_FILE, Subject, head_arrays
from ...shared.loop import Fit
from ..checkout import Checkout, Repository
from ..ga.head_files import Window, cameras_of, square, square_side, write_npy
from ..ga.method import check_mark, mark
from ..method import OfficialMethod, read_identity
from ..spec import GHA_OFFICIAL, GHAOfficialConfig
from ..workplace import Listed, Workplace, copy_file, is_white, opaque_colours, read_sized, write_launcher

MOUTH_ROWS = slice(48, 66)
"""Landmarks of the mouth in their code, around which it adds points; other landmarks have no special role."""
COARSE = 256
"""Side of the images for the mesh head, as their preprocessing writes them."""
MARK_SIDE = 8
IMAGES, PARAMETERS, CAMERAS = "images", "params", "cameras"


@dataclass(frozen=True, eq=False)
class GHATracking:
    """Tracked parameters of one subject for their code, as in the native method.

    A point of the canonical head is ``R (S x) + T`` in the world: R, T of the head's root and neck, S metres a unit.
    """

    driver: Driver

    rows: np.ndarray
    """(L,) vertices that correspond to their landmarks and to each hundredth vertex of their face model."""

    @classmethod
    def of(cls, head: HeadAsset, subject: Subject) -> GHATracking:
        """Landmarks of a subject."""
        if not len(head.regions.get("lips", ())):
            known = ", ".join(sorted(head.regions)) or "no regions"
            raise InputError(f"head model {head.version!r}", "regions", "a region 'lips'", known)
        published = GHAConfig()
        identity = (head, subject.shape, subject.static_offset)
        neutral = Driver(*identity, np.zeros(3), 1.0, None, "cpu").neutral.numpy()
        facial = landmark_vertices(head, neutral, published.landmarks)
        lips_alone = replace(head_arrays(head), regions={"face": head.regions["lips"]})
        lips = landmark_vertices(lips_alone, neutral, MOUTH_ROWS.stop - MOUTH_ROWS.start)
        before = np.resize(facial, MOUTH_ROWS.start)
        mouth = np.resize(lips, MOUTH_ROWS.stop - MOUTH_ROWS.start)
        more = facial[MOUTH_ROWS.start : published.landmarks - len(mouth)]
        driver = Driver(*identity, neutral[facial].mean(0), published.unit, None, "cpu")
        return cls(driver, np.concatenate([before, mouth, more]))

    @torch.no_grad()
    def parameters(self, pose: HeadPose) -> dict[str, FloatArray]:
        """Expression code (1, E), axis-angle and translation (1, 6), scale (1,)."""
        (signal,) = self.driver.signals(self.driver.arguments([pose]))
        return {
            "exp_coeff": signal.expression[None].numpy(),
            "pose": self.driver.motion(signal).code[None].numpy(),
            "scale": np.array([self.driver.unit], np.float32),
        }

    @torch.no_grad()
    def landmarks(self, pose: HeadPose) -> FloatArray:
        """(L, 3) points of the posed head, metres."""
        arguments = self.driver.arguments([pose])
        vertices = self.driver.model(canonical=self.driver.neutral[None], **arguments)[0]
        return np.asarray(vertices.numpy()[self.rows])


def write_training(
    clip: Clip, tracking: GHATracking, work: Workplace, progress: Progress
) -> dict[str, FrameKey]:
    """Write only the training frames, with timesteps and cameras numbered from 0. Returns the key of every image.

    Files are PNG under the names of their loader, which end in ``.jpg``; it detects the format by content. Nothing
    beyond the image's border is ``visible``, so there is no loss.
    """
    side, frames = training_side(clip), whole_timesteps(clip)
    windows = {name: square(camera, side) for name, camera in cameras_of(clip, "train").items()}
    names = list(windows)
    images: dict[str, FrameKey] = {}
    total = len(frames) * len(names)
    for number, (timestep, keys) in enumerate(frames.items()):
        frame = f"{number:06d}"
        for index, name in enumerate(names):
            for kind, image in _images(clip, keys[name], windows[name]).items():
                place = f"{IMAGES}/{frame}/{kind}_{index:02d}.jpg"
                write_png(work.input / place, image)
                images[f"input/{place}"] = keys[name]
            write_camera(work.input / CAMERAS / frame / f"camera_{index:02d}.npz", windows[name].camera)
            progress(number * len(names) + index + 1, total, "exporting")
        folder = work.input / PARAMETERS / frame
        save_npz(folder / "params.npz", tracking.parameters(clip.poses[timestep]))
        write_npy(folder / "lmk_3d.npy", np.ascontiguousarray(tracking.landmarks(clip.poses[timestep])))
        # All points are landmarks; their loader would add every hundredth of these vertices.
        write_npy(folder / "vertices.npy", np.zeros((0, 3), np.float32))
    return images


def write_list(
    frames: Sequence[Listed], tracking: GHATracking, side: int, work: Workplace
) -> list[tuple[Path, list[int]]]:
    """Write frames to render, with a folder for each camera; return the folders and frame numbers.

    Their renderer shows the mean of the previous parameters and those of the frame. The parameters written are
    extrapolated so that this mean is the frame's own. It writes the image beside the render, here a mark that encodes
    the frame's number.
    """
    groups: dict[tuple[Any, ...], list[Listed]] = {}
    for frame in frames:
        camera = frame.camera
        same = (camera.id, camera.width, camera.height, camera.K.tobytes(), camera.world_to_camera.tobytes())
        groups.setdefault(same, []).append(frame)
    written = []
    for index, group in enumerate(groups.values()):
        folder = work.input / f"camera_{index:04d}"  # their configuration does not accept a number as a name
        write_camera(folder / "camera.npz", square(group[0].camera, side).camera)
        shown: dict[str, FloatArray] = {}
        for place, frame in enumerate(group):
            wanted = tracking.parameters(frame.pose)
            save_npz(folder / PARAMETERS / f"{place:06d}.npz", overshot(wanted, shown))
            image = np.full((MARK_SIDE, MARK_SIDE, 3), mark(frame.number), np.uint8)
            write_png(folder / IMAGES / f"{place:06d}.png", image)
        written.append((folder, [frame.number for frame in group]))
    return written


def overshot(wanted: Mapping[str, FloatArray], shown: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """Parameters that give the wanted ones in a renderer that averages with the previous ones.

    ``shown`` has the previous parameters, initially none, and is updated with rounding.
    """
    given: dict[str, FloatArray] = {name: np.asarray(value, np.float32) for name, value in wanted.items()}
    half = np.float32(0.5)
    for name in ("exp_coeff", "pose"):
        if name in shown:
            given[name] = (given[name] - shown[name] * half) / half
            shown[name] = shown[name] * half + given[name] * half
        else:
            shown[name] = given[name]
    return given


def write_camera(path: Path, camera: Camera) -> None:
    """Write an OpenCV camera: the 3x4 matrix from the world, in metres, and K in pixels."""
    extrinsic = np.asarray(camera.world_to_camera, np.float64)[:3]
    save_npz(path, {"extrinsic": extrinsic, "intrinsic": np.asarray(camera.K, np.float64)})


def training_side(clip: Clip) -> int:
    """Side of the square images of all training cameras."""
    return square_side(cameras_of(clip, "train").values())


def whole_timesteps(clip: Clip) -> dict[int, dict[str, FrameKey]]:
    """Training frames by timestep and camera."""
    names = list(cameras_of(clip, "train"))
    frames: dict[int, dict[str, FrameKey]] = {}
    for key in sorted(clip.splits["train"], key=lambda key: (key.timestep, key.camera)):
        frames.setdefault(key.timestep, {})[key.camera] = key
    for timestep, keys in frames.items():
        missing = [name for name in names if name not in keys]
        if missing:
            expected = f"a training frame of each of {len(names)} cameras, which their loader requires"
            remedy = "Remove the timestep or the camera from the capture."
            raise InputError(
                f"clip {clip.subject}",
                f"timestep {timestep}",
                expected,
                f"none of {', '.join(missing)}",
                remedy,
            )
    return frames


def _images(clip: Clip, key: FrameKey, window: Window) -> dict[str, ByteArray]:
    """Files of a frame for their loaders, by prefix of the name.

    The mask of the second stage, which serves to composite images on white, is white because images are already on
    white.
    """
    image = clip.image(key)
    mask = clip.mask(key)
    if mask is None:
        raise InputError(f"clip {clip.subject}", str(key), "a mask; the mesh head is fitted to it", "none")
    full = {
        "image": window.padded(image, 255),
        "mask": np.full((window.camera.height, window.camera.width, 3), 255, np.uint8),
        "visible": window.padded(np.full_like(image, 255), 0),
    }
    coverage = window.padded(np.repeat(np.asarray(mask)[..., None], 3, axis=2), 0)
    reduced = {"image": full["image"], "mask": coverage, "visible": full["visible"]}
    small = {f"{name}_lowres": _resized(value, COARSE) for name, value in reduced.items()}
    return {**full, **small}


def _resized(image: Any, side: int) -> Any:
    """A square image at another size: area means when shrinking, linear when growing."""
    if image.shape[0] == side:
        return image
    how = cv2.INTER_AREA if side < image.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(image, (side, side), interpolation=how)


def read_render(path: Path, frame: Listed, side: int, rendered: int) -> tuple[ByteArray, FloatArray]:
    """Input image and render of a file: the render (H, W, 3) in [0, 1] at its camera's size."""
    image = read_sized(path, frame, 2 * rendered, rendered)
    render = _resized(image[:, rendered:].astype(np.float32) / 255, side)
    return image[:, :rendered], square(frame.camera, side).uncut(render, frame.camera)


MESH, GAUSSIANS = "train_meshhead.py", "train_gaussianhead.py"
REENACTMENT = "reenactment.py"
LAUNCHER = Path(__file__).with_name("stages.py")
NETWORKS = ("gaussianhead_latest", "supres_latest")
SIDE_FILE = "square.json"
TETRAHEDRA = "assets/tets_data.npz"
RENDERED = 2048
"""Side of their renders: four times 512 splatted pixels, a constant of their renderer."""
MOST_SIDE, SHORTEST = 1 << 15, 2
_check_white = partial(is_white, other=(1.0, 1.0, 1.0), known="white")

GHA_REPOSITORY = Repository(
    "https://github.com/YuelangX/Gaussian-Head-Avatar",
    GHAOfficialConfig().commit,
    (MESH, GAUSSIANS, REENACTMENT, "lib/dataset/Dataset.py", "config/config.py"),
    (
        *("torch", "torchvision", "kaolin", "pytorch3d.ops.knn", "diff_gaussian_rasterization"),
        *("simple_knn._C", "lpips", "yacs.config", "einops", "tensorboardX", "prefetch_generator"),
        *("skimage.io", "cv2", "tqdm"),
    ),
    downloads={TETRAHEDRA: "Download it from the link on the repository's page, and save it there."},
)


class GHAOfficial(OfficialMethod[GHAOfficialConfig]):
    """See the module docstring."""

    name, version = GHA_OFFICIAL.name, GHA_OFFICIAL.version
    config_class, repository = GHAOfficialConfig, GHA_REPOSITORY
    iteration_line = r"^headbench: iteration (\d+) loss ([\d.]+|nan|inf)"
    frame_line = r"^headbench: drawn (\d+)"
    avatar_files = (*NETWORKS, SUBJECT_FILE, SIDE_FILE)

    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Check that the background is white, pixels are not skewed, timesteps have all cameras and the head has a face."""
        where = f"clip {clip.subject}"
        _check_white(clip.background, where)
        for name, camera in cameras_of(clip).items():
            skew = abs(float(camera.K[0, 1]))
            if skew > 1e-3 * float(camera.K[0, 0]):
                raise InputError(
                    where, f"camera {name}", "no skew, which the code does not support", f"{skew:.2f}"
                )
        whole_timesteps(clip)
        GHATracking.of(clip.head, Subject.of(clip))

    def check_length(self, iterations: int, checkout: Checkout) -> None:
        """Refuse a run with less than an iteration for each of the two stages."""
        if iterations < SHORTEST:
            expected = f"{SHORTEST} or more, one for each stage"
            raise InputError(f"settings.{self.name}", "budget.iterations", expected, f"{iterations}")

    def export(self, clip: Clip, work: Workplace, progress: Progress) -> dict[str, FrameKey]:
        """Write the training frames in their layout, and the tetrahedra file."""
        target = work.program / TETRAHEDRA
        target.parent.mkdir(parents=True)
        os.symlink(work.checkout.folder / TETRAHEDRA, target)
        return write_training(clip, GHATracking.of(clip.head, Subject.of(clip)), work, progress)

    def train_command(self, fit: Fit, work: Workplace) -> list[str]:
        """Both of their scripts, run one after the other by the launcher."""
        mesh, gaussians = self._lengths(fit.budget.iterations or 0)
        clip = fit.clip
        cameras = len(cameras_of(clip, "train"))
        shared = {
            "gpu_id": 0,
            "batch_size": 1,
            "load_meshhead_checkpoint": "",
            "meshheadmodule": _networks(code_size(clip.head), mesh=True),
        }
        dataset = {
            "dataroot": str(work.input),
            "camera_ids": [f"{index:02d}" for index in range(cameras)],
            "original_resolution": training_side(clip),
        }
        published = GHAConfig()
        first = {
            **shared,
            "lr_net": published.mesh_lr,
            "lr_lmk": published.landmark_lr,
            "dataset": {
                **dataset,
                "resolution": published.mesh_size,
                "num_sample_view": min(published.mesh_views, cameras),
            },
            "recorder": _recorder("meshhead", work, mesh),
        }
        second = {
            **shared,
            "load_meshhead_checkpoint": str(_checkpoints(work, "meshhead") / "meshhead_latest"),
            "lr_net": published.network_lr,
            "lr_pose": published.correction_lr,
            "optimize_pose": True,
            "dataset": {**dataset, "resolution": RENDERED},
            "supresmodule": _SHARPENER,
            "gaussianheadmodule": _networks(code_size(clip.head), mesh=False),
            "recorder": _recorder("gaussianhead", work, gaussians),
        }
        parts = []
        for script, config, length, before in ((MESH, first, mesh, 0), (GAUSSIANS, second, gaussians, mesh)):
            path = work.root / f"{Path(script).stem}.yaml"
            write_json(path, config)  # JSON is YAML
            parts.append({"script": script, "config": str(path), "iterations": length, "before": before})
        return self._staged(work, parts, fit.seed)

    def keep(self, fit: Fit, work: Workplace) -> None:
        """Keep their Gaussians with the networks that drive them, and super-resolution."""
        for name in NETWORKS:
            copy_file(_checkpoints(work, "gaussianhead") / name, fit.out / name)
        write_json(fit.out / SIDE_FILE, {"side": training_side(fit.clip)})

    def render_command(
        self, folder: Path, frames: Sequence[Listed], background: Sequence[float], work: Workplace
    ) -> list[str]:
        """Write the frames of each camera as a separate application, all run by the launcher."""
        _check_white(background, "render")
        subject, head = read_identity(folder)
        tracking = GHATracking.of(head, subject)
        side = max(_side(folder), square_side(frame.camera for frame in frames))
        renders = work.model / self.render_folder
        renders.mkdir(parents=True)
        parts: list[dict[str, Any]] = []
        for place, numbers in write_list(frames, tracking, side, work):
            config = {
                "gpu_id": 0,
                "load_gaussianhead_checkpoint": str(folder.absolute() / NETWORKS[0]),
                "load_supres_checkpoint": str(folder.absolute() / NETWORKS[1]),
                "dataset": {
                    "dataroot": str(place),
                    "image_files": f"{IMAGES}/*.png",
                    "param_files": f"{PARAMETERS}/*.npz",
                    "camera_path": str(place / "camera.npz"),
                    "pose_code_path": "",
                    "freeview": False,
                    "resolution": RENDERED,
                    "original_resolution": side,
                },
                "supresmodule": _SHARPENER,
                "gaussianheadmodule": _networks(code_size(head), mesh=False),
                "recorder": {"name": place.name, "result_path": str(work.model / "results")},
            }
            path = work.root / f"{place.name}.yaml"
            write_json(path, config)
            before = sum(len(part["numbers"]) for part in parts)
            part = {"script": REENACTMENT, "config": str(path), "numbers": numbers, "before": before}
            parts.append({**part, "renders": str(renders)})
        write_json(work.root / SIDE_FILE, {"side": side})
        return self._staged(work, parts, 0)

    def read_back(self, frame: Listed, path: Path, background: Sequence[float], work: Workplace) -> Frame:
        """A render; the image beside it is used to verify the frame."""
        beside, render = read_render(path, frame, _side(work.root), RENDERED)
        check_mark(beside, path, frame.number)
        return opaque_colours(render)

    def differences(self, clip: Clip, seed: int) -> list[str]:
        """Of the export, the networks, the length of the training, and the renders."""
        side = training_side(clip)
        codes = code_size(clip.head)
        return [
            "the capture has no held-out frames; cameras and timesteps are renumbered",
            f"the head model's {codes} values of expression, jaw, eyes and eyelids replace the 64 expression coefficients "
            + "of the Basel Face Model; the first layers of the networks have the width that this requires",
            "landmarks are vertices of the head model: 48 of the face, 18 of the lips, and more of the face in place of "
            + "each hundredth vertex of the Basel Face Model",
            f"images are placed in squares of {side} pixels with the principal point in the middle; nothing beyond the "
            + f"image's border enters a loss. Their loader resizes squares to {RENDERED} pixels; renders are resized back",
            "images and renders are PNG in place of JPEG; their renderer rounds down to 8 bits",
            "the mask of the second stage is white because images are already on white",
            "training ends after a number of iterations, unlike the authors'",
            "renders show listed poses; the authors' smooths them over time",
        ]

    def _lengths(self, iterations: int) -> tuple[int, int]:
        mesh = min(iterations - 1, max(1, round(iterations * self.config.mesh_fraction)))
        return mesh, iterations - mesh

    @staticmethod
    def _staged(work: Workplace, parts: Sequence[dict[str, Any]], seed: int) -> list[str]:
        """Write launcher and plan; return the command."""
        plan = {"checkout": str(work.checkout.folder), "seed": seed, "parts": list(parts)}
        return [*work.checkout.python, *write_launcher(LAUNCHER, plan, work)]


_SHARPENER = {
    "input_dim": GHAConfig().channels,
    "output_dim": 3,
    "network_capacity": GHAConfig().sr_widths[-1],
}


def _networks(codes: int, *, mesh: bool) -> dict[str, Any]:
    """The published sizes, for an expression code of ``codes`` values in place of 64."""
    gha = GHAConfig()
    frequencies = 4
    point, pose = (size * (1 + 2 * frequencies) for size in (3, 6))
    shared = {
        "exp_color_mlp": [gha.features + codes, *gha.expression_color_hidden, gha.channels],
        "pose_color_mlp": [gha.features + pose, *gha.pose_color_hidden, gha.channels],
        "exp_deform_mlp": [point + codes, *gha.expression_deform_hidden, 3],
        "pose_deform_mlp": [point + pose, *gha.pose_deform_hidden, 3],
        "pos_freq": frequencies,
        "dist_threshold_near": gha.near_squared,
        "dist_threshold_far": gha.far_squared,
        "deform_scale": gha.displacement_scale,
    }
    if mesh:
        return {
            **shared,
            "geo_mlp": [point, *gha.geometry_hidden, 4 + gha.features],
            "model_bbox": [[-1.6, 1.6], [-1.7, 1.8], [-2.5, 1.0]],
            "subdivide": False,
        }
    return {
        **shared,
        "num_add_mouth_points": gha.mouth_points,
        "exp_attributes_mlp": [gha.features + codes, *gha.expression_attribute_hidden, 8],
        "pose_attributes_mlp": [gha.features + pose, *gha.pose_attribute_hidden, 8],
        "exp_coeffs_dim": codes,
        "attributes_scale": gha.attribute_scale,
    }


def _recorder(name: str, work: Workplace, iterations: int) -> dict[str, Any]:
    """Checkpoints after the first and last iteration; images only after the first."""
    return {
        "name": name,
        "logdir": str(work.model / "log" / name),
        "checkpoint_path": str(work.model / "checkpoints"),
        "result_path": str(work.model / "results"),
        "save_freq": max(1, iterations - 1),
        "show_freq": 10**9,
    }


def _checkpoints(work: Workplace, name: str) -> Path:
    return work.model / "checkpoints" / name


def _side(folder: Path) -> int:
    path = folder / SIDE_FILE
    side = read_json(path).get("side")
    if not isinstance(side, int) or not 1 <= side <= MOST_SIDE:
        raise InputError(path, "side", f"1 to {MOST_SIDE} pixels", repr(side)[:60])
    return side

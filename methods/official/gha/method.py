"""Gaussian Head Avatar by its authors' code.

Xu et al., "Gaussian Head Avatar: Ultra High-fidelity Head Avatar via Dynamic Gaussians", CVPR 2024.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ....bench.contracts import Clip, Frame, FrameKey, Progress
from ....bench.errors import InputError
from ....bench.io.documents import read_json
from ....bench.io.files import write_json
from ...gha.config import GHAConfig
from ...gha.driving import code_size
from ...shared.avatar_files import SUBJECT_FILE, Subject
from ...shared.loop import Fit
from ..checkout import Checkout, Repository
from ..config import GHAOfficialConfig
from ..ga.export import check_mark
from ..ga.windows import cameras_of, square_side
from ..method import OfficialMethod, read_identity
from ..spec import GHA_OFFICIAL
from ..workplace import Listed, Workplace, copy_file, is_white, opaque_colours, write_launcher
from .export import (
    IMAGES,
    PARAMETERS,
    GHATracking,
    read_render,
    training_side,
    whole_timesteps,
    write_list,
    write_training,
)

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

"""The kernel for 64-bit ARM, cross-compiled and run in an emulator, against the float64 reference."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from headbench.methods.benchmarks.splats import SplatScene, cloud, head_shell, relative_error
from headbench.methods.splats.rasterize import rasterize

COMPILER, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"
ROOT = Path(__file__).parents[4]
SOURCES = ROOT / "methods/splats/csrc"
OPTIONS = [
    "-std=c++17",
    "-O2",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-DHEADBENCH_NEON",
]
FIELDS = ("means", "quats", "scales", "opacities", "colors")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (shutil.which(COMPILER) and shutil.which(EMULATOR)), reason=f"needs {COMPILER} and {EMULATOR}"
    ),
]


@pytest.fixture(scope="module")
def driver(tmp_path_factory) -> Path:
    """The kernel and the driver as one program for 64-bit ARM."""
    program = tmp_path_factory.mktemp("driver") / "driver"
    sources = [Path(__file__).with_name("driver.cpp"), SOURCES / "frame.cpp"]
    sources += [ROOT / "bench/native" / name for name in ("thread_pool.cpp", "workspace.cpp")]
    compiler = [COMPILER, *OPTIONS, f"-I{ROOT}", f"-I{SOURCES}"]
    for name in ("neon", "portable"):
        sources.append(tmp_path_factory.getbasetemp() / f"{name}.o")
        isa = [f"-DHEADBENCH_ISA={name}", f"-DHEADBENCH_ISA_{name}"]
        subprocess.run(
            [*compiler, *isa, "-c", str(SOURCES / "variants.cpp"), "-o", str(sources[-1])], check=True
        )
    subprocess.run([*compiler, "-static", "-pthread", *map(str, sources), "-o", str(program)], check=True)
    return program


@pytest.mark.parametrize(
    "scene",
    [
        cloud(400, 61, 45, seed=1),
        cloud(100, 40, 24, seed=5, channels=5),
        head_shell(1500, 64, 80),
        cloud(1500, 18, 19, seed=9, size=0.1, opacity=4.0),
    ],
    ids=["cloud", "five channels", "head", "many opaque"],
)
def test_arm_kernels_agree_with_the_reference(driver, tmp_path, scene: SplatScene):
    rng = np.random.default_rng(0)
    channels = scene.colors.shape[1]
    on_image = rng.standard_normal((scene.height, scene.width, channels), dtype=np.float32)
    on_alpha = rng.standard_normal((scene.height, scene.width), dtype=np.float32)
    leaves = [getattr(scene, name).double().requires_grad_() for name in FIELDS]
    truth = rasterize(
        *leaves, *scene[5:9], background=scene.background.double(), backend="reference", check_values=True
    )
    upstream = (torch.from_numpy(on_image).double(), torch.from_numpy(on_alpha).double())
    gradients = torch.autograd.grad((truth.image, truth.alpha), leaves, upstream)

    view, K = scene.viewmat, scene.K
    camera = torch.cat([view[:3, :3].reshape(-1), view[:3, 3], K[[0, 1, 0, 1], [0, 1, 2, 2]]])
    sizes = np.array([len(scene.means), channels, scene.width, scene.height], dtype=np.int32)
    arrays = [camera, *(getattr(scene, name) for name in FIELDS), scene.background]
    parts = [sizes, *(value.contiguous().numpy() for value in arrays), on_image, on_alpha]
    (tmp_path / "in").write_bytes(b"".join(part.tobytes() for part in parts))
    subprocess.run([EMULATOR, str(driver), str(tmp_path / "in"), str(tmp_path / "out")], check=True)

    data, at, names = (tmp_path / "out").read_bytes(), 0, []
    wanted = [truth.image.detach(), truth.alpha.detach(), *gradients]
    while at < len(data):
        names.append(data[at : at + 16].rstrip(b"\0").decode())
        at += 16
        for label, value in zip(("image", "alpha", *FIELDS), wanted, strict=True):
            result = torch.frombuffer(bytearray(data[at : at + 4 * value.numel()]), dtype=torch.float32)
            at += 4 * value.numel()
            assert relative_error(result, value.reshape(-1)) < 1e-4, (names[-1], label)
    assert names == ["neon", "portable"]

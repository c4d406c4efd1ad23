"""``make lock``: write exact versions and hashes of everything that the Makefile installs, for Python 3.11 to 3.13 on Linux.

Five requirements files are written beside ``pyproject.toml``, whose open ranges they pin:

- ``requirements.txt``: what headbench needs, without PyTorch;
- ``requirements-dev.txt``: the extras ``dev`` and ``docs`` and the tools that build the kernels;
- ``requirements-uv.txt``: the program that installs the others;
- ``requirements-torch-cuda.txt``: PyTorch as the package index has it, CUDA's libraries, and the extra ``cuda``;
- ``requirements-torch-cpu.txt``: PyTorch's CPU build. Hashes of builds that no index configured for pip offers are kept
  from the file as it is.

Versions are the newest that fit, but for PyTorch's, which is set here. No address of an index is written.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TORCH = "2.13.0"
PYTHONS = ("3.11", "3.12", "3.13")
PLATFORMS = ("manylinux_2_28_x86_64", "manylinux_2_28_aarch64")
BUILDERS = ("cmake>=3.20", "ninja>=1.11", "uv>=0.8")
"""Programs that scikit-build-core runs, which asks for them only where the build is isolated, and uv."""

Pins = dict[str, str]
"""Requirements with their hashes, as a requirements file holds them, by the text up to the first hash."""


def resolve(extras: tuple[str, ...], more: list[str], constraints: Pins) -> Pins:
    """Return the newest versions that the extras of ``pyproject.toml`` and ``more`` admit, for all Pythons and platforms."""
    with tempfile.TemporaryDirectory() as folder:
        known = Path(folder, "constraints.txt")
        known.write_text("\n".join([f"torch=={TORCH}", *constraints]))
        command = [
            "uv",
            "pip",
            "compile",
            "pyproject.toml",
            "-",
            "--universal",
            "--python-version",
            PYTHONS[0],
        ]
        command += [
            "--generate-hashes",
            "--no-header",
            "--no-annotate",
            "--quiet",
            "--constraint",
            str(known),
        ]
        command += [word for extra in extras for word in ("--extra", extra)]
        found = subprocess.run(
            [sys.executable, "-m", *command],
            cwd=ROOT,
            input="\n".join(more),
            check=True,
            text=True,
            stdout=subprocess.PIPE,
        )
    return {text.split(" \\\n")[0]: text for text in re.split(r"\n(?=\S)", found.stdout.strip())}


def cpu_hashes() -> set[str]:
    """Return the hashes of PyTorch's CPU builds: those that pip's indexes offer, and those that are recorded already."""
    recorded = ROOT / "requirements-torch-cpu.txt"
    text = recorded.read_text() if recorded.exists() else ""
    hashes = set(re.findall(r"sha256:\w{64}", text)) if f"torch=={TORCH}+cpu" in text else set()
    for python in PYTHONS:
        for platform in PLATFORMS:
            command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
            command += ["--no-deps", "--only-binary", ":all:", "--python-version", python]
            command += ["--platform", platform, "--target", "unused", "--report", "-", f"torch=={TORCH}+cpu"]
            found = subprocess.run(command, capture_output=True, text=True, check=False)
            if found.returncode == 0:
                info = json.loads(found.stdout)["install"][0]["download_info"]
                hashes.add("sha256:" + info["archive_info"]["hashes"]["sha256"])
            else:
                print(
                    f"PyTorch {TORCH}+cpu, Python {python}, {platform}: on no index; recorded hashes are kept"
                )
    return hashes


def write(name: str, pins: Pins) -> None:
    """Write a requirements file."""
    header = "# Written by `make lock`, from the ranges in pyproject.toml.\n"
    (ROOT / name).write_text(header + "".join(f"{text}\n" for _, text in sorted(pins.items())))
    print(f"{name}: {len(pins)} packages")


def main() -> None:
    """Resolve and write all files; the smaller sets decide the versions of the larger ones."""
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    plain = resolve((), [], {})
    developer = resolve(("dev", "docs"), [*build, *BUILDERS], plain)
    everything = resolve(("dev", "docs", "cuda"), [*build, *BUILDERS], developer)
    cuda = re.compile(r"torch==|triton==|nvidia-|cuda-")
    main = {pin: text for pin, text in plain.items() if not cuda.match(pin)}
    write("requirements.txt", main)
    uv = {pin: text for pin, text in developer.items() if pin.startswith("uv==")}
    write("requirements-uv.txt", uv)
    write(
        "requirements-dev.txt",
        {pin: text for pin, text in developer.items() if pin not in main | uv and not cuda.match(pin)},
    )
    write(
        "requirements-torch-cuda.txt",
        {pin: text for pin, text in everything.items() if pin not in developer or cuda.match(pin)},
    )
    hashes = sorted(cpu_hashes())
    pin = f"torch=={TORCH}+cpu"
    write("requirements-torch-cpu.txt", {pin: " \\\n    --hash=".join([pin, *hashes])})


if __name__ == "__main__":
    main()

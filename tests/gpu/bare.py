"""The check of ``make gpu`` on a bare machine: no network, no package index, nothing of headbench installed.

``python3 tests/gpu/bare.py WHEELS`` takes the interpreter's own PyTorch and packages, unpacks what it lacks from the folder of
wheels, builds the kernels with CMake and ninja, and runs the steps. ``--collect`` fills the folder, on a machine with a network,
with locked packages for x86-64 and another Python: what training and drawing need besides PyTorch and NumPy. Only Python's own
modules are needed to start.
"""

import argparse
import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("bench", "datasets", "methods", "metrics", "reports", "tests")
# fmt: off
NAMES = (
    "annotated-types", "cloudpickle", "docstring-parser", "gsplat", "jaxtyping", "joblib", "markdown-it-py", "mdurl",
    "nanobind", "narwhals", "psutil", "pydantic", "pydantic-core", "pygments", "pyyaml", "rich",
    "safetensors", "scikit-learn", "scipy", "threadpoolctl", "typeguard", "typing-extensions",
    "typing-inspection", "tyro", "wadler-lindig"
)
# fmt: on
LIMIT_MB = 55
BUILD_S = 80
PLATFORMS = ("2_28", "2_27", "2_26", "2_24", "2_17", "2_12", "2_5")


def collect(folder, python):
    """Download the wheels of `NAMES` that the lock pins; return the exit code."""
    from pip._vendor.packaging.requirements import Requirement

    version = {"python_version": python, "python_full_version": f"{python}.0"}
    entries = []
    for name in ("requirements.txt", "requirements-dev.txt", "requirements-torch-cuda.txt"):
        for entry in re.split(r"\n(?=\w)", (ROOT / name).read_text().strip()):
            line = entry.split("\\\n")[0].strip()
            if entry.startswith("#") or (found := Requirement(line)).name not in NAMES:
                continue
            if not found.marker or found.marker.evaluate(version):
                # pip would judge a marker by the Python that it runs in.
                entries.append(entry.replace(line, line.split(";")[0].strip(), 1))
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as chosen:
        chosen.write("\n".join(entries))
        chosen.flush()
        platforms = [word for each in PLATFORMS for word in ("--platform", f"manylinux_{each}_x86_64")]
        command = [
            sys.executable,
            "-m",
            "pip",
            "download",
            "--no-deps",
            "--require-hashes",
            "--only-binary",
            ":all:",
        ]
        command += ["--python-version", python, "--dest", str(folder), *platforms, "-r", chosen.name]
        code = subprocess.run(command, check=False).returncode
    for wheel in folder.glob("*.whl"):
        shrink(wheel)
    size = sum(path.stat().st_size for path in folder.glob("*.whl")) / 1e6
    print(f"{folder}: {len(entries)} wheels for Python {python}, {size:.1f} MB of at most {LIMIT_MB}")
    return code or int(size > LIMIT_MB)


def shrink(wheel):
    """Write a wheel again without its package's own tests and documents, which are a tenth of all."""
    smaller = wheel.with_suffix(".part")
    with (
        zipfile.ZipFile(wheel) as whole,
        zipfile.ZipFile(smaller, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as part,
    ):
        for name in whole.namelist():
            if not re.search(r"/(tests?|docs?)/", name):
                part.writestr(name, whole.read(name))
    smaller.replace(wheel)


def unpack(wheels, site):
    """Unpack the wheels whose packages this Python lacks into ``site``."""
    site.mkdir(parents=True)
    for wheel in sorted(wheels.glob("*.whl")):
        name, version = wheel.name.split("-")[:2]
        try:
            print(f"  {name}: the interpreter's {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            zipfile.ZipFile(wheel).extractall(site)
            print(f"  {name}: {version} from the folder")


def install(site):
    """Put headbench into ``site`` without its kernels: its sources and the names of its plug-ins."""
    ignored = shutil.ignore_patterns("__pycache__", "*.so")
    for folder in FOLDERS:
        shutil.copytree(ROOT / folder, site / "headbench" / folder, ignore=ignored)
    shutil.copy(ROOT / "__init__.py", site / "headbench")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    about = site / f"headbench-{project['version']}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: headbench\nVersion: {project['version']}\n"
    )
    groups = (
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    )
    (about / "entry_points.txt").write_text("\n".join(groups))


def build(site, out):
    """Build the kernels into ``site``."""
    folder = str(out / "kernels")
    own = importlib.util.find_spec("nanobind")
    found = (Path(own.origin).parent if own else site / "nanobind") / "cmake"
    options = [
        "-DCMAKE_BUILD_TYPE=Release",
        f"-DPython_EXECUTABLE={sys.executable}",
        f"-Dnanobind_DIR={found}",
    ]
    command = ["cmake", "-G", "Ninja", "-S", str(ROOT), "-B", folder, "-DHEADBENCH_THIS_MACHINE=ON", *options]
    end = time.monotonic() + BUILD_S
    with (out / "kernels.log").open("w") as log:
        for each in (
            command,
            ["cmake", "--build", folder],
            ["cmake", "--install", folder, "--prefix", str(site)],
        ):
            subprocess.run(each, stdout=log, stderr=log, check=True, timeout=max(1.0, end - time.monotonic()))


def main():
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("wheels", type=Path, help="folder of wheels")
    parser.add_argument("--collect", action="store_true", help="fill the folder, and nothing else")
    parser.add_argument("--python", default="3.12", help="with --collect: Python of the bare machine")
    parser.add_argument("--device", default="cuda", help="cuda, or cpu to try this script")
    parser.add_argument("--out", type=Path, default=ROOT / "build/gpu")
    options = parser.parse_args()
    if options.collect:
        return collect(options.wheels, options.python)
    for module in ("torch", "numpy"):
        if not importlib.util.find_spec(module):
            sys.exit(f"{sys.executable} has no {module}: run this with the Python that has PyTorch.")
    for program in ("cmake", "ninja", *(["nvcc"] if options.device != "cpu" else [])):
        if not shutil.which(program):
            sys.exit(f"{program} is not on the PATH.")
    out = options.out.resolve()
    site = out / "site"
    shutil.rmtree(site, ignore_errors=True)
    start = time.monotonic()
    print(f"unpacking what {sys.executable} lacks", flush=True)
    unpack(options.wheels, site)
    install(site)
    print(f"building the kernels, after {time.monotonic() - start:.0f} s", flush=True)
    try:
        build(site, out)
    except (
        subprocess.SubprocessError,
        OSError,
    ) as error:  # without them the device is compared with the slow renderer
        print(f"The kernels were not built ({error}); see {out / 'kernels.log'}.", flush=True)
    print(f"running the steps, after {time.monotonic() - start:.0f} s", flush=True)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH")])),
    }
    command = [sys.executable, "-m", "headbench.tests.gpu", "--device", options.device, "--out", str(out)]
    code = subprocess.run(command, env=environment, check=False).returncode
    print(f"ended after {time.monotonic() - start:.0f} s; what was found is in {out}", flush=True)
    return code


if __name__ == "__main__":
    sys.exit(main())

"""``make setup``: the locked packages and headbench in an environment, installed by uv or, where uv cannot, by pip.

uv and pip install the same files, with the same hashes, from the same sources: pip's configuration is handed to uv. Without
a build of PyTorch asked for, its CPU build is taken if one of these sources has it.
"""

import ast
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
GB = {"cpu": 4, "cuda": 12}
"""Free disk that an environment needs, packages on their way in included."""
SETTINGS = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "no-index": "UV_NO_INDEX",
    "trusted-host": "UV_INSECURE_HOST",
    "cert": "SSL_CERT_FILE",
    "default-timeout": "UV_HTTP_TIMEOUT",
    "timeout": "UV_HTTP_TIMEOUT",
    "proxy": "ALL_PROXY",
}
"""What uv calls pip's settings."""
CAUSES = {
    r"No space left|os error 28|Errno 28": "there is no space left on the disk",
    r"resol\w+ host|name resolution|dns error|Connect\w*Error|connection|unreachable|timed? ?out": "no package index can "
    "be reached: check the network, or set PIP_INDEX_URL or PIP_FIND_LINKS to where the packages are",
    r"No matching distribution|not found in the package registry|no wheels|no version": "pip's sources lack a package",
    r"ResolutionImpossible": "pip's sources lack a package, or a constraint of pip's configuration excludes it",
}


class Failed(Exception):
    """A step that failed; its argument is what the user reads."""


def check_machine(build):
    """Raise for what would fail after minutes of installing: Python, compiler, headers, disk."""
    if build and build not in GB:
        raise Failed(f"TORCH is one of {', '.join(GB)}, not {build}")
    if not (3, 11) <= sys.version_info < (3, 14):
        version = ".".join(map(str, sys.version_info[:3]))
        raise Failed(
            f"headbench is locked for Python 3.11 to 3.13, and {sys.executable} is {version}: "
            "name another one, for example make setup PYTHON=python3.12"
        )
    if not any(map(shutil.which, (os.environ.get("CXX", "c++"), "c++", "g++", "clang++"))):
        raise Failed("there is no C++ compiler to build the kernels with: install g++ or clang++, or set CXX")
    header = Path(sysconfig.get_path("include"), "Python.h")
    if not header.exists():
        raise Failed(f"{header} is missing: install Python's headers (Debian: apt-get install python3-dev)")
    free = shutil.disk_usage(ROOT).free / 1e9
    if free < GB[build or "cpu"]:
        raise Failed(f"{ROOT} has {free:.1f} GB of free disk, and {GB[build or 'cpu']} GB are needed")


def uv_environment(python):
    """The environment with pip's configuration (files and ``PIP_...``) as uv reads it; uv's own settings stay."""
    listed = subprocess.run(
        [python, "-m", "pip", "config", "list"], capture_output=True, text=True, check=False
    ).stdout
    found = {}
    for section in ("global", "install", ":env:"):
        values = re.findall(rf"^{section}\.([\w-]+)=(.*)$", listed, re.MULTILINE)
        found |= {name: ast.literal_eval(value) for name, value in values}
    given = {
        SETTINGS[name]: " ".join(value.split())
        for name, value in found.items()
        if name in SETTINGS and value.strip()
    }
    if "UV_FIND_LINKS" in given:
        given["UV_FIND_LINKS"] = ",".join(given["UV_FIND_LINKS"].split())
    # As pip does: the best version of all indexes, not of the first that has the package.
    return {"UV_INDEX_STRATEGY": "unsafe-best-match", **given, **os.environ}


class Installer:
    """Installs requirements files into an environment and keeps what the programs print in its ``install.log``."""

    def __init__(self, folder):
        self.python, self.log = str(folder / "bin/python"), folder / "install.log"
        self.environment = uv_environment(self.python)
        self.uv = not self._run(self._pip("requirements-uv.txt"))

    def _run(self, command):
        with self.log.open("a") as log:
            log.write(f"\n$ {' '.join(command)}\n")
            log.flush()
            return subprocess.run(
                command, cwd=ROOT, env=self.environment, stdout=log, stderr=log, check=False
            ).returncode

    def _pip(self, *files):
        command = [self.python, "-m", "pip", "--disable-pip-version-check", "install", "--retries", "2"]
        return [*command, *self._locked(files)]

    def _locked(self, files):
        return ["--no-deps", "--require-hashes", "--only-binary", ":all:"] + [
            word for file in files for word in ("-r", file)
        ]

    def finds(self, *files):
        """Whether a program finds all packages of the files; nothing is installed."""
        return self.install(*files, options=["--dry-run"])

    def install(self, *files, options=()):
        """Install the files' packages by uv, or by pip where that fails; whether it succeeded."""
        uv = [self.python, "-m", "uv", "pip", "install", "--python", self.python, *self._locked(files)]
        if os.environ.get("PYTHONDONTWRITEBYTECODE"):  # every process would compile all it imports
            uv.append("--compile-bytecode")
        return (self.uv and not self._run([*uv, *options])) or not self._run([*self._pip(*files), *options])

    def build(self):
        """Build headbench; whether it succeeded and all packages fit together."""
        pip = [self.python, "-m", "pip", "--disable-pip-version-check"]
        options = ["--no-deps", "--no-build-isolation", "--editable", "."]
        return not self._run([*pip, "install", *options]) and not self._run([*pip, "check"])

    def reason(self):
        """Why the last program failed, in a sentence."""
        text = self.log.read_text(errors="replace").rsplit("\n$ ", 1)[-1]
        cause = next(
            (cause for pattern, cause in CAUSES.items() if re.search(pattern, text, re.IGNORECASE)), ""
        )
        lines = [line for line in text.splitlines() if line.strip()]
        return f"{cause or lines[-1].strip()} (what was printed is in {self.log})"


def _has_pip(python):
    """Whether an environment's Python starts and has pip, which comes last when an environment is made."""
    command = [str(python), "-m", "pip", "--version"]
    return python.exists() and not subprocess.run(command, capture_output=True, check=False).returncode


def main(folder, build=""):
    """Install into ``folder``; raise `Failed` with a sentence for the user."""
    check_machine(build)
    if not _has_pip(folder / "bin/python"):
        # What an interrupted set-up left, or an environment whose Python was removed, is replaced.
        again = ["--clear"] if (folder / "pyvenv.cfg").exists() else []
        made = subprocess.run(
            [sys.executable, "-m", "venv", *again, str(folder)], capture_output=True, text=True, check=False
        )
        if made.returncode:
            lines = (made.stdout + made.stderr).split()
            raise Failed(
                f"{sys.executable} cannot make an environment in {folder}: {' '.join(lines).rstrip('.')}"
            )
    (folder / "install.log").unlink(missing_ok=True)
    to = Installer(folder)
    if not build:
        build = "cpu" if to.finds("requirements-torch-cpu.txt") else "cuda"
        if build == "cuda":
            if not to.finds("requirements-torch-cuda.txt"):
                raise Failed(f"PyTorch cannot be found: {to.reason()}")
            print(
                "No source that pip is configured for has PyTorch's CPU build: the one with CUDA is taken, several GB."
            )
            check_machine(build)
    print(f"Installing packages, PyTorch's {build} build among them", flush=True)
    if not to.install(f"requirements-torch-{build}.txt", "requirements.txt", "requirements-dev.txt"):
        raise Failed(f"packages cannot be installed: {to.reason()}")
    print("Building headbench", flush=True)
    if not to.build():
        raise Failed(f"headbench cannot be built: {to.reason()}")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]), *sys.argv[2:])
    except Failed as error:
        sys.exit(f"make setup: {error}.")

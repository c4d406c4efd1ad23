"""Validation of the authors' checkout and interpreter before any long work."""

from __future__ import annotations

import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ...bench.errors import InputError
from ...bench.io.documents import checked, parse_json
from ...bench.io.files import read_bytes
from ...bench.process import environment
from .spec import INSTAOfficialConfig, OfficialConfig

SHORTEST_COMMIT = 7
PROBE_S = 300.0
"""Time limit for the interpreter to import the required modules, seconds; the first import reads them from disk."""
SHIM = "headbench.methods.official.shim.cpu"
SHIMMED = (
    *("diff_gaussian_rasterization", "simple_knn", "nvdiffrast"),
    *("pytorch3d", "point_cloud_utils", "torch.utils.tensorboard"),
    *("lpips", "yacs", "loguru", "skimage"),
)
"""Packages and modules that the shim replaces."""
_PROBE = """
import importlib, json, sys
found = {"python": sys.version.split()[0], "missing": {}, "failed": ""}
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
    except BaseException as error:
        found["missing"][name] = (type(error).__name__ + ": " + str(error))[:200]
if "torch" in sys.argv[1:] and "torch" not in found["missing"]:
    import torch
    found["torch"], found["cuda"] = torch.__version__, bool(torch.cuda.is_available())
if not found["missing"]:
    try:
        TRIAL
    except BaseException as error:
        found["failed"] = (type(error).__name__ + ": " + str(error))[:200]
print("\\nheadbench-probe " + json.dumps(found))
"""

_DEVICES = """
import ctypes
driver, count = ctypes.CDLL("libcuda.so.1"), ctypes.c_int()
print("headbench-devices", 0 if driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)) else count.value)
"""


@dataclass(frozen=True)
class Repository:
    """Description of an official repository."""

    url: str

    commit: str
    """The commit that its adapter was written for."""
    scripts: tuple[str, ...]
    """Files that identify its checkout."""
    modules: tuple[str, ...]
    """Modules that its interpreter must be able to import, if it has one."""
    trial: str = ""
    """A statement that its interpreter must execute, or "", and the remedy if it fails."""
    trial_remedy: str = ""

    downloads: Mapping[str, str] = field(default_factory=dict)
    """Files that the authors distribute separately and expect in the checkout, with their sources."""


@dataclass(frozen=True)
class Checkout:
    """A validated checkout."""

    folder: Path

    python: tuple[str, ...]
    """Command of the interpreter, or of the program if the code is a program."""
    record: dict[str, Any]
    """Commit, modified files and versions, for the avatar's record."""

    def constant(self, file: str, pattern: str, what: str) -> str:
        """First group of ``pattern`` in a source file."""
        return find_constant(self.folder, file, pattern, what)


def find_constant(folder: Path, file: str, pattern: str, what: str) -> str:
    """A value in a source file of a checkout; see `Checkout.constant`."""
    path = folder / file
    match = re.search(pattern, read_bytes(path, "a source file").decode(errors="replace"))
    if match is None:
        remedy = "Check out the commit that the adapter was written for."
        raise InputError(path, what, f"a line like {pattern}", "none", remedy)
    return match[1]


Environment = tuple[tuple[str, ...], dict[str, Any]]
"""Command that runs the code of a checkout, and versions for the avatar's record."""


def inspect_interpreter(
    method: str, config: OfficialConfig, repository: Repository, *, shim: bool = True
) -> Environment:
    """Command and versions of the interpreter; see `inspect_checkout`. ``shim``: whether the CPU shim supports the code."""
    python = _interpreter(method, config)
    if config.device != "cuda":
        needed = tuple(name for name in repository.modules if not {name, name.partition(".")[0]} & {*SHIMMED})
        repository = replace(repository, modules=(*needed, SHIM), trial="")
    return python, _probed(method, python, repository, cuda=config.device == "cuda", shim=shim)


def inspect_program(method: str, config: INSTAOfficialConfig, repository: Repository) -> Environment:
    """Command and version of the program built in the checkout; also checks for a GPU; see `inspect_checkout`."""
    source = f"settings.{method}.program"
    words = _words(config.program)
    if not words:
        raise InputError(source, "", "the program that was built", repr(config.program)[:80])
    if not config.checkout:
        raise InputError(f"settings.{method}", "checkout", "the folder that the program was built in", "none")
    inside = Path(config.checkout).expanduser().resolve() / words[0]
    built = f"Build it as {repository.url} says: cmake . -B build && cmake --build build -j, in the checkout."
    program = shutil.which(inside if len(words) == 1 else os.path.expanduser(words[0]))
    if program is None:
        raise InputError(
            inside if len(words) == 1 else words[0], source, "a program that can be run", "none", built
        )
    command = (str(Path.cwd() / program), *words[1:])
    kind = "a program of this machine"
    said, _ = _answer([*command, "--version"], source, kind)
    match = re.search(r"neural graphics primitives version (\S{1,40})", said)
    if match is None:
        found = " ".join(said.split())[-200:] or "no answer"
        raise InputError(program, source, "the answer of the authors' program to --version", found, built)
    counted, _ = _answer([sys.executable, "-c", _DEVICES], source, kind)
    devices = re.search(r"headbench-devices (\d+)", counted)
    if devices is None or devices[1] == "0":
        remedy = "Run it on a machine with an NVIDIA GPU."
        raise InputError(program, source, "a CUDA device, by NVIDIA's driver", "none", remedy)
    return command, {"program": f"instant-ngp {match[1]}"}


def _words(command: str) -> list[str]:
    """Split a command into words; empty if a quotation mark is not closed."""
    try:
        return shlex.split(command)
    except ValueError:
        return []


def _answer(
    command: Sequence[str], source: str, kind: str, errors: int = subprocess.STDOUT, remedy: str = ""
) -> tuple[str, str]:
    """Output of a command run for at most `PROBE_S` and, if ``errors`` separates it, its stderr."""
    try:
        done = subprocess.run(
            command,
            check=False,
            stdout=subprocess.PIPE,
            stderr=errors,
            stdin=subprocess.DEVNULL,
            timeout=PROBE_S,
            env=environment(),
            start_new_session=True,
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(command[0], source, f"an answer within {PROBE_S:g} s", "none", remedy) from error
    except OSError as error:
        raise InputError(command[0], source, kind, error.strerror or str(error)) from error
    return done.stdout.decode(errors="replace"), (done.stderr or b"").decode(errors="replace")


def inspect_checkout(
    method: str,
    config: OfficialConfig,
    repository: Repository,
    environment: Callable[[], Environment] | None = None,
) -> Checkout:
    """Check the settings of a method: folder, commit, interpreter or program, importable modules, and GPU.

    ``environment`` checks what runs the code; None uses `inspect_interpreter`.
    """
    folder, record = inspect_folder(method, config, repository)
    python, versions = environment() if environment else inspect_interpreter(method, config, repository)
    return Checkout(folder, python, record | versions)


def inspect_folder(
    method: str, config: OfficialConfig, repository: Repository
) -> tuple[Path, dict[str, Any]]:
    """The checkout with its commit and changes; see `inspect_checkout`."""
    source, commit = f"settings.{method}", config.commit
    made = f" and --set {source}.python=PYTHON of an environment made" if repository.modules else ", built"
    remedy = (
        f"git clone --recursive {repository.url} DIR && git -C DIR checkout {repository.commit[:12]}; then --set "
        f"settings.{method}.checkout=DIR{made} as its installation page says (methods/official/README.md)."
    )
    if not config.checkout:
        raise InputError(source, "checkout", f"the folder of a checkout of {repository.url}", "none", remedy)
    folder = Path(config.checkout).expanduser().resolve()
    if not folder.is_dir():
        raise InputError(folder, f"{source}.checkout", "a folder", "no such folder", remedy)
    missing = [name for name in repository.scripts if not (folder / name).is_file()]
    if missing:
        expected = f"a checkout of {repository.url}, with {', '.join(repository.scripts)}"
        raise InputError(folder, f"{source}.checkout", expected, f"none of {', '.join(missing)}", remedy)
    for name, where in repository.downloads.items():
        if not (folder / name).is_file():
            raise InputError(folder / name, f"{source}.checkout", "a file that the code reads", "none", where)
    if commit and not re.fullmatch(rf"[0-9a-f]{{{SHORTEST_COMMIT},40}}", commit):
        expected = f"{SHORTEST_COMMIT} to 40 digits of a commit, or nothing"
        raise InputError(source, "commit", expected, repr(commit)[:60])
    found, changed = _commit(folder)
    if commit and not found.startswith(commit):
        what = "a folder that is not a git checkout" if not found else f"commit {found[:12]}"
        step = (
            f"git -C {folder} checkout {commit[:12]}, or --set settings.{method}.commit={found[:12] or chr(39) * 2} "
            "to use this commit, which results then name."
        )
        raise InputError(folder, f"{source}.commit", f"commit {commit[:12]}", what, step)
    return folder, {"repository": repository.url, "commit": found, **changed}


def _commit(folder: Path) -> tuple[str, dict[str, Any]]:
    """Commit of a checkout ("" without one), and its modified files."""
    top = _git(folder, "rev-parse", "--show-toplevel").strip()
    if not top or Path(top).resolve() != folder:
        return "", {}
    commit = _git(folder, "rev-parse", "HEAD").strip()
    compare = ("diff", "--no-ext-diff", "--no-textconv", "--ignore-submodules", "HEAD")
    difference = _git(folder, *compare)
    if not difference:
        return commit, {"changed": []}
    changed = _git(folder, *compare, "--name-only").split("\n")
    digest = hashlib.sha256(difference.encode()).hexdigest()
    return commit, {"changed": [name for name in changed if name][:40], "difference": digest}


def _git(folder: Path, *arguments: str) -> str:
    """Output of git, "" if it fails. Programs named in the checkout's configuration are not run."""
    safe = ("-c", "core.fsmonitor=false", "-c", f"safe.directory={folder}")
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *safe, *arguments],
            check=False,
            capture_output=True,
            stdin=subprocess.DEVNULL,
            timeout=60,
            env=environment({"GIT_OPTIONAL_LOCKS": "0"}),
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.decode(errors="replace") if done.returncode == 0 else ""


def _interpreter(method: str, config: OfficialConfig) -> tuple[str, ...]:
    source = f"settings.{method}"
    if config.device != "cuda" and not config.python:
        return (sys.executable,)
    remedy = f"--set settings.{method}.python=/path/to/environment/bin/python, or a command that starts one."
    words = _words(config.python)
    if not words:
        found = repr(config.python)[:80] if config.python else "none"
        raise InputError(source, "python", "the interpreter that the checkout's code runs in", found, remedy)
    program = shutil.which(
        os.path.expanduser(words[0])
    )  # a Path would lose the ./ that distinguishes a file from a name
    if program is None:
        raise InputError(
            words[0], f"{source}.python", "a program that can be run", "none of that name", remedy
        )
    # Not resolved: the interpreter of a virtual environment is a link, whose location identifies the environment.
    absolute = Path(program) if Path(program).is_absolute() else Path.cwd() / program
    return (str(absolute), *words[1:])


def _probed(
    method: str, python: Sequence[str], repository: Repository, *, cuda: bool, shim: bool
) -> dict[str, Any]:
    """Versions of the interpreter, if it can import what the code needs."""
    source, kind = f"settings.{method}.python", "a Python interpreter"
    command = [*python, "-c", _PROBE.replace("TRIAL", repository.trial or "pass"), *repository.modules]
    said, failed = _answer(command, source, kind, subprocess.PIPE, "Try it by hand: import torch.")
    lines = (line for line in said.split("\n") if line.startswith("headbench-probe "))
    answer = next((line.partition(" ")[2] for line in lines), None)
    if answer is None:
        raise InputError(python[0], source, kind, failed.strip()[-200:] or "no answer")
    found = checked(parse_json(answer, python[0], source), _Probed, python[0])
    if found.missing:
        name, why = next(iter(found.missing.items()))
        expected = f"an interpreter that imports {', '.join(repository.modules)}"
        remedy = f"Install {', '.join(found.missing)} as {repository.url} says (methods/official/README.md)."
        raise InputError(python[0], source, expected, f"{name}: {why}", remedy)
    if found.failed:
        expected = f"that {repository.trial} works"
        raise InputError(python[0], source, expected, found.failed, repository.trial_remedy)
    if cuda and found.cuda is False:
        remedy = "Run it on a machine with an NVIDIA GPU and a CUDA build of PyTorch"
        remedy += f", or with headbench's renderer: --set settings.{method}.device=cpu-shim." if shim else "."
        raise InputError(python[0], source, "PyTorch that finds a CUDA device", "none", remedy)
    return {"python": found.python, "torch": found.torch}


@dataclass(frozen=True)
class _Probed:
    """Output of the interpreter."""

    python: str
    missing: dict[str, str]
    failed: str
    torch: str | None = None
    cuda: bool | None = None

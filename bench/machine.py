"""What machine and software a number was measured with."""

from __future__ import annotations

import csv
import os
import platform
import resource
import shutil
import subprocess
import sys
import threading
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Self

from .errors import HeadbenchError, InputError
from .registry import resolve

OPENCV = "opencv-contrib-python-headless"
RECORDED_PACKAGES = ("headbench", "torch", "numpy", OPENCV, "scikit-image", "mitsuba")
ACCELERATOR_FIELDS = ("name", "driver_version", "memory.total", "power.limit", "clocks.sm", "clocks.max.sm")
RUSAGE_UNIT = 1 if sys.platform == "darwin" else 1024
STATUS, RESET_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def processor_count() -> int:
    """Processor cores this process may use."""
    available = getattr(os, "sched_getaffinity", None)  # not on every system
    return len(available(0)) if available else os.cpu_count() or 1


def machine_record() -> dict[str, Any]:
    """Processor, memory, system and the versions of packages that influence results."""
    import psutil

    return {
        "processor": _processor(),
        "cores": processor_count(),
        "memory_bytes": psutil.virtual_memory().total,
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in RECORDED_PACKAGES},
        "accelerators": accelerators(),
    }


def accelerators() -> list[dict[str, str]]:
    """NVIDIA devices with driver, memory, power limit and clocks, as their driver reports; none without it."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return []
    command = [program, f"--query-gpu={','.join(ACCELERATOR_FIELDS)}", "--format=csv,noheader"]
    try:
        reported = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return []
    rows = csv.reader(reported.splitlines(), skipinitialspace=True)
    return [dict(zip(ACCELERATOR_FIELDS, row)) for row in rows]


class PeakMemory:
    """Context that finds the largest resident memory of this process while it lasts.

    Linux keeps that maximum, and lets a process reset it; elsewhere a thread looks every 20 ms, which can miss a
    short spike. A child that ended meanwhile counts singly, if it was the largest so far: others are not known.

    Attributes
    ----------
    before : bytes resident when it was entered.
    peak : largest resident bytes until it was left.
    """

    def __init__(self) -> None:
        import psutil

        self.before = self.peak = 0
        self._ended = threading.Event()
        self._watcher: threading.Thread | None = None
        self._process = psutil.Process()

    def __enter__(self) -> Self:
        self._children = _children_peak()
        self.before = self.peak = self._process.memory_info().rss
        try:
            RESET_PEAK.write_text("5", encoding="ascii")
        except OSError:
            self._watcher = threading.Thread(target=self._watch, daemon=True)
            self._watcher.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._watcher is None:
            self.peak = max(self.before, _resident_peak())
        else:
            self._ended.set()
            self._watcher.join()
        children = _children_peak()
        if children > self._children:
            self.peak = max(self.peak, children)

    def _watch(self) -> None:
        while True:
            self.peak = max(self.peak, self._process.memory_info().rss)
            if self._ended.wait(0.02):
                return


def peak_memory_bytes() -> int:
    """Return the largest resident memory of this process so far, its finished children counted singly."""
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * RUSAGE_UNIT
    return max(own, _children_peak())


def processor_seconds() -> float:
    """Return the processor time of this process so far, all threads, and of its finished children."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _children_peak() -> int:
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * RUSAGE_UNIT


def _resident_peak() -> int:
    """Largest resident memory of this process since it was last reset (Linux)."""
    return int(_entry(STATUS, "VmHWM").removesuffix("kB") or 0) * 1024


def _processor() -> str:
    return _entry(Path("/proc/cpuinfo"), "model name") or platform.processor() or platform.machine()


def _entry(path: Path, name: str) -> str:
    """What a file of the kernel says of ``name`` first; "" where it is not there."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def check_device(device: str) -> None:
    """Raise `InputError` unless torch can use ``device`` ("cpu", "cuda", "cuda:1", "mps", "xpu").

    The CPU needs no question; for others torch is asked by name, as this package knows it no more than it knows methods.
    """
    kind, _, index = device.partition(":")
    if kind == "cpu":
        return
    try:
        backend: Any = resolve(f"torch:{kind}")
        available = bool(backend.is_available())
    except HeadbenchError:  # a torch that never heard of this kind, or none at all
        available = False
    if not available:
        remedy = "Use device=cpu, or install a torch and a driver that support it."
        raise InputError("device", kind, f"a device for {device!r}", "none that torch can use", remedy)
    count = int(backend.device_count())
    if index and int(index) >= count:
        raise InputError("device", device, f"a number from 0 to {count - 1}", index)

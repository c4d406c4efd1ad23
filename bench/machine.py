"""The machine and software of a measurement."""

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
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Self

from .errors import HeadbenchError, InputError, shortened
from .native.dispatch import is_cuda
from .registry import resolve
from .specs import MAX_LABEL

OPENCV = "opencv-contrib-python-headless"
RECORDED_PACKAGES = ("headbench", "torch", "gsplat", "numpy", OPENCV, "scikit-image")
ACCELERATOR_FIELDS = ("name", "driver_version", "memory.total", "power.limit", "clocks.sm", "clocks.max.sm")
RUSAGE_UNIT = 1 if sys.platform == "darwin" else 1024
STATUS, RESET_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")
CGROUPS, OWN_CGROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def processor_count() -> int:
    """Number of threads for which this process has a core each, at least 1; see `processor_capacity`."""
    return max(1, int(processor_capacity()))


def processor_capacity() -> float:
    """Processor cores that this process may use: those of its affinity or, if less, the quota of its cgroups.

    The quota limits the mean over all cores, so it may be a fraction. Container engines set it (``docker run --cpus 1.5``).
    """
    names = ("cpu.max", "cpu.cfs_quota_us", "cpu.cfs_period_us")
    quotas = [int(words[0]) / int(words[1]) for words in _cgroup_limits("cpu", *names)]
    capacity = min([_allowed_cores(), *quotas])
    return int(capacity) if capacity == int(capacity) else round(capacity, 2)


def limit_threads() -> None:
    """Let OpenMP, and with it torch and the kernels, use only as many threads as the quota allows; before torch is imported."""
    if processor_count() < _allowed_cores():
        os.environ.setdefault("OMP_NUM_THREADS", str(processor_count()))


@contextmanager
def environment_variable(name: str, value: str | None) -> Iterator[None]:
    """Set an environment variable within the block, unless ``value`` is None; afterwards it is as before."""
    before = os.environ.get(name)
    if value is not None:
        os.environ[name] = value
    try:
        yield
    finally:
        if before is not None:
            os.environ[name] = before
        elif value is not None:
            del os.environ[name]


def _allowed_cores() -> int:
    available = getattr(os, "sched_getaffinity", None)  # not on every system
    return len(available(0)) if available else os.cpu_count() or 1


def _cgroup_limits(controller: str, *names: str) -> Iterator[list[str]]:
    """Words of the files ``names`` of every cgroup of this process that limits a controller; of versions 1 and 2."""
    lines = OWN_CGROUPS.read_text(encoding="utf-8").splitlines() if OWN_CGROUPS.exists() else []
    for _, controllers, group in (line.split(":", 2) for line in lines):
        if controllers and controller not in controllers.split(","):
            continue
        # In a container the path may be that outside, which does not exist here.
        place = (CGROUPS / controller if controllers else CGROUPS) / group.lstrip("/")
        for folder in (place, *place.parents):
            files = [folder / name for name in names]
            words = [word for file in files if file.is_file() for word in file.read_text("ascii").split()]
            if words and words[0].isdigit():  # no limit is "max" or -1
                yield words


def memory() -> tuple[int, int]:
    """Memory of this machine in bytes, whole and available, within the limits of cgroups less what this process uses."""
    import psutil

    limits = [int(words[0]) for words in _cgroup_limits("memory", "memory.max", "memory.limit_in_bytes")]
    whole = psutil.virtual_memory()
    own = psutil.Process().memory_info().rss
    return min([whole.total, *limits]), min([whole.available, *(limit - own for limit in limits)])


def machine_record(device: str = "cpu") -> dict[str, Any]:
    """Processor, memory and cores within the limits of cgroups, system, the versions of packages that influence results, and headbench's git commit, if any.

    For a CUDA ``device`` the entry "device" has its name, memory, compute capability, the CUDA version of
    torch, and whether matrix products and convolutions may round to TF32.
    """
    return {
        "processor": _processor(),
        "cores": processor_capacity(),
        "memory_bytes": memory()[0],
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in RECORDED_PACKAGES},
        **_commit_record(Path(__file__).parents[1]),
        "accelerators": accelerators(),
        **_device_record(device),
    }


@cache
def _commit_record(folder: Path) -> dict[str, str]:
    """The entry ``commit`` of a checkout, with "-dirty" if its files differ from it; empty for any other folder."""
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    with suppress(OSError, subprocess.SubprocessError):
        if (folder / ".git").exists():
            described = subprocess.run(command, capture_output=True, text=True, check=True, timeout=20)
            return {"commit": described.stdout.strip()}
    return {}


def _device_record(device: str) -> dict[str, Any]:
    """The entry ``device``; empty for the CPU, and if the run is described on another machine than the one
    that executes it."""
    if not is_cuda(device) or not resolve("torch:cuda").is_available():
        return {}
    use_device(device)
    properties = resolve("torch:cuda").get_device_properties(device)
    record = {
        "name": properties.name,
        "memory_bytes": properties.total_memory,
        "capability": f"{properties.major}.{properties.minor}",
        "cuda": resolve("torch:version").cuda,
    }
    return {"device": record}


def use_device(device: str) -> None:
    """Make a CUDA device the current one and turn TF32 off; no effect for other devices.

    TF32 rounds the factors of matrix products and convolutions to 10 bits of mantissa; torch lets convolutions do so.
    """
    if is_cuda(device):
        if ":" in device:  # without a number it means the current one
            resolve("torch:cuda").set_device(device)
        backends: Any = resolve("torch:backends")
        backends.cuda.matmul.allow_tf32 = False
        backends.cudnn.allow_tf32 = False


def check_device_answers(device: str) -> None:
    """Raise `HeadbenchError` if a CUDA device no longer responds, as after an illegal memory access."""
    if not is_cuda(device):
        return
    try:
        resolve("torch:cuda").synchronize(device)
    except RuntimeError as error:
        first = next(iter(str(error).splitlines()), "")
        message = f"{device} no longer responds to this process: {first}. Start the command again; finished work is kept."
        raise HeadbenchError(message) from error


def accelerators() -> list[dict[str, str]]:
    """NVIDIA devices with driver, memory, power limit and clocks, as their driver reports; empty without
    it."""
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
    """Context that measures the largest resident memory of this process and, on a CUDA device, torch's peak
    memory.

    Linux records this maximum and lets a process reset it; on other systems a thread samples memory every 20 ms, which
    can miss short peaks. For child processes that ended in the context, only the largest so far is known.

    Attributes
    ----------
    peak : int
        Largest number of resident bytes in the context.
    device_record : dict[str, Any]
        For a CUDA device ``device_memory_before_bytes`` and ``peak_device_memory_bytes``, the memory
        of this process's tensors on entry and at most; and ``tf32``, whether it was enabled on entry.
        Empty for other devices.
    """

    def __init__(self, device: str = "cpu") -> None:
        import psutil

        self.device_record: dict[str, Any] = {}
        self._device = device
        self._cuda: Any = resolve("torch:cuda") if is_cuda(device) else None

        self.before = self.peak = 0
        self._ended = threading.Event()
        self._watcher: threading.Thread | None = None
        self._process = psutil.Process()

    def __enter__(self) -> Self:
        if self._cuda is not None:
            self._cuda.reset_peak_memory_stats(self._device)
            self.device_record = {
                "device_memory_before_bytes": int(self._cuda.memory_allocated(self._device))
            }
        self._children = _children_peak()
        self.before = self.peak = self._process.memory_info().rss
        try:
            RESET_PEAK.write_text("5", encoding="ascii")
        except OSError:
            self._watcher = threading.Thread(target=self._watch, daemon=True)
            self._watcher.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._cuda is not None:
            backends = resolve("torch:backends")
            self.device_record |= {
                "peak_device_memory_bytes": int(self._cuda.max_memory_allocated(self._device)),
                "tf32": bool(backends.cuda.matmul.allow_tf32 or backends.cudnn.allow_tf32),
            }
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


SHORTEST_LOAD_S = 0.5
"""Minimum seconds for measuring the load: the system counts processor time in steps of 10 ms."""
BUSY = ("user", "nice", "system", "irq", "softirq", "steal")
"""Fields of a core's processor times in which it is busy with processes of this machine or of another guest."""


class ProcessorLoad:
    """Context that measures how many of this process's cores other processes kept busy.

    It subtracts the processor times of this process and its children from those of its cores. The load
    average would include this process, and follows a change only within a minute.

    Parameters
    ----------
    device : str
        Device of the computation, for `machine`.
    wait : bool
        Stay in the context until the load can be measured, for `SHORTEST_LOAD_S`.

    Attributes
    ----------
    machine : str
        Machine name, see `machine_name`.
    threads : int
        Threads of torch and of this package's kernels; 1 if torch is not imported.
    other_cores : float | None
        Mean number of these cores that other processes kept busy; None if the context was too short
        or the system does not report it.
    """

    def __init__(self, device: str = "cpu", *, wait: bool = False) -> None:
        self.machine, self.cores = machine_name(device), processor_capacity()
        self.threads = 1
        self.other_cores: float | None = None
        self._wait = wait

    def __enter__(self) -> Self:
        self._start = time.perf_counter()
        self._own, self._busy = _own_processor_seconds(), _busy_seconds()
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        torch = sys.modules.get("torch")
        self.threads = 1 if torch is None else int(torch.get_num_threads())
        if self._wait and kind is None:
            time.sleep(max(0.0, self._start + SHORTEST_LOAD_S - time.perf_counter()))
        # Own time is read outside of the total, so that work between the two calls is not attributed to others.
        busy, of_process = _busy_seconds(), _own_processor_seconds()
        seconds = time.perf_counter() - self._start
        if seconds >= SHORTEST_LOAD_S and self._busy is not None and busy is not None:
            others = busy - self._busy - (of_process - self._own)
            self.other_cores = round(min(max(0.0, others / seconds), self.cores), 3)

    @property
    def details(self) -> dict[str, float]:
        """The numbers for a `Measurement`; without `other_cores` if that is unknown."""
        others = {} if self.other_cores is None else {"other_cores": self.other_cores}
        return {"threads": self.threads, "cores": self.cores, **others}


def machine_name(device: str = "cpu") -> str:
    """Processor, number of usable cores and CUDA device; times are comparable only if they are equal."""
    cores = processor_capacity()
    name = f"{_processor()} ({cores} core{'s' * (cores != 1)})"
    record = _device_record(device).get("device")
    return shortened(name if record is None else f"{record['name']}, {name}", MAX_LABEL - 10)


def _own_processor_seconds() -> float:
    """Processor time of this process and of its finished and running children."""
    import psutil

    seconds = processor_seconds()
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):  # it may have ended already
            times = child.cpu_times()
            seconds += times.user + times.system
    return seconds


def _busy_seconds() -> float | None:
    """Total busy time of the cores that this process may use; None if the system does not report it."""
    import psutil

    cores = psutil.cpu_times(percpu=True)
    if not any(sum(core) for core in cores):
        return None
    available = getattr(os, "sched_getaffinity", None)
    allowed = available(0) if available else range(len(cores))
    # If some cores are offline, positions do not identify cores: use all.
    chosen = [cores[index] for index in allowed] if max(allowed) < len(cores) else cores
    return float(sum(getattr(core, name, 0.0) for core in chosen for name in BUSY))


def peak_memory_bytes() -> int:
    """Return the peak resident memory so far of this process or of any single finished child."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * RUSAGE_UNIT
    return max(peak, _children_peak())


def processor_seconds() -> float:
    """Return the processor time so far of all threads of this process and of its finished children."""
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
    """The first value of ``name`` in a kernel file; "" if it is missing."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def check_device(device: str) -> None:
    """Raise `InputError` unless torch can use ``device`` ("cpu", "cuda", "cuda:1", "mps", "xpu").

    "cpu" is always accepted; others are checked by torch, since this package has no list of device kinds.
    """
    kind, _, index = device.partition(":")
    if kind == "cpu":
        return
    try:
        backend: Any = resolve(f"torch:{kind}")
        available = bool(backend.is_available())
    except HeadbenchError:  # torch does not know this kind or is not installed
        available = False
    if not available:
        remedy = "Use device=cpu, or install a torch and a driver that support it."
        raise InputError("device", kind, f"a device for {device!r}", "none that torch can use", remedy)
    count = int(backend.device_count())
    if index and int(index) >= count:
        raise InputError("device", device, f"a number from 0 to {count - 1}", index)

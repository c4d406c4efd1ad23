"""Peak memory against allocations of known size; devices against a driver of our own."""

import os
import subprocess
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import psutil
import pytest
import torch

from headbench.bench import machine
from headbench.bench.errors import HeadbenchError, InputError
from headbench.bench.machine import (
    PeakMemory,
    ProcessorLoad,
    accelerators,
    check_device,
    check_device_answers,
    machine_record,
    use_device,
)

MB = 1_000_000


@pytest.mark.parametrize("system_keeps_it", [True, False])
def test_the_peak_is_that_of_what_was_allocated_meanwhile(monkeypatch, tmp_path, system_keeps_it):
    if not system_keeps_it:
        monkeypatch.setattr(machine, "RESET_PEAK", tmp_path / "no folder" / "clear_refs")
    elif not os.access(machine.RESET_PEAK, os.W_OK):
        pytest.skip("this system does not let a process reset its peak")
    earlier = np.ones(400 * MB // 8)
    del earlier
    with PeakMemory() as memory:
        spike = np.ones(200 * MB // 8)
        if not system_keeps_it:
            memory._ended.wait(0.2)  # nobody else sets it: gives the watching thread its turn
        del spike
    assert 180 * MB < memory.peak - memory.before < 320 * MB


@pytest.mark.parametrize(
    ("busy", "own", "wait", "expected"),
    [
        ((10.0, 11.5), (3.0, 3.5), True, 1.0),
        ((10.0, 10.5), (3.0, 3.6), True, 0.0),  # the system counts in steps
        ((10.0, 99.0), (3.0, 3.5), True, 2.0),  # no more than there are
        ((None, None), (3.0, 3.5), True, None),
        ((10.0, 11.5), (3.0, 3.5), False, None),  # too short to tell
    ],
)
def test_the_load_is_what_cores_worked_less_the_own_time(monkeypatch, busy, own, wait, expected):
    now = iter([100.0, 100.1, 101.0] if wait else [100.0, 100.2])
    waited = []
    monkeypatch.setattr(machine.time, "perf_counter", lambda: next(now))
    monkeypatch.setattr(machine.time, "sleep", waited.append)
    monkeypatch.setattr(machine, "processor_capacity", lambda: 2)
    for name, values in (("_busy_seconds", iter(busy)), ("_own_processor_seconds", iter(own))):
        monkeypatch.setattr(machine, name, lambda values=values: next(values))
    with ProcessorLoad(wait=wait) as load:
        pass
    assert load.other_cores == expected
    assert ("other_cores" in load.details) == (expected is not None)
    assert waited == ([pytest.approx(0.4)] if wait else [])
    assert (load.threads, load.cores) == (torch.get_num_threads(), 2)


QUOTA, PERIOD = "cpu.cfs_quota_us", "cpu.cfs_period_us"


@pytest.mark.parametrize(
    ("own", "files", "capacity", "threads", "memory"),
    [
        ("0::/", {}, 8, 8, None),
        ("0::/", {"cpu.max": "100000 100000", "memory.max": "max"}, 1, 1, None),  # in a container, version 2
        ("0::/", {"cpu.max": "max 100000", "memory.max": "4096"}, 8, 8, 4096),
        ("0::/", {"cpu.max": "150000 100000"}, 1.5, 1, None),
        ("0::/", {"cpu.max": "25000 50000"}, 0.5, 1, None),
        ("0::/", {"cpu.max": "1600000 100000"}, 8, 8, None),  # more than the affinity
        # The least of the own group and those above it.
        (
            "0::/a.slice/b",
            {"a.slice/cpu.max": "200000 100000", "a.slice/b/cpu.max": "300000 100000"},
            2,
            2,
            None,
        ),
        ("3:cpuset:/\n2:cpu,cpuacct:/", {f"cpu/{QUOTA}": "-1", f"cpu/{PERIOD}": "100000"}, 8, 8, None),
        # Version 1, with the path on the host, which the container does not have.
        (
            "2:cpu,cpuacct:/docker/1\n1:memory:/docker/1\n0::/",
            {f"cpu/{QUOTA}": "50000", f"cpu/{PERIOD}": "25000", "memory/memory.limit_in_bytes": "8192"},
            *(2, 2, 8192),
        ),
    ],
)
def test_quotas_of_cgroups_limit_cores_and_memory(
    monkeypatch, tmp_path, own, files, capacity, threads, memory
):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    monkeypatch.setattr(machine, "CGROUPS", tmp_path)
    monkeypatch.setattr(machine, "OWN_CGROUPS", tmp_path / "own")
    monkeypatch.setenv("OMP_NUM_THREADS", "")  # so that it is as before at the end
    monkeypatch.delenv("OMP_NUM_THREADS")
    for name, text in {"own": own, **files}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"{text}\n")
    record = machine_record()
    assert (record["cores"], machine.processor_count()) == (capacity, threads)
    assert record["memory_bytes"] == (memory or psutil.virtual_memory().total)
    assert machine.machine_name().endswith(f"({capacity} core{'s' * (capacity != 1)})")
    machine.limit_threads()
    assert os.environ.get("OMP_NUM_THREADS") == (None if threads == 8 else str(threads))


def test_accelerators_are_what_the_driver_reports(monkeypatch, tmp_path):
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\necho 'Abacus 9, 550.1, 9 MiB, 700.00 W, 345 MHz, 1980 MHz'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    (found,) = accelerators()
    assert (found["name"], found["driver_version"], found["power.limit"]) == ("Abacus 9", "550.1", "700.00 W")
    assert machine_record()["accelerators"] == [found]
    program.write_text("#!/bin/sh\nexit 9\n")
    assert accelerators() == []


@pytest.mark.parametrize("kind", ["cuda", "mps", "xpu"])
def test_a_device_that_is_not_there_is_refused(monkeypatch, kind):
    check_device("cpu")
    monkeypatch.setattr(torch, kind, SimpleNamespace(is_available=lambda: False, device_count=lambda: 0))
    with pytest.raises(InputError, match=f"device, {kind}: expected a device.*Use device=cpu"):
        check_device(kind)
    monkeypatch.setattr(torch, kind, SimpleNamespace(is_available=lambda: True, device_count=lambda: 2))
    check_device(kind)
    check_device(f"{kind}:1")
    with pytest.raises(InputError, match="from 0 to 1, found 2"):
        check_device(f"{kind}:2")


@pytest.fixture
def pretended_gpu(monkeypatch):
    """A CUDA device as far as the record asks for one, on which tensors took 7 bytes, then 5."""
    peaks = {"cuda:1": 7}
    card = lambda device: SimpleNamespace(name=f"Abacus {device}", total_memory=9, major=9, minor=0)
    cuda = SimpleNamespace(
        is_available=lambda: True,
        set_device=lambda device: peaks.__setitem__("current", device),
        get_device_properties=card,
        reset_peak_memory_stats=lambda device: peaks.__setitem__(device, 0),
        memory_allocated=lambda device: 2,
        max_memory_allocated=lambda device: peaks[device],
        synchronize=lambda device: peaks["fault"](),
    )
    flags = {"cuda": SimpleNamespace(matmul=SimpleNamespace(allow_tf32=True))}
    backends = SimpleNamespace(**flags, cudnn=SimpleNamespace(allow_tf32=True))
    for name, value in {"cuda": cuda, "backends": backends}.items():
        monkeypatch.setattr(torch, name, value)
    return peaks


def test_the_record_tells_of_the_device(pretended_gpu):
    record = machine_record("cuda:1")
    of_gpu = {"name": "Abacus cuda:1", "memory_bytes": 9, "capability": "9.0", "cuda": torch.version.cuda}
    assert record["device"] == of_gpu
    assert pretended_gpu["current"] == "cuda:1"
    assert {"torch", "gsplat"} <= record["packages"].keys()
    assert "device" not in machine_record()


def test_the_record_has_the_commit_of_a_checkout_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "__file__", str(tmp_path / "bench" / "machine.py"))
    assert "commit" not in machine_record()
    machine._commit_record.cache_clear()
    git = ["git", "-C", str(tmp_path), "-c", "user.name=me", "-c", "user.email=me@here"]
    for words in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "first"]):
        subprocess.run([*git, *words], check=True)
    head = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout
    assert machine_record()["commit"] == head.strip()


def test_a_cuda_device_is_used_without_tf32(pretended_gpu):
    with PeakMemory("cuda:1") as memory:
        pretended_gpu["cuda:1"] = 5
    found = {"device_memory_before_bytes": 2, "peak_device_memory_bytes": 5, "tf32": True}
    assert memory.device_record == found
    for device, current, tf32 in (("cpu", None, True), ("cuda", None, False), ("cuda:1", "cuda:1", False)):
        use_device(device)  # torch refuses to make "cuda" current, without a number
        assert pretended_gpu.get("current") == current
        flags = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
        assert flags == (tf32, tf32)


def test_a_device_lost_to_this_process_is_told(pretended_gpu):
    pretended_gpu["fault"] = Mock()
    check_device_answers("cuda")
    pretended_gpu["fault"].side_effect = RuntimeError("CUDA error: illegal memory access\nCompile with")
    check_device_answers("cpu")
    with pytest.raises(HeadbenchError, match=r"illegal memory access\. Start the command again"):
        check_device_answers("cuda:1")

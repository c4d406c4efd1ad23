"""Peak memory against allocations of known size; devices against a driver of our own."""

import os
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from headbench.bench import machine
from headbench.bench.errors import InputError
from headbench.bench.machine import PeakMemory, accelerators, check_device, machine_record

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


def test_without_allocation_an_earlier_peak_does_not_count():
    earlier = np.ones(300 * MB // 8)
    del earlier
    with PeakMemory() as memory:
        pass
    assert memory.peak - memory.before < 100 * MB


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in is a shell script")
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
@pytest.mark.parametrize(
    ("count", "number", "refused"),
    [
        (0, "", r"device, {0}: expected a device.*Use device=cpu"),
        (2, "", None),
        (2, ":1", None),
        (2, ":2", "from 0 to 1, found 2"),
    ],
)
def test_a_device_that_is_not_there_is_refused(monkeypatch, kind, count, number, refused):
    backend = SimpleNamespace(is_available=lambda: count > 0, device_count=lambda: count)
    monkeypatch.setattr(torch, kind, backend)
    check_device("cpu")
    if refused is None:
        check_device(kind + number)
    else:
        with pytest.raises(InputError, match=refused.format(kind)):
            check_device(kind + number)

"""Peak memory against allocations of known size; what the driver tells against a driver of our own."""

import os
import stat
import sys

import numpy as np
import pytest

from headbench.bench import machine
from headbench.bench.machine import PeakMemory, accelerators, machine_record

MB = 1_000_000


@pytest.mark.parametrize("system_keeps_it", [True, False])
def test_the_peak_is_that_of_what_was_allocated_meanwhile(monkeypatch, tmp_path, system_keeps_it):
    if not system_keeps_it:
        monkeypatch.setattr(machine, "RESET_PEAK", tmp_path / "no folder" / "clear_refs")
    elif not os.access(machine.RESET_PEAK, os.W_OK):
        pytest.skip("this system does not let a process begin its peak anew")
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
def test_accelerators_are_what_the_driver_tells(monkeypatch, tmp_path):
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\necho 'Abacus 9, 550.1, 9 MiB, 700.00 W, 345 MHz, 1980 MHz'\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    (found,) = accelerators()
    assert (found["name"], found["driver_version"], found["power.limit"]) == ("Abacus 9", "550.1", "700.00 W")
    assert machine_record()["accelerators"] == [found]
    program.write_text("#!/bin/sh\nexit 9\n")
    assert accelerators() == []

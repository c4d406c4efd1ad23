import types

import pytest
import torch

from headbench.bench.errors import InputError
from headbench.bench.machine import check_device


def backend(available, count):
    return types.SimpleNamespace(is_available=lambda: available, device_count=lambda: count)


def test_the_processor_is_always_there(monkeypatch):
    monkeypatch.setattr(torch, "cuda", backend(False, 0))
    check_device("cpu")


def test_a_device_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setattr(torch, "cuda", backend(False, 0))
    with pytest.raises(InputError, match=r"device, cuda: expected a device.*Use device=cpu"):
        check_device("cuda")


def test_a_number_beyond_the_devices_is_refused(monkeypatch):
    monkeypatch.setattr(torch, "cuda", backend(True, 2))
    check_device("cuda")
    check_device("cuda:1")
    with pytest.raises(InputError, match="from 0 to 1, found 2"):
        check_device("cuda:2")


@pytest.mark.parametrize("kind", ["cuda", "mps", "xpu"])
def test_every_kind_that_settings_allow_is_looked_for(monkeypatch, kind):
    monkeypatch.setattr(torch, kind, backend(False, 0))
    with pytest.raises(InputError, match=kind):
        check_device(kind)
    monkeypatch.setattr(torch, kind, backend(True, 1))
    check_device(kind)
